"""Profiles whose control word is a code: Delta's words, and the words 1 to 8 of INVT and Inovance.

Several makes have copied these words; some exchange INVT's 5 (stop) and 6 (coast).
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from enum import IntEnum, IntFlag
from typing import Any, ClassVar, cast

from multidrop.drive import Condition, Direction
from multidrop.drive.register import Access
from multidrop.drive.verbs import Script, insist, read, verb, write
from multidrop.errors import BusError, DriveException, WriteForbidden
from multidrop.families.profiles.profile import COMMON, READING, Profile, Role

# ---- Delta ----


STOPPED, STOPPING, STANDBY, RUNNING = range(4)  # Delta's status, bits 1 and 0
FORWARD, TO_FORWARD, TO_REVERSE, REVERSE = range(4)  # Delta's status, bits 4 and 3


class DeltaControl(IntEnum):
    """Control words at 2000H (CP2000 manual p. 12.1-09-8, MS300 p. 788), without the direction toggle."""

    NOTHING = 0x00
    STOP = 0x01
    FORWARD = 0x12
    REVERSE = 0x22
    JOG_FORWARD = 0x13
    JOG_REVERSE = 0x23


class DeltaReset(IntEnum):
    """The words that the library writes to 2002H: bit 1 resets a fault (MS300 manual p. 789).

    The library never sets bit 0, which causes a fault, or bit 2, which blocks the output (base block).
    """

    NOTHING = 0
    RESET = 2


class DeltaStatus(IntFlag):
    """The status word at 2101H (MS300 manual p. 790, VFD-EL-W p. 4-83 and 4-84)."""

    RUN_LAMP_0 = 1 << 0
    RUN_LAMP_1 = 1 << 1
    JOGS = 1 << 2
    REVERSE_LAMP_0 = 1 << 3
    REVERSE_LAMP_1 = 1 << 4
    REFERENCE_BY_LINE = 1 << 8
    REFERENCE_BY_TERMINAL = 1 << 9
    COMMANDED_BY_LINE = 1 << 10
    LOCKED = 1 << 11
    COPIES = 1 << 12


# Valid numbers in bits 15 to 13 of Delta's status. On a C2000 Plus they are the control mode (p. A-10).
MODES = range(5)


class Delta(Profile):
    """Delta's control words: 1 stops, 12H runs forward, 22H in reverse; a separate register resets faults.

    - The role `fault` is required, because the status shows no fault. Only its low byte is used; the high
      byte of newer drives is a warning.
    - The direction is sent with every run. The word that toggles it is never sent.
    - The bits of 2002H stay set until they are cleared. To reset a fault, the library writes 2 and then 0: a
      2 that stayed there would immediately reset a later fault. These writes also clear bit 2 (base block),
      after which a motor with a run command continues to turn. So the library sends a stop first.
    - Bit 10 of the status says that the drive takes its commands from the line; a start requires it.
    - No control word lets the motor coast.
    """

    stop_word: ClassVar[int] = DeltaControl.STOP
    reset_word: ClassVar[int] = DeltaReset.RESET
    reset_role: ClassVar[str] = "reset"
    needed_bits = ((DeltaStatus.COMMANDED_BY_LINE, "does not take commands from the line"),)
    roles = {
        **COMMON,
        "control": Role((Access.COMMAND,), values=DeltaControl, harmless=(0, DeltaControl.STOP)),
        "reset": Role((Access.COMMAND,), values=DeltaReset, harmless=()),
        "status": Role((Access.READING,), values=DeltaStatus),
        "fault": READING,
    }

    def _impossible(self, status: int) -> str:
        return "" if status >> 13 in MODES else "bits 15 to 13 are none of its modes"

    def _code(self) -> Script[int]:
        return int((yield from read(self.register("fault")))) & 0xFF

    def _tripped(self, status: int) -> Script[bool]:
        return (yield from self._code()) != 0

    def _fault(self) -> Script[str]:
        register = self.register("fault")
        code = yield from self._code()
        return register.format(register.decode(code)) if register.values is not None else f"code {code}"

    def _turns(self, status: int) -> bool:
        return status & 3 != STOPPED

    def _condition(self, status: int) -> Condition:
        return Condition.DECELERATING if status & 3 == STOPPING else super()._condition(status)

    def _direction(self, status: int) -> Direction | None:
        shown = status >> 3 & 3
        return Direction.REVERSE if shown in (TO_REVERSE, REVERSE) else Direction.FORWARD

    def _turns_in(self, direction: Direction) -> Script[bool]:
        """Return True if the motor turns in this direction, and a reversal has ended."""
        shown = (yield from self._status()) >> 3 & 3
        return shown in (FORWARD, REVERSE) and (yield from super()._turns_in(direction))

    def _start_word(self, direction: Direction | None, status: int) -> int:
        return DeltaControl.REVERSE if self._reverses(direction, status) else DeltaControl.FORWARD

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Turn slowly from rest until stopped; without a direction, forward."""
        word = yield from self._jog_word(direction, DeltaControl.JOG_FORWARD, DeltaControl.JOG_REVERSE)
        yield from write(self.control, word)
        yield from self._started(direction)

    def _take_reset_back(self) -> Script[None]:
        yield from write(self.register("reset"), DeltaReset.NOTHING)


# ---- INVT and Inovance ----


class InvtControl(IntEnum):
    """Control words at 2000H (Goodrive100 manual p. 167, Goodrive350 p. 326). A CHE has them at 1000H."""

    FORWARD = 1
    REVERSE = 2
    JOG_FORWARD = 3
    JOG_REVERSE = 4
    STOP = 5
    COAST = 6
    RESET_FAULT = 7
    STOP_JOG = 8


class InvtStatus(IntEnum):
    """Values of the status at 2100H (Goodrive300 manual)."""

    FORWARD = 1
    REVERSE = 2
    STANDBY = 3
    FAULT = 4
    POWER_OFF = 5


_DIRECTIONS: Mapping[int, Direction] = {
    InvtStatus.FORWARD: Direction.FORWARD,
    InvtStatus.REVERSE: Direction.REVERSE,
}


class Invt(Profile):
    """INVT's control words: a number for each of forward, reverse, jog, stop, coast and reset.

    - Other makes have copied these numbers with changes. Some exchange 5 (stop) and 6 (coast), and some have
      5 for reverse. Such a family states its own numbers in `control`, such as
      `{ forward = 1, stop = 6, coast = 5, reset_fault = 7 }`. A control word that it leaves out is never
      sent. Compare each of the numbers with the manual's list.
    - A stop might not end a jog. If the stop is refused, the motor still turns after it, or the state is
      unknown, STOP_JOG follows immediately. A start might not end a jog either: after a jog a stop is
      required.
    """

    stop_word: ClassVar[int] = InvtControl.STOP
    coast_word: ClassVar[int | None] = InvtControl.COAST
    reset_word: ClassVar[int] = InvtControl.RESET_FAULT
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=InvtControl,
            harmless=(InvtControl.STOP, InvtControl.COAST, InvtControl.STOP_JOG),
            renumbered=("forward", "stop", "reset_fault"),
        ),
        "status": Role((Access.READING,), values=InvtStatus),
    }

    _jogged = False  # True if this object has sent a jog and has not seen the motor at rest since

    def _impossible(self, status: int) -> str:
        return "" if status in tuple(cast(Any, self.status.values)) else "the profile has no such number"

    def _tripped(self, status: int) -> Script[bool]:
        return status == InvtStatus.FAULT
        yield

    def _turns(self, status: int) -> bool:
        return status not in (InvtStatus.STANDBY, InvtStatus.FAULT, InvtStatus.POWER_OFF)

    def _not_ready(self, status: int) -> str:
        return "has no mains" if status == InvtStatus.POWER_OFF else ""

    def _direction(self, status: int) -> Direction | None:
        return _DIRECTIONS.get(status)

    def _condition(self, status: int) -> Condition:
        return Condition.UNKNOWN if self._impossible(status) else super()._condition(status)

    def _has(self, word: InvtControl) -> bool:
        return word.name in cast(Any, self.control.values).__members__

    def _word(self, count: int, role: str = "control") -> Any:
        word = InvtControl(count)
        if not self._has(word):
            command = word.name.lower().replace("_", " ") + " command"
            raise self._unsupported(command)
        return cast(Any, self.control.values)[word.name]

    def _start_word(self, direction: Direction | None, status: int) -> int:
        return InvtControl.REVERSE if self._reverses(direction, status) else InvtControl.FORWARD

    def _check_start(self, status: int) -> Script[None]:
        yield from super()._check_start(status)
        if self._jogged and not (yield from self._is_at_rest()):
            raise self._stop_first(f"{self.name} may still be jogging, and a start might not end the jog")
        self._jogged = False

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Turn slowly from rest until stopped; without a direction, forward."""
        word = yield from self._jog_word(direction, InvtControl.JOG_FORWARD, InvtControl.JOG_REVERSE)
        self._jogged = True
        yield from write(self.control, word)
        yield from self._started(direction)

    def _stop_by(self, word: int) -> Script[None]:
        try:
            yield from self._send_stop(word)
            may_jog = self._turns((yield from self._status()))
        except WriteForbidden:  # the drive is of another family, so STOP_JOG could run its motor
            raise
        except BusError:  # a drive whose replies are lost may be jogging, and may still receive STOP_JOG
            if self._has(InvtControl.STOP_JOG):
                with suppress(BusError):
                    yield from insist(self.control, self._word(InvtControl.STOP_JOG), attempts=1)
            raise
        if may_jog and self._has(InvtControl.STOP_JOG):
            with suppress(DriveException):  # some drives refuse STOP_JOG without a jog
                yield from insist(self.control, self._word(InvtControl.STOP_JOG))
        yield from self._watch_stop()

    def _take_reset_back(self) -> Script[None]:
        """Do nothing: the drive carries out a word only once, so the reset may stay in the register."""
        yield from ()


class InovanceControl(IntEnum):
    """Control words at 2000H (Powtran PI130 manual p. 122, Inovance MD500 p. 703). 5 coasts and 6 stops."""

    FORWARD = 1
    REVERSE = 2
    JOG_FORWARD = 3
    JOG_REVERSE = 4
    COAST = 5
    STOP = 6
    RESET_FAULT = 7
    STOP_JOG = 8


class InovanceStatus(IntEnum):
    """The status at 3000H (PI130 manual p. 122). A Delixi E's 0, "none", counts as an unknown state."""

    FORWARD = 1
    REVERSE = 2
    STOPPED = 3


class Inovance(Invt):
    """The control words of Inovance MD, Powtran PI and their copies: 5 coasts, 6 stops along the ramp.

    - The role `fault` is required, because the status shows no fault. Any value except 0 is a fault.
    - The status is 1 forward, 2 reverse or 3 stopped. With any other number the state is unknown.
    - A family may give its own numbers in `control`, as in the profile `invt`. A word that it leaves out is
      never sent.
    """

    roles = {
        **Invt.roles,
        "control": Role(
            (Access.COMMAND,),
            values=InovanceControl,
            harmless=(InovanceControl.STOP, InovanceControl.COAST, InovanceControl.STOP_JOG),
            renumbered=("forward", "stop", "reset_fault"),
        ),
        "status": Role((Access.READING,), values=InovanceStatus),
        "fault": READING,
    }

    def _tripped(self, status: int) -> Script[bool]:
        return bool((yield from read(self.register("fault"))) != 0)

    def _turns(self, status: int) -> bool:
        return status != InovanceStatus.STOPPED

    @property
    def identity_is_weak(self) -> bool:
        """True, because `identify` may accept a drive with Delta's control words.

        On such a drive, INVT's stop word is a run word.
        """
        return True
