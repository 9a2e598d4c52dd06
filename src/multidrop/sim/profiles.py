"""Simulated drives of the profiles, after the manuals that each profile names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from multidrop.drive.family import Drive
from multidrop.families.profiles.command_bits import (
    CiA402,
    CiA402Control,
    CiA402Status,
    DanfossControl,
    DanfossFC,
    DanfossStatus,
    Optidrive,
    OptidriveControl,
    OptidriveStatus,
    Profidrive,
    ProfidriveControl,
    ProfidriveStatus,
    Yaskawa,
    YaskawaControl,
    YaskawaStatus,
)
from multidrop.families.profiles.command_codes import (
    FORWARD,
    REVERSE,
    RUNNING,
    STOPPED,
    STOPPING,
    Delta,
    DeltaReset,
    DeltaStatus,
    Inovance,
    InovanceStatus,
    Invt,
    InvtControl,
    InvtStatus,
)
from multidrop.sim.drive import Reason, Refusal
from multidrop.sim.memory import MemoryCell
from multidrop.sim.motor import COMMANDS, MotorDrive, Phase


class ProfileDrive(MotorDrive):
    """A simulated drive of a family that shares its control and status words with other families.

    The names of its registers, such as "reference" and "control", are the same in all these families. While
    `is_local` is set, the keypad is in control and commands from the line are ignored. After a `power_cycle`
    only settings in EEPROM are kept.
    """

    is_local = False
    word_before = 0

    def prepare(self) -> None:
        if "signature" in self.drive.registers:
            values: Any = self.drive.register("signature").values
            self["signature"] = next(iter(values))
        if "station" in self.drive.registers:
            self["station"] = self.drive.address
        self.powered_up()

    def setpoint(self) -> float:
        held = self._known("reference") or 0.0
        if self.drive.register("reference").unit != "%":
            return held
        return held / 100 * self.motor.maximum_frequency

    def changed(self, cell: MemoryCell) -> None:
        super().changed(cell)
        if cell.name == "control":
            self.word_before = cell.raw

    def refresh(self, cell: MemoryCell) -> None:
        super().refresh(cell)
        register = cell.register
        if register and register.name == "reference_in_force" and register not in self._held:
            self.memory.set(register, self.memory.get(self.drive.register("reference")))

    def rises(self, word: int, bits: int) -> bool:
        """Return True if the control word sets any of the bits, and the previous word set no such bit."""
        return bool(word & bits) and not self.word_before & bits

    def power_cycle(self) -> None:
        """Switch the mains off and on, which clears commands, setpoint and faults."""
        self.motor.coast()
        self.motor.reset()
        for name in ("control", "reset", "reference"):
            if name in self.drive.registers:
                self.memory.set_raw(self.drive.register(name), 0)
        self.word_before = 0
        self.set_up()
        self.powered_up()

    def powered_up(self) -> None:
        """Set the drive's state after power-up."""


_RUN = (
    ProfidriveControl.ENABLE_OPERATION
    | ProfidriveControl.ENABLE_RAMP
    | ProfidriveControl.CONTINUE_RAMP
    | ProfidriveControl.ENABLE_SETPOINT
)


class SimulatedProfidrive(ProfileDrive):
    """PROFIdrive. After power-up, a trip, OFF2 or OFF3, switching on is inhibited.

    A control word in which OFF1 is active, but not OFF2 or OFF3, allows it again.

    `off2` and `off3` are commands from another source, such as a terminal. In local control, or if bit 10 of
    the word is 0, only the OFF bits have an effect. A word that clears bit 3 lets the motor coast. The motor
    starts only if all three ramp bits are 1; these bits have no other effect here.
    """

    off2 = off3 = False

    def powered_up(self) -> None:
        self._is_inhibited = True
        self._is_on = False  # True if OFF1 is not active
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

    write_handlers = {"control": _control}
    read_handlers = {"status": _state}


_COMMANDS = 0x8F  # command bits 7 and 3 to 0
DISABLED, READY, SWITCHED_ON, ENABLED = range(4)
_STATES = {DISABLED: 0x40, READY: 0x21, SWITCHED_ON: 0x23, ENABLED: 0x27}


class SimulatedCiA402(ProfileDrive):
    """CiA 402, with the states DISABLED, READY, SWITCHED_ON and ENABLED.

    A control word moves the drive at most one state towards ENABLED. "disable voltage" or a trip disables it.

    The factory settings are the standard's: "shutdown" coasts, and "disable operation" ramps down.
    A drive in local control ignores all words. `stays_off` prevents switching on, as missing mains
    voltage does.
    """

    stays_off = False

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

    write_handlers = {"control": _control}
    read_handlers = {"status": _status}


class SimulatedDanfossFC(ProfileDrive):
    """Danfoss FC: a word without bit 10 is ignored. The motor runs while bit 6 is set, even after a reset.

    While `is_locked` is set, the trip cannot be reset.
    """

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

    write_handlers = {"control": _control}
    read_handlers = {"status": _state}


EXTERNAL_FAULT = 49  # fault code of "EF", an external fault


class SimulatedDelta(ProfileDrive):
    """Delta: a run command during a fault is ignored. While the reset bit is set, every fault is reset.

    The manuals do not say that the bit has a lasting effect. The simulation assumes it, so that tests detect
    a client that leaves the bit set.
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

    write_handlers = {"control": _control, "reset": _reset}
    read_handlers = {"status": _state}


_STARTS = (InvtControl.FORWARD, InvtControl.REVERSE, InvtControl.JOG_FORWARD, InvtControl.JOG_REVERSE)


class SimulatedInvt(ProfileDrive):
    """INVT: a start during a fault is refused. If `jog_needs_own_stop`, a normal stop does not end a jog."""

    jog_needs_own_stop = False
    _jogs = False

    def accept(self, cell: MemoryCell, raw: int) -> int:
        if cell.name == "control" and self._canonical(raw) in _STARTS and self.motor.fault:
            raise Refusal(Reason.CANNOT)
        return super().accept(cell, raw)

    def _canonical(self, raw: int) -> InvtControl | None:
        """Return the control word whose name a raw number has in this family; None if it has no name.

        Families use the same control words with different numbers.
        """
        values: Any = self.drive.register("control").values
        return next((InvtControl[member.name] for member in values if member == raw), None)

    def _control(self, raw: int) -> None:
        word = self._canonical(raw)
        if (
            self.is_local
            or word is None
            or (word == InvtControl.STOP and self._jogs and self.jog_needs_own_stop)
        ):
            return
        COMMANDS[word.name](self.motor)
        self._jogs = word in (InvtControl.JOG_FORWARD, InvtControl.JOG_REVERSE)

    def _state(self) -> int:
        if self.motor.fault:
            return InvtStatus.FAULT
        if not self.motor.energised:
            return InvtStatus.STANDBY
        return InvtStatus.REVERSE if self.motor.frequency < 0 else InvtStatus.FORWARD

    write_handlers = {"control": _control}
    read_handlers = {"status": _state}


class SimulatedInovance(SimulatedInvt):
    """A drive with Inovance's status register, which has no value for a fault: it shows STOPPED."""

    def _state(self) -> int:
        if not self.motor.energised:
            return InovanceStatus.STOPPED
        return InovanceStatus.REVERSE if self.motor.frequency < 0 else InovanceStatus.FORWARD

    read_handlers = {"status": _state}


class SimulatedYaskawa(ProfileDrive):
    """Yaskawa: the motor runs while a run bit is set, even immediately after a reset.

    A read of more than `most_answered` registers is refused with exception 03, as on an A1000.
    """

    most_answered = 16

    def prepare(self) -> None:
        super().prepare()
        self.most[0x03] = self.most_answered

    def _control(self, word: int) -> None:
        if self.is_local:
            return
        if self.rises(word, YaskawaControl.RESET):
            self.motor.reset()
        runs = word & (YaskawaControl.FORWARD | YaskawaControl.REVERSE)
        if runs in (YaskawaControl.FORWARD, YaskawaControl.REVERSE):
            self.motor.run(1 if runs == YaskawaControl.FORWARD else -1)
        else:
            self.motor.stop()

    def _state(self) -> int:
        fault, runs = bool(self.motor.fault), self.motor.energised
        bits = {
            YaskawaStatus.RUNS: runs,
            YaskawaStatus.ZERO_SPEED: not runs,
            YaskawaStatus.REVERSE: self.motor.frequency < 0,
            YaskawaStatus.READY: not fault,
            YaskawaStatus.FAULT: fault,
            YaskawaStatus.REFERENCE_BY_LINE: not self.is_local,
            YaskawaStatus.COMMANDED_BY_LINE: not self.is_local,
        }
        return sum(bit for bit, is_set in bits.items() if is_set)

    write_handlers = {"control": _control}
    read_handlers = {"status": _state}


class SimulatedOptidrive(ProfileDrive):
    """Optidrive E3: the motor runs while bit 0 is set and digital input 1 is on, even after a reset.

    `is_enabled` is that input. Two guides describe register 6 in different ways. With `is_first_reading`, the
    first one applies: the fault code is in the low byte, the state in the high byte.
    """

    is_enabled = True
    is_first_reading = False

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

    write_handlers = {"control": _control}
    read_handlers = {"status": _state}


# classes that simulate drives, by profile
PROFILE_DRIVES: Mapping[type[Drive], type[ProfileDrive]] = {
    Profidrive: SimulatedProfidrive,
    CiA402: SimulatedCiA402,
    DanfossFC: SimulatedDanfossFC,
    Delta: SimulatedDelta,
    Inovance: SimulatedInovance,  # listed before its base class Invt, so that it is found first
    Invt: SimulatedInvt,
    Optidrive: SimulatedOptidrive,
    Yaskawa: SimulatedYaskawa,
}
