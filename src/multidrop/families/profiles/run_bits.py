"""Profiles whose motor runs as long as a bit of the control word is 1: Danfoss FC, Optidrive E3, Yaskawa."""

from __future__ import annotations

from enum import IntFlag
from typing import ClassVar

from multidrop.drive import WriteForbidden
from multidrop.drive.register import Access
from multidrop.drive.state import Direction
from multidrop.drive.verbs import Script
from multidrop.families.profiles.profile import COMMON, Profile, Role

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
    BIT_5 = 1 << 5
    TRIP_LOCKED = 1 << 6  # not used on an FC 101
    WARNING = 1 << 7
    AT_REFERENCE = 1 << 8
    BY_LINE = 1 << 9  # 1 in auto mode, in which the line commands the drive; 0 in hand mode
    IN_RANGE = 1 << 10
    RUNNING = 1 << 11
    BIT_12 = 1 << 12
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


OPTIDRIVE_RESERVED = 0x9C  # bits 2, 3, 4 and 7 of the low byte


class Optidrive(Profile):
    """Optidrive E3: the motor runs while bit 0 of the control word is 1; bit 2 resets, bit 3 coasts.

    Its maker is Invertek; it is also sold under other names.

    - An Optidrive Plus 3GV has bit 1 for the reset and bit 2 for the second ramp. Bit 1 is never sent.
    - The first guide (1.00) prints the two bytes of register 6 in the opposite order to later guides. A start
      needs bit 6, ready, which a drive of the first guide never shows. A drive counts as stopped only if its
      output frequency is 0.
    - No guide says whether the reset bit acts on its edge. So a stop is sent before the reset, and the bit
      is cleared after it.
    - The direction is the sign of the setpoint. No negative setpoint is written.
    """

    stop_word: ClassVar[int] = 0x0000
    coast_word: ClassVar[int] = 0x0008
    reset_word: ClassVar[int] = 0x0004
    start_word: ClassVar[int] = 0x0001
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
    BIT_11 = 1 << 11
    BIT_12 = 1 << 12
    BIT_13 = 1 << 13
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
        return YaskawaControl.REVERSE if self._reverses(direction, status) else YaskawaControl.FORWARD
