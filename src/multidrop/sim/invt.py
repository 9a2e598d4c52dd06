"""INVT's words, simulated (Goodrive100 manual p. 167, Goodrive350 p. 326)."""

from __future__ import annotations

from multidrop.families.profiles.invt import InvtControl, InvtStatus
from multidrop.sim.memory import MemoryCell
from multidrop.sim.profile_drive import ProfileDrive
from multidrop.sim.protocol import Reason, Refusal

_STARTS = (InvtControl.FORWARD, InvtControl.REVERSE, InvtControl.JOG_FORWARD, InvtControl.JOG_REVERSE)


class SimulatedInvt(ProfileDrive):
    """INVT: a start in a fault is refused. `jog_needs_own_stop`: a jog goes on through a stop."""

    def prepare(self) -> None:
        super().prepare()
        self.jog_needs_own_stop = False
        self._jogs = False

    def accept(self, cell: MemoryCell, raw: int) -> int:
        if cell.name == "control" and raw in _STARTS and self.motor.fault:
            raise Refusal(Reason.CANNOT)
        return super().accept(cell, raw)

    def _control(self, word: int) -> None:
        if self.is_local or (word == InvtControl.STOP and self._jogs and self.jog_needs_own_stop):
            return
        actions = {
            InvtControl.FORWARD: lambda: self.motor.run(1),
            InvtControl.REVERSE: lambda: self.motor.run(-1),
            InvtControl.JOG_FORWARD: lambda: self.motor.jog(1),
            InvtControl.JOG_REVERSE: lambda: self.motor.jog(-1),
            InvtControl.STOP: self.motor.stop,
            InvtControl.COAST: self.motor.coast,
            InvtControl.RESET_FAULT: self.motor.reset,
            InvtControl.STOP_JOG: self.motor.stop,
        }
        actions[InvtControl(word)]()
        self._jogs = word in (InvtControl.JOG_FORWARD, InvtControl.JOG_REVERSE)

    def _state(self) -> int:
        if self.motor.fault:
            return InvtStatus.FAULT
        if not self.motor.energised:
            return InvtStatus.STANDBY
        return InvtStatus.REVERSE if self.motor.frequency < 0 else InvtStatus.FORWARD

    heeds = {"control": _control}
    tells = {"status": _state}
