"""YD1000, simulated (communication notes, sections 4 to 8)."""

from __future__ import annotations

import math

from multidrop.core import Message
from multidrop.register import HOLDING
from multidrop.sim.dialect import Reason
from multidrop.sim.memory import Cell
from multidrop.sim.powered import PoweredDrive

CONTROL, COMMUNICATION_FREQUENCY, PANEL_FREQUENCY = 0x1000, 0x1001, 0x1002
TIMEOUT_SETTING = 0x0803
COMMANDED, BY_FREQUENCY, RESET, EMERGENCY_STOP, COAST, RUN, REVERSE, JOG = (
    1 << bit for bit in range(15, 7, -1)
)
BAUDRATES = (1200, 2400, 4800, 9600)  # by the codes of F800
RESTART_TIME = 2.0  # s without ears after a reset
EMERGENCY_STOPPED, COMMUNICATION_LOST = 0x11, 0x18  # the notes have no table of fault codes
HELD = range(0x1200, 0x1206)  # frozen at a trip until the reset


class SimulatedYD1000(PoweredDrive):
    """Without bit 15 the panel is in command: it runs the motor when `panel_runs` says so."""

    functions = (0x03, 0x06)
    needs_silence = True  # 4.3
    codes = {  # the notes list no codes; these are the VF-S15's
        Reason.FUNCTION: 1,
        Reason.READ_ADDRESS: 2,
        Reason.WRITE_ADDRESS: 2,
        Reason.COUNT: 3,
        Reason.VALUE: 3,
        Reason.LOCKED: 4,
        Reason.CANNOT: 4,
    }

    def prepare(self) -> None:
        self.panel_runs = False
        self._heard_at = math.inf  # the watch begins with the first message
        self.memory.make_readable(HOLDING, [CONTROL])

    @property
    def most_gap(self) -> float:
        return 24 * self.drive.settings.character  # 4.2 (2)

    def takes_broadcast(self, request: Message) -> bool:
        return request.function == 0x06 and request.start in (CONTROL, COMMUNICATION_FREQUENCY)

    def setpoint(self) -> float:
        by_line = self.word(CONTROL) & BY_FREQUENCY
        return self.word(COMMUNICATION_FREQUENCY if by_line else PANEL_FREQUENCY) / 100

    def pass_time(self, now: float) -> None:
        limit = self.word(TIMEOUT_SETTING) or math.inf  # F803, 0 is off
        if now > self._heard_at + limit and not self.motor.fault:
            self.motor.run_to(self._heard_at + limit)
            self.trip(COMMUNICATION_LOST)
        self._heard_at = now
        super().pass_time(now)

    def trip(self, code: int) -> None:
        """A fault: what 1200H to 1205H show is frozen."""
        for address in HELD:
            cell = self.memory.readable(0x03, address)
            if cell:
                self.refresh(cell)
        super().trip(code)

    def refresh(self, cell: Cell) -> None:
        if not (self.motor.fault and cell.address in HELD):
            super().refresh(cell)

    def _control(self, word: int) -> None:
        if word & RESET:
            self._restart()
        elif word & EMERGENCY_STOP:
            if not self.motor.fault:
                self.trip(EMERGENCY_STOPPED)
        elif word & COAST:
            self.motor.coast()
        elif not word & COMMANDED:
            panel = self.motor.run if self.panel_runs else self.motor.stop
            panel()
        elif word & JOG:
            self.motor.jog(-1 if word & REVERSE else 1)
        elif word & RUN:
            self.motor.run(-1 if word & REVERSE else 1)
        else:
            self.motor.stop()

    def _restart(self) -> None:
        """Everything that is not in the EEPROM is gone, and the drive is deaf for a while."""
        self.motor.coast()
        self.motor.reset()
        self.deaf_until = self.now + RESTART_TIME
        for address in (CONTROL, COMMUNICATION_FREQUENCY, PANEL_FREQUENCY):
            cell = self.memory.writable(0x06, address)
            if cell:
                cell.raw = 0
        self.set_up()

    def _state(self) -> int:
        bits = RUN if self.motor.energised else 0
        return bits | (REVERSE if self.motor.direction < 0 else 0)

    obeys = {(0x03, CONTROL): _control}
    shows = {
        (0x03, 0x0800): lambda self: BAUDRATES.index(self.drive.settings.baudrate),
        (0x03, 0x0801): lambda self: "NEO".index(self.drive.settings.parity),
        (0x03, 0x0802): lambda self: self.drive.address,
        (0x03, 0x1200): lambda self: round(abs(self.motor.frequency) * 100),
        (0x03, 0x1201): _state,
    }
