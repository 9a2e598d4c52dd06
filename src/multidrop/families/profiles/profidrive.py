"""The PROFIdrive profile, used by ABB (as "ABB Drives") and Siemens' SINAMICS."""

from __future__ import annotations

from enum import IntFlag
from typing import ClassVar

from multidrop.drive import NotVerified, WriteForbidden
from multidrop.drive.register import Access
from multidrop.drive.script import Script, insist, until, wait, write
from multidrop.drive.state import Condition, Direction
from multidrop.families.profiles.profile import COMMON, Profile, Role

READY_TIME = 1.0  # s within which the drive must become ready to switch on
BETWEEN = 0.1  # s; least pause between "ready to switch on" and the next word (ACS550-02/U2 manual, p. 246)


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
    BIT_10 = 1 << 10
    BIT_11 = 1 << 11
    BIT_12 = 1 << 12
    BIT_13 = 1 << 13
    BIT_14 = 1 << 14
    BIT_15 = 1 << 15


STOP, COAST, RESET, START = 0x047E, 0x047C, 0x04FE, 0x047F
SWITCH_OFF, SWITCH_ON = 0x0476, 0x0477  # neither word turns the motor, because operation is not enabled


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

    stop_word: ClassVar[int] = STOP
    coast_word: ClassVar[int | None] = COAST
    reset_word: ClassVar[int] = RESET
    roles = {
        **COMMON,
        "control": Role(
            (Access.COMMAND,),
            values=ProfidriveControl,
            harmless=(STOP, COAST, SWITCH_OFF),
            never_together=(ProfidriveControl.RESET | ProfidriveControl.ON,),
        ),
        "status": Role((Access.READING,), values=ProfidriveStatus),
    }

    def _impossible(self, status: int) -> str:
        inhibited = status & ProfidriveStatus.SWITCH_ON_INHIBITED
        if inhibited and status & (ProfidriveStatus.READY_TO_OPERATE | ProfidriveStatus.READY_TO_SWITCH_ON):
            return "it would be ready to be switched on and inhibited from it"
        if status & ProfidriveStatus.READY_TO_OPERATE and not status & ProfidriveStatus.READY_TO_SWITCH_ON:
            return "it would be ready to operate and not to be switched on"
        return ""

    def _is_tripped(self, status: int) -> bool:
        return bool(status & ProfidriveStatus.TRIPPED)

    def _turns(self, status: int) -> bool:
        return bool(status & ProfidriveStatus.OPERATION_ENABLED)

    def _condition(self, status: int) -> Condition:
        if self._turns(status) and not status & ProfidriveStatus.READY_TO_OPERATE:
            return Condition.DECELERATING  # OFF1 is in progress
        return super()._condition(status)

    def _not_ready(self, status: int) -> str:
        return "" if status & ProfidriveStatus.REMOTE else "is in local control"

    def _start_word(self, direction: Direction | None, status: int) -> int:
        if direction is not None:
            raise WriteForbidden(
                f"{self.name}: this profile has no bit for the direction, which depends on the reference's "
                f"sign or the drive's settings; start without a direction"
            )
        return START

    def _prepare(self, status: int) -> Script[None]:
        yield from insist(self.control, self._word(SWITCH_OFF))
        if not (yield from until(self._is_ready, limit=READY_TIME)):
            raise WriteForbidden(f"{self.name} {self._hindrance((yield from self._status()))}; {self.remote}")
        yield from wait(BETWEEN)
        yield from write(self.control, self._word(SWITCH_ON))
        if not (yield from until(self._is_on, limit=READY_TIME)):
            yield from insist(self.control, self._word(STOP))
            why = f"after {READY_TIME:g} s it is not ready to operate"
            raise NotVerified(self.name, "the start", f"{why}; {self.remote}")

    def _is_ready(self) -> Script[bool]:
        return self._ready_to_switch_on((yield from self._status()))

    def _ready_to_switch_on(self, status: int) -> bool:
        wanted = ProfidriveStatus.READY_TO_SWITCH_ON | ProfidriveStatus.NO_OFF2 | ProfidriveStatus.NO_OFF3
        return status & wanted == wanted and not status & ProfidriveStatus.SWITCH_ON_INHIBITED

    def _is_on(self) -> Script[bool]:
        return bool((yield from self._status()) & ProfidriveStatus.READY_TO_OPERATE)

    def _hindrance(self, status: int) -> str:
        """Return the most serious reason why the drive cannot be switched on, as text."""
        if not status & ProfidriveStatus.NO_OFF2:
            return "is not started: OFF2, which coasts, is active from elsewhere"
        if not status & ProfidriveStatus.NO_OFF3:
            return "is not started: OFF3, the quick stop, is active from elsewhere"
        if status & ProfidriveStatus.SWITCH_ON_INHIBITED:
            return "is not started: switching on is inhibited"
        return "is not started: it is not ready to be switched on"
