"""Danfoss FC profile, simulated (FC 300 design guide p. 277, FC 51 operating instructions p. 29)."""

from __future__ import annotations

from multidrop.families.profiles.danfoss_fc import DanfossControl, DanfossStatus
from multidrop.sim.profile_drive import ProfileDrive


class SimulatedDanfossFC(ProfileDrive):
    """Danfoss FC: a word without bit 10 is ignored; bit 6 runs by its level, so also after a reset.

    `is_locked` is a trip that no reset ends.
    """

    def prepare(self) -> None:
        super().prepare()
        self.is_locked = False

    def powered_up(self) -> None:
        self.is_locked = False

    def _control(self, word: int) -> None:
        if self.is_local or not word & DanfossControl.VALID:
            return
        if self.rises(word, DanfossControl.RESET) and not self.is_locked:
            self.motor.reset()
        if not word & DanfossControl.NO_COAST:
            self.motor.coast()
        elif not word & DanfossControl.RAMP or not word & DanfossControl.NO_QUICK_STOP:
            self.motor.stop()
        elif word & DanfossControl.START:
            self.motor.run(-1 if word & DanfossControl.REVERSE else 1)
        else:
            self.motor.stop()

    def _state(self) -> int:
        fault = bool(self.motor.fault)
        bits = {
            DanfossStatus.CONTROL_READY: not fault,
            DanfossStatus.DRIVE_READY: not fault,
            DanfossStatus.NOT_COASTING: bool(self.word_before & DanfossControl.NO_COAST),
            DanfossStatus.TRIPPED: fault,
            DanfossStatus.TRIP_LOCKED: fault and self.is_locked,
            DanfossStatus.BY_LINE: not self.is_local,
            DanfossStatus.IN_RANGE: True,
            DanfossStatus.RUNNING: self.motor.energised,
        }
        return sum(bit for bit, is_set in bits.items() if is_set)

    heeds = {"control": _control}
    tells = {"status": _state}
