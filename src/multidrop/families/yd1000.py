"""YD1000, a relative of Toshiba's VF-S7 with a Modbus card: its registers and verbs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from enum import IntEnum, IntFlag
from typing import Any, Unpack

from multidrop.drive import Condition, Direction, Drive, State
from multidrop.drive.parameters import ParameterGroup, ParameterSpace
from multidrop.drive.register import HOLDING, Details, Kept, Option, Register, command, reading, setting
from multidrop.drive.verbs import Pulse, Script, insist, read, until, verb, wait, write
from multidrop.errors import BusError, DriveException, NotVerified, Unconfirmed, WriteForbidden

STOP_MARGIN = 5.0  # seconds that a stop may take in addition to the deceleration time
SELECTION_TIME = 1.0  # seconds within which register 1202H must show a newly selected preset speed
RELEASE_TIME = 2.0  # s; how long a release of control watches for a start by the panel or a terminal
RESET_TIME = 3.0  # seconds of a restart, in which the drive may not reply

PANEL = "it is effective from the panel only"
LINE = "it changes the drive's end of the line; set it on the panel"
COMMAND = "it decides what commands the motor; set it on the panel"
NO_SCALE = "its scale is not stated"
RUN_FUNCTIONS = (2, 3)  # codes of terminal functions that run the motor
AT_ONCE = "Takes effect at once."
AFTER_RESET = "Takes effect after a reset or at the next power-on."


class YD1000Control(IntFlag):
    """The control word 1000H. Bits 15 and 14 stay set until 0 is written to them or the power fails."""

    COMMAND_VALID = 1 << 15  # the motor obeys this word; if 0, parameter CNOD selects what it obeys
    FREQUENCY_VALID = 1 << 14  # the setpoint is register 1001H; if 0, parameter FNOD selects it
    RESET = 1 << 13
    EMERGENCY_STOP = 1 << 12
    COAST = 1 << 11
    RUN = 1 << 10
    REVERSE = 1 << 9
    JOG = 1 << 8
    DC_BRAKE = 1 << 7
    SECOND_RAMP = 1 << 6
    PRESET_SPEED_1 = 1 << 3
    PRESET_SPEED_2 = 1 << 2
    PRESET_SPEED_3 = 1 << 1
    PRESET_SPEED_4 = 1 << 0


STOP = YD1000Control.COMMAND_VALID | YD1000Control.FREQUENCY_VALID  # only bits 15 and 14, without the run bit

PRESET_SPEEDS = (  # bits for the number of the preset speed, from the lowest binary digit
    YD1000Control.PRESET_SPEED_1,
    YD1000Control.PRESET_SPEED_2,
    YD1000Control.PRESET_SPEED_3,
)


class YD1000Status(IntFlag):
    RUN = 1 << 10  # is also set while the motor is braked with direct current
    REVERSE = 1 << 9
    JOG = 1 << 8
    DC_BRAKE = 1 << 7
    SECOND_RAMP = 1 << 6


class Inputs(IntFlag):
    F = 1 << 0
    R = 1 << 1
    RST = 1 << 2
    S1 = 1 << 3
    S2 = 1 << 4


class Outputs(IntFlag):
    OUT1 = 1 << 0
    OUT2 = 1 << 1


class YD1000Baudrate(IntEnum):
    B1200 = 0
    B2400 = 1
    B4800 = 2
    B9600 = 3


class Parity(IntEnum):
    NONE = 0
    EVEN = 1
    ODD = 2


def choice(number: int, place: str, most: int | None = None, /, **more: Unpack[Details]) -> Register[float]:
    """Declare a parameter with values from 0 to `most`; None means that the range is unknown."""
    if most is not None:
        more["span"] = (0, most)
    return setting(number, **_parameter(place, more))


def seconds(number: int, place: str, /, **more: Unpack[Details]) -> Register[float]:
    """Declare a parameter that is a time. The unit s is assumed: the drive's manual states none."""
    more["step"], more["span"] = 0.1, (0.1, 3600)
    more["outside"] = "unit: Toshiba IPE002Z manual, p. 34"
    return setting(number, "s", **_parameter(place, more))


def hertz(number: int, place: str, least: float = 0, /, **more: Unpack[Details]) -> Register[float]:
    """Declare a parameter of up to 320 Hz, the limit of FH. The unit is assumed: the manual states none."""
    more["step"], more["span"] = 0.01, (least, 320)
    more["outside"] = "unit: Toshiba IPE002Z manual, p. 35"
    return setting(number, "Hz", **_parameter(place, more))


def preset(number: int, place: str, /) -> Register[float]:
    """Declare a preset speed. The parameters LL and UL are its limits."""
    return hertz(number, place, at_least="minimum_frequency", at_most="upper_limit_frequency", default=0.0)


def extended(name: str, unit: str = "", /, **details: Unpack[Details]) -> Register[float]:
    """Declare an extended parameter by its name in your manual: F800 is 0800H (section 6.2).

    The parameter is kept in EEPROM. Only the rule for its address is known, so declare it in a subclass:

        class MyYD1000(YD1000):
            start_frequency = extended("F240", "Hz", step=0.01)
    """
    if not re.fullmatch(r"F[0-9]{3}", name):
        raise ValueError(f"{name!r} is not an extended parameter: write F and three digits, such as F170")
    address = int(name[1:], 16)
    for known in YD1000.registers.values():
        if known.address == address:
            raise ValueError(f"{name} is already declared for every YD1000, as {known.name}")
    details["kept"] = Kept.EEPROM
    details.setdefault("place", f"6.2, {name}")
    return setting(address, unit, **details)


def _parameter(place: str, more: Details) -> Details:
    return {"kept": Kept.EEPROM, "while_running": True, "place": place, **more}


class YD1000(Drive):
    """YD1000; communication notes (MODBUS).

    Where the document errs or is silent, the safest interpretation applies:

    - Register numbers are hex digits that are sent as they are: dEC, number 0010, is 0010H. This rule,
      and the units of ACC, FH and similar, are those of Toshiba's related drives; the document does not state
      them. `identify` checks the rule: 0802H must be the drive's own address.
    - The tables of frames print the checksum's high byte first. As in all of Modbus, it is sent last.
    - The text mentions more functions, but the function table has only 03 (one register) and 06.
    - 0000H in the control word does not stop: without bit 15 the panel or the terminals command the drive,
      and may run it. Every command except `release_control` sets bit 15.
    - Bits 15 and 14 latch until they are written 0 or the power fails: until then panel and terminals have
      no effect. `release_control` writes 0000H, only at rest, and only if no terminal commands a run. The
      panel's command cannot be read: if the motor then turns, the stop is written again.
    - Bit 14 should keep its value, but it cannot be read reliably, so every command sets it. So the setpoint
      is 1001H after the first verb, which is 0 Hz until set_frequency is called. With the option
      `setpoint_by_fnod` a start clears bit 14, as the document's examples 8400H and 8600H do.
    - Bits 3 to 0 are called preset speed 1 to 4, but there are seven preset speeds, Sr1 to Sr7. The bits are
      taken for the binary number of a speed, as in related drives. With the option `preset_speed`, `start`
      first writes the bits without the run bit, at rest. It runs the motor only if 1202H then changes to that
      speed.
    - The effect of bit 7, the direct-current brake, during run and stop is not stated: it is never set.
    - Related drives restart repeatedly while bit 13 (reset) or 12 (emergency stop) is set. So the stop word
      follows 3 s after a reset, and when an emergency stop has stopped the motor. A reset has bit 15 and not
      the run bit; its reply may be cut off. A restart may clear bit 15, as power-on does (section 8.1). Then
      the terminals command the motor until the stop is written: a reset is refused while a terminal says run.
      The table of functions is missing: functions 2 and 3, which the terminals F and R have, count as run.
    - Jog is written without the run bit, which would turn the motor at the setpoint if jog is not obeyed.
    - 1200H and 1201H are called present values, but are frozen in a trip: only 1100H is live. The motor
      counts as stopped when 1100H is 0 twice. After a trip 1100H is 0, and 1200H is not. A trip at rest, such
      as after an emergency stop, shows only as a change in the fault record.
    - Registers marked "panel only" are never written, although section 8.1 writes 0007H to initialise.
      0800H to 0802H are not written either: they set baud rate, format and address. 0800H and 0801H take
      effect after a reset or at the next power-on, 0802H and 0803H at once (section 7).
    - CNOD, FNOD, FR, F103, F104 and F110 to F115 decide what commands the motor, and it is not stated what
      AU3 sets by itself. All these parameters are read and never written.
    - 0803H, the watchdog, is written only while the motor is at rest (the document does not require that): a
      time shorter than the pause between two polls trips the drive.
    - The table of faults is missing: codes are shown as they are. The meanings of exceptions are those of a
      relative, the VF-S15.
    - Addresses above 31 need a version above V104. The number of stop bits is not stated: 1 is used.

    All registers except 1000H to 12FFH are kept in EEPROM. The number of any other extended parameter is its
    name with 0 in place of F (section 6.2): declare your manual's parameters in a subclass, with `extended`.
    F800 = 3 and F801 = 1 are required: 9600 8E1. An S7e has no F800 and is fixed at 1200 bit/s.
    """

    model = "yd1000"
    title = "YD1000"
    manual = "YD1000 (MODBUS) communication notes"

    formats = dict.fromkeys(Drive.framings, ("8E1", "8N1", "8O1"))  # F801
    baudrates = (9600, 4800, 2400, 1200)  # F800
    line_terminals = "A and B"
    most_devices = 63  # section 1
    addresses = range(1, 64)
    silence_characters = 24  # section 4.3
    response_delay_characters = 24
    response_timeout = 0.5  # s; 24 characters take 220 ms at 1200 bit/s
    answers_every_read = True
    most_registers = {HOLDING: 1}  # the document only has reads of one register
    exceptions = {
        1: "no such function (after VF-S15)",
        2: "no such register (after VF-S15)",
        3: "value or count out of range (after VF-S15)",
        4: "cannot be done now (after VF-S15)",
    }
    broadcasts = True
    identify_recognises = True
    remote = (
        "no setting is needed, because bits 15 and 14 of a start override CNOD and FNOD; after a trip or an "
        "emergency stop the drive needs reset_fault()"
    )
    line_parameters = (
        "F800 baud rate (0 to 3: 1200, 2400, 4800, 9600; it must be 3, and an S7e is fixed at 1200), F801 "
        "parity (0 none, 1 even, 2 odd; it must be 1), both in effect after a reset or power-on; F802 address"
    )
    parameter_space = ParameterSpace(  # document, sections 6.1, 6.2 and 7
        groups=(
            ParameterGroup("", 0x0000, range(25), digits=4, as_hex=True),
            ParameterGroup("F", 0x0000, range(100, 900), digits=3, as_hex=True),
        ),
        line=("F801", "F800", "F802"),
        never={"F11*": COMMAND, "F103": COMMAND, "F104": COMMAND},
        firmware="cpu_version",
    )
    options = {
        "stop_time": Option("s", (1, 3600), "longest time that a stop may take; without it, dEC and 5 s"),
        "second_ramp": Option("", (0, 1), "1: `start` takes acceleration and deceleration 2 (bit 6)"),
        "preset_speed": Option("", (1, 7), "`start` runs at this preset speed, Sr1 to Sr7, and not at 1001H"),
        "setpoint_by_fnod": Option(
            "", (0, 1), "1: FNOD says where the setpoint comes from; `start` and `jog` leave bit 14 off"
        ),
    }
    watchdog = (
        "F803: the drive trips with Err.5 if it gets no valid message for 1 to 100 s, counted from the first "
        "one. 0 is off, and the factory value is not stated. Set it, as communication_timeout, longer than "
        "the longest gap between two polls."
    )

    # Basic parameters (document, section 6.1)
    automatic_ramp = choice(0x0000, "6.1, AU1", 1, default=0)
    automatic_torque_boost = choice(0x0001, "6.1, AU2", default=0, while_running=False, never=PANEL)
    automatic_environment = choice(
        0x0002, "6.1, AU3", 2, default=0, while_running=False, never="what else it sets is not stated"
    )
    command_mode = choice(0x0003, "6.1, CNOD", 1, default=1, never=COMMAND)
    frequency_mode = choice(0x0004, "6.1, FNOD", 2, default=2, never=COMMAND)
    meter_selection = choice(0x0005, "6.1, FNSL", 1, default=0)
    meter_adjustment = choice(0x0006, "6.1, FN", step=None, never=NO_SCALE)
    initialisation = choice(0x0007, "6.1, TYP", default=0, while_running=False, never=PANEL)
    panel_direction = choice(0x0008, "6.1, FR", 1, default=0, never=COMMAND)
    acceleration_time = seconds(0x0009, "6.1, ACC", default=10.0)
    deceleration_time = seconds(0x0010, "6.1, DEC", default=10.0)
    maximum_frequency = hertz(
        0x0011, "6.1, FH", 30, at_least="upper_limit_frequency", default=80.0, while_running=False
    )
    upper_limit_frequency = hertz(
        0x0012, "6.1, UL", 0.5, at_least="minimum_frequency", at_most="maximum_frequency", default=80.0
    )
    minimum_frequency = hertz(0x0013, "6.1, LL", at_most="upper_limit_frequency", default=0.0)
    base_frequency = hertz(0x0014, "6.1, uL", 25, default=60.0)
    voltage_frequency_mode = choice(0x0015, "6.1, PT", default=0, while_running=False, never=PANEL)
    torque_boost = choice(0x0016, "6.1, UB", step=None, never=NO_SCALE, note="0.0 to 30.0.")
    thermal_protection = choice(0x0017, "6.1, OLN", 7, default=0)
    preset_speed_1 = preset(0x0018, "6.1, SR1")
    preset_speed_2 = preset(0x0019, "6.1, SR2")
    preset_speed_3 = preset(0x0020, "6.1, SR3")
    preset_speed_4 = preset(0x0021, "6.1, SR4")
    preset_speed_5 = preset(0x0022, "6.1, SR5")
    preset_speed_6 = preset(0x0023, "6.1, SR6")
    preset_speed_7 = preset(0x0024, "6.1, SR7")

    # Extended parameters (document, section 6.2)
    low_speed_frequency = hertz(0x0100, "6.2, F100", at_most="maximum_frequency", default=0.0)
    speed_reach_frequency = hertz(0x0101, "6.2, F101", at_most="maximum_frequency", default=0.0)
    speed_reach_band = hertz(0x0102, "6.2, F102", at_most="maximum_frequency", default=2.5)
    st_selection = choice(0x0103, "6.2, F103", 2, default=1, never=COMMAND)
    rst_selection = choice(0x0104, "6.2, F104", 1, default=0, never=COMMAND)
    always_on_function = choice(0x0110, "6.2, F110", 37, default=0, never=COMMAND)
    input_1_function = choice(0x0111, "6.2, F111", 37, default=2, never=COMMAND)
    input_2_function = choice(0x0112, "6.2, F112", 37, default=3, never=COMMAND)
    input_3_function = choice(0x0113, "6.2, F113", 37, default=10, never=COMMAND)
    input_4_function = choice(0x0114, "6.2, F114", 37, default=6, never=COMMAND)
    input_5_function = choice(0x0115, "6.2, F115", 37, default=7, never=COMMAND)
    output_1_function = choice(0x0130, "6.2, F130", 9, default=4)
    output_2_function = choice(0x0131, "6.2, F131", 9, default=6)

    # Commands (document, section 6.3)
    control = command(
        0x1000,
        YD1000Control,
        kept=Kept.RAM,
        while_running=True,
        broadcast=(STOP, YD1000Control.COMMAND_VALID),
        harmless=(STOP, YD1000Control.COMMAND_VALID, STOP | YD1000Control.COAST),
        never_together=(YD1000Control.RESET | YD1000Control.RUN, YD1000Control.RESET | YD1000Control.JOG),
        place="6.3, 8.1 table 1: 1000",
    )
    frequency = setting(
        0x1001,
        "Hz",
        step=0.01,
        span=(0, 320),
        at_most="maximum_frequency",
        kept=Kept.RAM,
        while_running=True,
        broadcast=(0,),
        place="6.3: 1001",
        note="Used while bit 14 of 1000H is set.",
    )
    panel_frequency = setting(
        0x1002,
        "Hz",
        step=0.01,
        span=(0, 320),
        at_most="maximum_frequency",
        kept=Kept.RAM,
        while_running=True,
        place="6.3: 1002",
    )

    # Live values (document, section 6.4)
    output_frequency = reading(0x1100, "Hz", step=0.01, place="6.4: 1100")

    # Values that a trip freezes, and others (document, section 6.5)
    held_frequency = reading(
        0x1200, "Hz", step=0.01, place="6.5: 1200", note="The output frequency; frozen in a trip."
    )
    status = reading(0x1201, YD1000Status, place="6.5, 8.2 table 2: 1201", note="Frozen in a trip.")
    reference_frequency = reading(0x1202, "Hz", step=0.01, place="6.5: 1202")
    output_current = reading(0x1203, "%", step=0.01, place="6.5: 1203")
    dc_bus_voltage = reading(0x1204, "%", step=0.01, place="6.5: 1204")
    output_voltage = reading(0x1205, "%", step=0.01, place="6.5: 1205")
    inputs = reading(0x1206, Inputs, place="6.5, 8.2 table 3: 1206")
    outputs = reading(0x1207, Outputs, place="6.5, 8.2 table 4: 1207")
    cpu_version = reading(0x1208, step=None, place="6.5: 1208")
    eeprom_version = reading(0x1209, step=None, place="6.5: 1209")
    fault_record_1 = reading(0x1210, place="6.5: 1210", note="A code; the table of faults is missing.")
    fault_record_2 = reading(0x1211, place="6.5: 1211", note="A code; the table of faults is missing.")
    fault_record_3 = reading(0x1212, place="6.5: 1212", note="A code; the table of faults is missing.")
    fault_record_4 = reading(0x1213, place="6.5: 1213", note="A code; the table of faults is missing.")
    run_hours = reading(0x1214, "h", step=1, place="6.5: 1214")

    # Communication parameters (document, section 7)
    baudrate_setting = setting(
        0x0800, YD1000Baudrate, kept=Kept.EEPROM, never=LINE, place="7 (1), F800", note=AFTER_RESET
    )
    parity_setting = setting(
        0x0801, Parity, kept=Kept.EEPROM, never=LINE, place="7 (2), F801", note=AFTER_RESET
    )
    address_setting = setting(
        0x0802,
        span=(0, 63),
        kept=Kept.EEPROM,
        never=LINE,
        place="7 (3), F802",
        note=f"Up to 31 before version V104. {AT_ONCE}",
    )
    communication_timeout = setting(
        0x0803,
        "s",
        step=1,
        span=(0, 100),
        kept=Kept.EEPROM,
        while_running=False,
        place="7 (4), F803",
        note=f"0 is off. {AT_ONCE}",
    )

    _record: float | None = None  # the newest entry in the fault record at its last reading

    def known_counts(self) -> Mapping[Register[Any], tuple[int, int]]:
        """Return the expected raw counts of 0802H (the drive's own address) and 0011H (FH, 30 to 320 Hz)."""
        return {self.address_setting: (self.address, self.address), self.maximum_frequency: (3000, 32000)}

    @verb
    def identify(self) -> Script[None]:
        """Check that 0802H is the drive's own address, and 0011H a maximum frequency."""
        address = yield from read(self.address_setting)
        if address != self.address:
            raise WriteForbidden(
                f"{self.name} shows address {address:g} in 0802H (F802), but is declared at address "
                f"{self.address}. The device may be from another maker: check its name plate"
            )
        most = yield from read(self.maximum_frequency)
        if not 30 <= most <= 320:
            raise WriteForbidden(
                f"{self.name} shows a maximum frequency of {most:g} Hz in 0011H, which is outside 30 to 320 "
                "Hz. The device may be from another maker: check its name plate"
            )

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start at the setpoint 1001H.

        Without a direction, a turning motor keeps its direction, and a resting motor turns forward. The
        options `preset_speed` and `setpoint_by_fnod` select another setpoint, and `second_ramp` selects the
        second ramp. A stop always uses the first ramp.
        """
        how = YD1000Control.RUN
        if self.option.get("second_ramp"):
            how |= YD1000Control.SECOND_RAMP
        if self.option.get("preset_speed"):
            how |= yield from self._preset()
        elif not self._by_fnod():
            yield from self._setpoint_in_force()
        yield from self._turn(how, direction)

    def _by_fnod(self) -> bool:
        return bool(self.option.get("setpoint_by_fnod"))

    def _preset(self) -> Script[YD1000Control]:
        """Select the preset speed while the motor is at rest; return its bits once 1202H shows that speed."""
        number = int(self.option["preset_speed"])
        hz = yield from read(self.registers[f"preset_speed_{number}"])
        if hz == 0:
            raise WriteForbidden(
                f"preset speed {number} of {self.name} is 0: write preset_speed_{number} first"
            )
        if (yield from self._without_fault()).condition is Condition.RUNNING:
            raise self._stop_first(f"{self.name} turns, and a preset speed is started only from rest")
        yield from insist(self.control, STOP)
        if (yield from read(self.reference_frequency)) == hz:
            raise WriteForbidden(
                f"{self.name} is not started: its frequency command is already {hz:g} Hz, so preset speed "
                f"{number} cannot be verified. Write another frequency to 1001H first"
            )
        bits = YD1000Control(0)
        for at, bit in enumerate(PRESET_SPEEDS):
            if number >> at & 1:
                bits |= bit
        yield from write(self.control, self._valid() | bits)
        if not (yield from until(lambda: self._is_commanded(hz), limit=SELECTION_TIME)):
            yield from insist(self.control, STOP)
            raise WriteForbidden(
                f"{self.name} is not started: after preset speed {number} was selected, "
                f"its frequency command did not become {hz:g} Hz"
            )
        return bits

    def _is_commanded(self, hz: float) -> Script[bool]:
        return (yield from read(self.reference_frequency)) == hz

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Jog until stopped. Without a direction, keep a turning motor's direction, or turn forward."""
        yield from self._turn(YD1000Control.JOG, direction)

    def _turn(self, how: YD1000Control, direction: Direction | None) -> Script[None]:
        state = yield from self._without_fault()
        if direction is None and state.condition is Condition.RUNNING:
            direction = state.direction
        reverse = YD1000Control.REVERSE if direction is Direction.REVERSE else YD1000Control(0)
        yield from write(self.control, self._valid() | how | reverse)
        yield from self._started(direction)

    def _valid(self) -> YD1000Control:
        """Return bit 15, which makes a command valid, and bit 14 unless FNOD selects the setpoint."""
        return YD1000Control.COMMAND_VALID if self._by_fnod() else STOP

    def _without_fault(self) -> Script[State]:
        state = yield from self.state.script()
        if state.condition is Condition.FAULT:
            raise self._reset_first(str(state.fault))
        return state

    def _direction(self) -> Script[Direction]:
        """Return the direction of a turning motor from 1201H, which the drive updates except in a trip."""
        status = yield from read(self.status)
        return Direction.REVERSE if status & YD1000Status.REVERSE else Direction.FORWARD

    @verb
    def stop(self) -> Script[None]:
        """Stop along the ramp. The motor counts as stopped when 1100H is 0 twice in a row."""
        yield from insist(self.control, STOP)
        yield from self._stopped(self._is_at_rest, (yield from self._stop_limit()))

    @verb
    def coast(self) -> Script[None]:
        """Remove the voltage and let the motor coast; the coast bit stays set until the next command."""
        yield from insist(self.control, STOP | YD1000Control.COAST)
        yield from self._stopped(self._is_at_rest, STOP_MARGIN)

    @verb
    def emergency_stop(self) -> Script[None]:
        """Stop the motor with the drive's own emergency stop, which leaves the drive in a fault state.

        The command is sent once. If it is not confirmed, the stop along the ramp follows immediately.
        """
        try:
            yield Pulse(self.control, STOP | YD1000Control.EMERGENCY_STOP)
        except (Unconfirmed, DriveException):
            yield from self.stop.script()
            return
        try:
            yield from self._stopped(self._is_at_rest, (yield from self._stop_limit()))
        except BusError:
            yield from insist(self.control, STOP)
            raise
        yield from insist(self.control, STOP)

    def _stop_limit(self) -> Script[float]:
        known = self.option.get("stop_time")
        return known if known else (yield from read(self.deceleration_time)) + STOP_MARGIN

    def _is_at_rest(self) -> Script[bool]:
        if (yield from read(self.output_frequency)) > 0:
            return False
        yield from wait(0.1)
        return (yield from read(self.output_frequency)) == 0

    @verb
    def reset_fault(self) -> Script[None]:
        """Restart the drive once, which resets its fault. Then send a stop.

        The restart loses the setpoint: call set_frequency before the next start.
        """
        if (yield from read(self.output_frequency)) > 0:
            raise WriteForbidden(f"{self.name} runs: it has no fault to reset")
        yield from self._no_terminal_runs("after the reset")
        with suppress(Unconfirmed):  # the restart may cut off the reply
            yield from write(self.control, STOP | YD1000Control.RESET)
        yield from wait(RESET_TIME)
        yield from insist(self.control, STOP)
        self._record = yield from read(self.fault_record_1)

    def _no_terminal_runs(self, when: str) -> Script[None]:
        """Raise WriteForbidden if a closed terminal would start the motor when control returns to it."""
        closed = yield from read(self.inputs)
        functions = {"F110, which is always on,": self.always_on_function}
        for number, terminal in enumerate(Inputs, 1):  # parameters F111 to F115: functions of the terminals
            if closed & terminal:
                functions[f"terminal {terminal.name}"] = self.registers[f"input_{number}_function"]
        for what, function in functions.items():
            if (yield from read(function)) in RUN_FUNCTIONS:
                raise WriteForbidden(
                    f"{what} of {self.name} has a run function and may start the motor {when}. First change "
                    f"this function or open the terminal"
                )

    @verb
    def release_control(self) -> Script[None]:
        """Let panel and terminals command the motor again: clear bits 15 and 14. Allowed only at rest.

        If the motor is then seen to turn, or the drive does not answer, the stop is written again.
        """
        if not (yield from self._is_at_rest()):
            raise self._stop_first(f"control of {self.name} is released only at rest, but its motor turns")
        yield from self._no_terminal_runs("when the line releases control")
        try:
            yield from write(self.control, YD1000Control(0))
        except Unconfirmed:  # the write may have taken effect
            yield from insist(self.control, STOP)
            raise
        try:
            turns = yield from until(self._turns, limit=RELEASE_TIME)
        except BusError:
            yield from insist(self.control, STOP)
            raise
        if turns:
            yield from self.stop.script()
            reason = "its panel or a terminal started the motor, so the stop was written again"
            raise NotVerified(self.name, "the release of its control", reason)

    def _turns(self) -> Script[bool]:
        return (yield from read(self.output_frequency)) > 0

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint, at most FH, the maximum frequency."""
        for name in ("preset_speed", "setpoint_by_fnod"):
            if self.option.get(name):
                raise WriteForbidden(
                    f"{self.name} ignores the setpoint 1001H: its option {name} selects another source"
                )
        yield from self._write_setpoint(self.frequency, hz)

    @verb
    def state(self) -> Script[State]:
        """Return the state. A new entry in the fault record, or a frequency in 1200H at rest, is a fault."""
        if not (yield from self._is_at_rest()):
            return State(Condition.RUNNING, (yield from self._direction()))
        record = yield from read(self.fault_record_1)
        if self._record is None:
            self._record = record
        if record != self._record or (yield from self._is_frozen()):
            return State(Condition.FAULT, fault=f"code {int(record):02X}H")
        return State(
            Condition.STOPPED, note="a trip at rest before the first read of the state would not show"
        )

    def _is_frozen(self) -> Script[bool]:
        """Return True if 1200H is not 0 although 1100H is 0, as in a trip or a start (section 8.2)."""
        if (yield from read(self.held_frequency)) == 0:
            return False
        return (yield from read(self.output_frequency)) == 0
