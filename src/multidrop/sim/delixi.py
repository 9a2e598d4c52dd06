"""Delixi 9100 and 9200, simulated: standard Modbus, and Delixi's own protocol."""

from __future__ import annotations

from multidrop.core import Message
from multidrop.sim.dialect import COMMAND, QUERY, STATE, Reason, Refusal
from multidrop.sim.memory import Cell
from multidrop.sim.powered import PoweredDrive

MOST_GAP = 10e-3  # s between two bytes; of part 3, for want of another
UNDER_VOLTAGE = 7  # fault number, POFF

BAUDRATES = (1200, 2400, 4800, 9600, 19200, 38400)  # by the codes of P04.28
MODBUS_FORMATS = ("7N2", "7E1", "7O1", "8N2", "8E1", "8O1")  # of P04.29, first ASCII, then RTU
NATIVE_FORMATS = ("8N1", "8E1", "8O1")
COMMANDS, STARTS = range(1, 5), (2, 3)  # what K = 02 may command
BY_LINE = {0: 2, 1: 1}  # P00.00 and P00.01


class SimulatedDelixi(PoweredDrive):
    """Standard Modbus: the document has no exceptions, so what cannot be done is not answered."""

    functions = (0x03, 0x06)
    codes = {}
    begins = BY_LINE

    @property
    def most_gap(self) -> float:
        return MOST_GAP

    def takes_broadcast(self, request: Message) -> bool:
        return request.function == 0x06 and request.start == 0x2000  # run commands only

    def _control(self, bits: int) -> None:
        self.run_or_stop(bits & 0x03, {0x10: 1, 0x20: -1, 0x30: -self.motor.direction}.get(bits & 0x30))

    def _format(self) -> int:
        return MODBUS_FORMATS.index(self.drive.settings.format)

    obeys = {(0x03, 0x2000): _control}
    shows = {
        (0x03, 428): lambda self: BAUDRATES.index(self.drive.settings.baudrate),
        (0x03, 429): _format,
        (0x03, 430): lambda self: self.drive.address,
    }


class SimulatedDelixiNative(PoweredDrive):
    """Delixi's own protocol: a set is answered with its copy, a query with what was asked for."""

    begins = BY_LINE

    def takes_broadcast(self, request: Message) -> bool:
        return request.function == COMMAND

    def accept(self, cell: Cell, raw: int) -> int:
        if cell.table.write == COMMAND and (raw not in COMMANDS or (raw in STARTS and self.motor.fault)):
            raise Refusal(Reason.CANNOT)
        return super().accept(cell, raw)

    def changed(self, cell: Cell) -> None:
        if cell.name == "stored_frequency":  # whichever was written last counts
            self.memory.set(self.drive.register("frequency"), self["stored_frequency"])
        super().changed(cell)

    def _command(self, number: int) -> None:
        actions = {
            1: self.motor.stop,
            2: lambda: self.motor.run(1),
            3: lambda: self.motor.run(-1),
            4: self.motor.reset,
        }
        actions[number]()

    def _state(self) -> int:
        if self.motor.fault:
            return 5 if self.motor.fault == UNDER_VOLTAGE else 4
        if not self.motor.energised:
            return 1
        return 3 if self.motor.frequency < 0 else 2

    obeys = {(COMMAND, 0): _command}
    shows = {
        (STATE, 0): _state,
        (QUERY, 428): lambda self: BAUDRATES.index(self.drive.settings.baudrate),
        (QUERY, 429): lambda self: NATIVE_FORMATS.index(self.drive.settings.format),
        (QUERY, 430): lambda self: self.drive.address,
        (QUERY, 0x0213): lambda self: int(str(self.motor.fault), 16),  # 10 is printed 00000010
    }
