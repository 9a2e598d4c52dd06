"""Profiles whose control word consists of bits.

CiA 402 (Schneider's Altivar, Lenze's i500) and PROFIdrive (ABB, SINAMICS) are state machines of IEC 61800-7.
The motor of a Danfoss FC, an Optidrive E3 or a Yaskawa runs as long as one bit is 1.
"""

from __future__ import annotations

from enum import IntFlag
from functools import partial
from typing import ClassVar

from multidrop.drive import Condition, Direction
from multidrop.drive.register import Access
from multidrop.drive.verbs import Script, insist, until, wait, write
from multidrop.errors import NotVerified, WriteForbidden
from multidrop.families.profiles.profile import COMMON, Profile, Role

READY_TIME = 1.0  # seconds allowed for each state change before the start word is sent


# ---- CiA 402 ----


class CiA402Control(IntFlag):
    """The control word, 6040H. Bits 0 to 3 and 7 are those of the standard; each make defines the others."""

    SWITCH_ON = 1 << 0
    ENABLE_VOLTAGE = 1 << 1
    NO_QUICK_STOP = 1 << 2
    ENABLE_OPERATION = 1 << 3
    RESET = 1 << 7  # acts on a change from 0 to 1


class CiA402Status(IntFlag):
    """The status word, 6041H. Bits 0 to 7, 9 and 10 are those of the standard."""

    READY_TO_SWITCH_ON = 1 << 0
    SWITCHED_ON = 1 << 1
    OPERATION_ENABLED = 1 << 2
    FAULT = 1 << 3
    VOLTAGE_ENABLED = 1 << 4
    NO_QUICK_STOP = 1 << 5
    SWITCH_ON_DISABLED = 1 << 6
    WARNING = 1 << 7
    REMOTE = 1 << 9
    AT_REFERENCE = 1 << 10


# control words that lead to "operation enabled", in this order
SHUTDOWN, SWITCH_ON, ENABLE = 0x0006, 0x0007, 0x000F
MASK, SHORT_MASK = 0x6F, 0x4F  # masks of the state bits: with and without the quick stop bit
# states of the status word, masked with SHORT_MASK
NOT_READY, SWITCH_ON_DISABLED, FAULT_REACTION, FAULT = 0x00, 0x40, 0x0F, 0x08
# states of the status word, masked with MASK
READY, SWITCHED_ON, ENABLED, QUICK_STOP = 0x21, 0x23, 0x27, 0x07
_UP = ((SHUTDOWN, READY, "ready to be switched on"), (SWITCH_ON, SWITCHED_ON, "switched on"))


class CiA402(Profile):
    """CiA 402: the words 6, 7, 15 start the motor, 7 stops it along the ramp, 0 lets it coast; bit 7 resets.

    - The stop is "disable operation", 0007H. With factory settings it ramps down. It never starts the motor:
      it only switches on a drive that is ready to be switched on. "Shutdown", 0006H, coasts or ramps,
      depending on a setting.
    - The reset is 0087H: bit 7 and the stop word. Because bit 3 is 0, the reset does not enable operation.
    - The standard has no direction for frequency drives. A family may declare a bit of its own,
      `bits = { reverse = 11 }`; without it a direction is refused.
    - For a start, the remote bit 9 of the status must be set: it means that the drive obeys the line.
    """

    stop_word: ClassVar[int] = SWITCH_ON
    coast_word: ClassVar[int] = 0x0000
    reset_word: ClassVar[int] = 0x0087
    trip_bits: ClassVar[int] = CiA402Status.FAULT
    running_bits: ClassVar[int] = CiA402Status.OPERATION_ENABLED
    needed_bits = ((CiA402Status.REMOTE, "does not take commands from the line"),)
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=CiA402Control,
            harmless=(coast_word, SHUTDOWN, stop_word),
            never_together=(CiA402Control.RESET | CiA402Control.ENABLE_OPERATION,),
            extra=("reverse",),
        ),
        "status": Role((Access.READING,), values=CiA402Status),
    }

    def _impossible(self, status: int) -> str:
        if status & SHORT_MASK in (NOT_READY, SWITCH_ON_DISABLED, FAULT_REACTION, FAULT):
            return ""
        known = status & MASK in (READY, SWITCHED_ON, ENABLED, QUICK_STOP)
        return "" if known else "this is not a state of CiA 402"

    def _condition(self, status: int) -> Condition:
        return Condition.DECELERATING if status & MASK == QUICK_STOP else super()._condition(status)

    def _start_word(self, direction: Direction | None, status: int) -> int:
        reverse = {member.name: int(member) for member in self.control.values or ()}.get("REVERSE", 0)
        if direction is not None and not reverse:
            raise WriteForbidden(
                f"the control word of {self.name} has no declared bit for the direction: "
                "start without a direction"
            )
        if direction is None and reverse and self._turns(status):
            raise WriteForbidden(
                f"{self.name} turns, but cannot report its direction: give a direction, forward or reverse"
            )
        return ENABLE | reverse if direction is Direction.REVERSE else ENABLE

    def _prepare(self, status: int) -> Script[None]:
        for word, state, words in _UP:
            yield from insist(self.control, self._word(word))
            if not (yield from until(partial(self._is_in, state), limit=READY_TIME)):
                why = f"the drive is not {words} after {READY_TIME:g} s"
                raise NotVerified(self.name, "the start", f"{why}; {self.remote}")

    def _is_in(self, state: int) -> Script[bool]:
        return (yield from self._status()) & MASK == state


# ---- PROFIdrive ----

# shortest pause between "ready to switch on" and the next control word, in s (ACS550-02/U2 manual, p. 246)
BETWEEN = 0.1


class ProfidriveControl(IntFlag):
    """The control word STW1 (ACS550 manual p. 209, 240; ACS355 p. 319; SINAMICS G120C p. 195)."""

    ON = 1 << 0  # 0 means OFF1, a stop along the ramp
    NO_OFF2 = 1 << 1  # 0 means OFF2, coasting
    NO_OFF3 = 1 << 2  # 0 means OFF3, a stop along the quick ramp
    ENABLE_OPERATION = 1 << 3
    ENABLE_RAMP = 1 << 4
    CONTINUE_RAMP = 1 << 5
    ENABLE_SETPOINT = 1 << 6
    RESET = 1 << 7  # acts on a change from 0 to 1
    BY_LINE = 1 << 10


class ProfidriveStatus(IntFlag):
    """The status word ZSW1 (ACS355 p. 319, ACQ550 p. 242, G120C p. 235); each make defines bits 10 to 15."""

    READY_TO_SWITCH_ON = 1 << 0
    READY_TO_OPERATE = 1 << 1
    OPERATION_ENABLED = 1 << 2
    TRIPPED = 1 << 3
    NO_OFF2 = 1 << 4
    NO_OFF3 = 1 << 5
    SWITCH_ON_INHIBITED = 1 << 6
    ALARM = 1 << 7
    AT_SETPOINT = 1 << 8
    REMOTE = 1 << 9


OFF, ON, START = 0x0476, 0x0477, 0x047F  # OFF and ON do not turn the motor: they do not enable operation


class Profidrive(Profile):
    """PROFIdrive: OFF1 stops along the ramp, OFF2 coasts, a rising bit 7 resets.

    A start follows the ACS550's manual (p. 246): 0476H until the drive is ready to be switched on, a pause of
    100 ms, 0477H until it is ready to operate, then 047FH. 0477H and 047FH are sent once each. A start is
    refused in local control, while OFF2 or OFF3 is active from another source, and while a trip or the
    power-up inhibits switching on.

    - The stop is 047EH, which only clears bit 0 (OFF1). The manual's 0476H clears bit 3 too, which would let
      the motor coast if bit 3 carries the run enable (ACS550, 1601 = COMM).
    - The direction is the sign of the reference, or a bit that differs between makes (bit 11 on a SINAMICS;
      on an ABB bit 11 selects EXT2). No negative reference is written, and a start has no direction.
    - Each make has its own jog, so none is sent.
    """

    stop_word: ClassVar[int] = 0x047E
    coast_word: ClassVar[int] = 0x047C
    reset_word: ClassVar[int] = 0x04FE
    trip_bits: ClassVar[int] = ProfidriveStatus.TRIPPED
    running_bits: ClassVar[int] = ProfidriveStatus.OPERATION_ENABLED
    needed_bits = ((ProfidriveStatus.REMOTE, "is in local control"),)
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=ProfidriveControl,
            harmless=(stop_word, coast_word, OFF),
            never_together=(ProfidriveControl.RESET | ProfidriveControl.ON,),
        ),
        "status": Role((Access.READING,), values=ProfidriveStatus),
    }

    def _impossible(self, status: int) -> str:
        inhibited = status & ProfidriveStatus.SWITCH_ON_INHIBITED
        if inhibited and status & (ProfidriveStatus.READY_TO_OPERATE | ProfidriveStatus.READY_TO_SWITCH_ON):
            return "this would be both ready to switch on and inhibited"
        if status & ProfidriveStatus.READY_TO_OPERATE and not status & ProfidriveStatus.READY_TO_SWITCH_ON:
            return "this would be ready to operate but not to switch on"
        return ""

    def _condition(self, status: int) -> Condition:
        if self._turns(status) and not status & ProfidriveStatus.READY_TO_OPERATE:
            return Condition.DECELERATING  # OFF1 is in progress, a stop along the ramp
        return super()._condition(status)

    def _start_word(self, direction: Direction | None, status: int) -> int:
        if direction is not None:
            raise WriteForbidden(
                f"the control word of {self.name} has no bit for the direction: start without a direction. "
                "The sign of the reference or the drive's settings select it"
            )
        return START

    def _prepare(self, status: int) -> Script[None]:
        yield from insist(self.control, self._word(OFF))
        if not (yield from until(self._is_ready, limit=READY_TIME)):
            why = self._hindrance((yield from self._status()))
            raise WriteForbidden(f"{self.name} is not started: {why}; {self.remote}")
        yield from wait(BETWEEN)
        yield from write(self.control, self._word(ON))
        if not (yield from until(self._is_on, limit=READY_TIME)):
            yield from insist(self.control, self._word(self.stop_word))
            why = f"the drive is not ready to operate after {READY_TIME:g} s"
            raise NotVerified(self.name, "the start", f"{why}; {self.remote}")

    def _is_ready(self) -> Script[bool]:
        status = yield from self._status()
        wanted = ProfidriveStatus.READY_TO_SWITCH_ON | ProfidriveStatus.NO_OFF2 | ProfidriveStatus.NO_OFF3
        return status & wanted == wanted and not status & ProfidriveStatus.SWITCH_ON_INHIBITED

    def _is_on(self) -> Script[bool]:
        return bool((yield from self._status()) & ProfidriveStatus.READY_TO_OPERATE)

    def _hindrance(self, status: int) -> str:
        """Return the most serious reason why the drive cannot be switched on, as text."""
        if not status & ProfidriveStatus.NO_OFF2:
            return "another source holds OFF2 (coast) active"
        if not status & ProfidriveStatus.NO_OFF3:
            return "another source holds OFF3 (quick stop) active"
        if status & ProfidriveStatus.SWITCH_ON_INHIBITED:
            return "switching on is inhibited"
        return "the drive is not ready to be switched on"


# ---- Danfoss FC ----


class DanfossControl(IntFlag):
    """The control word CTW (FC 300 design guide MG.33.B6, p. 277; FC 51 manual p. 29, coils 1 to 16)."""

    RAMP = 1 << 2  # if 0, the drive brakes with direct current
    NO_COAST = 1 << 3
    NO_QUICK_STOP = 1 << 4
    NO_FREEZE = 1 << 5
    START = 1 << 6
    RESET = 1 << 7  # takes effect when it changes from 0 to 1
    VALID = 1 << 10
    REVERSE = 1 << 15


class DanfossStatus(IntFlag):
    """The status word STW (MCA 121 instructions, FC profile, p. 24; FC 51 p. 29; FC 101 guide table 7.16)."""

    CONTROL_READY = 1 << 0
    DRIVE_READY = 1 << 1
    NOT_COASTING = 1 << 2  # on an FC 101 this bit means "safety closed"
    TRIPPED = 1 << 3
    ERROR = 1 << 4
    TRIP_LOCKED = 1 << 6  # not used on an FC 101
    WARNING = 1 << 7
    AT_REFERENCE = 1 << 8
    BY_LINE = 1 << 9  # 1 in auto mode, in which the line commands the drive; 0 in hand mode
    IN_RANGE = 1 << 10
    RUNNING = 1 << 11
    VOLTAGE_WARNING = 1 << 13
    CURRENT_LIMIT = 1 << 14
    THERMAL_WARNING = 1 << 15


class DanfossFC(Profile):
    """Danfoss FC profile: the motor runs while bit 6 is 1; bit 15 reverses; a rising bit 7 resets.

    The VLT and iC2 drives have this control word.

    - Bit 6 acts by its level: a drive that is reset while bit 6 is set starts immediately. So a stop is
      confirmed before a reset, and no word has both bits.
    - A locked trip ends only when the mains are switched off (VT2800 guide, p. 115): the reset is refused.
    - The status shows no direction. A start without a direction goes forward from rest, and is refused while
      the motor turns. Bit 15 has an effect only if parameter 8-54 allows it.
    - Jog (bit 8), the preset references, the relays and the set-ups are not sent.
    """

    stop_word: ClassVar[int] = 0x043C
    coast_word: ClassVar[int] = 0x0434
    reset_word: ClassVar[int] = 0x04BC
    start_word: ClassVar[int] = 0x047C
    trip_bits: ClassVar[int] = DanfossStatus.TRIPPED | DanfossStatus.TRIP_LOCKED
    running_bits: ClassVar[int] = DanfossStatus.RUNNING
    needed_bits = (
        (DanfossStatus.BY_LINE, "is in hand mode, or was stopped on its keypad"),
        (DanfossStatus.CONTROL_READY, "is not ready"),
        (DanfossStatus.DRIVE_READY, "is not ready"),
    )
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=DanfossControl,
            harmless=(stop_word, coast_word),
            never_together=(DanfossControl.RESET | DanfossControl.START,),
        ),
        "status": Role((Access.READING,), values=DanfossStatus),
    }

    def _impossible(self, status: int) -> str:
        if status & DanfossStatus.RUNNING and status & DanfossStatus.TRIPPED:
            return "this would be both running and tripped"
        return ""

    def _cannot_reset(self, status: int) -> str:
        if status & DanfossStatus.TRIP_LOCKED:
            return "is trip-locked, which a reset cannot clear; switch off its mains and remove the cause"
        return ""

    def _start_word(self, direction: Direction | None, status: int) -> int:
        if direction is None and self._turns(status):
            raise WriteForbidden(
                f"{self.name} turns, but cannot report its direction: give a direction, forward or reverse"
            )
        return self.start_word | (DanfossControl.REVERSE if direction is Direction.REVERSE else 0)


# ---- Optidrive E3 ----


class OptidriveControl(IntFlag):
    """The control word, register 1 (ODE-3 user guide 1.00, p. 33). An Optidrive Plus swaps bits 1 and 2."""

    RUN = 1 << 0
    RESET = 1 << 2
    COAST = 1 << 3


class OptidriveStatus(IntFlag):
    """The status, low byte of register 6 (E3 advanced manual, issue 05, p. 35; E3 IP66 guide 1.25, p. 48)."""

    RUNNING = 1 << 0
    TRIPPED = 1 << 1
    STANDBY = 1 << 5
    READY = 1 << 6


OPTIDRIVE_RESERVED = 0x9C  # bits 2, 3, 4 and 7 of the low byte


class Optidrive(Profile):
    """Optidrive E3: the motor runs while bit 0 of the control word is 1; bit 2 resets, bit 3 coasts.

    Its maker is Invertek; it is also sold under other names.

    - On an Optidrive Plus 3GV, bit 1 is the reset, and bit 2 selects the second ramp. Bit 1 is never sent.
    - The first edition of the guide (1.00) prints the two bytes of register 6, the status, in the opposite
      order to later editions. A start needs bit 6 (ready). Drives with the opposite order never set it, so
      they are never started. A drive counts as stopped only if its output frequency is 0.
    - No guide says whether the reset bit acts on its edge. So a stop is sent before the reset, and the bit
      is cleared after it.
    - The direction is the sign of the setpoint. No negative setpoint is written.
    """

    stop_word: ClassVar[int] = 0x0000
    coast_word: ClassVar[int] = 0x0008
    reset_word: ClassVar[int] = 0x0004
    start_word: ClassVar[int] = 0x0001
    trip_bits: ClassVar[int] = OptidriveStatus.TRIPPED
    running_bits: ClassVar[int] = OptidriveStatus.RUNNING
    needed_bits = ((OptidriveStatus.READY | OptidriveStatus.RUNNING, "is not ready to run"),)
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=OptidriveControl,
            harmless=(stop_word, coast_word),
            never_together=(OptidriveControl.RESET | OptidriveControl.RUN,),
        ),
        "status": Role((Access.READING,), values=OptidriveStatus),
    }

    def _impossible(self, status: int) -> str:
        return "its reserved bits are set" if status & OPTIDRIVE_RESERVED else ""

    def _fault(self) -> Script[str]:
        """Return the trip code in the status's high byte, named if the family has a register `fault`."""
        named = yield from super()._fault()
        return named or f"code {(yield from self._status()) >> 8}"

    def _start_word(self, direction: Direction | None, status: int) -> int:
        if direction is not None:
            raise WriteForbidden(
                f"the control word of {self.name} has no bit for the direction: start without a direction"
            )
        return self.start_word


# ---- Yaskawa ----


class YaskawaControl(IntFlag):
    """The control word 0001H (A1000 manual SIEP C710616 27G, p. 559). Bit 2, external fault, is not sent."""

    FORWARD = 1 << 0
    REVERSE = 1 << 1
    RESET = 1 << 3


class YaskawaStatus(IntFlag):
    """The status 004BH, monitor U1-12 (A1000 technical manual SIEP C710616 27C, p. 494)."""

    RUNS = 1 << 0
    ZERO_SPEED = 1 << 1
    REVERSE = 1 << 2
    RESETTING = 1 << 3
    AT_REFERENCE = 1 << 4
    READY = 1 << 5
    ALARM = 1 << 6
    FAULT = 1 << 7
    PARAMETER_ERROR = 1 << 8
    POWER_LOSS = 1 << 9
    SECOND_MOTOR = 1 << 10
    REFERENCE_BY_LINE = 1 << 14
    COMMANDED_BY_LINE = 1 << 15


class Yaskawa(Profile):
    """Yaskawa: bit 0 runs the motor forward, bit 1 in reverse, while the bit is 1; bit 3 resets.

    The A1000, V1000 and other drives of the 1000 series have these registers.

    - Bits 0 and 1 are those of H5-12 = 0, the factory setting. With H5-12 = 1 bit 1 is the direction, and a
      start in reverse has no effect: `start` raises NotVerified.
    - No control word lets the motor coast, and no jog is sent.
    - A status of 0 is impossible: the bit "zero speed" is set at rest, the bit "during run" otherwise.
    - Bit 15 of the status says that the drive takes its commands from the line; a start requires it.
    """

    stop_word: ClassVar[int] = 0
    reset_word: ClassVar[int] = YaskawaControl.RESET
    trip_bits: ClassVar[int] = YaskawaStatus.FAULT
    running_bits: ClassVar[int] = YaskawaStatus.RUNS
    needed_bits = (
        (YaskawaStatus.COMMANDED_BY_LINE, "does not take commands from the line"),
        (YaskawaStatus.READY | YaskawaStatus.RUNS, "is not ready"),
    )
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=YaskawaControl,
            harmless=(stop_word,),
            never_together=(
                YaskawaControl.RESET | YaskawaControl.FORWARD,
                YaskawaControl.RESET | YaskawaControl.REVERSE,
                YaskawaControl.FORWARD | YaskawaControl.REVERSE,
            ),
        ),
        "status": Role((Access.READING,), values=YaskawaStatus),
    }

    def _impossible(self, status: int) -> str:
        if status & YaskawaStatus.RUNS and status & YaskawaStatus.FAULT:
            return "this would be both running and in a fault"
        return "" if status else "no bit is set"

    def _direction(self, status: int) -> Direction | None:
        return Direction.REVERSE if status & YaskawaStatus.REVERSE else Direction.FORWARD

    def _start_word(self, direction: Direction | None, status: int) -> int:
        return YaskawaControl.REVERSE if self._reverses(direction, status) else YaskawaControl.FORWARD
