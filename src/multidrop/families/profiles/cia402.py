"""The CiA 402 profile (IEC 61800-7-201), used by Schneider's Altivar, Lenze's i500 and others."""

from __future__ import annotations

from enum import IntFlag
from functools import partial
from typing import ClassVar

from multidrop.drive import NotVerified, WriteForbidden
from multidrop.drive.register import Access
from multidrop.drive.script import Script, insist, until
from multidrop.drive.state import Condition, Direction
from multidrop.families.profiles.profile import COMMON, Profile, Role

READY_TIME = 1.0  # s allowed for each step up to "switched on"


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
    BIT_8 = 1 << 8
    REMOTE = 1 << 9
    AT_REFERENCE = 1 << 10
    BIT_11 = 1 << 11
    BIT_12 = 1 << 12
    BIT_13 = 1 << 13
    BIT_14 = 1 << 14
    BIT_15 = 1 << 15


DISABLE_VOLTAGE, SHUTDOWN, SWITCH_ON, ENABLE, RESET = 0x0000, 0x0006, 0x0007, 0x000F, 0x0087
MASK, SHORT_MASK = 0x6F, 0x4F  # masks of the state bits: with and without the quick stop bit
NOT_READY, SWITCH_ON_DISABLED, FAULT_REACTION, FAULT = 0x00, 0x40, 0x0F, 0x08  # states, with SHORT_MASK
READY, SWITCHED_ON, ENABLED, QUICK_STOP = 0x21, 0x23, 0x27, 0x07  # states, with MASK
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
    coast_word: ClassVar[int | None] = DISABLE_VOLTAGE
    reset_word: ClassVar[int] = RESET
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=CiA402Control,
            harmless=(DISABLE_VOLTAGE, SHUTDOWN, SWITCH_ON),
            never_together=(CiA402Control.RESET | CiA402Control.ENABLE_OPERATION,),
            extra=("reverse",),
        ),
        "status": Role((Access.READING,), values=CiA402Status),
    }

    def _impossible(self, status: int) -> str:
        if status & SHORT_MASK in (NOT_READY, SWITCH_ON_DISABLED, FAULT_REACTION, FAULT):
            return ""
        known = status & MASK in (READY, SWITCHED_ON, ENABLED, QUICK_STOP)
        return "" if known else "it is none of the states of CiA 402"

    def _is_tripped(self, status: int) -> bool:
        return bool(status & CiA402Status.FAULT)

    def _turns(self, status: int) -> bool:
        return bool(status & CiA402Status.OPERATION_ENABLED)

    def _condition(self, status: int) -> Condition:
        return Condition.DECELERATING if status & MASK == QUICK_STOP else super()._condition(status)

    def _not_ready(self, status: int) -> str:
        return "" if status & CiA402Status.REMOTE else "does not take its commands from the line"

    def _start_word(self, direction: Direction | None, status: int) -> int:
        reverse = {member.name: int(member) for member in self.control.values or ()}.get("REVERSE", 0)
        if direction is not None and not reverse:
            raise WriteForbidden(
                f"{self.name}: the standard has no direction, and its family declares no bit for it; "
                "start without a direction"
            )
        if direction is None and reverse and self._turns(status):
            raise WriteForbidden(f"{self.name} turns, and cannot report which way: give the direction")
        return ENABLE | reverse if direction is Direction.REVERSE else ENABLE

    def _prepare(self, status: int) -> Script[None]:
        for word, state, words in _UP:
            yield from insist(self.control, self._word(word))
            if not (yield from until(partial(self._is_in, state), limit=READY_TIME)):
                why = f"after {READY_TIME:g} s it is not {words}"
                raise NotVerified(self.name, "the start", f"{why}; {self.remote}")

    def _is_in(self, state: int) -> Script[bool]:
        return (yield from self._status()) & MASK == state
