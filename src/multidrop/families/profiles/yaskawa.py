"""The MEMOBUS registers of Yaskawa's 1000 series: A1000, V1000 and relatives."""

from __future__ import annotations

from enum import IntFlag
from typing import ClassVar

from multidrop.drive.register import Access
from multidrop.drive.state import Direction
from multidrop.families.profiles.profile import COMMON, Profile, Role


class YaskawaControl(IntFlag):
    """The control word 0001H (A1000 manual SIEP C710616 27G, p. 559). Bit 2, external fault, is never set."""

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
    BIT_11 = 1 << 11
    BIT_12 = 1 << 12
    BIT_13 = 1 << 13
    REFERENCE_BY_LINE = 1 << 14
    COMMANDED_BY_LINE = 1 << 15


STOP, RESET = 0, YaskawaControl.RESET
FORWARD, REVERSE = YaskawaControl.FORWARD, YaskawaControl.REVERSE


class Yaskawa(Profile):
    """Yaskawa: bit 0 runs the motor forward, bit 1 in reverse, while the bit is 1; bit 3 resets.

    - Bits 0 and 1 are those of H5-12 = 0, the factory setting. With H5-12 = 1 bit 1 is the direction, and a
      start in reverse has no effect: `start` raises NotVerified.
    - No control word lets the motor coast, and no jog is sent.
    - A status of 0 is impossible: the bit "zero speed" is set at rest, the bit "during run" otherwise.
    - Bit 15 of the status says that the drive takes its commands from the line; a start requires it.
    """

    stop_word: ClassVar[int] = STOP
    reset_word: ClassVar[int] = RESET
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=YaskawaControl,
            harmless=(STOP,),
            never_together=(RESET | FORWARD, RESET | REVERSE, FORWARD | REVERSE),
        ),
        "status": Role((Access.READING,), values=YaskawaStatus),
    }

    def _impossible(self, status: int) -> str:
        if status & YaskawaStatus.RUNS and status & YaskawaStatus.FAULT:
            return "it would run and have a fault"
        return "" if status else "no bit is set"

    def _is_tripped(self, status: int) -> bool:
        return bool(status & YaskawaStatus.FAULT)

    def _turns(self, status: int) -> bool:
        return bool(status & YaskawaStatus.RUNS)

    def _not_ready(self, status: int) -> str:
        if not status & YaskawaStatus.COMMANDED_BY_LINE:
            return "does not take its commands from the line"
        return "" if status & (YaskawaStatus.READY | YaskawaStatus.RUNS) else "is not ready"

    def _direction(self, status: int) -> Direction | None:
        return Direction.REVERSE if status & YaskawaStatus.REVERSE else Direction.FORWARD

    def _start_word(self, direction: Direction | None, status: int) -> int:
        turns_back = self._turns(status) and self._direction(status) is Direction.REVERSE
        if direction is Direction.REVERSE or (direction is None and turns_back):
            return REVERSE
        return FORWARD
