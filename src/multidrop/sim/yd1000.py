"""Simulated YD1000 (communication notes, sections 4 to 8)."""

from __future__ import annotations

import math

from multidrop.core import Message
from multidrop.drive.register import HOLDING
from multidrop.sim.memory import MemoryCell, decode
from multidrop.sim.motor_drive import MotorDrive
from multidrop.sim.protocol import Reason, Refusal

CONTROL, COMMUNICATION_FREQUENCY, PANEL_FREQUENCY = 0x1000, 0x1001, 0x1002
TIMEOUT_SETTING = 0x0803
COMMANDED, BY_FREQUENCY, RESET, EMERGENCY_STOP, COAST, RUN, REVERSE, JOG, DC_BRAKE, SECOND_RAMP = (
    1 << bit for bit in range(15, 5, -1)
)
# maps a control bit to the value that it adds to the preset's number
PRESET_BITS = {1 << 3: 1, 1 << 2: 2, 1 << 1: 4, 1 << 0: 8}
PRESET_SPEEDS = (0x0018, 0x0019, 0x0020, 0x0021, 0x0022, 0x0023, 0x0024)  # addresses of Sr1 to Sr7
PANEL_ONLY = (0x0001, 0x0007, 0x0015)
BAUDRATES = (1200, 2400, 4800, 9600)  # indexed by F800
RESTART_TIME = 2.0  # time in s after a reset in which requests are ignored
EMERGENCY_STOPPED, COMMUNICATION_LOST = 0x11, 0x18
HELD = (0x1200, 0x1201)  # addresses frozen from a trip until the reset


class SimulatedYD1000(MotorDrive):
    """YD1000. Without bit 15 the panel is in control: the motor runs while `panel_runs` is set.

    A value outside its limits in section 6 is refused, also if the limit is another parameter's value. A
    write to a parameter marked "panel only" is confirmed but not stored (6.1). This includes 0007H, although
    section 8.1 says that writing it initialises the drive.

    The notes leave some facts open; these facts come from related drives. Exception codes are those of
    Modbus, as on the VF-S15. Fault codes are those of the VF-S11. As on the VF-S11, an emergency stop is a
    fault, and a reset restarts the drive. The drive then ignores the line for 2 s and drops its commands.

    Three facts are only assumed. The bits of the preset speeds form a number. The second ramp has the times
    of the first ramp. The brake has priority over run, and sets the frequency to 0 immediately.
    """

    functions = (0x03, 0x06)
    needs_silence = True  # notes, section 4.3

    _panel_runs = False
    _in_force = 0  # control word in force
    _message_at = math.inf  # time of the last message in s; inf: no message yet, so no timeout

    def prepare(self) -> None:
        self.memory.make_readable(HOLDING, [CONTROL])

    @property
    def panel_runs(self) -> bool:
        """True while the panel commands the motor to run. Ignored while the line is in control."""
        return self._panel_runs

    @panel_runs.setter
    def panel_runs(self, runs: bool) -> None:
        self._panel_runs = runs
        if not self._in_force:
            self._control(0)

    @property
    def most_gap(self) -> float:
        return 24 * self.drive.settings.character  # notes, section 4.2 (2)

    def takes_broadcast(self, request: Message) -> bool:
        return request.function == 0x06 and request.start in (CONTROL, COMMUNICATION_FREQUENCY)

    def setpoint(self) -> float:
        word = self.word(CONTROL)
        number = sum(value for bit, value in PRESET_BITS.items() if word & bit) if word & COMMANDED else 0
        if 1 <= number <= len(PRESET_SPEEDS):
            return self.word(PRESET_SPEEDS[number - 1]) / 100
        return self.word(COMMUNICATION_FREQUENCY if word & BY_FREQUENCY else PANEL_FREQUENCY) / 100

    def accept(self, cell: MemoryCell, raw: int) -> int:
        register = cell.register
        if cell.address in PANEL_ONLY:
            return cell.raw
        if register is not None and register.values is None:
            value = decode(register, raw)
            if register.at_least and value < self[register.at_least]:
                raise Refusal(Reason.VALUE)
            if register.at_most and value > self[register.at_most]:
                raise Refusal(Reason.VALUE)
        return super().accept(cell, raw)

    def wears(self, cell: MemoryCell, function: int, address: int) -> bool:
        return cell.address not in PANEL_ONLY and super().wears(cell, function, address)

    def pass_time(self, now: float) -> None:
        limit = self.word(TIMEOUT_SETTING) or math.inf  # F803, in s; 0 disables the timeout
        if now > self._message_at + limit and not self.motor.fault:
            self.motor.run_to(self._message_at + limit)
            self.trip(COMMUNICATION_LOST)
        self._message_at = now
        super().pass_time(now)

    def trip(self, code: int) -> None:
        """Freeze registers 1200H and 1201H, then trip."""
        for address in HELD:
            cell = self.memory.readable(0x03, address)
            if cell:
                self.refresh(cell)
        super().trip(code)

    def refresh(self, cell: MemoryCell) -> None:
        if not (self.motor.fault and cell.address in HELD):
            super().refresh(cell)

    def _control(self, word: int) -> None:
        direction = -1 if word & REVERSE else 1
        if not word & COMMANDED:  # other bits have an effect only together with bit 15 (8.1)
            panel = self.motor.run if self.panel_runs else self.motor.stop
            panel()
        elif word & RESET:
            self._restart()
        elif word & EMERGENCY_STOP:
            if not self.motor.fault:
                self.trip(EMERGENCY_STOPPED)
        elif word & COAST:
            self.motor.coast()
        elif word & DC_BRAKE:
            self.motor.brake()
        elif word & JOG:
            self.motor.jog(direction)
        elif word & RUN:
            self.motor.run(direction)
        else:
            self.motor.stop()
        self._in_force = word if word & COMMANDED else 0

    def _restart(self) -> None:
        """Drop all state that is not in the EEPROM, and ignore the line for RESTART_TIME."""
        self.motor.coast()
        self.motor.reset()
        self.deaf_until = self.now + RESTART_TIME
        self._message_at = math.inf  # the next message restarts the timeout
        for address in (CONTROL, COMMUNICATION_FREQUENCY, PANEL_FREQUENCY):
            cell = self.memory.writable(0x06, address)
            if cell:
                cell.raw = 0
        self.set_up()

    def _state(self) -> int:
        bits = self._in_force & SECOND_RAMP | (REVERSE if self.motor.direction < 0 else 0)
        if not self.motor.energised:
            return bits
        return bits | RUN | self._in_force & (JOG | DC_BRAKE)  # RUN is set while braking too (8.2, table 2)

    obeys = {"control": _control}
    shows = {
        "baudrate_setting": lambda self: BAUDRATES.index(self.drive.settings.baudrate),
        "parity_setting": lambda self: "NEO".index(self.drive.settings.parity),
        "address_setting": lambda self: self.drive.address,
        "held_frequency": lambda self: round(abs(self.motor.frequency) * 100),
        "status": _state,
    }
