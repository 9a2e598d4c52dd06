"""INVT CHE: its registers and verbs, and functions to declare the parameters of your own model."""

from __future__ import annotations

from contextlib import suppress
from enum import IntEnum
from typing import Any, Unpack

from multidrop.drive import Condition, Direction, Drive, State
from multidrop.drive.number_format import NumberFormat
from multidrop.drive.register import (
    HOLDING,
    Details,
    Kept,
    Option,
    Register,
    Worded,
    command,
    declaration,
    reading,
    setting,
)
from multidrop.drive.verbs import Script, insist, read, verb, write
from multidrop.errors import ANOTHER_FAMILY, Advice, BusError, DriveException, NotVerified, WriteForbidden

CHE100 = "CHE100 manual v1.4, p. 117"
CHE100_NEXT = "CHE100 manual v1.4, p. 118"
CHE100_CODES = "CHE100 manual v1.4, p. 119"
SCALE = f"{CHE100}; scale: Goodrive300L manual, p. 130 (compatible with CHF100A and CHV100)"

STOP_TIME = 60.0  # seconds allowed for a stop by default: the deceleration time has no known address


class CHEControl(IntEnum):
    FORWARD = 1
    REVERSE = 2
    JOG_FORWARD = 3
    JOG_REVERSE = 4
    STOP = 5  # stop along the ramp; some other makes use 6 for this and 5 to coast
    COAST = 6
    RESET_FAULT = 7
    STOP_JOG = 8


class CHEStatus(IntEnum):
    FORWARD = 1
    REVERSE = 2
    STANDBY = 3
    FAULT = 4


class Device(IntEnum):
    CHE_UNIVERSAL = 0x0101
    CHE_1500_HZ = 0x0102


# device codes in register 3016H, from the manuals of these series
OTHER_SERIES = {0x010A: "Goodrive300L", 0x010C: "Goodrive200L"}
# high byte of 3016H in the CHF series, which has the same control words (CHE100 manual v1.4, p. 119)
CHF = 0x02


class CHEFault(Worded):
    NONE = 0
    OUT1_PHASE_U = 1, "fault of output phase U (OUT1)"
    OUT2_PHASE_V = 2, "fault of output phase V (OUT2)"
    OUT3_PHASE_W = 3, "fault of output phase W (OUT3)"
    OC1_OVERCURRENT_ACCELERATING = 4, "overcurrent while accelerating (OC1)"
    OC2_OVERCURRENT_DECELERATING = 5, "overcurrent while decelerating (OC2)"
    OC3_OVERCURRENT_CONSTANT = 6, "overcurrent at constant speed (OC3)"
    OV1_OVERVOLTAGE_ACCELERATING = 7, "overvoltage while accelerating (OV1)"
    OV2_OVERVOLTAGE_DECELERATING = 8, "overvoltage while decelerating (OV2)"
    OV3_OVERVOLTAGE_CONSTANT = 9, "overvoltage at constant speed (OV3)"
    UV_UNDERVOLTAGE = 10, "undervoltage (UV)"
    OL1_MOTOR_OVERLOAD = 11, "motor overload (OL1)"
    OL2_INVERTER_OVERLOAD = 12, "inverter overload (OL2)"
    SPI_INPUT_PHASE = 13, "input phase failure (SPI)"
    SPO_OUTPUT_PHASE = 14, "output phase failure (SPO)"
    OH1_RECTIFIER_OVERHEAT = 15, "rectifier overheat (OH1)"
    OH2_INVERTER_OVERHEAT = 16, "inverter overheat (OH2)"
    EF_EXTERNAL = 17, "external fault (EF)"
    CE_COMMUNICATION = 18, "communication fault (CE)"
    ITE_CURRENT_DETECTION = 19, "current detection fault (ITE)"
    TE_AUTOTUNING = 20, "autotuning fault (TE)"
    EEP_EEPROM = 21, "EEPROM fault (EEP)"
    PIDE_FEEDBACK = 22, "PID feedback lost (PIDE)"
    BCE_BRAKE_UNIT = 23, "brake unit fault (BCE)"


class CommunicationFault(IntEnum):
    NONE = 0
    WRONG_PASSWORD = 1
    BAD_COMMAND_CODE = 2
    BAD_CHECKSUM = 3
    BAD_ADDRESS = 4
    BAD_DATA = 5
    PARAMETER_CHANGE_INVALID = 6
    SYSTEM_LOCKED = 7
    BUSY_STORING = 8


@declaration
def parameter(ordinal: int, what: Any = "", /, **details: Unpack[Details]) -> Register[Any]:
    """Declare a parameter by its ordinal, its position in the list of your model's manual (section 11.6.4).

    The parameter is kept in EEPROM, but writes go to its address in RAM, which has bit 15 set. A written
    value is lost at power-off; use `stored_parameter` for permanent writes. Before the first write, compare
    the value read with the keypad: with a wrong ordinal a write may restore the factory settings.

        class MyCHE(InvtCHE):
            acceleration_time = parameter(8, "s", step=0.1, place="P0.08")
            stored_deceleration_time = stored_parameter(9, "s", step=0.1, place="P0.09")
    """
    _in_section_11_6_4(ordinal, details)
    details["ram_address"] = ordinal | 0x8000
    return setting(ordinal, what, **details)


@declaration
def stored_parameter(ordinal: int, what: Any = "", /, **details: Unpack[Details]) -> Register[Any]:
    """Declare a parameter whose writes go to EEPROM, so that they survive a loss of power.

    Every write wears the EEPROM (section 11.6.4), so writes are sent only on change, and are counted.
    """
    _in_section_11_6_4(ordinal, details)
    return setting(ordinal, what, **details)


def _in_section_11_6_4(ordinal: int, details: Details) -> None:
    if not 0 <= ordinal <= 0x01FF:
        raise ValueError(f"ordinal {ordinal} is outside 0 to 511, the addresses of parameters")
    details["kept"] = Kept.EEPROM
    details.setdefault("place", f"section 11.6.4, ordinal {ordinal}")


class InvtCHE(Drive):
    """INVT CHE series; manual, chapter 11 "communication protocol".

    The chapter's register table is lost. All registers here, the meaning of exceptions and the PC group are
    from the CHE100 manual v1.4. Scales, if given, are from the Goodrive300L manual. The names of faults are
    those of the CHE100's relatives, for display only.

    Where the sources err or are silent, the safest interpretation applies:

    - The address of a function code, as INVT calls a parameter, is its ordinal number. The two examples
      contradict each other (P5.05 is 003AH by counting, P0.07 is said to be 000CH), so no ordinal is
      computed. A model's own codes are declared in a subclass, with `parameter` or `stored_parameter`.
    - Addresses with bit 15 set write to RAM only and cannot be read.
    - 2000H is a percentage of the maximum frequency (P0.04), so `set_frequency` needs that as the
      option `maximum_frequency`. A negative percentage probably reverses the motor, so only 0 to 100 % is
      written.
    - Newer INVT families have the control word at 2000H: see `identify`.
    - Two scales are not stated, because sources differ: GD200L and GD300L print the DC bus voltage (3002H)
      with and without a decimal; the output power (3006H) is 0.1 % in the Goodrive300L manual, and 0.01 kW
      on a CHF100A, whose owner compared the register with the keypad.
    - The example that writes 5000 to 0008H does not say what that register is: do not repeat it.
    - STOP might not end a jog: if the motor still turns after STOP, or the motor's state is unknown, STOP_JOG
      follows at once. A start might not end a jog either: after a jog a stop is required before a start.
      Whether a jog ends a run is not stated: `jog` is refused while the motor turns.
    - State words other than 1 to 4 are not explained: while one is shown, `start` and `jog` are refused.
    - Exception 03 is a malformed frame; a value out of range is 12H.

    The drive may also speak ASCII (CHE100 manual); the chapter has RTU only. P0.01 = 2 takes
    commands from the line. The PE group is the maker's, and is neither read nor written.
    """

    model = "invt-che"
    title = "INVT CHE"
    manual = "CHE series manual, chapter 11, communication protocol; registers: CHE100 manual v1.4"

    formats = dict.fromkeys(Drive.framings, ("8N1", "8E1", "8O1", "8N2", "8E2", "8O2"))  # PC.02
    baudrates = (9600, 1200, 2400, 4800, 19200, 38400)  # PC.01
    addresses = range(1, 248)
    response_timeout = 0.4  # s; PC.03 sets the delay of a reply: 5 ms by default, at most 200 ms
    answers_every_read = True
    most_registers = {HOLDING: 16}
    # the document allows reads that include these reserved registers
    readable_gaps = {HOLDING: range(0x3000, 0x3017)}
    exceptions = {
        0x01: "illegal command, or the drive has a fault",
        0x02: "illegal address",
        0x03: "malformed frame",
        0x06: "busy storing in EEPROM",
        0x10: "wrong password",
        0x11: "checksum error",
        0x12: "write not allowed: out of range, not changeable now, or terminal function already used",
        0x13: "locked by a password",
    }
    damaged = frozenset({0x11})
    broadcasts = True
    identify_recognises = True
    setpoint_name = "setpoint"
    remote = "P0.01 must be 2, and P0.03 must take the frequency from the line"
    line_parameters = (
        "PC.00 address (1 from the factory), PC.01 baud rate (0 to 5: 1200, 2400, 4800, 9600, 19200, 38400; "
        "3 from the factory), PC.02 format (0 to 5: 8N1, 8E1, 8O1, 8N2, 8E2, 8O2, all RTU; 0 from the "
        "factory); CHE100 manual v1.4"
    )
    options = {
        "maximum_frequency": Option("Hz", (1, 3000), "P0.04, of which the setpoint is a percentage"),
        "stop_time": Option("s", (1, 3600), "longest time that a stop may take; 60 without it"),
    }
    watchdog = (
        "PC.04 (0.1 to 100.0 s) is off from the factory; PC.05 = 0 coasts with alarm CE, 1 (factory) runs "
        "on, 2 stops if P0.01 = 2, 3 always stops (CHE100 manual v1.4). Both are set on the keypad."
    )

    control = command(
        0x1000,
        CHEControl,
        kept=Kept.RAM,
        while_running=True,
        broadcast=(CHEControl.STOP,),
        harmless=(CHEControl.STOP, CHEControl.COAST, CHEControl.STOP_JOG),
        outside=CHE100,
    )
    status = reading(0x1001, CHEStatus, outside=CHE100)
    setpoint = setting(
        0x2000,
        "%",
        step=0.01,
        span=(0, 100),
        number_format=NumberFormat.I16,
        kept=Kept.RAM,
        while_running=True,
        broadcast=(0,),
        outside=CHE100,
        note="Of P0.04, or of the PID's range; only if P0.03 takes the frequency from the line.",
    )
    output_frequency = reading(0x3000, "Hz", step=0.01, outside=SCALE)
    reference_frequency = reading(0x3001, "Hz", step=0.01, outside=SCALE)
    dc_bus_voltage = reading(
        0x3002,
        "V",
        step=None,
        outside=CHE100,
        note="0.1 V (seen on a CHF100A) or 1 V: 1.41 times the mains tells which.",
    )
    output_voltage = reading(0x3003, "V", step=1, outside=SCALE)
    output_current = reading(0x3004, "A", step=0.1, outside=SCALE)
    motor_speed = reading(0x3005, "rpm", step=1, outside=SCALE)
    output_power = reading(
        0x3006,
        step=None,
        number_format=NumberFormat.I16,
        outside=CHE100,
        note="0.01 kW (seen on a CHF100A) or 0.1 % (Goodrive300L manual): the keypad tells which.",
    )
    output_torque = reading(0x3007, "%", step=0.1, number_format=NumberFormat.I16, outside=SCALE)
    pid_setpoint = reading(0x3008, "%", step=0.1, outside=SCALE)
    pid_feedback = reading(0x3009, "%", step=0.1, outside=SCALE)
    inputs = reading(0x300A, outside=CHE100, note="Its bits are not described.")
    outputs = reading(0x300B, outside=CHE100, note="Its bits are not described.")
    analog_input_1 = reading(0x300C, "V", step=0.01, outside=SCALE)
    analog_input_2 = reading(0x300D, "V", step=0.01, outside=SCALE)
    pulse_frequency = reading(
        0x3010, "kHz", step=None, outside=CHE100, note='Printed as "0.00-50.00 kHz (unit 0.01 Hz)".'
    )
    stage = reading(0x3012, outside=CHE100, note="Of the PLC or the multi-step speeds.")
    length = reading(0x3013, step=None, outside=CHE100_NEXT)
    counter = reading(0x3014, outside=CHE100_NEXT)
    device = reading(0x3016, Device, outside=CHE100_CODES)
    fault = reading(
        0x5000,
        CHEFault,
        outside=f"{CHE100_NEXT}; names: Powtran PI130 manual, p. 123, Goodrive350 manual, p. 193",
        note="The same as P7.15.",
    )
    communication_fault = reading(0x5001, CommunicationFault, outside=CHE100_NEXT)

    _jogged = False  # True if this object has sent a jog and has not seen the motor at rest since

    @verb
    def identify(self) -> Script[None]:
        """Check that 3016H is 0101H or 0102H. A stop is withheld only if 3016H shows another INVT series."""
        device = yield from read(self.device)
        if isinstance(device, Device):
            return
        series = OTHER_SERIES.get(int(device))
        known = f", a {series}" if series else ""
        if int(device) >> 8 == CHF:
            known = ", a CHF100A; declare model = invt-chf100a"
        raise WriteForbidden(
            f"{self.name} reports device code {int(device):04X}H{known}. A CHE reports 0101H or 0102H",
            rule=ANOTHER_FAMILY if series else "",
        )

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start at the setpoint in force.

        Without a direction, a turning motor keeps its direction, and a resting motor turns forward.
        """
        if self._jogged and not (yield from self._is_at_rest()):
            raise self._stop_first(f"{self.name} may still be jogging, and a start might not end the jog")
        forward = yield from self._goes_forward(direction)
        yield from self._setpoint_in_force()
        self._jogged = False
        yield from write(self.control, CHEControl.FORWARD if forward else CHEControl.REVERSE)
        yield from self._started(direction)

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Turn slowly from rest until stopped; without a direction, forward."""
        forward = yield from self._goes_forward(direction)
        if not (yield from self._is_at_rest()):
            raise self._stop_first(f"{self.name} already turns, and a jog must start from rest")
        self._jogged = True
        yield from write(self.control, CHEControl.JOG_FORWARD if forward else CHEControl.JOG_REVERSE)
        yield from self._started(direction)

    def _goes_forward(self, direction: Direction | None) -> Script[bool]:
        status = yield from read(self.status)
        if status == CHEStatus.FAULT:
            fault = self.fault.in_words((yield from read(self.fault)))
            raise self._reset_first(fault)
        if status not in STATES:
            raise WriteForbidden(
                f"{self.name} shows state {int(status):04X}H in 1001H, which the manual does not explain"
            )
        if direction is None:
            return status != CHEStatus.REVERSE
        return direction is Direction.FORWARD

    @verb
    def stop(self) -> Script[None]:
        """Stop along the ramp.

        If the motor still turns, also send STOP_JOG, because no register shows a jog.
        """
        refusals: list[DriveException] = []
        try:
            if (yield from self._rests_after(CHEControl.STOP, refusals)):
                return
        except WriteForbidden:  # the drive is of another family, so STOP_JOG could run its motor
            raise
        except BusError:  # a drive whose replies are lost may be jogging, and may still receive STOP_JOG
            with suppress(BusError):
                yield from insist(self.control, CHEControl.STOP_JOG, attempts=1)
            raise
        if (yield from self._rests_after(CHEControl.STOP_JOG, refusals)):
            return
        if len(refusals) > 1:
            raise refusals[0]
        yield from self._stopped(self._is_at_rest, self.option.get("stop_time", STOP_TIME))

    def _rests_after(self, word: CHEControl, refusals: list[DriveException]) -> Script[bool]:
        """Write a stop word; return True if the motor is then at rest. A refusal is added to `refusals`."""
        try:
            yield from insist(self.control, word)
        except DriveException as refusal:  # some drives refuse this stop word during a fault or without a jog
            refusals.append(refusal)
        return (yield from self._is_at_rest())

    @verb
    def coast(self) -> Script[None]:
        """Remove the voltage and let the motor coast."""
        yield from insist(self.control, CHEControl.COAST)
        yield from self._stopped(self._is_at_rest, self.option.get("stop_time", STOP_TIME))

    def _is_at_rest(self) -> Script[bool]:
        """Return True if the status shows that the motor has no voltage, as in standby or a fault."""
        return (yield from read(self.status)) in (CHEStatus.STANDBY, CHEStatus.FAULT)

    @verb
    def reset_fault(self) -> Script[None]:
        """Reset a fault; never starts the motor. The command is sent once, then verified."""
        if (yield from read(self.status)) in (CHEStatus.FORWARD, CHEStatus.REVERSE):
            raise WriteForbidden(f"{self.name} runs: it has no fault to reset")
        yield from write(self.control, CHEControl.RESET_FAULT)
        if (yield from read(self.status)) == CHEStatus.FAULT:
            fault = self.fault.in_words((yield from read(self.fault)))
            raise NotVerified(self.name, "the fault reset", f"the fault remains: {fault}")

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint, converted from Hz to a percentage of the maximum frequency."""
        most = self.option.get("maximum_frequency")
        if most is None:
            raise WriteForbidden(
                f"{self.name} takes its setpoint in percent of P0.04, the maximum frequency: "
                "declare maximum_frequency = HZ",
                advice=Advice.declare("maximum_frequency", "HZ"),
            )
        if not 0 <= hz <= most:
            raise ValueError(f"{hz:g} Hz is outside 0 to {most:g} Hz, the maximum frequency of {self.name}")
        yield from self._write_setpoint(self.setpoint, hz / most * 100)

    @verb
    def state(self) -> Script[State]:
        """Return the state shown by the state word, and the fault by name."""
        status = yield from read(self.status)
        if status == CHEStatus.FAULT:
            fault = yield from read(self.fault)
            return State(Condition.FAULT, fault=self.fault.in_words(fault) if fault else None)
        return STATES.get(status, State(Condition.UNKNOWN, note=f"1001H = {int(status)} is not explained"))


STATES = {
    CHEStatus.FORWARD: State(Condition.RUNNING, Direction.FORWARD),
    CHEStatus.REVERSE: State(Condition.RUNNING, Direction.REVERSE),
    CHEStatus.STANDBY: State(Condition.STOPPED),
}
