"""ERMAN ER-G-220-01(02): its registers, coils and verbs."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Any, Unpack

from multidrop.drive import Condition, Direction, Drive, State
from multidrop.drive.number_format import NumberFormat
from multidrop.drive.parameters import ParameterSpace
from multidrop.drive.register import (
    COIL,
    HOLDING,
    INPUT,
    Details,
    Option,
    Register,
    command,
    declaration,
    reading,
    setting,
)
from multidrop.drive.verbs import Script, insist, read, verb, write
from multidrop.errors import Advice, BusError, DriveException, Unconfirmed, WriteForbidden

STOP_MARGIN = 5.0  # seconds that a stop may take in addition to the deceleration time
UNKNOWN_RAMP = 30.0  # seconds allowed for a stop if the deceleration time cannot be read


class Coil(IntEnum):
    OFF = 0
    ON = 1


class ErmanStatus(IntEnum):
    """Bits 0 and 1 form one number, the state; bit 5 means that the motor is overloaded."""

    STOPPED = 0
    RUNNING = 1
    ACCELERATING = 2
    DECELERATING = 3
    STOPPED_OVERLOADED = 0x20
    RUNNING_OVERLOADED = 0x21
    ACCELERATING_OVERLOADED = 0x22
    DECELERATING_OVERLOADED = 0x23


PHASE = 0x03
OVERLOAD = 0x20

CONDITIONS = (Condition.STOPPED, Condition.RUNNING, Condition.ACCELERATING, Condition.DECELERATING)


class ErmanFault(IntFlag):
    EMERGENCY_STOP = 1 << 0
    LOW_DC_VOLTAGE = 1 << 1
    HIGH_DC_VOLTAGE = 1 << 2
    LOW_MOTOR_CURRENT = 1 << 3
    MOTOR_CURRENT_ABOVE_THRESHOLD = 1 << 4  # two thresholds: 120 and 150 % of the rated current
    INVERTER_SHORT_CIRCUIT = 1 << 5
    OVERHEAT = 1 << 6
    PWM_MODULATOR = 1 << 7
    SYSTEM_ERROR = 1 << 10
    SYSTEM_RESET = 1 << 11


class Modes(IntFlag):
    """Bits of register 0001H. The drive's manual does not state what their values mean."""

    MODULATION_TYPE = 1 << 0
    CONTROL_TYPE = 1 << 4
    AUTOMATIC_VOLTAGE_REGULATOR = 1 << 8


@declaration
def _coil(number: int, what: Any, /, **details: Unpack[Details]) -> Register[Any]:
    details["table"], details["place"] = COIL, f"section 10, commands: {number}"
    return command(number, what, **details)


@declaration
def _held(number: int, what: Any, /) -> Register[Any]:
    return reading(number, what, table=COIL, place=f"section 6, function 01; section 10, commands: {number}")


@declaration
def _state(number: int, what: Any, /, **details: Unpack[Details]) -> Register[Any]:
    details["table"], details["place"] = INPUT, f"section 10, state: {details.get('place', number)}"
    return reading(number, what, **details)


@declaration
def _control(number: int, what: Any, /, **details: Unpack[Details]) -> Register[Any]:
    """Declare a control register; `place` is its parameter name in the drive's menu."""
    details["place"] = f"{details['place']}; section 10, control: {number}"
    return setting(number, what, **details)


class ErmanERG220(Drive):
    """ERMAN ER-G-220-01(02); MODBUS communication protocol, document 1.4 of 30.03.2021.

    Where the document errs or is silent, the safest interpretation applies:

    - The example of function 04 has the checksum of function 03's example. Its reply has a byte count of 10H
      for 5 registers: the library requires the byte count that fits the request.
    - The example of function 06 writes the setpoint to 0001H. That is a misprint, the setpoint is
      0002H; 0001H is never written.
    - The example of function 0F resets a fault and starts in one frame, and sets a reserved coil.
      Coils are written one at a time (05), and reset and start are two calls.
    - The byte order of a reply to function 01 is doubtful, so coils are read only within one byte. They show
      the last command, and are polled only if a plant names them. Whether the motor runs is read from 0400H,
      whose bits 0 and 1 are one number and not two flags.
    - Diagnostics (function 08) are described by one example, of subfunction 0, and its error reply
      has the code 89H instead of 88H. `drive.send_raw(0x08, 0x0000, b"\\xa5\\x37")` sends this example. The
      reply is a copy of the request, like an adapter's echo, so it does not prove that a drive is there.
    - The order of the two words at 0400H and 0402H is not stated, but one word is always 0.
    - 0402H is the last fault. The document does not say whether a reset clears this register, or whether
      the fault is still active. `start` is refused until the fault was reset with this object's
      `reset_fault`, or acknowledged with the option `acknowledged_fault`.
    - Whether START and STOP are levels or pulses is not stated. `stop` sets STOP and clears START. It also
      sets EMERGENCY STOP if the motor still runs after the deceleration time, or after 30 s if that time is
      unreadable. Both stop coils stay set until `start` clears them, because clearing them earlier could let
      a latched START take effect. START is cleared even if STOP is not
      confirmed, because the drive may receive one of the two writes although the other is lost.
    - Exception 03 is used for any wrong address, and 04 is described as "on write": neither means a device
      failure.
    - The models -03 and -04 of this make have a different register map: see `identify`.
    - A setpoint is limited to the minimum and the maximum frequency, because the drive does not refuse
      others.

    No ranges, defaults or timing are stated, nor which registers are in EEPROM. Address 0 is called the
    broadcast, but the document does not say whether drives reply to it, so it is never sent. b.001 and b.002
    must select RS-485.
    """

    model = "erman-er-g-220"
    title = "ERMAN ER-G-220-01(02)"
    manual = "ER-G-220-01(02) frequency converter, MODBUS communication protocol, document 1.4 of 30.03.2021"

    formats = dict.fromkeys(Drive.framings, ("8N1",))
    baudrates = (38400,)
    line_terminals = "485A and 485B"
    most_devices = 31  # section 1
    remote = "b.001 must be 2 and b.002 must be 5 (RS-485)"
    line_parameters = (
        "b.010 address (1 from the factory), set while the motor stands, in effect after the next power-on; "
        "38400 bit/s and 1 stop bit are fixed, and there is no parity"
    )
    no_broadcasts = "the manual does not say whether drives reply to address 0, so none is sent"
    addresses = range(1, 32)
    answers_every_read = True
    most_registers = {HOLDING: 88, INPUT: 17, COIL: 12}
    readable_gaps = {HOLDING: range(0x0000, 0x0059), INPUT: range(0x0000, 0x1000)}
    exceptions = {
        1: "unknown command",
        2: "bad register address",
        3: "bad addresses on read or write (the table has it for reads, the examples for writes too)",
        4: "bad addresses on write",
    }
    # parameter names in the drive's menu, such as b.001
    parameter_space = ParameterSpace(named=r"^([bdE]\.\d+);")
    options = {
        "acknowledged_fault": Option(
            "", (0, 0xFFFF_FFFF), "the drive's last fault, as its number, once it has been dealt with"
        )
    }

    # Commands, which are coils (section 10 of the document)
    start_coil = _coil(0x0000, Coil, harmless=(Coil.OFF,))
    stop_coil = _coil(0x0001, Coil, harmless=(Coil.ON,))
    emergency_stop_coil = _coil(0x0002, Coil, harmless=(Coil.ON,))
    fault_reset_coil = _coil(0x0009, Coil, harmless=(Coil.OFF,))

    # State registers (section 10 of the document)
    output_frequency = _state(0x0001, "Hz", step=0.1)
    output_current = _state(0x0003, "A", step=0.1)
    dc_bus_voltage = _state(0x0005, "V")
    heatsink_temperature = _state(
        0x0006, "°C", number_format=NumberFormat.I16, note="Whether it is signed is not stated."
    )
    output_voltage = _state(0x000C, "V")
    status = _state(
        0x0400,
        ErmanStatus,
        number_format=NumberFormat.U32_EITHER,
        place="1024-1025",
        note="The word order is not stated; all defined values fit into one word.",
    )
    last_fault = _state(
        0x0402,
        ErmanFault,
        number_format=NumberFormat.U32_EITHER,
        place="1026-1027",
        note="The last fault, which may be past. The word order is not stated.",
    )

    # Control registers (section 10 of the document)
    control_register = setting(
        0x0001,
        Modes,
        never="it changes the kind of modulation and control, and what its bits mean is not stated",
        place="section 10, control: 1",
    )
    frequency = _control(
        0x0002, "Hz", step=0.1, at_least="minimum_frequency", at_most="maximum_frequency", place="b.007"
    )
    maximum_frequency = _control(0x0003, "Hz", step=0.1, at_least="minimum_frequency", place="b.006")
    minimum_frequency = _control(0x0004, "Hz", step=0.1, at_most="maximum_frequency", place="b.005")
    carrier_frequency = _control(0x000B, "kHz", step=0.1, place="d.006")
    acceleration_time = _control(0x000C, "s", step=0.1, place="b.003")
    deceleration_time = _control(0x000D, "s", step=0.1, place="b.004")
    braking_threshold = _control(0x0015, "V", place="E.06", note="Of dynamic braking.")

    # The command coils, as the drive reports them: they show the last command (sections 6 and 10). A read
    # includes only the wanted coils, so that its reply has all wanted coils in one byte.
    start_held = _held(0x0000, Coil)
    stop_held = _held(0x0001, Coil)
    emergency_stop_held = _held(0x0002, Coil)
    fault_reset_held = _held(0x0009, Coil)

    _reset_fault = ErmanFault(0)  # value of `last_fault` at the last reset; this fault does not block a start

    @classmethod
    def readings(cls) -> tuple[Register[Any], ...]:
        """Return all readings except the coils, which only show the last command."""
        return tuple(register for register in super().readings() if register.table is not COIL)

    @verb
    def identify(self) -> Script[None]:
        """Check that register 0400H can be read with function 04, which the models -03 and -04 lack."""
        try:
            yield from read(self.status)
        except DriveException as refusal:
            raise WriteForbidden(
                f"{self.name} has no state register at 0400H, so it is not an ER-G-220-01(02)"
            ) from refusal

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor; the drive has no reverse."""
        if direction is Direction.REVERSE:
            raise self._unsupported("reverse")
        fault = yield from read(self.last_fault)
        dealt_with = self.option.get("acknowledged_fault", 0)
        if fault and fault not in (self._reset_fault, dealt_with):
            reset, declare = Advice.call("reset_fault"), Advice.declare("acknowledged_fault", int(fault))
            way = Advice(
                f"{reset.program}, or {declare.program}",
                f"{reset.command} and {declare.command}",
                f"{reset.command}, or {declare.plant}",
            )
            shown = self.last_fault.in_words(fault)
            raise WriteForbidden(
                f"{self.name} may have a fault, {shown}: remove its cause, then {way.program}", advice=way
            )
        yield from self._setpoint_in_force()
        yield from write(self.stop_coil, Coil.OFF)
        yield from write(self.emergency_stop_coil, Coil.OFF)
        yield from write(self.start_coil, Coil.ON)
        yield from self._started()

    @verb
    def stop(self) -> Script[None]:
        """Stop along the ramp.

        If that is refused, or the motor still turns afterwards, use the emergency stop.
        """
        try:
            yield from self._stop_and_clear_start(self.stop_coil)
        except DriveException:
            yield from self.emergency_stop.script()
            return
        limit = yield from self._longest_ramp()
        try:
            yield from self._stopped(self._is_at_rest, limit)
        except Unconfirmed:
            yield from insist(self.emergency_stop_coil, Coil.ON)
            yield from self._stopped(self._is_at_rest, limit)

    @verb
    def emergency_stop(self) -> Script[None]:
        """Stop the motor with the drive's own emergency stop."""
        yield from self._stop_and_clear_start(self.emergency_stop_coil)
        yield from self._stopped(self._is_at_rest, (yield from self._longest_ramp()))

    def _stop_and_clear_start(self, stop: Register[Coil]) -> Script[None]:
        """Set this stop coil and clear START, even if setting the stop coil is not confirmed."""
        try:
            yield from insist(stop, Coil.ON)
        except Unconfirmed:
            yield from insist(self.start_coil, Coil.OFF, attempts=1)
            raise
        yield from insist(self.start_coil, Coil.OFF)

    def _longest_ramp(self) -> Script[float]:
        """Return the longest time in s that the motor may still turn after a stop."""
        try:
            return (yield from read(self.deceleration_time)) + STOP_MARGIN
        except BusError:  # if this read gets no reply, the drive may not receive a stop either
            return UNKNOWN_RAMP

    def _is_at_rest(self) -> Script[bool]:
        status = yield from read(self.status)
        return not status & PHASE and (yield from read(self.output_frequency)) == 0

    @verb
    def reset_fault(self) -> Script[None]:
        """Reset a fault. START is cleared first, so that the reset cannot start the motor."""
        if (yield from read(self.status)) & PHASE:
            raise WriteForbidden(f"{self.name} runs: it has no fault to reset")
        fault = yield from read(self.last_fault)
        yield from insist(self.start_coil, Coil.OFF)
        try:
            yield from write(self.fault_reset_coil, Coil.ON)
        except BusError:
            yield from insist(self.fault_reset_coil, Coil.OFF)
            raise
        yield from insist(self.fault_reset_coil, Coil.OFF)
        self._reset_fault = fault

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint, which must lie between the drive's minimum and maximum frequency."""
        yield from self._write_setpoint(self.frequency, hz)

    @verb
    def state(self) -> Script[State]:
        """Return the phase of the ramp as the state.

        The last fault is only a note, because it may be over.
        """
        status = yield from read(self.status)
        fault = yield from read(self.last_fault)
        notes = ["motor overloaded"] if status & OVERLOAD else []
        condition = CONDITIONS[status & PHASE]
        if condition is Condition.STOPPED and fault:
            notes.append(f"last fault {self.last_fault.in_words(fault)}, which may still be in force")
        return State(condition, note="; ".join(notes))
