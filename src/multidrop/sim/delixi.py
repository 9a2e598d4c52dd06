"""Simulated Delixi 9100 and 9200: in standard Modbus, and in Delixi's own protocol."""

from __future__ import annotations

from multidrop.core import Message
from multidrop.sim.memory import MemoryCell
from multidrop.sim.motor_drive import MotorDrive
from multidrop.sim.protocol import COMMAND, SET, STORE, Reason, Refusal

# longest silence in s within a frame; only the third part of Delixi's document states it
MOST_GAP = 10e-3
UNDER_VOLTAGE = 7  # fault number of POFF

BAUDRATES = (1200, 2400, 4800, 9600, 19200, 38400)  # indexed by P04.28
MODBUS_FORMATS = ("7N2", "7E1", "7O1", "8N2", "8E1", "8O1")  # indexed by P04.29: ASCII, then RTU
NATIVE_FORMATS = ("8N1", "8E1", "8O1")
COMMANDS, STARTS = range(1, 5), (2, 3)  # values of the run command (K = 02)
RUN_SOURCE, FREQUENCY_SOURCE = 0, 1  # P00.00 and P00.01
BY_LINE = {RUN_SOURCE: 2, FREQUENCY_SOURCE: 1}


class SimulatedDelixi(MotorDrive):
    """Delixi in standard Modbus. The manual documents no exceptions: a request that fails gets no reply.

    Assumptions beyond the document: during a fault, or unless P00.00 is 2, a run command is confirmed
    and has no effect. The setpoint is 0 unless P00.01 is 1. A start ends a jog. The longest silence
    within a frame is the one that the document's third part states for Delixi's own protocol.
    """

    functions = (0x03, 0x06)
    codes = {}
    begins = BY_LINE

    @property
    def most_gap(self) -> float:
        return MOST_GAP

    def takes_broadcast(self, request: Message) -> bool:
        return request.function == 0x06 and request.start == 0x2000  # only run commands may be broadcast

    def setpoint(self) -> float:
        by_line = self.word(FREQUENCY_SOURCE) == BY_LINE[FREQUENCY_SOURCE]
        return super().setpoint() if by_line else 0.0

    def _control(self, bits: int) -> None:
        if self.word(RUN_SOURCE) != BY_LINE[RUN_SOURCE]:
            return
        self.run_or_stop(bits & 0x03, {0x10: 1, 0x20: -1, 0x30: -self.motor.direction}.get(bits & 0x30))

    def _format(self) -> int:
        return MODBUS_FORMATS.index(self.drive.settings.format)

    obeys = {"control": _control}
    shows = {
        "baudrate_setting": lambda self: BAUDRATES.index(self.drive.settings.baudrate),
        "format_setting": _format,
        "address_setting": lambda self: self.drive.address,
    }


class SimulatedDelixiNative(MotorDrive):
    """Delixi in its own protocol: replies to writes repeat the request, replies to queries have the value.

    While `locked` is set, writes of parameters are refused with FEH. A start during a fault is refused
    with F0H. The manual does not say what happens to a run command if P00.00 is not 2; here it is
    refused with F0H. Nor does the manual say how P00.01 affects K = 04; here the setpoint that was
    written last is used. A fault number, also in the fault records, is sent as hex digits that equal its
    printed decimal digits.
    """

    begins = BY_LINE

    locked = False

    def takes_broadcast(self, request: Message) -> bool:
        return request.function == COMMAND

    def accept(self, cell: MemoryCell, raw: int) -> int:
        if cell.table.write == COMMAND:
            by_line = self.word(RUN_SOURCE) == BY_LINE[RUN_SOURCE]
            if raw not in COMMANDS or not by_line or (raw in STARTS and self.motor.fault):
                raise Refusal(Reason.CANNOT)
        elif self.locked and cell.table.write in (SET, STORE):
            raise Refusal(Reason.LOCKED)
        return super().accept(cell, raw)

    def changed(self, cell: MemoryCell) -> None:
        if cell.name == "stored_frequency":  # the setpoint that was written last applies: copy it
            self.memory.set(self.drive.register("frequency"), self["stored_frequency"])
        super().changed(cell)

    def _state(self) -> int:
        if self.motor.fault:
            return 5 if self.motor.fault == UNDER_VOLTAGE else 4
        if not self.motor.energised:
            return 1
        return 3 if self.motor.frequency < 0 else 2

    obeys = {"control": MotorDrive.carry_out_named}
    shows = {
        "status": _state,
        "baudrate_setting": lambda self: BAUDRATES.index(self.drive.settings.baudrate),
        "format_setting": lambda self: NATIVE_FORMATS.index(self.drive.settings.format),
        "address_setting": lambda self: self.drive.address,
        "fault": lambda self: _printed(self.motor.fault),
    } | {
        f"fault_record_{number}": lambda self, number=number: _printed(self.motor.fault_record(number))
        for number in range(1, 5)
    }


def _printed(fault: int) -> int:
    """Return the raw count whose hex digits are the number's decimal digits: fault 10 is 00000010H."""
    return int(str(fault), 16)
