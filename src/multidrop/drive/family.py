"""Drive: what a family's manual says, collected from its registers, and the verbs that command it.

A family is a subclass that declares registers. Its verbs are scripts; called on a drive that is
attached to a bus, a verb is carried out there.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, TypeVar, cast

from multidrop.core import Framing
from multidrop.drive.declaration_check import DeclarationError, mistakes
from multidrop.drive.register import Access, Kept, Register, Table
from multidrop.drive.script import (
    Script,
    read,
    until,
    write,
)
from multidrop.drive.state import Condition, Direction, State
from multidrop.drive.timing import Settings
from multidrop.drive.verbs import MOVING, Option, verb
from multidrop.errors import Advice, NotDone, Refused, Unconfirmed, Unsupported

LONGEST_SILENCE = 1.0  # s, that a line may be given
START_TIME = 5.0  # s in which a motor that was started is to be seen to run
_SETPOINT_FIRST = Advice("call set_frequency before start", "add --frequency HZ")

T = TypeVar("T", bound=float)


_CONFIRMED = Option("", (0, 1), "1: its name plate says what it is; the class has no `identify`")


_TURNING = (Condition.RUNNING, Condition.ACCELERATING, Condition.DECELERATING)


class Drive:
    """One drive on a line; its class is the family: the table of the manual, in the manual's order.

    `address` is 1 to 247, as far as the family goes; baud rate, format and framing default to the
    family's. `silence`, in s, takes the place of the standard's t3.5 where all drives on the line bear
    it; what the family's document demands is kept all the same. Options are facts that only the owner
    knows (see `options`); `ram` names the registers that its owner knows to be kept in RAM although the
    document does not say so. Raises ValueError for anything the family's document does not allow.
    """

    model: ClassVar[str] = ""
    title: ClassVar[str] = ""
    manual: ClassVar[str] = ""

    framings: ClassVar[tuple[Framing, ...]] = (Framing.RTU,)
    formats: ClassVar[Mapping[Framing, tuple[str, ...]]] = {}  # the first is the default
    baudrates: ClassVar[tuple[int, ...]] = (9600, 1200, 2400, 4800, 19200, 38400, 57600, 115200)
    addresses: ClassVar[range] = range(1, 248)

    silence: ClassVar[float] = 0.0  # s, before and after a frame; t3.5 is the least for RTU
    silence_characters: ClassVar[float] = 0.0  # the same, in characters
    response_delay: float = 0.005  # s, typical, from the request's end to the reply's begin
    response_delay_characters: ClassVar[float] = 0.0  # the same, in characters, where that is more
    response_timeout: ClassVar[float] = 0.3  # s, after which no reply is to be expected
    answering_time: ClassVar[float] = 0.0  # s, that the document gives the drive for a reply; 0: it is silent
    turnaround_delay: ClassVar[float] = 0.1  # s, after a broadcast

    most_registers: ClassVar[Mapping[Table, int]] = {}  # in one read; 1 where a table is not named
    readable_gaps: ClassVar[Mapping[Table, range]] = {}  # reserved addresses that may be read across
    exceptions: ClassVar[Mapping[int, str]] = {
        1: "illegal function",
        2: "illegal address",
        3: "illegal value",
        4: "device failure",
        5: "acknowledged, still working",
        6: "busy",
    }
    damaged: ClassVar[frozenset[int]] = frozenset()  # of these, those that say the request came damaged
    later: ClassVar[frozenset[int]] = frozenset({5, 6})  # and those that say the drive will answer later
    broadcasts: ClassVar[bool] = False  # the document has broadcasts, which nobody answers
    identity_is_inferred: ClassVar[bool] = False  # what `identify` refuses may be one of the family
    options: ClassVar[Mapping[str, Option]] = {}
    setpoint_name: ClassVar[str] = "frequency"  # the register that set_frequency writes
    remote: ClassVar[str] = "the drive must take its commands from the line"  # to be set on its keypad
    line_parameters: ClassVar[str] = ""  # those for its address, baud rate and format
    no_broadcasts: ClassVar[str] = "none documented"  # in words, where there are none
    watchdog: ClassVar[str] = "The document names no watchdog: the motor runs on when the client dies."

    registers: ClassVar[Mapping[str, Register[Any]]] = {}

    def __init_subclass__(cls) -> None:
        """Collect the registers; raises DeclarationError with all that is wrong with them."""
        super().__init_subclass__()
        found: dict[str, Register[Any]] = {}
        for owner in reversed(cls.__mro__):
            for name, it in vars(owner).items():
                if isinstance(it, Register):
                    found[name] = it
                else:
                    found.pop(name, None)  # a subclass has something else of this name
        cls.registers = found
        cls.options = cls._all_options()
        if wrong := mistakes(found, _NAMES, cls.options):
            raise DeclarationError(cls.__name__, wrong)
        if not cls.formats:
            cls.formats = dict.fromkeys(cls.framings, ("8N1", "8E1", "8O1", "8N2"))

    @classmethod
    def _all_options(cls) -> Mapping[str, Option]:
        """Those of the class, and where it commands a motor but has no `identify` its owner's word."""
        commands = any(it.commands or it.access is Access.COMMAND for it in cls.registers.values())
        verbs = any(getattr(cls, name) is not getattr(Drive, name) for name in MOVING)
        if cls.identify is not Drive.identify or not (commands or verbs):
            return cls.options
        return {"confirmed": _CONFIRMED, **cls.options}

    def check_confirmed(self, what: str) -> None:
        """Refused where the class cannot tell its drives from others, and nobody has said what it is.

        The same address means different things to different makes, and may start their motor.
        """
        family = type(self)
        if family.identify is Drive.identify and not self.option.get("confirmed"):
            kind = self.title or family.__name__
            raise Refused(
                f"{what} is not sent to {self.name}: its class has no `identify` that could tell a {kind} "
                "from another drive, to which the same may mean a start; look at its name plate, and declare "
                "confirmed = 1",
                rule="nobody has confirmed what it is",
                advice=Advice.declare("confirmed", 1),
            )

    def __init__(
        self,
        address: int,
        *,
        name: str | None = None,
        framing: Framing | str | None = None,
        baudrate: int | None = None,
        format: str | None = None,
        silence: float | None = None,
        ram: Iterable[str] = (),
        **options: float,
    ) -> None:
        self.address = self._checked("address", address, self.addresses)
        self.framing = self._framing(framing)
        formats = self.formats[self.framing]
        self.settings = Settings(
            self._checked("baud rate", self.baudrates[0] if baudrate is None else baudrate, self.baudrates),
            self._checked("format", formats[0] if format is None else format, formats),
        )
        self.agreed_silence = silence
        self._check_silence()
        self.response_delay = max(
            self.response_delay, self.response_delay_characters * self.settings.character
        )
        self.name = name or f"{self.model or type(self).__name__}@{address}"
        if not self.name.isprintable():  # in a text recording a torn line must be seen to be torn
            raise ValueError(f"the name {name!r} is not one line of printable characters")
        self.option = self._options(options)
        self.ram = frozenset(self._in_ram(name) for name in ram)
        self.commanded: float | None = None  # the setpoint register that set_frequency wrote last
        self.bus: Any = None  # that it is attached to
        self.perform: Callable[[Script[Any]], Any] = self._perform_nowhere
        self.check_identity: Callable[[], None] = lambda: None  # a bus looks at it
        self.begin_call: Callable[[str], Any] = lambda verb: (
            None
        )  # what keeps it from being sent after a stop
        self.carry_out_move: Callable[[Script[Any], Any], Any] = self._move_nowhere
        self.carry_out_stop: Callable[[str, Callable[[], Script[Any]], float | None], Any] = (
            lambda verb, make, seconds: self.perform(make())
        )

    def __repr__(self) -> str:
        where = f"on {self.bus.line.port}" if self.bus else "not attached"
        line = f"{self.framing}, {self.settings}"
        return f"<{type(self).__name__} {self.name!r}, address {self.address}, {line}, {where}>"

    def _move_nowhere(self, script: Script[Any], call: Any) -> Any:
        self.check_identity()
        return self.perform(script)

    def _perform_nowhere(self, script: Script[Any]) -> Any:
        raise RuntimeError(f"{self.name} is not attached to a bus: use bus.attach(...)")

    @classmethod
    def _checked(cls, what: str, value: Any, allowed: Any) -> Any:
        if value in allowed:
            return value
        choices = (
            f"{allowed[0]} to {allowed[-1]}"
            if isinstance(allowed, range)
            else ", ".join(str(choice) for choice in allowed)
        )
        raise ValueError(f"{what} {value!r} is not one of {cls.title or cls.__name__}: {choices}")

    @classmethod
    def _framing(cls, framing: Framing | str | None) -> Framing:
        if framing is None:
            return cls.framings[0]
        if isinstance(framing, str):
            framing = {str(known): known for known in Framing}.get(framing.lower(), framing)
        return cast(Framing, cls._checked("framing", framing, cls.framings))

    @classmethod
    def _options(cls, given: dict[str, float]) -> dict[str, float]:
        for name, value in given.items():
            if name not in cls.options:
                known = ", ".join(cls.options) or "none"
                raise ValueError(f"{cls.title or cls.__name__} has no option {name!r}; its options: {known}")
            low, high = cls.options[name].span
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                raise ValueError(
                    f"{name} = {value!r} is outside {low:g} to {high:g} {cls.options[name].unit}".rstrip()
                )
            if not cls.options[name].unit and value != int(value):
                raise ValueError(f"{name} = {value!r} is no whole number from {low:g} to {high:g}")
        return given

    @classmethod
    def _in_ram(cls, name: str) -> str:
        if not isinstance(name, str):
            raise TypeError(f"ram takes names of registers, not {name!r}")
        register = cls.register(name)
        if register.kept is Kept.EEPROM:
            raise ValueError(f"{name} of {cls.title or cls.__name__} is in EEPROM, as its document says")
        return register.name

    @classmethod
    def register(cls, name: str) -> Register[Any]:
        """The register of this name; ValueError with the nearest names when there is none."""
        try:
            return cls.registers[name]
        except KeyError:
            near = difflib.get_close_matches(name, cls.registers, n=3)
            hint = f"did you mean {' or '.join(near)}?" if near else f"see `multidrop models {cls.model}`"
            raise ValueError(f"{cls.title or cls.__name__} has no register {name!r}; {hint}") from None

    @classmethod
    def readings(cls) -> tuple[Register[Any], ...]:
        """What is polled when nothing else is said."""
        return tuple(it for it in cls.registers.values() if it.access is Access.READING and it.readable)

    @property
    def echo_probe(self) -> Register[Any] | None:
        """Where a reply may be a copy of its request, as an echo is: a register whose reply is none."""
        return None

    def known_counts(self) -> Mapping[Register[Any], tuple[int, int]]:
        """Return registers that are known to hold raw counts from the least to the most given here.

        Where a family reads one register at a time its replies differ in nothing else: an answer that
        comes late is told from another's by its value, so no two of the ranges may overlap.
        """
        return {}

    def __setattr__(self, name: str, value: object) -> None:
        if name in self.registers:
            raise AttributeError(f"{name} is a register, which bus.write(drive, drive.{name}, VALUE) writes")
        super().__setattr__(name, value)

    def exception(self, code: int) -> str:
        """The meaning of an exception code in this family."""
        return self.exceptions.get(code, "a code that the document does not explain")

    def is_passing(self, code: int) -> bool:
        """Whether this exception says nothing against what was asked: it came damaged, or at a bad time."""
        return code in self.exceptions and code in self.damaged | self.later

    def needed_silence(self) -> float:
        """Silence in s that this drive demands before a request and after its reply."""
        own = max(self.silence, self.silence_characters * self.settings.character)
        if self.framing is not Framing.RTU:
            return own
        return max(self.settings.t3_5 if self.agreed_silence is None else self.agreed_silence, own)

    def _check_silence(self) -> None:
        """A shorter one would end frames in their middle: pauses within them may be that long."""
        agreed, least = self.agreed_silence, 1.5 * self.settings.character
        if agreed is None:
            return
        if (
            isinstance(agreed, bool)
            or not isinstance(agreed, (int, float))
            or not 0 <= agreed <= LONGEST_SILENCE
        ):
            raise ValueError(f"silence {agreed!r} is not a time from 0 to {LONGEST_SILENCE:g} s")
        if self.framing is Framing.RTU and self.needed_silence() < least:
            raise ValueError(
                f"silence {agreed * 1e6:g} us is shorter than 1.5 characters at {self.settings}, which may "
                f"pass within a frame: it is to be {math.ceil(least * 1e6)} us or more"
            )

    # ---- verbs; each family replaces those that its document has ----

    def _unsupported(self, what: str) -> Unsupported:
        return Unsupported(f"{self.name}: the document of {self.title or type(self).__name__} has no {what}")

    def _stopped(self, look: Callable[[], Script[bool]], limit: float) -> Script[None]:
        """Wait until the drive is seen to have stopped; Unconfirmed when it is not after `limit` seconds."""
        if not (yield from until(look, limit=limit)):
            raise Unconfirmed(self.name, "the stop", f"after {limit:g} s it is not seen to have stopped")

    def _hold(self, register: Register[float], value: float) -> Script[None]:
        """Write the setpoint; NotDone when the drive then holds another value."""
        self.commanded = None
        held = yield from write(register, value)
        if held != register.decode(register.encode(value)):
            what = f"{register.name} = {register.format(value)}"
            raise NotDone(self.name, what, f"the drive holds {register.format(held)}")
        self.commanded = held

    def _setpoint_in_force(self) -> Script[None]:
        """Refused unless the setpoint is known, is not 0, and is still the one that was written."""
        register = self.register(self.setpoint_name)
        held = (yield from read(register)) if register.readable else self.commanded
        if held is None:
            raise Refused(
                f"{self.name} cannot say its setpoint: call set_frequency before start",
                advice=_SETPOINT_FIRST,
            )
        if held == 0:
            raise Refused(
                f"the setpoint of {self.name} is 0: call set_frequency before start", advice=_SETPOINT_FIRST
            )
        if self.commanded is not None and held != self.commanded:
            raise Refused(
                f"{self.name} holds {register.format(held)} and not {register.format(self.commanded)} as it "
                "was told: it may have lost its power; call set_frequency before start",
                advice=_SETPOINT_FIRST,
            )

    def _started(self) -> Script[None]:
        """Look whether it runs: NotDone when it trips, Unconfirmed when it is not seen to run."""
        if not (yield from until(self._runs, limit=START_TIME)):
            reason = f"after {START_TIME:g} s it is not seen to run; {self.remote}"
            raise Unconfirmed(self.name, "the start", reason)

    def _runs(self) -> Script[bool]:
        state = yield from self.state.script()
        if state.condition is Condition.FAULT:
            raise NotDone(self.name, "the start", f"it tripped: {state.fault or 'it shows a fault'}")
        return state.condition in _TURNING

    @verb
    def identify(self) -> Script[None]:
        """Look, without writing, whether this is a drive of the family; Refused when it is another.

        What is not refused is not proven: few families say who they are.
        """
        yield from ()

    def resembles(self) -> Script[bool]:
        """Whether it reads like one of the family where `identify` refuses it: good for a guess alone."""
        yield from ()
        return False

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor at the setpoint in force; without a direction, in the one in force."""
        raise self._unsupported("start command")
        yield

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor along its deceleration ramp."""
        raise self._unsupported("stop command")
        yield

    @verb
    def coast(self) -> Script[None]:
        """Take the voltage off and let the motor run out."""
        raise self._unsupported("coast command")
        yield

    @verb
    def emergency_stop(self) -> Script[None]:
        """Stop the motor as the drive's own emergency stop does."""
        raise self._unsupported("emergency stop")
        yield

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Turn slowly until stopped."""
        raise self._unsupported("jog command")
        yield

    @verb
    def reset_fault(self) -> Script[None]:
        """Reset a fault; never starts the motor."""
        raise self._unsupported("fault reset")
        yield

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the frequency setpoint in Hz."""
        raise self._unsupported("frequency setpoint")
        yield

    @verb
    def state(self) -> Script[State]:
        """What the drive says of itself."""
        raise self._unsupported("state")
        yield


# What a drive has besides registers.
_NAMES = frozenset(
    {*dir(Drive), *("address", "framing", "settings", "agreed_silence", "response_delay", "name")}
    | {"option", "ram", "commanded", "bus", "perform", "check_identity"}
)
