"""INNOVERT IBD: its registers and verbs."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from enum import IntEnum, IntFlag
from typing import Any

from multidrop.drive import Condition, Direction, Drive, Framing, State
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.parameters import ParameterGroup, ParameterSpace
from multidrop.drive.register import HOLDING, Option, Register, command, reading, setting
from multidrop.drive.verbs import Script, insist, read, verb, write
from multidrop.errors import Advice, BusError, DriveException, Unconfirmed, WriteForbidden

STOP_MARGIN = 5.0  # seconds that a stop may take in addition to the deceleration time

# bits of PrA.22 without a name; and those that are 1 in the manual's example
UNNAMED, UNNAMED_AS_1 = 0xD800, 0x1800

INFERRED = "the address is inferred: the table of letters is lost"
OTHER_MAKE = "code: Delta VFD-B and DEMA D5M manuals; the document itself has 1 = 9600 bit/s"


def parameter(name: str) -> int:
    """Return the address of a parameter: 3 for PrA.03, 107 for Prb.07 (appendix 2, table 2).

    The digits for A and b are known from examples. Those for C to H are inferred, because the manual's table
    is missing.
    """
    letter, _, number = name.removeprefix("Pr").partition(".")
    return "ABCDEFGH".index(letter.upper()) * 100 + int(number)


class IBDControl(IntEnum):
    """The control words that this library sends.

    No word sets both direction bits (2 and 3), and no word sets the bit that reverses a turning motor.
    """

    NOTHING = 0x00
    STOP = 0x01
    RUN = 0x02
    JOG = 0x03
    RUN_BIT_2 = 0x06
    JOG_BIT_2 = 0x07
    RUN_BIT_3 = 0x0A
    JOG_BIT_3 = 0x0B
    RESET_FAULT = 0x10


class Terminals(IntFlag):
    FWD = 1 << 0
    REV = 1 << 1
    S1 = 1 << 2
    S2 = 1 << 3
    S3 = 1 << 4
    S4 = 1 << 5
    S5 = 1 << 6
    S6 = 1 << 7
    M01 = 1 << 8
    M02 = 1 << 9
    YABC = 1 << 10
    VIRTUAL = 1 << 13


class Output(IntEnum):
    """Functions of a programmable output. The manual names only these codes."""

    RUNNING = 1
    FAULT = 3
    ACCELERATING = 7
    DECELERATING = 8


class FrequencySource(IntEnum):
    PARAMETER = 0  # Prb.00
    LINE = 5


class IBDRunSource(IntEnum):
    LINE = 2


class IBDBaudrate(IntEnum):
    B4800 = 0
    B9600 = 1
    B19200 = 2
    B38400 = 3


class IBDFormat(IntEnum):
    ASCII_8N1 = 0
    ASCII_8E1 = 1
    ASCII_8O1 = 2
    RTU_8N1 = 3
    RTU_8E1 = 4
    RTU_8O1 = 5


# registers of the state that a sibling declares: when the value is 0, and whether it is a code
OF_STATE = {
    "run_state": ("at rest", True),
    "output_frequency": ("at rest", False),
    "fault": ("without a fault", True),
}


class InnovertIBD(Drive):
    """INNOVERT IBD series; operating manual, appendix 2, pp. 128-134.

    Where the document errs or is silent, the safest interpretation applies:

    - The meaning of Prb.01 is contradictory (by the text, 5 selects the line; in an example,
      5 selects the potentiometer): it is never written. Set it to 5, and Prb.02 to 2, on the keypad.
    - The two direction bits are ambiguous: they are printed in the opposite order to all other bits. A
      direction is refused, unless the option `forward_bit` says which bit was seen on site to turn the motor
      forward. Without a direction both bits are 0, and `start` turns the motor in the last direction. The
      word that toggles the direction is never sent.
    - A jog ends only with a stop, after which a start is possible (table 3). No register shows whether a
      turning motor jogs: `start` and `jog` are refused while it turns, and need a stop first.
    - A reset has "no action" in bits 1 and 0, so a run from before the fault may stay in force. A reset is
      sent only after a confirmed stop.
    - A sibling, a family file that extends this family, may declare `run_state` (0 at rest),
      `output_frequency` and `fault`. `state`, `stop` and `start` then read these, and not the outputs.
    - No state word is documented. `state` and `stop` use the outputs if these are programmed as in the
      example (Prd.23 = 1, Prd.24 = 7, Prd.25 = 8, Prd.28 = 3). Otherwise the state is unknown, and `stop`
      uses current and speed.
    - 2000H and 2001H are marked "write": they are not read.
    - A value above a parameter's maximum is silently stored as the maximum: settings are read back.
      The setpoint's range, 0 to 400 Hz, ignores the drive's maximum frequency: declare that
      frequency as the option `maximum_frequency`.
    - The manual's table of the letters' digits is missing. The digits of A and b are known from examples.
      Those of C to H are inferred: these parameters are read, but never written.
    - No register identifies an IBD: see `identify`, and the option `confirmed`.
    - The "ordinal of the register" in a reply is the byte count. At most 4 registers are read.

    Functions 03 and 06 only. Exceptions, fault codes, the registers in EEPROM and those that may be changed
    while the motor turns are not stated.
    """

    model = "innovert-ibd"
    title = "INNOVERT IBD"
    manual = "INNOVERT IBD series, operating manual, appendix 2, data exchange, pp. 128-134"

    framings = (Framing.RTU, Framing.ASCII)
    formats = dict.fromkeys(framings, ("8N1", "8E1", "8O1"))
    baudrates = (9600, 4800, 19200, 38400)
    line_terminals = "RS+ and RS-"
    addresses = range(1, 241)
    answers_every_read = True
    silence = 10e-3  # seconds of silence before and after an RTU frame (table "message in RTU mode")
    most_registers = {HOLDING: 4}
    exceptions = {}
    broadcasts = True
    remote = "set Prb.01 to 5 and Prb.02 to 2 on the keypad"
    line_parameters = (
        "PrH.00 baud rate (1 is 9600), PrH.01 format (0 to 2: ASCII, 3 to 5: RTU; each 8N1, 8E1, 8O1), "
        "PrH.02 address"
    )
    parameter_space = ParameterSpace(  # the addresses of the groups PrC to PrH are inferred
        groups=tuple(
            ParameterGroup(f"Pr{letter}.", hundred * 100, range(100))
            for hundred, letter in enumerate("bCdEFGH", start=1)
        ),
        never=dict.fromkeys(("PrC.*", "Prd.*", "PrE.*", "PrF.*", "PrG.*", "PrH.*"), INFERRED),
    )
    options = {
        "maximum_frequency": Option("Hz", (1, 400), "the highest setpoint that may be written"),
        "forward_bit": Option("", (2, 3), "2 or 3, the bit of 2000H that was seen to turn it forward"),
        "confirmed": Option("", (0, 1), "1: its name plate says that it is an IBD; see `identify`"),
    }

    output_current = reading(parameter("PrA.03"), "A", step=0.1, place="PrA.03")
    motor_speed = reading(parameter("PrA.04"), step=None, place="PrA.04", note="Its unit is not stated.")
    terminals = reading(
        parameter("PrA.22"),
        Terminals,
        place="PrA.22, table 4",
        note="Bits 11 and 12 are reserved, and were seen as 1.",
    )

    stored_frequency = setting(
        parameter("Prb.00"),
        "Hz",
        step=None,
        never="its scale is not stated",
        place="Prb.00",
        note="The setpoint when Prb.01 = 0.",
    )
    frequency_source = setting(
        parameter("Prb.01"), FrequencySource, never="what its values mean is contradictory", place="Prb.01"
    )
    run_source = setting(
        parameter("Prb.02"),
        IBDRunSource,
        never="it decides what commands the motor; set it on the keypad",
        place="Prb.02",
    )
    acceleration_time = setting(parameter("Prb.07"), "s", step=0.1, place="Prb.07")
    deceleration_time = setting(parameter("Prb.08"), "s", step=0.1, place="Prb.08")

    output_m01 = setting(parameter("Prd.23"), Output, never=INFERRED, place="Prd.23")
    output_m02 = setting(parameter("Prd.24"), Output, never=INFERRED, place="Prd.24")
    output_yabc = setting(parameter("Prd.25"), Output, never=INFERRED, place="Prd.25")
    output_virtual = setting(parameter("Prd.28"), Output, never=INFERRED, place="Prd.28")
    jog_frequency = setting(parameter("PrE.00"), "Hz", step=None, never=INFERRED, place="PrE.00")
    baudrate_setting = setting(
        parameter("PrH.00"), IBDBaudrate, never=INFERRED, place="PrH.00", outside=OTHER_MAKE
    )
    format_setting = setting(parameter("PrH.01"), IBDFormat, never=INFERRED, place="PrH.01")
    address_setting = setting(parameter("PrH.02"), never=INFERRED, place="PrH.02")

    control = command(
        0x2000,
        IBDControl,
        broadcast=(IBDControl.STOP,),
        harmless=(IBDControl.NOTHING, IBDControl.STOP),
        place="2000H, table 3",
    )
    frequency = command(
        0x2001,
        "Hz",
        step=0.01,
        span=(0, 400),
        at_most="maximum_frequency",
        moves=False,
        broadcast=(0,),
        place="2001H, table 3",
        note="Used if Prb.01 = 5.",
    )

    def __init_subclass__(cls) -> None:
        """Raise DeclarationError if a sibling's registers of the state do not suit `state` and `stop`."""
        if wrong := cls.role_mistakes(vars(cls)):
            raise DeclarationError(cls.__name__, wrong)
        super().__init_subclass__()

    @classmethod
    def role_mistakes(cls, own: Mapping[str, Any]) -> list[str]:
        """Return a mistake for each register of OF_STATE that could show 0 while its raw count is not 0."""
        found = {name: own[name] for name in OF_STATE if isinstance(own.get(name), Register)}
        return [
            f"{name}: it is 0 only {meaning}, so it cannot have a part, offset or scale_register"
            + (", and its step must be 1" if is_code else "")
            for name, one in found.items()
            for meaning, is_code in [OF_STATE[name]]
            if one.part or one.offset or one.scale_register or (is_code and one.step not in (1, None))
        ]

    def needed_silence(self) -> float:
        return super().needed_silence() if self.framing is Framing.RTU else 0.0

    @verb
    def identify(self) -> Script[None]:
        """Raise WriteForbidden unless PrH.00 holds the line's baud rate, and PrH.02 the drive's address.

        The manual does not state the register addresses of the two parameters: 02BCH and 02BEH are inferred.
        So an IBD may fail this check. Its owner then declares `confirmed = 1` in the plant file.

        If a family file extends this family and declares `run_state`, a second check is enough: `run_state`
        has a valid value, and the drive takes its commands and its setpoint from the line.
        """
        if self.identity_is_weak or (yield from self._line_settings_match()):
            return
        if not (self._has_state and (yield from self._state_matches())):
            raise WriteForbidden(
                f"{self.name} does not show its baud rate in 02BCH and its address in 02BEH, as an IBD does. "
                "Check its name plate, and declare confirmed = 1 if the drive is an IBD",
                advice=Advice.declare("confirmed", 1),
            )

    @property
    def identity_is_weak(self) -> bool:
        """True if only the owner's confirmation shows that the drive is an IBD, because no register does."""
        return bool(self.option.get("confirmed")) and not self.declared_in

    def _state_matches(self) -> Script[bool]:
        """Return True if `run_state` is valid, and the drive takes commands and setpoint from the line."""
        try:
            state = yield from read(self.register("run_state"))
            source = yield from read(self.frequency_source)
            return (
                state in (0, *SHOWN_STATES)
                and source == FrequencySource.LINE
                and (yield from read(self.run_source)) == IBDRunSource.LINE
            )
        except DriveException:
            return False

    def _line_settings_match(self) -> Script[bool]:
        try:
            baudrate = yield from read(self.baudrate_setting)
            address = yield from read(self.address_setting)
        except DriveException:
            return False
        return baudrate == IBDBaudrate[f"B{self.settings.baudrate}"] and address == self.address

    def resembles(self) -> Script[bool]:
        """Return True if the unnamed bits of PrA.22 are as in the manual, and four other registers exist."""
        try:
            yield from read(self.output_current)
            yield from read(self.motor_speed)
            yield from read(self.acceleration_time)
            yield from read(self.run_source)
            return (yield from read(self.terminals)) & UNNAMED == UNNAMED_AS_1
        except BusError:
            return False

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start from rest in the last direction; another direction needs the option `forward_bit`."""
        yield from self._command(IBDControl.RUN, direction)

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Turn from rest at the jog frequency PrE.00 until stopped; for `direction` see `start`."""
        yield from self._command(IBDControl.JOG, direction)

    def _command(self, word: IBDControl, direction: Direction | None) -> Script[None]:
        sent = word if direction is None else IBDControl(word | self._bit(direction))
        yield from self._commanded_by_line()
        if self._has_state:
            if fault := (yield from self._code()):
                raise self._reset_first(self.register("fault").format(fault))
        elif (yield from self._programmed()) and (yield from read(self.terminals)) & Terminals.VIRTUAL:
            raise self._reset_first()
        if word is IBDControl.RUN:
            yield from self._setpoint_in_force()
        if (yield from self._runs()):
            raise self._stop_first(f"{self.name} already turns, and no register shows if this is a jog")
        yield from write(self.control, sent)
        yield from self._started(direction)

    def _bit(self, direction: Direction) -> int:
        forward = self.option.get("forward_bit")
        if forward not in (2, 3):
            raise WriteForbidden(
                f"{self.name}: the manual does not say whether bit 2 or 3 of 2000H means {direction.value}. "
                "Start without a direction, or find out which of them turns the motor forward and "
                "declare forward_bit = N",
                advice=Advice.declare("forward_bit", "N"),
            )
        return 1 << int(forward if direction is Direction.FORWARD else 5 - forward)

    def _commanded_by_line(self) -> Script[None]:
        if (yield from read(self.frequency_source)) != FrequencySource.LINE or (
            yield from read(self.run_source)
        ) != IBDRunSource.LINE:
            raise WriteForbidden(f"{self.name} does not take commands from the line: {self.remote}")

    def _runs(self) -> Script[bool]:
        return (yield from super()._runs()) or not (yield from self._is_at_rest())

    @verb
    def stop(self) -> Script[None]:
        """Stop along the ramp.

        Wait until the outputs, or else current and speed, show that the motor stopped.
        """
        yield from insist(self.control, IBDControl.STOP)
        limit = (yield from read(self.deceleration_time)) + STOP_MARGIN
        look = self._is_at_rest
        with suppress(BusError):  # a lost reply does not end the stop: current and speed are read instead
            if not self._has_state and (yield from self._programmed()):
                look = self._is_off
        yield from self._stopped(look, limit)

    def _is_off(self) -> Script[bool]:
        """Return True if the programmed outputs show neither a run nor a ramp."""
        return not (yield from read(self.terminals)) & (Terminals.M01 | Terminals.M02 | Terminals.YABC)

    @property
    def _has_state(self) -> bool:
        """True if a subclass has added run state, output frequency and fault, as family files may do."""
        return OF_STATE.keys() <= self.registers.keys()

    def _code(self) -> Script[int]:
        return int((yield from read(self.register("fault"))))

    def _is_at_rest(self) -> Script[bool]:
        if self._has_state:
            at_rest = bool((yield from read(self.register("run_state"))) == 0)
            return at_rest and bool((yield from read(self.register("output_frequency"))) == 0)
        return (yield from read(self.motor_speed)) == 0 and (yield from read(self.output_current)) == 0

    @verb
    def reset_fault(self) -> Script[None]:
        """Reset a fault after a stop; never starts the motor. The reset is sent once.

        A second stop clears the reset bit, because a bit that stayed set could reset a later fault.
        """
        if not (yield from self._is_at_rest()):
            raise WriteForbidden(f"{self.name} turns: it has no fault to reset")
        yield from insist(self.control, IBDControl.STOP)
        try:
            yield from write(self.control, IBDControl.RESET_FAULT)
        except (Unconfirmed, DriveException):
            yield from insist(self.control, IBDControl.STOP)
            raise
        yield from insist(self.control, IBDControl.STOP)

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint, which cannot be read back."""
        yield from self._write_setpoint(self.frequency, hz)

    @verb
    def state(self) -> Script[State]:
        """Return the state of the drive.

        It is read from `run_state` or from the outputs, if they are programmed to show the state. Without
        these, it is UNKNOWN.
        """
        if self._has_state:
            return (yield from self._shown_state())
        terminals = yield from read(self.terminals)
        if not (yield from self._programmed()):
            return State(
                Condition.UNKNOWN,
                note="the outputs are not programmed as Prd.23 = 1, Prd.24 = 7, Prd.25 = 8, Prd.28 = 3",
            )
        for bit, condition in OUTPUTS.items():
            if terminals & bit:
                return State(condition)
        return State(Condition.STOPPED)

    def _shown_state(self) -> Script[State]:
        if fault := (yield from self._code()):
            return State(Condition.FAULT, fault=self.register("fault").format(fault))
        shown = int((yield from read(self.register("run_state"))))
        if shown == 0:
            stands = (yield from read(self.register("output_frequency"))) == 0
            return State(Condition.STOPPED if stands else Condition.DECELERATING)
        return SHOWN_STATES.get(shown, State(Condition.UNKNOWN, note=f"run_state {shown} is not explained"))

    def _programmed(self) -> Script[bool]:
        """Return True if the four outputs have the functions of the manual's example.

        The addresses of these settings are inferred: an exception means False.
        """
        try:
            for register, function in (
                (self.output_m01, Output.RUNNING),
                (self.output_m02, Output.ACCELERATING),
                (self.output_yabc, Output.DECELERATING),
                (self.output_virtual, Output.FAULT),
            ):
                if (yield from read(register)) != function:
                    return False
        except DriveException:
            return False
        return True


OUTPUTS = {  # the most serious condition is first
    Terminals.VIRTUAL: Condition.FAULT,
    Terminals.YABC: Condition.DECELERATING,
    Terminals.M02: Condition.ACCELERATING,
    Terminals.M01: Condition.RUNNING,
}

SHOWN_STATES = {
    1: State(Condition.RUNNING, Direction.FORWARD),
    2: State(Condition.RUNNING, Direction.REVERSE),
}
