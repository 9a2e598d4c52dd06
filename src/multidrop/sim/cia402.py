"""The state machine of CiA 402, simulated (IEC 61800-7-201, the states' table and transitions)."""

from __future__ import annotations

from multidrop.families.profiles.cia402 import CiA402Control, CiA402Status
from multidrop.sim.profile_drive import ProfileDrive

_COMMANDS = 0x8F  # bits 7 and 3 to 0
DISABLED, READY, SWITCHED_ON, ENABLED = range(4)
_STATES = {DISABLED: 0x40, READY: 0x21, SWITCHED_ON: 0x23, ENABLED: 0x27}


class SimulatedCiA402(ProfileDrive):
    """CiA 402: one step up for each word, none over a step; "disable voltage" and a trip go to the bottom.

    A shutdown coasts here, as the standard's factory setting does, and "disable operation" ramps. A drive in
    local control takes no word. `stays_off` keeps it from being switched on, as lacking mains do.
    """

    def prepare(self) -> None:
        super().prepare()
        self.stays_off = False
        self.powered_up()

    def powered_up(self) -> None:
        self._state = DISABLED

    def trip(self, code: int) -> None:
        super().trip(code)
        self._state = DISABLED

    def _control(self, word: int) -> None:
        if self.is_local:
            return
        if self.motor.fault:
            if self.rises(word, CiA402Control.RESET):
                self.motor.reset()
                self._state = DISABLED
            return
        command = word & _COMMANDS & ~CiA402Control.RESET
        if not command & CiA402Control.ENABLE_VOLTAGE:
            self.motor.coast()
            self._state = DISABLED
        elif not command & CiA402Control.NO_QUICK_STOP:
            self.motor.stop()
            self._state = DISABLED
        elif command == 0x06:
            self.motor.coast()
            self._state = READY
        elif command == 0x07:
            self._switched_on()
        elif command == 0x0F and self._state in (SWITCHED_ON, ENABLED):
            self._state = ENABLED
            extra = word & ~_COMMANDS
            self.motor.run(-1 if extra else 1)

    def _switched_on(self) -> None:
        if self._state == ENABLED:
            self.motor.stop()
        if self._state in (READY, ENABLED) and not self.stays_off:
            self._state = SWITCHED_ON

    def _status(self) -> int:
        if self.motor.fault:
            return CiA402Status.FAULT | self._remote()
        return _STATES[self._state] | self._remote() | CiA402Status.VOLTAGE_ENABLED

    def _remote(self) -> int:
        return 0 if self.is_local else CiA402Status.REMOTE

    heeds = {"control": _control}
    tells = {"status": _status}
