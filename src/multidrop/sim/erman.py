"""Simulated ERMAN ER-G-220-01(02) (Modbus manual v1.4, sections 5 to 8)."""

from __future__ import annotations

from multidrop.core import Message
from multidrop.drive.register import COIL
from multidrop.sim.motor import Phase
from multidrop.sim.motor_drive import MotorDrive
from multidrop.sim.protocol import Reason

COILS = range(13)  # including reserved coils, 3 to 8 and 10 to 12
STOP, EMERGENCY_STOP = 1, 2
EMERGENCY_STOPPED = 1 << 0  # bit of the register for the last fault
OVERLOADED = 1 << 5  # bit of the register for the state
_STATES = {Phase.STOPPED: 0, Phase.CONSTANT: 1, Phase.ACCELERATING: 2, Phase.DECELERATING: 3}


class SimulatedERMAN(MotorDrive):
    """ERMAN. Coils keep their state; writing START on starts the motor unless a stop coil is on.

    The manual leaves three points open. It does not say whether a coil is a level or a pulse. Here clearing
    START also stops the motor, and neither clearing a stop coil nor a reset starts it. It does not say when
    the motor is overloaded: here above 1.2 times its rated current. It does not say whether the drive obeys
    commands from the line if b.001 is not 2: here it obeys them.
    """

    functions = (0x01, 0x03, 0x04, 0x05, 0x06, 0x08, 0x0F, 0x10)
    # All examples in the manual have 03 for an invalid address; the table in section 5 has another code.
    codes = {
        Reason.FUNCTION: 1,
        Reason.READ_ADDRESS: 3,
        Reason.WRITE_ADDRESS: 3,
        Reason.COUNT: 3,
    }

    def prepare(self) -> None:
        self.memory.make_readable(COIL, COILS)
        self.memory.make_writable(COIL, COILS)

    def takes_broadcast(self, request: Message) -> bool:
        return True  # section 6 allows every request to address 0

    def _start(self, on: int) -> None:
        if not on:
            self.motor.stop()
        elif not (self._coil(STOP) or self._coil(EMERGENCY_STOP)):
            self.motor.run()

    def _stop(self, on: int) -> None:
        if on:
            self.motor.stop()

    def _emergency_stop(self, on: int) -> None:
        if on:
            self.trip(EMERGENCY_STOPPED)

    def _reset(self, on: int) -> None:
        if on:
            self.motor.reset()

    def _coil(self, address: int) -> int:
        cell = self.memory.writable(0x05, address)
        return cell.raw if cell else 0

    def _state(self) -> int:
        overloaded = self.motor.current > 1.2 * self.motor.rating.current
        return _STATES[self.motor.phase] | (OVERLOADED if overloaded else 0)

    obeys = {
        "start_coil": _start,
        "stop_coil": _stop,
        "emergency_stop_coil": _emergency_stop,
        "fault_reset_coil": _reset,
    }
    shows = {
        "status": _state,
        "last_fault": lambda self: self.motor.fault_record(1),  # not cleared by a reset
    }
