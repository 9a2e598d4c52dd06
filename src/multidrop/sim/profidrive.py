"""PROFIdrive's state machine, simulated (ACS550-02/U2 manual p. 246, ACS355 p. 319, G120C p. 195 and 235)."""

from __future__ import annotations

from multidrop.families.profiles.profidrive import ProfidriveControl, ProfidriveStatus
from multidrop.sim.profile_drive import ProfileDrive

_NO_OFF = ProfidriveControl.NO_OFF2 | ProfidriveControl.NO_OFF3
_RUN = (
    ProfidriveControl.ENABLE_OPERATION
    | ProfidriveControl.ENABLE_RAMP
    | ProfidriveControl.CONTINUE_RAMP
    | ProfidriveControl.ENABLE_SETPOINT
)


class SimulatedProfidrive(ProfileDrive):
    """PROFIdrive: inhibited after power-up, a trip, OFF2 and OFF3, until a word with OFF1 and without these.

    `off2` and `off3` are active from elsewhere, such as a terminal. In local control, and where the remote
    bit is 0, the word is ignored, but for its OFF bits. A word that takes back bit 3 lets the motor coast.
    Whether the ramp bits stop a motor that runs is not simulated: all three at 1 let it run.
    """

    def prepare(self) -> None:
        super().prepare()
        self.off2 = self.off3 = False
        self.powered_up()

    def powered_up(self) -> None:
        self._is_inhibited = True
        self._is_on = False  # OFF1 is not active
        self._is_enabled = False

    def trip(self, code: int) -> None:
        super().trip(code)
        self._is_on = self._is_enabled = False

    def _control(self, word: int) -> None:
        if self.rises(word, ProfidriveControl.RESET) and self.motor.fault:
            self.motor.reset()
            self._is_inhibited = True
        if self.off2 or not word & ProfidriveControl.NO_OFF2:
            self.motor.coast()
            self._off()
        elif self.off3 or not word & ProfidriveControl.NO_OFF3:
            self.motor.stop()
            self._off()
        elif not word & ProfidriveControl.ON:
            self.motor.stop()
            self._is_inhibited = False
            self._is_on = self._is_enabled = False
        elif word & ProfidriveControl.BY_LINE and not self.is_local:
            self._switch_on(word)

    def _off(self) -> None:
        self._is_on = self._is_enabled = False
        self._is_inhibited = True

    def _switch_on(self, word: int) -> None:
        if self._is_inhibited or self.motor.fault:
            return
        self._is_on = True
        if word & ProfidriveControl.ENABLE_OPERATION:
            self._is_enabled = True
            if word & _RUN == _RUN:
                self.motor.run(1)
        elif self._is_enabled:
            self.motor.coast()
            self._is_enabled = False

    def _state(self) -> int:
        fault = bool(self.motor.fault)
        ready = not (fault or self._is_inhibited or self.off2 or self.off3)
        bits = {
            ProfidriveStatus.READY_TO_SWITCH_ON: ready,
            ProfidriveStatus.READY_TO_OPERATE: ready and self._is_on,
            ProfidriveStatus.OPERATION_ENABLED: self._is_enabled or self.motor.energised,
            ProfidriveStatus.TRIPPED: fault,
            ProfidriveStatus.NO_OFF2: not self.off2 and self._last(ProfidriveControl.NO_OFF2),
            ProfidriveStatus.NO_OFF3: not self.off3 and self._last(ProfidriveControl.NO_OFF3),
            ProfidriveStatus.SWITCH_ON_INHIBITED: self._is_inhibited,
            ProfidriveStatus.AT_SETPOINT: self._is_enabled and self.motor.frequency == self.motor.goal,
            ProfidriveStatus.REMOTE: not self.is_local,
        }
        return sum(bit for bit, is_set in bits.items() if is_set)

    def _last(self, bit: int) -> bool:
        return bool(self.word_before & bit)

    heeds = {"control": _control}
    tells = {"status": _state}
