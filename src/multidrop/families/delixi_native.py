"""Delixi inverters that use the maker's own ASCII protocol."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from multidrop.drive import Framing, NotVerified, WriteForbidden
from multidrop.drive.register import Carrier, Kept, Register, Table, command, reading, setting
from multidrop.drive.script import Script, insist, read, write
from multidrop.drive.state import Condition, Direction, State
from multidrop.drive.verbs import verb
from multidrop.families.delixi_parameters import KEYPAD, DelixiParameters, parameter

COMMAND = Table("run command", None, 0x02, Carrier.NUMBER, Kept.RAM)
STATE = Table("run state", 0x03, None, Carrier.NUMBER)
SETPOINT = Table("run setpoint", None, 0x04, Carrier.LONG, Kept.RAM)
PARAMETER_RAM = Table("parameter, not stored", 0x07, 0x05, Carrier.LONG, Kept.RAM)
PARAMETER = Table("parameter", 0x07, 0x06, Carrier.LONG, Kept.EEPROM)


class DelixiNativeControl(IntEnum):
    STOP = 1
    FORWARD = 2
    REVERSE = 3
    RESET_FAULT = 4


class DelixiNativeStatus(IntEnum):
    STOPPED = 1
    FORWARD = 2  # the document prints 2 as "FWD (stopped)", 3 as "REV (stopped)"
    REVERSE = 3
    FAULT = 4
    UNDERVOLTAGE = 5


class DelixiNativeFormat(IntEnum):
    """Values of P04.29, the character format, in firmware for Delixi's own protocol."""

    N81 = 0
    E81 = 1
    O81 = 2


class DelixiNative(DelixiParameters, table=PARAMETER):
    """Delixi inverters; RS-485 communication protocol, part 3, Modbus-like ASCII format.

    Each function code K has its own table: 02 run command, 03 run state, 04 run setpoint (RAM), 05 and 06
    parameters (05 writes to RAM, 06 to EEPROM), 07 read parameters. Declare your own parameters in a
    subclass, such as `setting(parameter(0, 17), "s", table=PARAMETER_RAM)`. The table determines the memory:
    06 writes to EEPROM, and 02, 04 and 05 do not.

    Where the document errs or is silent, the safest interpretation applies:

    - The replies 0002 and 0003 to K = 03 are printed as "forward (stopped)" and "reverse (stopped)". They
      count as running, and are never reported as stopped.
    - The faults 10 to 14 are printed as if in hex, so 0AH-0EH and 10H-14H are both decoded as these faults.
      Any other code except 0 is a fault too.
    - "K = FOH" is F0H, "3800" bit/s is 4800, and "<80m" is 80 ms.
    - Which value of P00.01 makes the drive use the setpoint of K = 04 is not stated.
    - K = 03 may report a fault or undervoltage while P05.31 is 0. What a run command does then is not stated
      (it may wait for the mains), so `start` is refused, as in any unexplained state.
    - The checksum does not detect swapped bytes, so a reply is compared with its request field by field.
    - K = F0 to FF occur only in a drive's replies, so they are never sent.

    Less than 10 ms may pass between two characters. Only run commands (K = 02) may be broadcast.
    """

    model = "delixi-native"
    title = "Delixi (own protocol)"
    manual = "Delixi inverters, RS-485 communication protocol, part 3, Modbus-like ASCII format"

    framings = (Framing.DELIXI,)
    formats = {Framing.DELIXI: ("8N1", "8E1", "8O1")}  # P04.29
    exceptions = {
        0xF0: "command cannot be executed",
        0xFC: "invalid parameter number",
        0xFD: "value out of limits",
        0xFE: "parameter locked",
        0xFF: "checksum error",
    }
    damaged = frozenset({0xFF})
    broadcasts = True

    control = command(
        0,
        DelixiNativeControl,
        table=COMMAND,
        broadcast=(DelixiNativeControl.STOP,),
        harmless=(DelixiNativeControl.STOP,),
        place="part 3, section 5: K = 02",
    )
    status = reading(0, DelixiNativeStatus, table=STATE, place="part 3, section 5: K = 03")
    frequency = command(
        0x0001, "Hz", step=0.01, table=SETPOINT, moves=False, place="part 3, section 5: K = 04, 0001"
    )
    pi_setpoint = command(
        0x0007, step=0.1, table=SETPOINT, moves=False, place="part 3, section 5: K = 04, 0007"
    )
    stored_frequency = setting(
        parameter(0, 2), "Hz", step=0.01, table=PARAMETER, place="P00.02", note="Used if P00.01 = 1."
    )
    format_setting = setting(
        parameter(4, 29), DelixiNativeFormat, table=PARAMETER, never=KEYPAD, place="P04.29"
    )

    @property
    def echo_probe(self) -> Register[Any]:
        """The run state. It is never 0, so its reply differs from an echo (document, part 3, section 5)."""
        return self.status

    @verb
    def identify(self) -> Script[None]:
        """Check that P04.30 is the drive's address and P04.28 its baud rate."""
        yield from self._shows_its_line()

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start at the setpoint in force.

        Without a direction, a turning motor keeps its direction, and a resting motor turns forward.
        """
        yield from self._may_start()
        status = yield from read(self.status)
        if status in (DelixiNativeStatus.FAULT, DelixiNativeStatus.UNDERVOLTAGE):
            raise self._reset_first(status.name)
        if status not in CONDITIONS:
            raise WriteForbidden(
                f"{self.name} says {int(status):04X}H in reply to K = 03, a state that the manual does not "
                f"explain"
            )
        yield from self._setpoint_in_force()
        if direction is None and status == DelixiNativeStatus.REVERSE:
            direction = Direction.REVERSE
        word = DelixiNativeControl.REVERSE if direction is Direction.REVERSE else DelixiNativeControl.FORWARD
        yield from write(self.control, word)
        yield from self._started(direction)

    @verb
    def stop(self) -> Script[None]:
        """Stop. The motor counts as stopped when neither run state nor output frequency shows a run."""
        yield from insist(self.control, DelixiNativeControl.STOP)
        yield from self._stopped(self._stands, self._limit())

    def _stands(self) -> Script[bool]:
        if (yield from read(self.status)) not in (
            DelixiNativeStatus.STOPPED,
            DelixiNativeStatus.FAULT,
            DelixiNativeStatus.UNDERVOLTAGE,
        ):
            return False
        return (yield from read(self.output_frequency)) == 0

    @verb
    def reset_fault(self) -> Script[None]:
        """Reset a fault; never starts the motor. The command is sent once, then verified."""
        if (yield from read(self.status)) in CONDITIONS and not (yield from self._stands()):
            raise WriteForbidden(f"{self.name} runs: it has no fault to reset")
        yield from write(self.control, DelixiNativeControl.RESET_FAULT)
        status = yield from read(self.status)
        if status in (DelixiNativeStatus.FAULT, DelixiNativeStatus.UNDERVOLTAGE):
            fault = self.fault.in_words((yield from read(self.fault)))
            raise NotVerified(self.name, "the fault reset", f"the fault remains: {fault}")

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint to RAM; it cannot be read back."""
        yield from self._hold(self.frequency, hz)

    @verb
    def state(self) -> Script[State]:
        """Return the run state with its direction, and the fault by name."""
        status = yield from read(self.status)
        if status in CONDITIONS:
            condition, direction = CONDITIONS[status]
            still = condition is Condition.RUNNING and (yield from read(self.output_frequency)) == 0
            return State(condition, direction, note="output frequency 0" if still else "")
        if status in (DelixiNativeStatus.FAULT, DelixiNativeStatus.UNDERVOLTAGE):
            fault = yield from read(self.fault)
            return State(
                Condition.FAULT, fault=self.fault.in_words(fault) if fault else self.status.in_words(status)
            )
        return State(Condition.UNKNOWN, note=f"K = 03 says {int(status):04X}H, which is not explained")


CONDITIONS = {
    DelixiNativeStatus.STOPPED: (Condition.STOPPED, None),
    DelixiNativeStatus.FORWARD: (Condition.RUNNING, Direction.FORWARD),
    DelixiNativeStatus.REVERSE: (Condition.RUNNING, Direction.REVERSE),
}
