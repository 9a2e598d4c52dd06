"""Danfoss FC profile: the control word of the VLT and iC2 drives."""

from __future__ import annotations

from enum import IntFlag
from typing import ClassVar

from multidrop.drive import WriteForbidden
from multidrop.drive.register import Access
from multidrop.drive.state import Direction
from multidrop.families.profiles.profile import COMMON, Profile, Role


class DanfossControl(IntFlag):
    """The control word CTW (FC 300 design guide MG.33.B6, p. 277; FC 51 manual p. 29, coils 1 to 16)."""

    RAMP = 1 << 2  # 0 means: brake with direct current
    NO_COAST = 1 << 3
    NO_QUICK_STOP = 1 << 4
    NO_FREEZE = 1 << 5
    START = 1 << 6
    RESET = 1 << 7  # acts on a change from 0 to 1
    VALID = 1 << 10
    REVERSE = 1 << 15


class DanfossStatus(IntFlag):
    """The status word STW (MCA 121 instructions, FC profile, p. 24; FC 51 p. 29; FC 101 guide table 7.16)."""

    CONTROL_READY = 1 << 0
    DRIVE_READY = 1 << 1
    NOT_COASTING = 1 << 2  # means "safety closed" on an FC 101
    TRIPPED = 1 << 3
    ERROR = 1 << 4
    BIT_5 = 1 << 5
    TRIP_LOCKED = 1 << 6  # not used on an FC 101
    WARNING = 1 << 7
    AT_REFERENCE = 1 << 8
    BY_LINE = 1 << 9  # 1 in auto mode, 0 in hand mode
    IN_RANGE = 1 << 10
    RUNNING = 1 << 11
    BIT_12 = 1 << 12
    VOLTAGE_WARNING = 1 << 13
    CURRENT_LIMIT = 1 << 14
    THERMAL_WARNING = 1 << 15


STOP, COAST, RESET, START = 0x043C, 0x0434, 0x04BC, 0x047C


class DanfossFC(Profile):
    """Danfoss FC profile: the motor runs while bit 6 is 1; bit 15 reverses; a rising bit 7 resets.

    - Bit 6 acts by its level: a drive that is reset while bit 6 is set starts immediately. So a stop is
      confirmed before a reset, and no word has both bits.
    - A locked trip ends only when the mains are switched off (VT2800 guide, p. 115): the reset is refused.
    - The status shows no direction. A start without a direction goes forward from rest, and is refused while
      the motor turns. Bit 15 has an effect only if parameter 8-54 allows it.
    - Jog (bit 8), the preset references, the relays and the set-ups are not sent.
    """

    stop_word: ClassVar[int] = STOP
    coast_word: ClassVar[int | None] = COAST
    reset_word: ClassVar[int] = RESET
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=DanfossControl,
            harmless=(STOP, COAST),
            never_together=(DanfossControl.RESET | DanfossControl.START,),
        ),
        "status": Role((Access.READING,), values=DanfossStatus),
    }

    def _impossible(self, status: int) -> str:
        if status & DanfossStatus.RUNNING and status & DanfossStatus.TRIPPED:
            return "it would run and be tripped"
        return ""

    def _is_tripped(self, status: int) -> bool:
        return bool(status & (DanfossStatus.TRIPPED | DanfossStatus.TRIP_LOCKED))

    def _turns(self, status: int) -> bool:
        return bool(status & DanfossStatus.RUNNING)

    def _not_ready(self, status: int) -> str:
        if not status & DanfossStatus.BY_LINE:
            return "is in hand mode, or was stopped on its keypad"
        if not status & DanfossStatus.CONTROL_READY or not status & DanfossStatus.DRIVE_READY:
            return "is not ready"
        return ""

    def _cannot_reset(self, status: int) -> str:
        if status & DanfossStatus.TRIP_LOCKED:
            return "is trip-locked, which no reset ends: take its mains away, and see to the cause"
        return ""

    def _start_word(self, direction: Direction | None, status: int) -> int:
        if direction is None and self._turns(status):
            raise WriteForbidden(f"{self.name} turns, and cannot report which way: give the direction")
        return START | DanfossControl.REVERSE if direction is Direction.REVERSE else START
