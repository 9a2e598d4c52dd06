"""Delixi inverters: their parameters, standard Modbus (9200, 9100-SC), and the maker's own ASCII protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from enum import IntEnum
from typing import Any

from multidrop.drive import Condition, Direction, Drive, Framing, State
from multidrop.drive.parameters import ParameterGroup, ParameterSpace
from multidrop.drive.register import (
    HOLDING,
    Carrier,
    Kept,
    Option,
    Register,
    Table,
    Worded,
    command,
    reading,
    setting,
)
from multidrop.drive.verbs import Script, insist, read, verb, write
from multidrop.errors import NotVerified, WriteForbidden

# s; default limit of a stop: the manual does not say which parameter is the deceleration time
STOP_TIME = 60.0

KEYPAD = "it sets up the line, or decides what commands the motor; set it on the keypad"

UNIT_INFERRED = "Its unit is inferred: the manual has only the name."


def parameter(group: int, index: int) -> int:
    """Return the number of a parameter: 500 for P05.00."""
    return group * 100 + index


class DelixiFault(Worded):
    """P05.31, the fault. The codes 10 to 14 may be decimal or hex digits, so both are accepted."""

    NONE = 0
    OC_OVERCURRENT = 1, "overcurrent (OC)"
    OC_1_OVERCURRENT_ACCELERATING = 2, "overcurrent while accelerating (OC-1)"
    OC_2_OVERCURRENT_DECELERATING = 3, "overcurrent while decelerating (OC-2)"
    OU_OVERVOLTAGE = 4, "overvoltage (OU)"
    OU_1_OVERVOLTAGE_ACCELERATING = 5, "overvoltage while accelerating (OU-1)"
    OU_2_OVERVOLTAGE_DECELERATING = 6, "overvoltage while decelerating (OU-2)"
    POFF_UNDERVOLTAGE = 7, "undervoltage (POFF)"
    OH_OVERHEAT = 8, "overheat (OH)"
    OL_OVERLOAD = 9, "overload (OL)"
    EF_EXTERNAL = 10, "external fault (EF)"
    PARAMETER_WRITE = 11, "fault of a parameter write"
    VFOP_VF1_CHANNEL_BROKEN = 12, "channel VF1 is broken (VFOP)"
    IFOP_VF2_CHANNEL_BROKEN = 13, "channel VF2 is broken (IFOP)"
    FLT_MODULE = 14, "module fault (FLT)"

    @classmethod
    def _missing_(cls, value: object) -> DelixiFault | None:
        return cls(value - 6) if isinstance(value, int) and 0x10 <= value <= 0x14 else None


class DelixiRunSource(IntEnum):
    KEYPAD = 0
    TERMINALS = 1
    LINE = 2
    BY_TERMINAL = 3


class DelixiBaudrate(IntEnum):
    B1200 = 0
    B2400 = 1
    B4800 = 2  # 4800 bit/s; the document prints 3800
    B9600 = 3
    B19200 = 4
    B38400 = 5


class DelixiParameters(Drive):
    """The parameters of Delixi's inverters. A subclass states in which table its protocol reads them.

    P04.29, the format, has different codes in each protocol, so subclasses declare it.

    Values have no decimal point, and the document's list of scales is missing. Only the scale of the output
    frequency is known, from an example. The units of P05.01 to P05.10 are inferred from their names.
    """

    baudrates = (9600, 1200, 2400, 4800, 19200, 38400)  # P04.28
    line_terminals = "SG+ and SG-"
    addresses = range(1, 32)  # P04.30
    response_timeout = 0.15
    answers_every_read = True
    answering_time = 0.08  # seconds within which the drive replies
    remote = "P00.00 must be 2 (RS-485)"
    line_parameters = (
        "P04.28 baud rate (0 to 5: 1200, 2400, 4800, 9600, 19200, 38400), P04.29 format (its codes are those "
        "of format_setting), P04.30 address"
    )
    options = {"stop_time": Option("s", (1, 3600), "longest time that a stop may take; 60 without it")}

    run_source = setting(parameter(0, 0), DelixiRunSource, never=KEYPAD, place="P00.00")
    frequency_source = setting(
        parameter(0, 1), never=KEYPAD, place="P00.01", note="1, the digital setting, for P00.02 to be used."
    )
    baudrate_setting = setting(parameter(4, 28), DelixiBaudrate, never=KEYPAD, place="P04.28")
    address_setting = setting(parameter(4, 30), never=KEYPAD, place="P04.30")

    output_frequency = reading(parameter(5, 0), "Hz", step=0.01, place="P05.00")
    reference_frequency = reading(parameter(5, 1), "Hz", step=None, place="P05.01", note=UNIT_INFERRED)
    output_current = reading(parameter(5, 2), "A", step=None, place="P05.02", note=UNIT_INFERRED)
    output_voltage = reading(parameter(5, 3), "V", step=None, place="P05.03", note=UNIT_INFERRED)
    dc_bus_voltage = reading(parameter(5, 4), "V", step=None, place="P05.04", note=UNIT_INFERRED)
    io_signals = reading(parameter(5, 5), place="P05.05", note="Its bits are not described.")
    closed_loop_setpoint = reading(parameter(5, 6), step=None, place="P05.06")
    closed_loop_feedback = reading(parameter(5, 7), step=None, place="P05.07")
    heatsink_temperature = reading(
        parameter(5, 8), "°C", step=None, place="P05.08", note=f"Of the power module. {UNIT_INFERRED}"
    )
    synchronous_speed = reading(parameter(5, 9), "rpm", step=None, place="P05.09", note=UNIT_INFERRED)
    motor_speed = reading(parameter(5, 10), "rpm", step=None, place="P05.10", note=UNIT_INFERRED)
    counter = reading(parameter(5, 11), place="P05.11")
    length = reading(parameter(5, 12), step=None, place="P05.12")
    set_length = reading(parameter(5, 13), step=None, place="P05.13")
    overload = reading(parameter(5, 14), step=None, place="P05.14", note="Accumulated.")
    stage = reading(parameter(5, 15), place="P05.15", note="Of the program.")
    stage_time = reading(parameter(5, 16), step=None, place="P05.16")
    stage_time_left = reading(parameter(5, 17), step=None, place="P05.17")
    work_time = reading(parameter(5, 18), step=None, place="P05.18", note="Accumulated.")
    energy_high = reading(
        parameter(5, 19), step=None, place="P05.19", note="Accumulated output power, high part."
    )
    energy_low = reading(
        parameter(5, 20), step=None, place="P05.20", note="Accumulated output power, low part."
    )
    vf1_input = reading(parameter(5, 21), step=None, place="P05.21")
    vf2_input = reading(parameter(5, 22), step=None, place="P05.22")
    vf1_transformed = reading(parameter(5, 23), step=None, place="P05.23")
    vf2_transformed = reading(parameter(5, 24), step=None, place="P05.24")
    fault_record_1 = reading(parameter(5, 25), place="P05.25", note="A code; its names are not stated.")
    fault_record_2 = reading(parameter(5, 26), place="P05.26", note="A code; its names are not stated.")
    fault_record_3 = reading(parameter(5, 27), place="P05.27", note="A code; its names are not stated.")
    fault_record_4 = reading(parameter(5, 28), place="P05.28", note="A code; its names are not stated.")
    overcurrent_record = reading(parameter(5, 29), step=None, place="P05.29")
    overvoltage_record = reading(parameter(5, 30), step=None, place="P05.30")
    fault = reading(parameter(5, 31), DelixiFault, place="P05.31")

    def __init_subclass__(cls, *, table: Table | None = None) -> None:
        if table is not None:
            cls.parameter_space = ParameterSpace(
                groups=tuple(ParameterGroup(f"P{group:02}.", group * 100, range(100)) for group in range(6)),
                table=table,
                monitors=("P05.*",),
                line=("P04.29", "P04.28", "P04.30"),
            )
            for name, register in DelixiParameters.registers.items():
                moved: Register[float] = replace(register, table=table)
                moved.__set_name__(cls, name)
                setattr(cls, name, moved)
        super().__init_subclass__()

    def _check_line_settings(self) -> Script[None]:
        """Raise WriteForbidden unless P04.30 is the declared address and P04.28 the declared baud rate."""
        address = yield from read(self.address_setting)
        if address != self.address:
            raise WriteForbidden(
                f"{self.name} shows address {address:g} in P04.30, but is declared at address "
                f"{self.address}. The device may be from another maker: check its name plate, and its P04.30"
            )
        held, declared = (yield from read(self.baudrate_setting)), self.settings.baudrate
        if held == DelixiBaudrate[f"B{declared}"]:
            return
        named = f" ({held.name[1:]} bit/s)" if isinstance(held, DelixiBaudrate) else ""
        raise WriteForbidden(
            f"{self.name} shows baud rate code {int(held)}{named} in P04.28, but is declared with {declared} "
            "bit/s. Declare the baud rate of P04.28; if the keypad shows another P04.28, the device is from "
            "another maker"
        )

    def _check_start(self) -> Script[None]:
        """Raise WriteForbidden if the drive has a fault, or does not take its commands from the line."""
        fault = yield from read(self.fault)
        if fault:
            raise WriteForbidden(
                f"{self.name} has a fault, {self.fault.in_words(fault)}: remove the cause, then reset it"
            )
        if (yield from read(self.run_source)) != DelixiRunSource.LINE:
            raise WriteForbidden(f"{self.name} does not take commands from the line: {self.remote}")

    def _stop_limit(self) -> float:
        return self.option.get("stop_time", STOP_TIME)

    def _is_at_rest(self) -> Script[bool]:
        return (yield from read(self.output_frequency)) == 0


# ---- standard Modbus ----


class DelixiModbusControl(IntEnum):
    """The control words that this library sends. Run and jog words include a direction."""

    NOTHING = 0x00
    STOP = 0x01
    FORWARD = 0x12
    REVERSE = 0x22
    JOG_FORWARD = 0x13
    JOG_REVERSE = 0x23


class DelixiModbusFormat(IntEnum):
    """Values of P04.29, the character format, in firmware for standard Modbus."""

    ASCII_7N2 = 0
    ASCII_7E1 = 1
    ASCII_7O1 = 2
    RTU_8N2 = 3
    RTU_8E1 = 4
    RTU_8O1 = 5


class DelixiModbus(DelixiParameters, table=HOLDING):
    """Delixi 9200 (RTU firmware) and 9100-SC; RS-485 communication protocol, part 2, standard Modbus.

    P04.29 selects RTU or ASCII on a 9200; a 9100-SC has ASCII only. For other models use `delixi-native`.
    Where the document errs or is silent, the safest interpretation applies:

    - The address of the setpoint in RAM is printed "xxH". The only known setpoint is 0002H (P00.02), which
      wears the EEPROM. It is written on change only, so do not ramp with it.
    - Whether a run command without a direction keeps the previous direction is not stated, so every run
      command has a direction. `start` without a direction goes forward from rest. It is refused while the
      motor turns, because the direction cannot be read. The word that toggles the direction is never sent.
    - It is not stated whether a start ends a jog, or whether a jog ends a run. So after a jog a stop is
      required before a start, and a turning motor must be stopped before a jog.
    - No fault reset is documented, and reserved bits are not tried.
    - No state word is documented: an output frequency of 0 may mean a stop, or a run at a setpoint of 0.
    - "3800" bit/s is a misprint of 4800. The fault "0C-xx" is OC-2, and 04 is OU.
    - How many registers one request may read is not stated, so each request reads one. Exception codes are
      not stated either, so any exception counts as a refusal.
    - Timing is taken from part 3 of the document.

    With P00.00 = 2 the drive takes commands from the line; with P00.01 = 1 it takes the setpoint from P00.02.
    Only functions 03 and 06 are used. Only run commands may be broadcast.
    """

    model = "delixi-modbus"
    title = "Delixi 9200/9100-SC (Modbus)"
    manual = "Delixi inverters, RS-485 communication protocol, part 2, standard Modbus"

    framings = (Framing.RTU, Framing.ASCII)
    formats = {  # P04.29
        Framing.RTU: ("8N2", "8E1", "8O1"),
        Framing.ASCII: ("7N2", "7E1", "7O1"),
    }
    most_registers = {HOLDING: 1}  # the document has no example that reads more registers at once
    exceptions = {}
    broadcasts = True
    identify_recognises = True
    remote = "P00.00 must be 2 (RS-485), and P00.01 must be 1 (digital setting)"

    control = command(
        0x2000,
        DelixiModbusControl,
        broadcast=(DelixiModbusControl.STOP,),
        harmless=(DelixiModbusControl.NOTHING, DelixiModbusControl.STOP),
        place="part 2, section 3: 2000H",
    )
    frequency = setting(
        parameter(0, 2),
        "Hz",
        step=0.01,
        kept=Kept.EEPROM,
        place="P00.02",
        note="Every write wears the EEPROM. Used if P00.01 = 1.",
    )
    format_setting = setting(parameter(4, 29), DelixiModbusFormat, never=KEYPAD, place="P04.29")

    _jogged = False  # True if this object has sent a jog since it last saw the motor at rest

    def known_counts(self) -> Mapping[Register[Any], tuple[int, int]]:
        """Return a range of raw counts for P04.30 (address), the bus voltage and P04.28 (baud rate).

        The ranges do not overlap: addresses end at 31, and the voltage starts at 32. P04.28 is left out if
        its code is equal to the address.
        """
        known = {self.address_setting: (self.address, self.address), self.dc_bus_voltage: (32, 0xFFFF)}
        code = DelixiBaudrate.__members__.get(f"B{self.settings.baudrate}", self.address)
        return known if code == self.address else known | {self.baudrate_setting: (code, code)}

    @verb
    def identify(self) -> Script[None]:
        """Check that P04.30 is the drive's address, P04.28 its baud rate, and P05.31 a fault code."""
        yield from self._check_line_settings()
        fault = yield from read(self.fault)
        if not isinstance(fault, type(self.fault.decode(0))):
            raise WriteForbidden(
                f"{self.name} shows fault code {int(fault):04X}H in P05.31, which the manual does not list. "
                "The device may be from another maker: check its name plate"
            )

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start at the setpoint in force. Without a direction: forward, and only from rest."""
        if self._jogged and not (yield from self._is_at_rest()):
            raise self._stop_first(f"{self.name} may still be jogging, and a start might not end the jog")
        forward = yield from self._goes_forward(direction)
        if (yield from read(self.frequency_source)) != 1:
            raise WriteForbidden(f"{self.name} ignores the setpoint P00.02: set P00.01 to 1 on the keypad")
        yield from self._setpoint_in_force()
        self._jogged = False
        yield from write(
            self.control, DelixiModbusControl.FORWARD if forward else DelixiModbusControl.REVERSE
        )
        yield from self._started(direction)

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Turn slowly from rest until stopped; without a direction, forward."""
        forward = yield from self._goes_forward(direction)
        if not (yield from self._is_at_rest()):
            raise self._stop_first(f"{self.name} already turns, and a jog must start from rest")
        self._jogged = True
        yield from write(
            self.control, DelixiModbusControl.JOG_FORWARD if forward else DelixiModbusControl.JOG_REVERSE
        )
        yield from self._started(direction)

    def _goes_forward(self, direction: Direction | None) -> Script[bool]:
        yield from self._check_start()
        if direction is None and not (yield from self._is_at_rest()):
            raise WriteForbidden(
                f"{self.name} turns, but cannot report its direction: give a direction, forward or reverse"
            )
        return direction is not Direction.REVERSE

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor. It counts as stopped when the output frequency is 0."""
        yield from insist(self.control, DelixiModbusControl.STOP)
        yield from self._stopped(self._is_at_rest, self._stop_limit())

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint, which is stored in EEPROM, if it changes."""
        yield from self._write_setpoint(self.frequency, hz)

    @verb
    def state(self) -> Script[State]:
        """Return a fault by its name, or `running` above 0 Hz; at 0 Hz the state is unknown."""
        fault = yield from read(self.fault)
        if fault:
            return State(Condition.FAULT, fault=self.fault.in_words(fault))
        if (yield from self._is_at_rest()):
            return State(Condition.UNKNOWN, note="output frequency 0: stopped, or running at a setpoint of 0")
        return State(Condition.RUNNING)


# ---- Delixi's own protocol ----


COMMAND = Table("run command", None, 0x02, Carrier.NUMBER, Kept.RAM)
STATE = Table("run state", 0x03, None, Carrier.NUMBER)
SETPOINT = Table("run setpoint", None, 0x04, Carrier.LONG, Kept.RAM)
PARAMETER_RAM = Table("parameter, not stored", 0x07, 0x05, Carrier.LONG, Kept.RAM)
PARAMETER = Table("parameter", 0x07, 0x06, Carrier.LONG, Kept.EEPROM)


class DelixiNativeControl(IntEnum):
    STOP = 1
    FORWARD = 2
    REVERSE = 3
    RESET_FAULT = 4


class DelixiNativeStatus(IntEnum):
    STOPPED = 1
    FORWARD = 2  # the document prints 2 as "FWD (stopped)", 3 as "REV (stopped)"
    REVERSE = 3
    FAULT = 4
    UNDERVOLTAGE = 5


CONDITIONS = {
    DelixiNativeStatus.STOPPED: (Condition.STOPPED, None),
    DelixiNativeStatus.FORWARD: (Condition.RUNNING, Direction.FORWARD),
    DelixiNativeStatus.REVERSE: (Condition.RUNNING, Direction.REVERSE),
}


class DelixiNativeFormat(IntEnum):
    """Values of P04.29, the character format, in firmware for Delixi's own protocol."""

    N81 = 0
    E81 = 1
    O81 = 2


class DelixiNative(DelixiParameters, table=PARAMETER):
    """Delixi inverters; RS-485 communication protocol, part 3, Modbus-like ASCII format.

    Each function code K has its own table: 02 run command, 03 run state, 04 run setpoint (RAM), 05 and 06
    parameters (05 writes to RAM, 06 to EEPROM), 07 read parameters. Declare your own parameters in a
    subclass, such as `setting(parameter(0, 17), "s", table=PARAMETER_RAM)`. The table determines the memory:
    06 writes to EEPROM, and 02, 04 and 05 do not.

    Where the document errs or is silent, the safest interpretation applies:

    - The replies 0002 and 0003 to K = 03 are printed as "forward (stopped)" and "reverse (stopped)". They
      count as running, and are never reported as stopped.
    - The faults 10 to 14 are printed as if in hex, so 0AH-0EH and 10H-14H are both decoded as these faults.
      Any other code except 0 is a fault too.
    - "K = FOH" is F0H, "3800" bit/s is 4800, and "<80m" is 80 ms.
    - Which value of P00.01 makes the drive use the setpoint of K = 04 is not stated.
    - K = 03 may report a fault or undervoltage while P05.31 is 0. What a run command does then is not stated
      (it may wait for the mains), so `start` is refused, as in any unexplained state.
    - The checksum does not detect swapped bytes, so a reply is compared with its request field by field.
    - K = F0 to FF occur only in a drive's replies, so they are never sent.

    Less than 10 ms may pass between two characters. Only run commands (K = 02) may be broadcast.
    """

    model = "delixi-native"
    title = "Delixi (own protocol)"
    manual = "Delixi inverters, RS-485 communication protocol, part 3, Modbus-like ASCII format"

    framings = (Framing.DELIXI,)
    formats = {Framing.DELIXI: ("8N1", "8E1", "8O1")}  # P04.29
    exceptions = {
        0xF0: "command cannot be executed",
        0xFC: "invalid parameter number",
        0xFD: "value out of limits",
        0xFE: "parameter locked",
        0xFF: "checksum error",
    }
    damaged = frozenset({0xFF})
    broadcasts = True

    control = command(
        0,
        DelixiNativeControl,
        table=COMMAND,
        broadcast=(DelixiNativeControl.STOP,),
        harmless=(DelixiNativeControl.STOP,),
        place="part 3, section 5: K = 02",
    )
    status = reading(0, DelixiNativeStatus, table=STATE, place="part 3, section 5: K = 03")
    frequency = command(
        0x0001, "Hz", step=0.01, table=SETPOINT, moves=False, place="part 3, section 5: K = 04, 0001"
    )
    pi_setpoint = command(
        0x0007, step=0.1, table=SETPOINT, moves=False, place="part 3, section 5: K = 04, 0007"
    )
    stored_frequency = setting(
        parameter(0, 2), "Hz", step=0.01, table=PARAMETER, place="P00.02", note="Used if P00.01 = 1."
    )
    format_setting = setting(
        parameter(4, 29), DelixiNativeFormat, table=PARAMETER, never=KEYPAD, place="P04.29"
    )

    @property
    def echo_probe(self) -> Register[Any]:
        """The run state.

        Its value is never 0, so its reply differs from an echo of the request (part 3, section 5).
        """
        return self.status

    @verb
    def identify(self) -> Script[None]:
        """Check that P04.30 is the drive's address and P04.28 its baud rate."""
        yield from self._check_line_settings()

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start at the setpoint in force.

        Without a direction, a turning motor keeps its direction, and a resting motor turns forward.
        """
        yield from self._check_start()
        status = yield from read(self.status)
        if status in (DelixiNativeStatus.FAULT, DelixiNativeStatus.UNDERVOLTAGE):
            raise self._reset_first(status.name)
        if status not in CONDITIONS:
            raise WriteForbidden(
                f"{self.name} reports state {int(status):04X}H in its reply to K = 03, "
                "which the manual does not explain"
            )
        yield from self._setpoint_in_force()
        if direction is None and status == DelixiNativeStatus.REVERSE:
            direction = Direction.REVERSE
        word = DelixiNativeControl.REVERSE if direction is Direction.REVERSE else DelixiNativeControl.FORWARD
        yield from write(self.control, word)
        yield from self._started(direction)

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor.

        It counts as stopped when the run state shows no run and the output frequency is 0.
        """
        yield from insist(self.control, DelixiNativeControl.STOP)
        yield from self._stopped(self._is_at_rest, self._stop_limit())

    def _is_at_rest(self) -> Script[bool]:
        if (yield from read(self.status)) not in (
            DelixiNativeStatus.STOPPED,
            DelixiNativeStatus.FAULT,
            DelixiNativeStatus.UNDERVOLTAGE,
        ):
            return False
        return (yield from read(self.output_frequency)) == 0

    @verb
    def reset_fault(self) -> Script[None]:
        """Reset a fault; never starts the motor. The command is sent once, then verified."""
        if (yield from read(self.status)) in CONDITIONS and not (yield from self._is_at_rest()):
            raise WriteForbidden(f"{self.name} runs: it has no fault to reset")
        yield from write(self.control, DelixiNativeControl.RESET_FAULT)
        status = yield from read(self.status)
        if status in (DelixiNativeStatus.FAULT, DelixiNativeStatus.UNDERVOLTAGE):
            fault = self.fault.in_words((yield from read(self.fault)))
            raise NotVerified(self.name, "the fault reset", f"the fault remains: {fault}")

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint to RAM; it cannot be read back."""
        yield from self._write_setpoint(self.frequency, hz)

    @verb
    def state(self) -> Script[State]:
        """Return the run state with its direction, and the fault by name."""
        status = yield from read(self.status)
        if status in CONDITIONS:
            condition, direction = CONDITIONS[status]
            still = condition is Condition.RUNNING and (yield from read(self.output_frequency)) == 0
            return State(condition, direction, note="output frequency 0" if still else "")
        if status in (DelixiNativeStatus.FAULT, DelixiNativeStatus.UNDERVOLTAGE):
            fault = yield from read(self.fault)
            return State(
                Condition.FAULT, fault=self.fault.in_words(fault) if fault else self.status.in_words(status)
            )
        return State(Condition.UNKNOWN, note=f"K = 03 says {int(status):04X}H, which is not explained")
