"""Drive: the base of all families: facts of the line, registers, and the verbs that command the motor.

A family is a subclass that declares registers. Its verbs are scripts; a verb of a drive that is attached
to a bus is carried out there.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, TypeVar, cast

from multidrop.core import MODBUS, Framing
from multidrop.drive.declaration_check import DeclarationError, declaration_errors
from multidrop.drive.network import speaks_tcp
from multidrop.drive.read_limits import limit_errors
from multidrop.drive.register import Access, Register
from multidrop.drive.scale_check import scale_errors
from multidrop.drive.script import Script, read, until, write
from multidrop.drive.state import Condition, Direction, State
from multidrop.drive.table import Kept, Table
from multidrop.drive.text import Text, text_errors
from multidrop.drive.timing import Settings
from multidrop.drive.verbs import MOVING, Option, verb
from multidrop.errors import Advice, NotDone, Refused, Unconfirmed, Unsupported

A = TypeVar("A")
LONGEST_SILENCE = 1.0  # s
SERIAL_ADDRESSES = range(1, 248)  # 0 is a broadcast there
START_TIME = 5.0  # s, after which a motor that was started must be seen to run
_SETPOINT_FIRST = Advice("call set_frequency before start", "add --frequency HZ")

_CONFIRMED = Option("", (0, 1), "1: its name plate says what it is; the class has no `identify`")
_CHECKED = Option("", (0, 1), "1: its name plate says what it is, and `multidrop check` of its file was read")
_TURNING = (Condition.RUNNING, Condition.ACCELERATING, Condition.DECELERATING)


class Drive:
    """One drive on a line; its class is the family, with the manual's tables in the manual's order.

    `address` is 1 to 247, as far as the family goes; on a tcp:// port it is a unit id, which may be 0 to
    255 where the family has them. Baud rate, format and framing default to the family's; on a tcp:// port
    the framing is TCP, and baud rate and format are those of the wire behind the gateway. `silence`, in s,
    takes the place of the standard's t3.5 where all drives on the line bear it; what the family's document
    demands is kept all the same. Options are facts that only the owner knows (see `options`); `ram` names
    registers that the owner knows to be kept in RAM although the document does not say so. Raises
    ValueError for anything the family's document does not allow.
    """

    model: ClassVar[str] = ""
    declared_in: ClassVar[str] = ""  # name of the file that declares it; nobody tested such a family
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
    answering_time: ClassVar[float] = 0.0  # s that the document gives the drive for a reply; 0: not stated
    turnaround_delay: ClassVar[float] = 0.1  # s, after a broadcast

    least_interval: ClassVar[float] = 0.0  # s, from the end of an exchange with it to its next request

    most_registers: ClassVar[Mapping[Table, int]] = {}  # in one read; the standard's where none is stated
    readable_gaps: ClassVar[Mapping[Table, range]] = {}  # reserved addresses that may be read across
    read_together: ClassVar[tuple[tuple[str, ...], ...]] = ()  # registers that share a request, in this order
    exceptions: ClassVar[Mapping[int, str]] = {
        1: "illegal function",
        2: "illegal address",
        3: "illegal value",
        4: "device failure",
        5: "acknowledged, still working",
        6: "busy",
    }
    damaged: ClassVar[frozenset[int]] = frozenset()  # of these, codes of a damaged request
    later: ClassVar[frozenset[int]] = frozenset({5, 6})  # and codes of a drive that will answer later
    broadcasts: ClassVar[bool] = False  # the document has them; nobody answers one
    identity_is_inferred: ClassVar[bool] = False  # a drive that `identify` refuses may be of the family
    options: ClassVar[Mapping[str, Option]] = {}
    setpoint_name: ClassVar[str] = "frequency"  # the register that set_frequency writes
    remote: ClassVar[str] = "the drive must take its commands from the line"  # to be set on its keypad
    line_parameters: ClassVar[str] = ""  # those for its address, baud rate and format
    no_broadcasts: ClassVar[str] = "none documented"  # in words, where there are none
    watchdog: ClassVar[str] = "The document names no watchdog: the motor runs on when the client dies."

    registers: ClassVar[Mapping[str, Register[Any]]] = {}
    texts: ClassVar[Mapping[str, Text]] = {}

    bus: Any = None  # that it is attached to

    def __init_subclass__(cls) -> None:
        """Collect the registers. Raises DeclarationError with all that is wrong with them."""
        super().__init_subclass__()
        found = cls._declared(Register)
        cls.registers = found
        cls.texts = cls._declared(Text)
        cls.options = cls._all_options()
        wrong = declaration_errors(found, TAKEN_NAMES, cls.options) + text_errors(cls.texts, TAKEN_NAMES)
        if wrong := wrong or scale_errors(cls) or list(limit_errors(cls)):
            raise DeclarationError(cls.__name__, wrong)
        if not cls.formats:
            cls.formats = dict.fromkeys(cls.framings, ("8N1", "8E1", "8O1", "8N2"))

    @classmethod
    def _declared(cls, kind: type[A]) -> dict[str, A]:
        """Return the class's attributes of a kind by name, without those that a subclass has replaced."""
        found: dict[str, A] = {}
        for owner in reversed(cls.__mro__):
            for name, attribute in vars(owner).items():
                if isinstance(attribute, kind):
                    found[name] = attribute
                else:
                    found.pop(name, None)
        return found

    @classmethod
    def _all_options(cls) -> Mapping[str, Option]:
        """Return the class's options, and `confirmed` where it commands a motor untested or unidentified."""
        commands = any(
            register.commands or register.access is Access.COMMAND for register in cls.registers.values()
        )
        verbs = any(getattr(cls, name) is not getattr(Drive, name) for name in MOVING)
        if not (commands or verbs) or not (cls.declared_in or cls.identify is Drive.identify):
            return cls.options
        return {"confirmed": _CHECKED if cls.declared_in else _CONFIRMED, **cls.options}

    def check_confirmed(self, what: str) -> None:
        """Raise Refused where nobody has confirmed a drive of a class that needs it.

        That is a class that cannot identify its drives, since the same address means different things to
        different makes, and may start their motor; and one from a file, which nobody has tested.
        """
        family = type(self)
        if "confirmed" not in self.options or self.option.get("confirmed"):
            return
        if family.declared_in:
            reason = (
                f"{family.declared_in} declares it, which nobody has tested: read `multidrop check "
                f"{family.declared_in}` against the manual and look at its name plate"
            )
        elif family.identify is Drive.identify:
            kind = self.title or family.__name__
            reason = (
                f"its class has no `identify` that could tell a {kind} from another drive, to which the same "
                "may mean a start; look at its name plate"
            )
        else:
            return
        raise Refused(
            f"{what} is not sent to {self.name}: {reason}, and declare confirmed = 1",
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
        self._declared_framing = None if framing is None else self.framing
        formats = self.formats_in(self.framing)
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
        if not self.name.isprintable():  # a truncated line of a text recording must be recognised
            raise ValueError(f"the name {name!r} is not one line of printable characters")
        self.option = self._options(options)
        self.ram = frozenset(self._in_ram(name) for name in ram)
        self.commanded: float | None = None  # setpoint that set_frequency wrote last
        self.perform: Callable[[Script[Any]], Any] = self._perform_nowhere
        self.check_identity: Callable[[], None] = lambda: None  # a bus does
        self.begin_call: Callable[[str], Any] = lambda verb: None  # its permit, which a stop ends
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
        if framing is Framing.TCP and cls.speaks(framing):
            return framing
        return cast(Framing, cls._checked("framing", framing, cls.framings))

    @classmethod
    def speaks(cls, framing: Framing) -> bool:
        """Return True for the document's framings, and for TCP where one is Modbus: a gateway translates."""
        return framing in cls.framings or (
            framing is Framing.TCP and any(one in MODBUS for one in cls.framings)
        )

    @classmethod
    def formats_in(cls, framing: Framing) -> tuple[str, ...]:
        """Return the formats of a framing; with TCP those of the wire behind the gateway."""
        return cls.formats.get(framing) or cls.formats[cls.framings[0]]

    def take_framing_of(self, port: str) -> None:
        """Take the framing that this port has: TCP on tcp://, and what was declared on any other.

        Raises ValueError where the drive cannot have it.
        """
        is_tcp, declared = speaks_tcp(port), self._declared_framing or self.framings[0]
        if is_tcp and self._declared_framing not in (None, Framing.TCP):
            raise ValueError(
                f"framing {declared} is a serial line's, and {port} speaks Modbus TCP: leave "
                "framing out, or name the port socket:// where the far end passes serial bytes on"
            )
        if is_tcp and not self.speaks(Framing.TCP):
            raise ValueError(
                f"{self.title or type(self).__name__} does not speak Modbus, and {port} carries "
                "nothing else: name the port socket://, and have the far end pass serial bytes on"
            )
        if not is_tcp and declared is Framing.TCP:
            raise ValueError(
                f"framing tcp is that of tcp:// ports, such as tcp://10.0.0.7:502, and {port} is none"
            )
        if not is_tcp and self.address not in SERIAL_ADDRESSES:
            raise ValueError(
                f"address {self.address} is a unit id of Modbus TCP; on {port} it is to be "
                f"{SERIAL_ADDRESSES[0]} to {SERIAL_ADDRESSES[-1]}"
            )
        self.framing = Framing.TCP if is_tcp else declared

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
        """Return the register of this name; ValueError with the nearest names when there is none."""
        try:
            return cls.registers[name]
        except KeyError:
            near = difflib.get_close_matches(name, cls.registers, n=3)
            hint = f"did you mean {' or '.join(near)}?" if near else f"see `multidrop models {cls.model}`"
            raise ValueError(f"{cls.title or cls.__name__} has no register {name!r}; {hint}") from None

    @classmethod
    def readings(cls) -> tuple[Register[Any], ...]:
        """Return the registers that are polled by default."""
        return tuple(
            register
            for register in cls.registers.values()
            if register.access is Access.READING and register.readable
        )

    @property
    def ledger_name(self) -> str:
        """Name under which writes to its EEPROM are counted: files of one name are told by their titles."""
        if self.declared_in:
            return f"{self.model}: {self.title}"
        return self.model or type(self).__name__

    @property
    def echo_probe(self) -> Register[Any] | None:
        """Register whose reply is never a copy of its request, where a family has others; else None.

        It is read first while it is unknown whether the adapter echoes.
        """
        return None

    def known_counts(self) -> Mapping[Register[Any], tuple[int, int]]:
        """Return registers that hold raw counts in a known range, from the least to the most.

        Where a family reads one register at a time its replies differ in nothing else: a late reply is told
        from another register's by its value, so no two of the ranges may overlap.
        """
        return {}

    def __setattr__(self, name: str, value: object) -> None:
        if name in self.registers:
            raise AttributeError(f"{name} is a register, which bus.write(drive, drive.{name}, VALUE) writes")
        if name in self.texts:
            raise AttributeError(f"{name} is a text, which bus.read_text(drive, drive.{name}) reads")
        super().__setattr__(name, value)

    def exception(self, code: int) -> str:
        """Return the meaning of an exception code in this family."""
        return self.exceptions.get(code, "a code that the document does not explain")

    def is_passing(self, code: int) -> bool:
        """Return True where the request may be right, and came damaged or at a bad time."""
        return code in self.exceptions and code in self.damaged | self.later

    def needed_silence(self) -> float:
        """Return the silence in s that this drive needs before a request and after its reply."""
        own = max(self.silence, self.silence_characters * self.settings.character)
        if self.framing is Framing.TCP:  # the gateway keeps it
            return 0.0
        if self.framing is not Framing.RTU:
            return own
        return max(self.settings.t3_5 if self.agreed_silence is None else self.agreed_silence, own)

    def _check_silence(self) -> None:
        """Refuse a silence that may also occur within a frame, or that is no time at all."""
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
        """Wait until the drive is seen to have stopped; Unconfirmed after `limit` seconds."""
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
        """Raise Refused unless the setpoint is known, is not 0, and is still the one that was written."""
        register = self.register(self.setpoint_name)
        held = (yield from read(register)) if register.readable else self.commanded
        if held is None:
            why = f"{self.name} cannot say its setpoint:"
        elif held == 0:
            why = f"the setpoint of {self.name} is 0:"
        elif self.commanded is not None and held != self.commanded:
            shown = f"{register.format(held)} and not {register.format(self.commanded)}"
            why = f"{self.name} holds {shown} as it was told: it may have lost its power;"
        else:
            return
        raise Refused(f"{why} call set_frequency before start", advice=_SETPOINT_FIRST)

    def _stop_first(self, why: str) -> Refused:
        return Refused(f"{self.name} {why} call stop() first", advice=Advice.call("stop"))

    def _reset_first(self, fault: str = "") -> Refused:
        shown = f"a fault, {fault}" if fault else "a fault"
        why = f"{self.name} has {shown}: see to it, then call reset_fault()"
        return Refused(why, advice=Advice.call("reset_fault"))

    def _started(self) -> Script[None]:
        """Wait until the motor is seen to run; NotDone when the drive trips, Unconfirmed when it is not."""
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
        """Check by reading that this is a drive of the family; Refused when it is another.

        A drive that passes is not proven to be one: few families say who they are.
        """
        yield from ()

    def resembles(self) -> Script[bool]:
        """Return True where a drive that `identify` refuses reads like the family: good for a guess alone."""
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
        """Report condition, direction and fault."""
        raise self._unsupported("state")
        yield


# Names that a register cannot have.
TAKEN_NAMES = frozenset(
    {*dir(Drive), *("address", "framing", "settings", "agreed_silence", "response_delay", "name")}
    | {"option", "ram", "commanded", "perform", "check_identity"}
)
