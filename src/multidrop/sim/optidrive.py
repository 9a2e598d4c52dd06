"""Invertek Optidrive E3, simulated (ODE-3 user guide 1.00, p. 33; E3 IP66 guide 1.25, p. 48)."""

from __future__ import annotations

from multidrop.families.profiles.optidrive import OptidriveControl, OptidriveStatus
from multidrop.sim.profile_drive import ProfileDrive


class SimulatedOptidrive(ProfileDrive):
    """Optidrive E3: bit 0 runs by its level, so also after a reset, while digital input 1 enables it.

    `is_enabled` is that input. `is_first_reading` shows register 6 as the first guide prints it: code low,
    state high.
    """

    def prepare(self) -> None:
        super().prepare()
        self.is_enabled = True
        self.is_first_reading = False

    def _control(self, word: int) -> None:
        if self.is_local:
            return
        if self.rises(word, OptidriveControl.RESET):
            self.motor.reset()
        if word & OptidriveControl.COAST or not self.is_enabled:
            self.motor.coast()
        elif word & OptidriveControl.RUN:
            self.motor.run(1)
        else:
            self.motor.stop()

    def _state(self) -> int:
        fault, runs = self.motor.fault, self.motor.energised
        if self.is_first_reading:
            return fault | (2 if fault else int(runs)) << 8
        bits = {
            OptidriveStatus.RUNNING: runs,
            OptidriveStatus.TRIPPED: bool(fault),
            OptidriveStatus.READY: not fault and self.is_enabled,
        }
        return fault << 8 | sum(bit for bit, is_set in bits.items() if is_set)

    heeds = {"control": _control}
    tells = {"status": _state}
