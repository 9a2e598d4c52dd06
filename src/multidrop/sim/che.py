"""Simulated INVT CHE (manual, chapter 11; registers and exceptions from the CHE100 manual)."""

from __future__ import annotations

from multidrop.core import Message
from multidrop.drive.register import HOLDING
from multidrop.sim.memory import MemoryCell
from multidrop.sim.motor_drive import MotorDrive
from multidrop.sim.protocol import MODBUS, Reason, Refusal

CONTROL, SETPOINT = 0x1000, 0x2000
STARTS = range(1, 5)
FULL = 10_000  # raw setpoint for 100 %
DEVICE_CODE = 0x0101  # CHE, universal
_MODBUS_FAULTS = {1: 2, 2: 4, 3: 5, 6: 8, 0x11: 3, 0x12: 6}  # exception code: value of register 5001H


def _signed(raw: int) -> int:
    return raw - 0x10000 if raw & 0x8000 else raw


class SimulatedCHE(MotorDrive):
    """INVT CHE. The setpoint is a percentage of P0.04, the drive's option `maximum_frequency`.

    The unit of output power is 0.01 kW, as on a CHF100A; no manual of a CHE states it.

    After a write to the EEPROM the drive is busy for `storing` s. The manual does not say which command ends
    a jog or a run. Here both stop commands end a jog and a run, and a start ends a jog.
    """

    functions = (0x03, 0x06)
    needs_silence = True  # manual, section 11.5
    codes = {
        **MODBUS.codes,
        Reason.VALUE: 0x12,
        Reason.LOCKED: 0x12,
        Reason.CANNOT: 1,  # the manual uses this code also for a command during a fault
        Reason.DAMAGED: 0x11,  # manual, section 11.1: a receive error is answered with a fault frame
    }

    storing = 0.0
    _busy_until = 0.0
    _modbus_fault = 0

    def prepare(self) -> None:
        self.memory.make_readable(HOLDING, [CONTROL])

    @property
    def most_gap(self) -> float:
        return 1.5 * self.drive.settings.character  # manual, section 11.5

    def setpoint(self) -> float:
        return _signed(self.word(SETPOINT)) / FULL * self.motor.maximum_frequency

    def accept(self, cell: MemoryCell, raw: int) -> int:
        if self.now < self._busy_until:
            raise Refusal(Reason.BUSY)
        if cell.address == SETPOINT:  # the drive accepts negative setpoints, but multidrop sends none
            if not -FULL <= _signed(raw) <= FULL:
                raise Refusal(Reason.VALUE)
            return raw
        if cell.address == CONTROL and raw in STARTS and self.motor.fault:
            raise Refusal(Reason.CANNOT)
        return super().accept(cell, raw)

    def wore(self) -> None:
        self._busy_until = self.now + self.storing

    def refused(self, request: Message, code: int) -> Message:
        self._modbus_fault = _MODBUS_FAULTS.get(code, 0)
        return super().refused(request, code)

    def _state(self) -> int:
        if self.motor.fault:
            return 4
        if not self.motor.energised:
            return 3
        return 2 if self.motor.frequency < 0 else 1

    obeys = {"control": MotorDrive.carry_out_named}
    shows = {
        "status": _state,
        "output_power": lambda self: round(self.motor.power * 100),
        "device": lambda self: DEVICE_CODE,
        "fault": lambda self: self.motor.fault,
        "communication_fault": lambda self: self._modbus_fault,
    }
