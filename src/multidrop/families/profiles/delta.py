"""Delta's control and status words at 2000H, 2002H, 2100H and 2101H, which several makes have copied."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import ClassVar

from multidrop.drive.register import Access
from multidrop.drive.state import Condition, Direction
from multidrop.drive.verbs import Script, read, verb, write
from multidrop.families.profiles.profile import COMMON, READING, Profile, Role

STOPPED, STOPPING, STANDBY, RUNNING = range(4)  # values of bits 1 and 0 of the status
FORWARD, TO_FORWARD, TO_REVERSE, REVERSE = range(4)  # values of bits 4 and 3 of the status


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
    BIT_5 = 1 << 5
    BIT_6 = 1 << 6
    BIT_7 = 1 << 7
    REFERENCE_BY_LINE = 1 << 8
    REFERENCE_BY_TERMINAL = 1 << 9
    COMMANDED_BY_LINE = 1 << 10
    LOCKED = 1 << 11
    COPIES = 1 << 12
    BIT_13 = 1 << 13
    BIT_14 = 1 << 14
    BIT_15 = 1 << 15


MODES = range(5)  # bits 15 to 13: reserved, or HOA and LOC/REM mode on a C2000 Plus (its manual, p. A-10)


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

    def _not_ready(self, status: int) -> str:
        return "" if status & DeltaStatus.COMMANDED_BY_LINE else "does not take its commands from the line"

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
