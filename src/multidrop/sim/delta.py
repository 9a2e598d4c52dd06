"""Delta's words, simulated (CP2000 manual p. 12.1-09-8, MS300 p. 788 to 790)."""

from __future__ import annotations

from multidrop.families.profiles.delta import (
    FORWARD,
    REVERSE,
    RUNNING,
    STOPPED,
    STOPPING,
    DeltaReset,
    DeltaStatus,
)
from multidrop.sim.motor import Phase
from multidrop.sim.profile_drive import ProfileDrive

EXTERNAL_FAULT = 49  # EF


class SimulatedDelta(ProfileDrive):
    """Delta: a run that comes in a fault is forgotten. The reset bit resets for as long as it is set.

    The manuals do not say so; it is simulated to find a client that leaves the bit set.
    """

    def pass_time(self, now: float) -> None:
        super().pass_time(now)
        register = self.drive.register("reset")
        if int(self.memory.get(register)) & DeltaReset.RESET:
            self.motor.reset()

    def _control(self, word: int) -> None:
        if not self.is_local:
            self.run_or_stop(word & 3, {0x10: 1, 0x20: -1, 0x30: -self.motor.direction}.get(word & 0x30))

    def _reset(self, word: int) -> None:
        if word & 1:
            self.trip(EXTERNAL_FAULT)
        if word & DeltaReset.RESET:
            self.motor.reset()

    def _state(self) -> int:
        phase = self.motor.phase
        lamps = STOPPED if not self.motor.energised else RUNNING
        if phase is Phase.DECELERATING and self.motor.goal == 0:
            lamps = STOPPING
        side = REVERSE if self.motor.direction < 0 else FORWARD
        by_line = 0 if self.is_local else DeltaStatus.COMMANDED_BY_LINE | DeltaStatus.REFERENCE_BY_LINE
        return lamps | side << 3 | by_line

    heeds = {"control": _control, "reset": _reset}
    tells = {"status": _state}
