"""INVT's control words 1 to 8. Several makes have copied them, some with 5 (stop) and 6 (coast) exchanged."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from enum import IntEnum
from typing import Any, ClassVar, cast

from multidrop.drive import BusError, DriveException, WriteForbidden
from multidrop.drive.register import Access
from multidrop.drive.state import Condition, Direction
from multidrop.drive.verbs import Script, insist, read, verb, write
from multidrop.families.profiles.profile import COMMON, READING, Profile, Role


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

    - Other makes have copied the words with 5 and 6 exchanged (both stop), and some with 5 for reverse. Such
      a family names its own numbers in `control`: `{ forward = 1, stop = 6, coast = 5, reset_fault = 7 }`. A
      word that it leaves out is never sent. Compare each of the numbers with the manual's list.
    - A stop may not end a jog. If the stop is refused, the motor still turns after it, or the state is
      unknown, STOP_JOG follows immediately. A start may not end a jog either: after a jog a stop is required.
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

    def _is_tripped(self, status: int) -> bool:
        return status == InvtStatus.FAULT

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
            raise self._unsupported(f"{word.name.lower().replace('_', ' ')} command")
        return cast(Any, self.control.values)[word.name]

    def _start_word(self, direction: Direction | None, status: int) -> int:
        return InvtControl.REVERSE if self._reverses(direction, status) else InvtControl.FORWARD

    def _check_start(self, status: int) -> Script[None]:
        yield from super()._check_start(status)
        if self._jogged and not (yield from self._is_at_rest()):
            raise self._stop_first(f"{self.name} may still jog, and a start may not end the jog")
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

    def _is_tripped(self, status: int) -> bool:
        return False  # the status register has no value for a fault

    def _turns(self, status: int) -> bool:
        return status != InovanceStatus.STOPPED

    @property
    def identity_is_weak(self) -> bool:
        """True, because `identify` may accept a drive with Delta's control words.

        On such a drive, INVT's stop word is a run word.
        """
        return True
