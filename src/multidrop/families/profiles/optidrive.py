"""The control word of Invertek's Optidrive E3, which is also sold under other names."""

from __future__ import annotations

from enum import IntFlag
from typing import ClassVar

from multidrop.drive import WriteForbidden
from multidrop.drive.register import Access
from multidrop.drive.script import Script
from multidrop.drive.state import Direction
from multidrop.families.profiles.profile import COMMON, Profile, Role


class OptidriveControl(IntFlag):
    """The control word, register 1 (ODE-3 user guide 1.00, p. 33). An Optidrive Plus swaps bits 1 and 2."""

    RUN = 1 << 0
    RESET = 1 << 2
    COAST = 1 << 3


class OptidriveStatus(IntFlag):
    """The status, low byte of register 6 (E3 advanced manual, issue 05, p. 35; E3 IP66 guide 1.25, p. 48)."""

    RUNNING = 1 << 0
    TRIPPED = 1 << 1
    BIT_2 = 1 << 2
    BIT_3 = 1 << 3
    BIT_4 = 1 << 4
    STANDBY = 1 << 5
    READY = 1 << 6
    BIT_7 = 1 << 7
    CODE_0 = 1 << 8
    CODE_1 = 1 << 9
    CODE_2 = 1 << 10
    CODE_3 = 1 << 11
    CODE_4 = 1 << 12
    CODE_5 = 1 << 13
    CODE_6 = 1 << 14
    CODE_7 = 1 << 15


RESERVED = 0x9C  # bits 2, 3, 4 and 7 of the low byte
STOP, COAST, RESET, START = 0x0000, 0x0008, 0x0004, 0x0001


class Optidrive(Profile):
    """Optidrive E3: the motor runs while bit 0 of the control word is 1; bit 2 resets, bit 3 coasts.

    - An Optidrive Plus 3GV has bit 1 for the reset and bit 2 for the second ramp. Bit 1 is never sent.
    - The first guide (1.00) prints the two bytes of register 6 in the opposite order to later guides. A start
      needs bit 6, ready, which a drive of the first guide never shows. A drive counts as stopped only if its
      output frequency is 0.
    - No guide says whether the reset bit acts on its edge. So a stop is sent before the reset, and the bit
      is cleared after it.
    - The direction is the sign of the setpoint. No negative setpoint is written.
    """

    stop_word: ClassVar[int] = STOP
    coast_word: ClassVar[int | None] = COAST
    reset_word: ClassVar[int] = RESET
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=OptidriveControl,
            harmless=(STOP, COAST),
            never_together=(OptidriveControl.RESET | OptidriveControl.RUN,),
        ),
        "status": Role((Access.READING,), values=OptidriveStatus),
    }

    def _impossible(self, status: int) -> str:
        return "its reserved bits are set" if status & RESERVED else ""

    def _is_tripped(self, status: int) -> bool:
        return bool(status & OptidriveStatus.TRIPPED)

    def _fault(self) -> Script[str]:
        """Return the trip code in the status's high byte, named if the family has a register `fault`."""
        named = yield from super()._fault()
        return named or f"code {(yield from self._status()) >> 8}"

    def _turns(self, status: int) -> bool:
        return bool(status & OptidriveStatus.RUNNING)

    def _not_ready(self, status: int) -> str:
        return "" if status & (OptidriveStatus.READY | OptidriveStatus.RUNNING) else "is not ready to run"

    def _start_word(self, direction: Direction | None, status: int) -> int:
        if direction is not None:
            raise WriteForbidden(
                f"{self.name}: its control word has no bit for the direction; start without a direction"
            )
        return START
