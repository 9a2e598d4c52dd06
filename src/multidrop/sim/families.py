"""Simulated drives of the built-in families, and `simulated`, which chooses the class for a drive.

Each class follows the manual that it names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from multidrop.core import Framing, Message
from multidrop.drive.family import Drive
from multidrop.drive.number_format import signed
from multidrop.drive.register import COIL, HOLDING
from multidrop.families.delixi import DelixiModbus, DelixiNative
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.families.yd1000 import YD1000
from multidrop.sim.drive import COMMAND, GAPS, MODBUS, SET, STORE, Reason, Refusal, SimulatedDrive
from multidrop.sim.memory import MemoryCell, decode
from multidrop.sim.motor import MotorDrive, Phase
from multidrop.sim.profiles import PROFILE_DRIVES

# ---- INVT CHE ----

CHE_CONTROL, CHE_SETPOINT = 0x1000, 0x2000
CHE_STARTS = range(1, 5)
CHE_FULL = 10_000  # raw count of the setpoint 100 %
CHE_DEVICE_CODE = 0x0101  # CHE, universal
CHE_MODBUS_FAULTS = {1: 2, 2: 4, 3: 5, 6: 8, 0x11: 3, 0x12: 6}  # value of register 5001H, by exception code


class SimulatedCHE(MotorDrive):
    """INVT CHE (manual, chapter 11; registers and exceptions from the CHE100 manual).

    The setpoint is a percentage of P0.04, the drive's option `maximum_frequency`.
    The unit of output power is 0.01 kW, as on a CHF100A; no manual of a CHE states it.

    After a write to the EEPROM the drive is busy for `storing` s. The manual does not say which command ends
    a jog or a run. Here both stop commands end a jog and a run, and a start ends a jog.
    """

    functions = (0x03, 0x06)
    needs_silence = True  # CHE manual, section 11.5
    codes = {
        **MODBUS.codes,
        Reason.VALUE: 0x12,
        Reason.LOCKED: 0x12,
        Reason.CANNOT: 1,  # the manual also uses this code for a command during a fault
        Reason.DAMAGED: 0x11,  # manual, section 11.1: a damaged request gets an exception reply
    }

    storing = 0.0
    _busy_until = 0.0
    _modbus_fault = 0

    def prepare(self) -> None:
        self.memory.make_readable(HOLDING, [CHE_CONTROL])

    @property
    def most_gap(self) -> float:
        return 1.5 * self.drive.settings.character  # CHE manual, section 11.5

    def setpoint(self) -> float:
        return signed(self.word(CHE_SETPOINT), 16) / CHE_FULL * self.motor.maximum_frequency

    def accept(self, cell: MemoryCell, raw: int) -> int:
        if self.now < self._busy_until:
            raise Refusal(Reason.BUSY)
        # the drive accepts negative setpoints, although multidrop sends none
        if cell.address == CHE_SETPOINT:
            if not -CHE_FULL <= signed(raw, 16) <= CHE_FULL:
                raise Refusal(Reason.VALUE)
            return raw
        if cell.address == CHE_CONTROL and raw in CHE_STARTS and self.motor.fault:
            raise Refusal(Reason.CANNOT)
        return super().accept(cell, raw)

    def eeprom_written(self) -> None:
        self._busy_until = self.now + self.storing

    def refused(self, request: Message, code: int) -> Message:
        self._modbus_fault = CHE_MODBUS_FAULTS.get(code, 0)
        return super().refused(request, code)

    def _state(self) -> int:
        if self.motor.fault:
            return 4
        if not self.motor.energised:
            return 3
        return 2 if self.motor.frequency < 0 else 1

    write_handlers = {"control": MotorDrive.carry_out_named}
    read_handlers = {
        "status": _state,
        "output_power": lambda self: round(self.motor.power * 100),
        "device": lambda self: CHE_DEVICE_CODE,
        "fault": lambda self: self.motor.fault,
        "communication_fault": lambda self: self._modbus_fault,
    }


# ---- Delixi ----

DELIXI_UNDER_VOLTAGE = 7  # fault number of the fault POFF

DELIXI_BAUDRATES = (1200, 2400, 4800, 9600, 19200, 38400)  # baud rates, indexed by P04.28
# character formats, indexed by P04.29: three of ASCII, then three of RTU
DELIXI_MODBUS_FORMATS = ("7N2", "7E1", "7O1", "8N2", "8E1", "8O1")
DELIXI_NATIVE_FORMATS = ("8N1", "8E1", "8O1")
# the run commands (K = 02), and the commands that start the motor
DELIXI_COMMANDS, DELIXI_STARTS = range(1, 5), (2, 3)
DELIXI_RUN_SOURCE, DELIXI_FREQUENCY_SOURCE = 0, 1  # indexes of the parameters P00.00 and P00.01
DELIXI_BY_LINE = {DELIXI_RUN_SOURCE: 2, DELIXI_FREQUENCY_SOURCE: 1}


class SimulatedDelixi(MotorDrive):
    """Delixi 9100 and 9200 in standard Modbus (RS-485 communication protocol, part 2).

    The manual documents no exceptions: a request that fails gets no reply.

    Assumptions beyond the document: during a fault, or unless P00.00 is 2, a run command is confirmed
    and has no effect. The setpoint is 0 unless P00.01 is 1. A start ends a jog. The longest silence
    within a frame is the one that the document's third part states for Delixi's own protocol.
    """

    functions = (0x03, 0x06)
    codes = {}
    initial_values = DELIXI_BY_LINE

    @property
    def most_gap(self) -> float:
        return GAPS[Framing.DELIXI]

    def accepts_broadcast(self, request: Message) -> bool:
        return request.function == 0x06 and request.start == 0x2000  # only run commands may be broadcast

    def accept(self, cell: MemoryCell, raw: int) -> int:
        # the drive obeys the bits of every control word, also of words that this library never sends
        return raw if cell.name == "control" else super().accept(cell, raw)

    def setpoint(self) -> float:
        by_line = self.word(DELIXI_FREQUENCY_SOURCE) == DELIXI_BY_LINE[DELIXI_FREQUENCY_SOURCE]
        return super().setpoint() if by_line else 0.0

    def _control(self, bits: int) -> None:
        if self.word(DELIXI_RUN_SOURCE) != DELIXI_BY_LINE[DELIXI_RUN_SOURCE]:
            return
        self.run_or_stop(bits & 0x03, {0x10: 1, 0x20: -1, 0x30: -self.motor.direction}.get(bits & 0x30))

    def _format(self) -> int:
        return DELIXI_MODBUS_FORMATS.index(self.drive.settings.format)

    write_handlers = {"control": _control}
    read_handlers = {
        "baudrate_setting": lambda self: DELIXI_BAUDRATES.index(self.drive.settings.baudrate),
        "format_setting": _format,
        "address_setting": lambda self: self.drive.address,
    }


class SimulatedDelixiNative(MotorDrive):
    """Delixi in its own protocol (RS-485 communication protocol, part 3).

    Replies to writes repeat the request, replies to queries have the value.

    While `locked` is set, writes of parameters are refused with FEH. A start during a fault is refused
    with F0H. The manual leaves two points open. It does not say what happens to a run command if P00.00 is
    not 2: here it is refused with F0H. It does not say whether P00.01 selects between the setpoint in a
    parameter and a setpoint written with function code 04: here the one that was written last is used.

    Fault numbers are sent in binary-coded decimal: fault 10 is 10H.
    """

    initial_values = DELIXI_BY_LINE

    locked = False

    def accepts_broadcast(self, request: Message) -> bool:
        return request.function == COMMAND

    def accept(self, cell: MemoryCell, raw: int) -> int:
        if cell.table.write == COMMAND:
            by_line = self.word(DELIXI_RUN_SOURCE) == DELIXI_BY_LINE[DELIXI_RUN_SOURCE]
            if raw not in DELIXI_COMMANDS or not by_line or (raw in DELIXI_STARTS and self.motor.fault):
                raise Refusal(Reason.CANNOT)
        elif self.locked and cell.table.write in (SET, STORE):
            raise Refusal(Reason.LOCKED)
        return super().accept(cell, raw)

    def changed(self, cell: MemoryCell) -> None:
        # the motor runs with the setpoint that was written last
        if cell.name == "stored_frequency":
            self.memory.set(self.drive.register("frequency"), self["stored_frequency"])
        super().changed(cell)

    def _state(self) -> int:
        if self.motor.fault:
            return 5 if self.motor.fault == DELIXI_UNDER_VOLTAGE else 4
        if not self.motor.energised:
            return 1
        return 3 if self.motor.frequency < 0 else 2

    write_handlers = {"control": MotorDrive.carry_out_named}
    read_handlers = {
        "status": _state,
        "baudrate_setting": lambda self: DELIXI_BAUDRATES.index(self.drive.settings.baudrate),
        "format_setting": lambda self: DELIXI_NATIVE_FORMATS.index(self.drive.settings.format),
        "address_setting": lambda self: self.drive.address,
        "fault": lambda self: _printed(self.motor.fault),
    } | {
        f"fault_record_{number}": lambda self, number=number: _printed(self.motor.fault_record(number))
        for number in range(1, 5)
    }


def _printed(fault: int) -> int:
    """Return the fault number as the document prints it in hex digits: 00000010H for fault 10."""
    return int(str(fault), 16)


# ---- ERMAN ER-G-220 ----

ERMAN_COILS = range(13)  # all coils, including the reserved coils 3 to 8 and 10 to 12
ERMAN_STOP, ERMAN_EMERGENCY_STOP = 1, 2
ERMAN_EMERGENCY_STOPPED = 1 << 0  # bit of the register `last_fault`
ERMAN_OVERLOADED = 1 << 5  # bit of the state register
ERMAN_STATES = {Phase.STOPPED: 0, Phase.CONSTANT: 1, Phase.ACCELERATING: 2, Phase.DECELERATING: 3}


class SimulatedERMAN(MotorDrive):
    """ERMAN ER-G-220-01(02) (Modbus manual v1.4, sections 5 to 8).

    Coils keep their state. Writing START on starts the motor unless a stop coil is on.

    The manual leaves three points open. It does not say whether a coil is a level or a pulse. Here clearing
    START also stops the motor, and neither clearing a stop coil nor a reset starts it. It does not say when
    the motor is overloaded: here above 1.2 times its rated current. It does not say whether the drive obeys
    commands from the line if b.001 is not 2: here it obeys them.
    """

    functions = (0x01, 0x03, 0x04, 0x05, 0x06, 0x08, 0x0F, 0x10)
    # In all examples of the manual, the reply to an invalid address has code 03. The table in section 5 has
    # another code.
    codes = {
        Reason.FUNCTION: 1,
        Reason.READ_ADDRESS: 3,
        Reason.WRITE_ADDRESS: 3,
        Reason.COUNT: 3,
    }

    def prepare(self) -> None:
        self.memory.make_readable(COIL, ERMAN_COILS)
        self.memory.make_writable(COIL, ERMAN_COILS)

    def accepts_broadcast(self, request: Message) -> bool:
        return True  # Modbus manual, section 6: any request may be sent to address 0

    def _start(self, on: int) -> None:
        if not on:
            self.motor.stop()
        elif not (self._coil(ERMAN_STOP) or self._coil(ERMAN_EMERGENCY_STOP)):
            self.motor.run()

    def _stop(self, on: int) -> None:
        if on:
            self.motor.stop()

    def _emergency_stop(self, on: int) -> None:
        if on:
            self.trip(ERMAN_EMERGENCY_STOPPED)

    def _reset(self, on: int) -> None:
        if on:
            self.motor.reset()

    def _coil(self, address: int) -> int:
        cell = self.memory.writable(0x05, address)
        return cell.raw if cell else 0

    def _state(self) -> int:
        overloaded = self.motor.current > 1.2 * self.motor.rating.current
        return ERMAN_STATES[self.motor.phase] | (ERMAN_OVERLOADED if overloaded else 0)

    write_handlers = {
        "start_coil": _start,
        "stop_coil": _stop,
        "emergency_stop_coil": _emergency_stop,
        "fault_reset_coil": _reset,
    }
    read_handlers = {
        "status": _state,
        "last_fault": lambda self: self.motor.fault_record(1),  # a reset does not clear this register
    }


# ---- INNOVERT IBD ----

IBD_SETPOINT = 0x2001
# addresses of Prb.00, Prb.01 and Prb.02
IBD_STORED_SETPOINT, IBD_FREQUENCY_SOURCE, IBD_RUN_SOURCE = 100, 101, 102
IBD_BY_PARAMETER, IBD_BY_LINE, IBD_RUN_BY_LINE = 0, 5, 2
IBD_STOP, IBD_RUN, IBD_JOG = 1, 2, 3  # values of bits 1 and 0 of the control word 2000H
IBD_ALWAYS_SEEN = 1 << 11 | 1 << 12  # bits without a name that are 1 in the manual's example of PrA.22
IBD_LARGEST = {107: 36000, 108: 36000}  # assumed largest values of Prb.07 and Prb.08; the manual states none
# digital outputs: address of the parameter (Prd.nn) that sets the output's function, and bit mask of the
# output in PrA.22
IBD_OUTPUTS = {323: 1 << 8, 324: 1 << 9, 325: 1 << 10, 328: 1 << 13}
# functions of the outputs, as set in Prd.23 to Prd.28
IBD_RUNNING, IBD_FAULT, IBD_ACCELERATING, IBD_DECELERATING = 1, 3, 7, 8
IBD_BAUDRATES = (4800, 9600, 19200, 38400)
IBD_FORMATS = ("8N1", "8E1", "8O1")


class SimulatedIBD(MotorDrive):
    """INNOVERT IBD (manual, part 9, appendix 2), set up for RS-485: Prb.01 = 5, Prb.02 = 2.

    Its outputs are programmed as in the manual's example.

    The manual documents no exceptions: a request that fails gets no reply. A value above the maximum is
    stored as the maximum, but the reply repeats the written value. A run command does not end a jog; a stop
    does, and then a new run command runs the motor (table 3).

    Assumptions beyond the manual: unless Prb.02 = 2, a command is confirmed and has no effect. The setpoint
    is 0 if Prb.01 is neither 5 nor 0. The unit of Prb.00 is 0.01 Hz, like that of 2001H.
    """

    functions = (0x03, 0x06)
    needs_silence = True  # stated by the manual's table "message in RTU mode"
    codes = {}
    initial_values = {
        IBD_FREQUENCY_SOURCE: IBD_BY_LINE,
        IBD_RUN_SOURCE: IBD_RUN_BY_LINE,
        323: IBD_RUNNING,
        324: IBD_ACCELERATING,
        325: IBD_DECELERATING,
        328: IBD_FAULT,
    }

    _jogs = False

    @property
    def most_gap(self) -> float:
        return super().most_gap if self.drive.framing is Framing.ASCII else 10e-3

    def accept(self, cell: MemoryCell, raw: int) -> int:
        register = cell.register
        if register is not None and register.span is not None:
            return min(raw, int(register.encode(register.span[1])))
        return min(raw, IBD_LARGEST.get(cell.address, raw))

    def setpoint(self) -> float:
        source = {IBD_BY_LINE: IBD_SETPOINT, IBD_BY_PARAMETER: IBD_STORED_SETPOINT}.get(
            self.word(IBD_FREQUENCY_SOURCE)
        )
        return self.word(source) / 100 if source is not None else 0.0

    def _control(self, bits: int) -> None:
        """Carry out a control word.

        The manual is ambiguous about bits 3 and 2, the direction. Here they form one number: 1 is reverse,
        2 is forward, 3 is a change of direction.
        """
        if bits & 0x10:
            self.motor.reset()
        action = bits & 0x03
        jogs = self._jogs and self.motor.energised
        if self.word(IBD_RUN_SOURCE) != IBD_RUN_BY_LINE or (jogs and action == IBD_RUN):
            return
        self.run_or_stop(action, {0x04: -1, 0x08: 1, 0x0C: -self.motor.direction}.get(bits & 0x0C))
        self._jogs = action == IBD_JOG or (jogs and action != IBD_STOP)

    def _terminals(self) -> int:
        says = {
            IBD_RUNNING: self.motor.energised,
            IBD_FAULT: bool(self.motor.fault),
            IBD_ACCELERATING: self.motor.phase is Phase.ACCELERATING,
            IBD_DECELERATING: self.motor.phase is Phase.DECELERATING,
        }
        bits = (bit for address, bit in IBD_OUTPUTS.items() if says.get(self.word(address)))
        return sum(bits, IBD_ALWAYS_SEEN)

    def _run_state(self) -> int:
        """Return the value of PA28, the run state, which only some related models have."""
        if not self.motor.energised:
            return 0
        return 2 if self.motor.frequency < 0 else 1

    def _format(self) -> int:
        first_rtu = 0 if self.drive.framing is Framing.ASCII else len(IBD_FORMATS)
        return first_rtu + IBD_FORMATS.index(self.drive.settings.format)

    write_handlers = {"control": _control}
    read_handlers = {
        "terminals": _terminals,
        "run_state": _run_state,
        "baudrate_setting": lambda self: IBD_BAUDRATES.index(self.drive.settings.baudrate),
        "format_setting": _format,
        "address_setting": lambda self: self.drive.address,
    }


# ---- YD1000 ----

YD_CONTROL, YD_COMMUNICATION_FREQUENCY, YD_PANEL_FREQUENCY = 0x1000, 0x1001, 0x1002
YD_TIMEOUT_SETTING = 0x0803
(
    YD_COMMANDED,
    YD_BY_FREQUENCY,
    YD_RESET,
    YD_EMERGENCY_STOP,
    YD_COAST,
    YD_RUN,
    YD_REVERSE,
    YD_JOG,
    YD_DC_BRAKE,
    YD_SECOND_RAMP,
) = (1 << bit for bit in range(15, 5, -1))
# values that are added to the number of the preset speed, by control bit
YD_PRESET_BITS = {1 << 3: 1, 1 << 2: 2, 1 << 1: 4, 1 << 0: 8}
# addresses of the parameters Sr1 to Sr7
YD_PRESET_SPEEDS = (0x0018, 0x0019, 0x0020, 0x0021, 0x0022, 0x0023, 0x0024)
YD_PANEL_ONLY = (0x0001, 0x0007, 0x0015)
YD_BAUDRATES = (1200, 2400, 4800, 9600)  # baud rates, indexed by F800
YD_RESTART_TIME = 2.0  # seconds after a reset in which requests are ignored
YD_EMERGENCY_STOPPED, YD_COMMUNICATION_LOST = 0x11, 0x18
YD_HELD = (0x1200, 0x1201)  # addresses of the registers that are frozen from a trip until the reset


class SimulatedYD1000(MotorDrive):
    """YD1000 (communication notes, sections 4 to 8).

    Without bit 15 the panel is in control: the motor runs while `panel_runs` is set.

    A value outside its limits in section 6 is refused, also if the limit is another parameter's value. A
    write to a parameter marked "panel only" is confirmed but not stored (6.1). This includes 0007H, although
    section 8.1 says that writing it initialises the drive.

    The notes do not state the following; it is taken from related drives. Exception codes are those of
    Modbus, as on the VF-S15. Fault codes are those of the VF-S11. As on the VF-S11, an emergency stop is a
    fault, and a reset restarts the drive. The drive then ignores the line for 2 s and drops its commands.

    Three properties are only assumed. The bits of the preset speeds form a number. The second ramp has the
    times of the first ramp. The brake has priority over run, and sets the frequency to 0 immediately.
    """

    functions = (0x03, 0x06)
    needs_silence = True  # YD1000 communication notes, section 4.3

    _panel_runs = False
    _in_force = 0  # the control word that was accepted last
    _message_at = math.inf  # time of the last message in s; inf: none yet, so that no timeout can occur

    def prepare(self) -> None:
        self.memory.make_readable(HOLDING, [YD_CONTROL])

    @property
    def panel_runs(self) -> bool:
        """True if the panel commands the motor to run. It has no effect while the line is in control."""
        return self._panel_runs

    @panel_runs.setter
    def panel_runs(self, runs: bool) -> None:
        self._panel_runs = runs
        if not self._in_force:
            self._control(0)

    @property
    def most_gap(self) -> float:
        return 24 * self.drive.settings.character  # YD1000 communication notes, section 4.2 (2)

    def accepts_broadcast(self, request: Message) -> bool:
        return request.function == 0x06 and request.start in (YD_CONTROL, YD_COMMUNICATION_FREQUENCY)

    def setpoint(self) -> float:
        word = self.word(YD_CONTROL)
        number = (
            sum(value for bit, value in YD_PRESET_BITS.items() if word & bit) if word & YD_COMMANDED else 0
        )
        if 1 <= number <= len(YD_PRESET_SPEEDS):
            return self.word(YD_PRESET_SPEEDS[number - 1]) / 100
        return self.word(YD_COMMUNICATION_FREQUENCY if word & YD_BY_FREQUENCY else YD_PANEL_FREQUENCY) / 100

    def accept(self, cell: MemoryCell, raw: int) -> int:
        register = cell.register
        if cell.address in YD_PANEL_ONLY:
            return cell.raw
        if register is not None and register.values is None:
            value = decode(register, raw)
            if register.at_least and value < self[register.at_least]:
                raise Refusal(Reason.VALUE)
            if register.at_most and value > self[register.at_most]:
                raise Refusal(Reason.VALUE)
        return super().accept(cell, raw)

    def wears_eeprom(self, cell: MemoryCell, function: int, address: int) -> bool:
        return cell.address not in YD_PANEL_ONLY and super().wears_eeprom(cell, function, address)

    def pass_time(self, now: float) -> None:
        limit = self.word(YD_TIMEOUT_SETTING) or math.inf  # F803, the timeout in s; 0 disables it
        if now > self._message_at + limit and not self.motor.fault:
            self.motor.run_to(self._message_at + limit)
            self.trip(YD_COMMUNICATION_LOST)
        self._message_at = now
        super().pass_time(now)

    def trip(self, code: int) -> None:
        """Freeze the registers 1200H and 1201H, as the drive does in a trip, and trip the motor."""
        for address in YD_HELD:
            cell = self.memory.readable(0x03, address)
            if cell:
                self.refresh(cell)
        super().trip(code)

    def refresh(self, cell: MemoryCell) -> None:
        if not (self.motor.fault and cell.address in YD_HELD):
            super().refresh(cell)

    def _control(self, word: int) -> None:
        direction = -1 if word & YD_REVERSE else 1
        if not word & YD_COMMANDED:  # without bit 15, the other bits have no effect (manual, section 8.1)
            panel = self.motor.run if self.panel_runs else self.motor.stop
            panel()
        elif word & YD_RESET:
            self._restart()
        elif word & YD_EMERGENCY_STOP:
            if not self.motor.fault:
                self.trip(YD_EMERGENCY_STOPPED)
        elif word & YD_COAST:
            self.motor.coast()
        elif word & YD_DC_BRAKE:
            self.motor.brake()
        elif word & YD_JOG:
            self.motor.jog(direction)
        elif word & YD_RUN:
            self.motor.run(direction)
        else:
            self.motor.stop()
        self._in_force = word if word & YD_COMMANDED else 0

    def _restart(self) -> None:
        """Lose all state that is not in EEPROM, and ignore the line for YD_RESTART_TIME seconds."""
        self.motor.coast()
        self.motor.reset()
        self.deaf_until = self.now + YD_RESTART_TIME
        self._message_at = math.inf  # no timeout can occur before the next message
        for address in (YD_CONTROL, YD_COMMUNICATION_FREQUENCY, YD_PANEL_FREQUENCY):
            cell = self.memory.writable(0x06, address)
            if cell:
                cell.raw = 0
        self.set_up()

    def _state(self) -> int:
        bits = self._in_force & YD_SECOND_RAMP | (YD_REVERSE if self.motor.direction < 0 else 0)
        if not self.motor.energised:
            return bits
        # YD_RUN is also set while the motor is braked with direct current (8.2, table 2)
        return bits | YD_RUN | self._in_force & (YD_JOG | YD_DC_BRAKE)

    write_handlers = {"control": _control}
    read_handlers = {
        "baudrate_setting": lambda self: YD_BAUDRATES.index(self.drive.settings.baudrate),
        "parity_setting": lambda self: "NEO".index(self.drive.settings.parity),
        "address_setting": lambda self: self.drive.address,
        "held_frequency": lambda self: round(abs(self.motor.frequency) * 100),
        "status": _state,
    }


# ---- the class for each family ----


FAMILIES: Mapping[type[Drive], type[SimulatedDrive]] = {
    ErmanERG220: SimulatedERMAN,
    InvtCHE: SimulatedCHE,
    InnovertIBD: SimulatedIBD,
    DelixiModbus: SimulatedDelixi,
    DelixiNative: SimulatedDelixiNative,
    YD1000: SimulatedYD1000,
    **PROFILE_DRIVES,
}


def simulated(drive: Drive, *, response_delay: float | None = None) -> SimulatedDrive:
    """Return a simulation of the drive. A user's class or family file gets a plain SimulatedDrive.

    Raises TypeError for a family instead of a drive.
    """
    if isinstance(drive, type):
        raise TypeError(f"{drive.__name__} is a family, not a drive: write {drive.__name__}(1) for address 1")
    kinds = (kind for family, kind in FAMILIES.items() if isinstance(drive, family))
    return next(kinds, SimulatedDrive)(drive, response_delay=response_delay)
