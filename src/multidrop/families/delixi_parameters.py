"""Parameters and fault codes that Delixi's two protocols share."""

from __future__ import annotations

from dataclasses import replace
from enum import IntEnum

from multidrop.drive import Drive, WriteForbidden
from multidrop.drive.options import Option
from multidrop.drive.parameters import ParameterGroup, ParameterSpace
from multidrop.drive.register import Register, Table, Worded, reading, setting
from multidrop.drive.script import Script, read

STOP_TIME = 60.0  # s; the parameter number of the deceleration time is not known

KEYPAD = "it belongs to the line or to the command over the motor; set it on the keypad"

UNIT_INFERRED = "Its unit is inferred: the manual has only the name."


def parameter(group: int, index: int) -> int:
    """Return the number of a parameter: 500 for P05.00."""
    return group * 100 + index


class DelixiFault(Worded):
    """P05.31, the fault. The codes 10 to 14 may be decimal or hex digits: both are accepted."""

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
    B4800 = 2  # misprinted as 3800 in the document
    B9600 = 3
    B19200 = 4
    B38400 = 5


class DelixiParameters(Drive):
    """The parameters of Delixi's inverters; each protocol's subclass passes the table that holds them.

    P04.29, the format, has different codes in each protocol, so subclasses declare it.

    Values have no decimal point, and the document's list of scales is missing. Only the scale of the output
    frequency is known, from an example. The units of P05.01 to P05.10 are inferred from their names.
    """

    baudrates = (9600, 1200, 2400, 4800, 19200, 38400)  # P04.28
    line_terminals = "SG+ and SG-"
    addresses = range(1, 32)  # P04.30
    response_timeout = 0.15
    answers_every_read = True
    answering_time = 0.08  # s; the drive replies within this time
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

    def _shows_its_line(self) -> Script[None]:
        """Raise WriteForbidden unless P04.30 and P04.28 are the declared address and baud rate."""
        address = yield from read(self.address_setting)
        if address != self.address:
            raise WriteForbidden(
                f"{self.name} has {address:g} as P04.30, not its address {self.address}: it may be another "
                "make; look at its name plate, and at P04.30 on its keypad"
            )
        held, declared = (yield from read(self.baudrate_setting)), self.settings.baudrate
        if held == DelixiBaudrate[f"B{declared}"]:
            return
        named = f", {held.name[1:]} bit/s" if isinstance(held, DelixiBaudrate) else ""
        raise WriteForbidden(
            f"{self.name} has {int(held)} as P04.28{named}, and is declared with {declared} bit/s: declare "
            f"the drive's own baud rate, even behind a converter; if its keypad shows another P04.28, it is "
            f"another make"
        )

    def _may_start(self) -> Script[None]:
        """Raise WriteForbidden in a fault, without a setpoint, or if the line does not command the drive."""
        fault = yield from read(self.fault)
        if fault:
            raise WriteForbidden(
                f"{self.name} has a fault, {self.fault.in_words(fault)}: remove its cause and reset it first"
            )
        if (yield from read(self.run_source)) != DelixiRunSource.LINE:
            raise WriteForbidden(f"{self.name} does not take its commands from the line: {self.remote}")

    def _limit(self) -> float:
        return self.option.get("stop_time", STOP_TIME)

    def _stands(self) -> Script[bool]:
        return (yield from read(self.output_frequency)) == 0
