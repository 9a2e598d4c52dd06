"""YD1000, a relative of Toshiba's VF-S7 with a Modbus card: its registers and verbs."""

from __future__ import annotations

from contextlib import suppress
from enum import IntEnum, IntFlag
from typing import Unpack

from multidrop.drive import (
    BusError,
    Condition,
    Direction,
    Drive,
    DriveRefused,
    Option,
    Pulse,
    Refused,
    Script,
    State,
    Unconfirmed,
    insist,
    read,
    verb,
    wait,
    write,
)
from multidrop.register import Details, Kept, Register, command, reading, setting

STOP_MARGIN = 5.0  # s, on top of the deceleration time
RESET_TIME = 3.0  # s in which the drive restarts and may be deaf

PANEL = "it is effective from the panel only"
LINE = "it changes the drive's end of the line; set it on the panel"
NO_SCALE = "its scale is not stated"


class Control(IntFlag):
    """1000H. Bits 15 and 14 latch until they are written 0 or the power goes."""

    COMMAND_VALID = 1 << 15  # this word, not CNOD, commands the motor
    FREQUENCY_VALID = 1 << 14  # 1001H, not FNOD, is the setpoint
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


STOP = Control.COMMAND_VALID | Control.FREQUENCY_VALID  # all that this library sends has these two


class Status(IntFlag):
    RUN = 1 << 10  # also while braking by direct current
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


class Baudrate(IntEnum):
    B1200 = 0
    B2400 = 1
    B4800 = 2
    B9600 = 3


class Parity(IntEnum):
    NONE = 0
    EVEN = 1
    ODD = 2


def choice(number: int, place: str, most: int | None = None, /, **more: Unpack[Details]) -> Register[float]:
    """A parameter from 0 to `most`, or of unknown range."""
    if most is not None:
        more["span"] = (0, most)
    return setting(number, **_parameter(place, more))


def seconds(number: int, place: str, /, **more: Unpack[Details]) -> Register[float]:
    """A time; its unit is from outside the document."""
    more["step"], more["span"] = 0.1, (0.1, 3600)
    more["outside"] = "unit: Toshiba IPE002Z manual, p. 34"
    return setting(number, "s", **_parameter(place, more))


def hertz(number: int, place: str, least: float = 0, /, **more: Unpack[Details]) -> Register[float]:
    """A frequency up to the highest FH; its unit is from outside the document."""
    more["step"], more["span"] = 0.01, (least, 320)
    more["outside"] = "unit: Toshiba IPE002Z manual, p. 35"
    return setting(number, "Hz", **_parameter(place, more))


def preset(number: int, place: str, /) -> Register[float]:
    """A preset speed, from LL to UL."""
    return hertz(number, place, at_least="minimum_frequency", at_most="upper_limit_frequency", default=0.0)


def _parameter(place: str, more: Details) -> Details:
    return {"kept": Kept.EEPROM, "while_running": True, "place": place, **more}


class YD1000(Drive):
    """YD1000; communication notes (MODBUS).

    Where the document errs or is silent, the safest reading is taken:

    - Register numbers are hex digits that are sent as they are: dEC, number 0010, is 0010H. That
      and the units of ACC, FH and their like are from outside the document (Toshiba's relatives):
      see `identify`, which holds 0802H against the drive's own address.
    - The table heads have the checksum's high byte first. It is the low one, as everywhere.
    - Other functions than 03 (one register) and 06 are spoken of, but not in the function table.
    - 0000H in the control word is no stop: without bit 15 the panel or the terminals are in command,
      and may say run. A stop keeps bit 15, and so does everything else.
    - Bit 14 should stay as it was, and what it is cannot be told for sure: every command has it set.
      So the setpoint is 1001H from the first verb on, which is 0 Hz until set_frequency is called.
    - Bit 13 (reset) and 12 (emergency stop) are held for a moment only: relatives restart again and
      again while they are set. A reset keeps bit 15 and the run bit off, so that no terminal starts the
      motor; its reply may be cut off, and 3 s later the stop is written again.
    - Jog is written without the run bit, which would turn the motor at the setpoint if jog is not obeyed.
    - 1200H and 1201H are called present values, but are frozen in a trip: only 1100H is live. A motor
      has stopped when it is 0 twice. A trip cannot be seen, only a change in the fault record.
    - Registers marked "panel only" are never written, although section 8.1 writes 0007H to initialise;
      0800H to 0803H neither: they act on the line at once.
    - The table of faults is missing: codes are shown as they are. Exceptions are a relative's, VF-S15's.
    - Addresses above 31 need a version above V104. The stop bits are not stated: 1.

    All but 1000H to 12FFH is kept in EEPROM. F800 = 3 and F801 = 1 are required: 9600 8E1. An S7e has
    no F800 and is fixed at 1200 bit/s.
    """

    model = "yd1000"
    title = "YD1000"
    manual = "YD1000 (MODBUS) communication notes"

    formats = dict.fromkeys(Drive.framings, ("8E1", "8N1", "8O1"))  # F801
    baudrates = (9600, 4800, 2400, 1200)  # F800
    addresses = range(1, 64)
    silence_characters = 24  # section 4.3
    response_delay_characters = 24
    response_timeout = 0.5  # 24 characters are 220 ms at 1200 bit/s
    exceptions = {
        1: "no such function (after VF-S15)",
        2: "no such register (after VF-S15)",
        3: "value or count out of range (after VF-S15)",
        4: "cannot be done now (after VF-S15)",
    }
    broadcasts = True
    remote = "a start has bits 15 and 14 set, so that neither CNOD nor FNOD matters"
    options = {
        "stop_time": Option("s", (1, 3600), "longest time that a stop may take; without it, dEC and 5 s"),
    }
    watchdog = (
        "F803: trips with Err.5 when no valid message comes for 1 to 100 s; 0 is off. Set it on the panel, "
        "longer than the longest gap between two polls."
    )

    # Section 6.1, basic parameters
    automatic_ramp = choice(0x0000, "6.1, AU1", 1, default=0)
    automatic_torque_boost = choice(0x0001, "6.1, AU2", default=0, while_running=False, never=PANEL)
    automatic_environment = choice(0x0002, "6.1, AU3", 2, default=0, while_running=False)
    command_mode = choice(0x0003, "6.1, CNOD", 1, default=1)
    frequency_mode = choice(0x0004, "6.1, FNOD", 2, default=2)
    meter_selection = choice(0x0005, "6.1, FNSL", 1, default=0)
    meter_adjustment = choice(0x0006, "6.1, FN", step=None, never=NO_SCALE)
    initialisation = choice(0x0007, "6.1, TYP", default=0, while_running=False, never=PANEL)
    panel_direction = choice(0x0008, "6.1, FR", 1, default=0)
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

    # Section 6.2, extended parameters
    low_speed_frequency = hertz(0x0100, "6.2, F100", at_most="maximum_frequency", default=0.0)
    speed_reach_frequency = hertz(0x0101, "6.2, F101", at_most="maximum_frequency", default=0.0)
    speed_reach_band = hertz(0x0102, "6.2, F102", at_most="maximum_frequency", default=2.5)
    st_selection = choice(0x0103, "6.2, F103", 2, default=1)
    rst_selection = choice(0x0104, "6.2, F104", 1, default=0)
    always_on_function = choice(0x0110, "6.2, F110", 37, default=0)
    input_1_function = choice(0x0111, "6.2, F111", 37, default=2)
    input_2_function = choice(0x0112, "6.2, F112", 37, default=3)
    input_3_function = choice(0x0113, "6.2, F113", 37, default=10)
    input_4_function = choice(0x0114, "6.2, F114", 37, default=6)
    input_5_function = choice(0x0115, "6.2, F115", 37, default=7)
    output_1_function = choice(0x0130, "6.2, F130", 9, default=4)
    output_2_function = choice(0x0131, "6.2, F131", 9, default=6)

    # Section 6.3, commands
    control = command(
        0x1000,
        Control,
        kept=Kept.RAM,
        while_running=True,
        broadcast=(STOP, Control.COMMAND_VALID),
        harmless=(STOP, Control.COMMAND_VALID, STOP | Control.COAST),
        never_together=(Control.RESET | Control.RUN, Control.RESET | Control.JOG),
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

    # Section 6.4, live
    output_frequency = reading(0x1100, "Hz", step=0.01, place="6.4: 1100")

    # Section 6.5
    held_frequency = reading(
        0x1200, "Hz", step=0.01, place="6.5: 1200", note="The output frequency; frozen in a trip."
    )
    status = reading(0x1201, Status, place="6.5, 8.2 table 2: 1201", note="Frozen in a trip.")
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

    # Section 7, communication
    baudrate_setting = setting(0x0800, Baudrate, kept=Kept.EEPROM, never=LINE, place="7 (1), F800")
    parity_setting = setting(0x0801, Parity, kept=Kept.EEPROM, never=LINE, place="7 (2), F801")
    address_setting = setting(0x0802, kept=Kept.EEPROM, never=LINE, place="7 (3), F802")
    communication_timeout = setting(
        0x0803, "s", step=1, kept=Kept.EEPROM, never=LINE, place="7 (4), F803", note="0 is off; 1 to 100 s."
    )

    _record: float | None = None  # the latest entry of the fault record when it was last looked at

    @verb
    def identify(self) -> Script[None]:
        """0802H is the drive's own address, and 0011H a maximum frequency."""
        address = yield from read(self.address_setting)
        if address != self.address:
            raise Refused(f"{self.name} has {address:g} at 0802H, not its address: it is not a YD1000")
        most = yield from read(self.maximum_frequency)
        if not 30 <= most <= 320:
            raise Refused(f"{self.name} has {most:g} Hz at 0011H, not 30 to 320: it is not a YD1000")

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start at 1001H; without a direction, in the one it turns in, or forward."""
        yield from self._setpoint_in_force()
        yield from self._turn(Control.RUN, direction)

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Turn slowly until stopped; without a direction, in the one it turns in, or forward."""
        yield from self._turn(Control.JOG, direction)

    def _turn(self, how: Control, direction: Direction | None) -> Script[None]:
        state = yield from self.state.script()
        if state.condition is Condition.FAULT:
            raise Refused(f"{self.name} has a fault, {state.fault}: see to it, then call reset_fault()")
        if direction is None and state.condition is Condition.RUNNING:
            direction = state.direction
        reverse = Control.REVERSE if direction is Direction.REVERSE else Control(0)
        yield from write(self.control, STOP | how | reverse)
        yield from self._started()

    def _direction(self) -> Script[Direction]:
        """Of a motor that turns: then 1201H is not frozen."""
        status = yield from read(self.status)
        return Direction.REVERSE if status & Status.REVERSE else Direction.FORWARD

    @verb
    def stop(self) -> Script[None]:
        """Stop along the ramp, which has happened when 1100H is 0 twice."""
        yield from insist(self.control, STOP)
        yield from self._stopped(self._stands, (yield from self._limit()))

    @verb
    def coast(self) -> Script[None]:
        """Take the voltage off and let the motor run out; the coast bit stays set until the next command."""
        yield from insist(self.control, STOP | Control.COAST)
        yield from self._stopped(self._stands, STOP_MARGIN)

    @verb
    def emergency_stop(self) -> Script[None]:
        """Stop the motor as the drive's own emergency stop does, which is a fault.

        It is a pulse and sent once. When it is not confirmed, the stop along the ramp follows at once.
        """
        try:
            yield Pulse(self.control, STOP | Control.EMERGENCY_STOP)
        except (Unconfirmed, DriveRefused):
            yield from self.stop.script()
            return
        try:
            yield from self._stopped(self._stands, (yield from self._limit()))
        except BusError:
            yield from insist(self.control, STOP)
            raise
        yield from insist(self.control, STOP)

    def _limit(self) -> Script[float]:
        known = self.option.get("stop_time")
        return known if known else (yield from read(self.deceleration_time)) + STOP_MARGIN

    def _stands(self) -> Script[bool]:
        if (yield from read(self.output_frequency)) > 0:
            return False
        yield from wait(0.1)
        return (yield from read(self.output_frequency)) == 0

    @verb
    def reset_fault(self) -> Script[None]:
        """Restart the drive, which resets its fault, and command the stop again; sent once.

        Its setpoint is lost with it: call set_frequency before the next start.
        """
        if (yield from read(self.output_frequency)) > 0:
            raise Refused(f"{self.name} runs: it has no fault to reset")
        with suppress(Unconfirmed):  # the restart cuts the reply off
            yield from write(self.control, STOP | Control.RESET)
        yield from wait(RESET_TIME)
        yield from insist(self.control, STOP)
        self._record = yield from read(self.fault_record_1)
        self.commanded = None

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint, which is at most FH."""
        yield from self._hold(self.frequency, hz)

    @verb
    def state(self) -> Script[State]:
        """Whether it turns; a fault only if the record has changed since this object's last look."""
        if not (yield from self._stands()):
            return State(Condition.RUNNING, (yield from self._direction()))
        record = yield from read(self.fault_record_1)
        if self._record is None:
            self._record = record
        if record != self._record:
            return State(Condition.FAULT, fault=f"code {int(record):02X}H")
        return State(Condition.STOPPED, note="a trip before the first look would not show")
