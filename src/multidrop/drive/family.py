"""Drive: the base class of all families, with properties from the manual, registers and verbs.

A family is a subclass that declares registers and verbs. A verb commands the motor. It is a generator, called
a script, whose steps are carried out by the bus that the drive is attached to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar

from multidrop.core import MODBUS, Framing
from multidrop.drive.declaration_check import (
    DeclarationError,
    declaration_errors,
    fact_errors,
    request_errors,
    text_errors,
)
from multidrop.drive.line_settings import Settings, check_agreed_silence, first_given, framing_on, supported
from multidrop.drive.link import NO_LINK, Link, RegisterAccess
from multidrop.drive.parameters import ParameterSpace
from multidrop.drive.register import Access, Kept, Option, Register, Table
from multidrop.drive.text import Text
from multidrop.drive.verbs import (
    MOVING,
    VERB_OPTIONS,
    CalledStop,
    Condition,
    Direction,
    Script,
    State,
    read,
    until,
    verb,
    verb_errors,
    write,
)
from multidrop.errors import Advice, NotVerified, Unconfirmed, Unsupported, WriteForbidden
from multidrop.printable import did_you_mean, is_number

START_TIME = 5.0  # seconds within which a started motor must be seen to turn
REVERSAL_TIME = 60.0  # seconds allowed for a reversal without the option `stop_time`
_SETPOINT_FIRST = Advice("call set_frequency before start", "add --frequency HZ")
_TURNING = (Condition.RUNNING, Condition.ACCELERATING, Condition.DECELERATING)
_CONFIRMED = Option("", (0, 1), "1: its name plate says what it is; the class has no `identify`")
_CHECKED = Option("", (0, 1), "1: its name plate says what it is, and `multidrop check` of its file was read")

A = TypeVar("A")


class _PendingWrite(NamedTuple):
    """A write of the setpoint that has not ended yet."""

    before: float | _PendingWrite | None


class Drive(RegisterAccess):
    """A drive on a line. Each family of drives is a subclass, with the registers in the manual's order.

    `address` is 1 to 247, or less in some families. On a tcp:// port it is a unit id, in some families 0 to
    255. Baud rate, format and framing have the family's defaults. On a tcp:// port the framing is TCP, and
    baud rate and format are those of the wire behind the gateway. `silence`, in s, replaces the standard's
    t3.5; use it only if all drives on the line tolerate it. If the family's document requires a longer
    silence, that applies. `options` are properties that only the drive's owner knows, such as its maximum
    frequency. `ram` names registers that the drive keeps in RAM according to its owner, although the document
    does not say so. Raises ValueError for values that the family's document does not allow.
    """

    title: ClassVar[str] = ""
    model: ClassVar[str] = ""
    declared_in: ClassVar[str] = ""  # name of the TOML file that declares the family, which is untested
    manual: ClassVar[str] = ""

    # ---- the line ----

    framings: ClassVar[tuple[Framing, ...]] = (Framing.RTU,)
    # character formats by framing, the default format first
    formats: ClassVar[Mapping[Framing, tuple[str, ...]]] = {}
    baudrates: ClassVar[tuple[int, ...]] = (9600, 1200, 2400, 4800, 19200, 38400, 57600, 115200)
    addresses: ClassVar[range] = range(1, 248)
    line_terminals: ClassVar[str] = ""  # the manual's names of the drive's two RS-485 terminals
    most_devices: ClassVar[int] = 0  # limit of devices on an RS-485 line with such a drive; 0: not stated

    silence: ClassVar[float] = 0.0  # seconds before and after a frame; RTU needs 3.5 characters
    # `silence` as a number of characters; the longer silence applies
    silence_characters: ClassVar[float] = 0.0
    response_delay: float = 0.005  # typical time in s from the end of a request to the start of the reply
    # `response_delay` as a number of characters; the longer delay applies
    response_delay_characters: ClassVar[float] = 0.0
    response_timeout: ClassVar[float] = 0.3  # seconds without a reply after which a request has failed
    # seconds within which the drive replies, according to its document; 0: not stated
    answering_time: ClassVar[float] = 0.0
    turnaround_delay: ClassVar[float] = 0.1  # seconds without requests after a broadcast
    least_interval: ClassVar[float] = 0.0  # shortest time between a reply and the next request, in s
    # True if the drive answers every read of its tables, with a value or an exception
    answers_every_read: ClassVar[bool] = False

    # ---- registers, exceptions and commands ----

    # limit of registers in one read, by table; default: the Modbus limit
    most_registers: ClassVar[Mapping[Table, int]] = {}
    # by table: addresses that one read may include, although some addresses have no register
    readable_gaps: ClassVar[Mapping[Table, range]] = {}
    # groups of registers that one request must read, in this order
    read_together: ClassVar[tuple[tuple[str, ...], ...]] = ()
    exceptions: ClassVar[Mapping[int, str]] = {
        1: "illegal function",
        2: "illegal address",
        3: "illegal value",
        4: "device failure",
        5: "acknowledged, still working",
        6: "busy",
    }
    # exception codes with which the drive refuses a damaged request
    damaged: ClassVar[frozenset[int]] = frozenset()
    # exception codes with which a busy drive refuses a request
    later: ClassVar[frozenset[int]] = frozenset({5, 6})
    broadcasts: ClassVar[bool] = False  # True if the document describes broadcasts
    identify_recognises: ClassVar[bool] = False  # True if `identify` fails for every drive of another make
    identity_proofs: ClassVar[tuple[Any, ...]] = ()  # registers by which a family file identifies the device
    options: ClassVar[Mapping[str, Option]] = {}
    has_motor: ClassVar[bool] = True  # False for a device such as a meter: `stop_all` skips it
    setpoint_name: ClassVar[str] = "frequency"  # name of the register that set_frequency writes
    # what must be set on the keypad before the drive obeys the line
    remote: ClassVar[str] = "the drive must take its commands from the line"
    line_parameters: ClassVar[str] = ""  # names of the drive's parameters for address, baud rate and format
    # None: the rule for parameter addresses is not known
    parameter_space: ClassVar[ParameterSpace | None] = None
    no_broadcasts: ClassVar[str] = "none documented"  # reason why the drive gets no broadcasts
    watchdog: ClassVar[str] = "The document names no watchdog: the motor runs on when the client dies."

    registers: ClassVar[Mapping[str, Register[Any]]] = {}
    texts: ClassVar[Mapping[str, Text]] = {}

    bus: Any = None  # the bus that the drive is attached to

    # ---- the class ----

    def __init_subclass__(cls) -> None:
        """Collect the registers. Raises DeclarationError with all errors in the class."""
        super().__init_subclass__()
        cls.registers = cls._declared(Register)
        cls.texts = cls._declared(Text)
        wrong = fact_errors(cls) + verb_errors(cls)
        moving = [name for name, register in cls.registers.items() if register.commands] if not wrong else []
        if moving and not cls.has_motor:
            wrong.append(f"has_motor = False, but a write to {moving[0]} may move one: declare moves=False")
        options = cls.options = cls._all_options() if isinstance(cls.options, Mapping) else {}
        wrong += declaration_errors(cls.registers, TAKEN_NAMES, options) + text_errors(cls.texts, TAKEN_NAMES)
        if wrong := wrong or request_errors(cls):
            raise DeclarationError(cls.__name__, wrong)
        if not cls.formats:
            cls.formats = dict.fromkeys(cls.framings, ("8N1", "8E1", "8O1", "8N2"))

    @classmethod
    def _declared(cls, kind: type[A]) -> dict[str, A]:
        """Return the attributes of type `kind` by name, without those that a subclass has replaced."""
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
        """Return the options of the class, with `confirmed` if its commands need it (`check_confirmed`)."""
        commands = any(one.commands or one.access is Access.COMMAND for one in cls.registers.values())
        verbs = any(getattr(cls, name) is not getattr(Drive, name) for name in MOVING)
        if not (commands or verbs) or (cls._identifies() and not cls.declared_in):
            return cls.options
        return {"confirmed": _CHECKED if cls.declared_in else _CONFIRMED, **cls.options}

    @classmethod
    def _identifies(cls) -> bool:
        return cls.identify is not Drive.identify

    @classmethod
    def _kind(cls) -> str:
        return cls.title or cls.__name__

    @classmethod
    def register(cls, name: str) -> Register[Any]:
        """Return the register of this name. Raises ValueError with the nearest names if there is none."""
        if not isinstance(name, str):
            first = next(iter(cls.registers), "speed")
            raise TypeError(f"{name!r} is not a register's name, such as {first!r}")
        try:
            return cls.registers[name]
        except KeyError:
            if name in cls.texts:
                wrong = f"{name!r} of {cls._kind()} is a text, which can be read, but not polled or written"
                raise ValueError(wrong) from None
            hint = did_you_mean(name, cls.registers, cls.model and f"see `multidrop models {cls.model}`", 3)
            raise ValueError(f"{cls._kind()} has no register {name!r}; {hint}") from None

    @classmethod
    def readings(cls) -> tuple[Register[Any], ...]:
        """Return the registers that are polled unless the plant file lists others."""
        registers = cls.registers.values()
        return tuple(one for one in registers if one.access is Access.READING and one.readable)

    @classmethod
    def speaks(cls, framing: Framing) -> bool:
        """Return True if the family can use this framing: one of its own, or TCP if it uses Modbus."""
        is_modbus = any(one in MODBUS for one in cls.framings)
        return framing in cls.framings or (framing is Framing.TCP and is_modbus)

    @classmethod
    def formats_in(cls, framing: Framing) -> tuple[str, ...]:
        """Return the character formats of a framing; for TCP, those of the serial line behind the gateway."""
        return cls.formats.get(framing) or cls.formats[cls.framings[0]]

    # ---- one drive ----

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
        if type(self) is Drive:
            raise TypeError("Drive is the base class: use a family, such as YD1000, or your own subclass")
        self.address = supported("address", address, self.addresses, self._kind())
        self.framing = self._framing(framing)
        self._declared_framing = None if framing is None else self.framing
        self.own_settings = (baudrate, format, silence)
        self._default_settings = (self.baudrates[0], self.formats_in(self.framing)[0], None)
        self._use(*self.settings_on(None, None, None))
        self.name = name or f"{self.model or type(self).__name__}@{address}"
        if not (isinstance(self.name, str) and self.name.isprintable()):  # a line break would split a row
            raise ValueError(f"the name {name!r} must be one line of printable characters")
        self._check_options(options)
        self.option: Mapping[str, float] = options
        self.ram = frozenset(self._in_ram(name) for name in ram)
        self._known_setpoint: float | _PendingWrite | None = None
        self.link: Link = NO_LINK
        # one item: the number of stops called so far, which the bus changes
        self.stops_called: Sequence[int] = (0,)

    @classmethod
    def _framing(cls, framing: Framing | str | None) -> Framing:
        if framing is None:
            return cls.framings[0]
        if isinstance(framing, str):
            framing = {str(known): known for known in Framing}.get(framing.lower(), framing)
        if framing in cls.framings or (framing is Framing.TCP and cls.speaks(framing)):
            return Framing(framing)
        known = ", ".join(str(one) for one in cls.framings)
        hint = f"; write {known}, or omit framing" if len(cls.framings) == 1 else ""
        raise ValueError(
            f"framing {str(framing)!r} is not supported by {cls._kind()}, which has {known}{hint}"
        )

    @classmethod
    def _in_ram(cls, name: str) -> str:
        if not isinstance(name, str):
            raise TypeError(f"the argument ram must hold register names, not {name!r}")
        register = cls.register(name)
        if register.kept is Kept.EEPROM:
            raise ValueError(f"{name} of {cls._kind()} cannot be in ram: the manual says it is in EEPROM")
        return register.name

    @classmethod
    def _check_options(cls, given: Mapping[str, float]) -> None:
        """Raise ValueError for an unknown option or a value outside the option's limits."""
        for name, value in given.items():
            if name not in cls.options:
                known = ", ".join([*(Drive.__init__.__kwdefaults__ or ()), *cls.options])
                raise ValueError(f"{cls._kind()} has no argument or option {name!r}; it takes {known}")
            (low, high), unit = cls.options[name].span, cls.options[name].unit
            if not is_number(value) or not low <= value <= high:
                raise ValueError(f"{name} = {value!r} is outside {low:g} to {high:g} {unit}".rstrip())
            if not unit and value != int(value):
                raise ValueError(f"{name} = {value!r} is not a whole number from {low:g} to {high:g}")

    def take_framing_of(self, port: str) -> None:
        """Use TCP framing on a tcp:// port, else the declared one; raise ValueError if that is impossible."""
        self.framing = framing_on(
            port,
            self._declared_framing,
            self.framings[0],
            self.address,
            family=self._kind(),
            speaks_modbus=self.speaks(Framing.TCP),
        )

    def settings_on(self, *line: Any) -> tuple[Any, ...]:
        """Return the drive's own baud rate, format and silence, else those of `line`, else the family's."""
        return first_given(self.own_settings, line, self._default_settings)

    def take_settings(self, *line: Any, bus: Any = None) -> None:
        """Use `settings_on(*line)`. A drive on an open bus other than `bus` keeps the settings of that bus.

        Raises ValueError for a setting that the family does not support; the drive then keeps its settings.
        """
        if self.bus in (None, bus) or not self.bus.is_open:
            wanted = self.settings_on(*line)
            if wanted != (self.settings.baudrate, self.settings.format, self.agreed_silence):
                self._use(*wanted)

    def _use(self, baudrate: int, format: str, silence: float | None) -> None:
        settings = Settings(
            supported("baud rate", baudrate, self.baudrates, self._kind()),
            supported("format", format, self.formats_in(self.framing), self._kind()),
        )
        if silence is not None:
            own = self._own_silence(settings) if self.framing is Framing.RTU else None
            check_agreed_silence(silence, settings, own)
        self.settings, self.agreed_silence = settings, silence
        if self.response_delay_characters:
            least = self.response_delay_characters * settings.character
            self.response_delay = max(type(self).response_delay, least)

    def needed_silence(self) -> float:
        """Return the silence in s that this drive needs before a request and after its reply."""
        if self.framing is Framing.TCP:  # on Modbus TCP, the gateway keeps the silence
            return 0.0
        if self.framing is not Framing.RTU:
            return self._own_silence(self.settings)
        agreed = self.settings.t3_5 if self.agreed_silence is None else self.agreed_silence
        return max(agreed, self._own_silence(self.settings))

    def _own_silence(self, settings: Settings) -> float:
        return max(self.silence, self.silence_characters * settings.character)

    def __setattr__(self, name: str, value: object) -> None:
        if name in self.registers:
            raise AttributeError(f"{name} is a register; write it with drive.write({name!r}, VALUE)")
        if name in self.texts:
            raise AttributeError(f"{name} is a text; read it with drive.read({name!r})")
        super().__setattr__(name, value)

    def __repr__(self) -> str:
        where = f"on {self.bus.line.port}" if self.bus else "not attached"
        line = f"{self.framing}, {self.settings}"
        return f"<{type(self).__name__} {self.name!r}, address {self.address}, {line}, {where}>"

    @property
    def ledger_name(self) -> str:
        """Name under which EEPROM writes are counted. For a family from a file, it includes the title."""
        if self.declared_in:
            return f"{self.model}: {self.title}"
        return self.model or type(self).__name__

    @property
    def identity_is_weak(self) -> bool:
        """True if a drive of another make may pass `identify`; then commands need more checks."""
        return False

    @property
    def echo_probe(self) -> Register[Any] | None:
        """A register whose reply never equals the request, to detect an echo; None if there is none."""
        return None

    def known_counts(self) -> Mapping[Register[Any], tuple[int, int]]:
        """Return registers with known raw counts, each with its smallest and its largest count.

        The ranges must not overlap, because the value in a reply must show which register was read.
        """
        return {}

    def exception(self, code: int) -> str:
        """Return the meaning of an exception code in this family."""
        return self.exceptions.get(code, "a code that the document does not explain")

    def is_temporary(self, code: int) -> bool:
        """Return True for an exception that may not occur again: a damaged request, or a busy drive."""
        return code in self.exceptions and code in self.damaged | self.later

    def check_confirmed(self, what: str) -> None:
        """Raise WriteForbidden if the owner must confirm the drive's class and has not confirmed it.

        Two kinds of families need confirmation: a family without `identify`, because the same write may start
        a motor of another make, and a family from a file, because it is untested.
        """
        if "confirmed" not in self.options or self.option.get("confirmed"):
            return
        if self.declared_in:
            why = (
                f"the family file {self.declared_in} is not confirmed for this drive. Compare the output of "
                f"`multidrop check {self.declared_in}` with the manual, read the drive's name plate"
            )
        elif not self._identifies():
            why = (
                f"its class cannot identify a {self._kind()}, and the write may start a motor on a drive of "
                "another maker. Read the drive's name plate"
            )
        else:
            return
        raise WriteForbidden(
            f"{what} is not sent to {self.name}: {why}, then declare confirmed = 1",
            rule="the drive is not confirmed",
            advice=Advice.declare("confirmed", 1),
        )

    @property
    def commanded(self) -> float | None:
        """The setpoint that was written last; None unless the drive is known to hold it."""
        return None if isinstance(self._known_setpoint, _PendingWrite) else self._known_setpoint

    @commanded.setter
    def commanded(self, held: float | None) -> None:
        self._known_setpoint = held

    def begin_setpoint(self) -> Callable[[], None]:
        """Forget the setpoint until its write ends; return a function that restores it.

        The caller calls that function if the write was not sent or was refused. The function does nothing if
        another thread has written a setpoint since.
        """
        pending = self._known_setpoint = _PendingWrite(self._known_setpoint)

        def restore() -> None:
            if self._known_setpoint is pending:
                self._known_setpoint = pending.before

        return restore

    # ---- scripts, carried out by the bus ----

    def perform(self, script: Script[Any]) -> Any:
        """Carry out a script's steps on the bus; return the script's result."""
        return self.link.perform(self, script)

    def begin_call(self, verb: str, seen: int) -> Any:
        """Register a call, so that a later stop can cancel it; `seen` stops were called before this call."""
        return self.link.begin_call(self, verb, seen)

    def carry_out_move(self, script: Script[Any], call: Any) -> Any:
        """Carry out a verb that may move the motor. `call` is the result of `begin_call`."""
        return self.link.carry_out_move(self, script, call)

    def begin_stop(self, verb: str, make: Callable[[], Script[Any]], seconds: float | None) -> CalledStop:
        """Register a stop without sending it; `make` returns the stop's script."""
        return self.link.begin_stop(self, verb, make, seconds)

    # ---- for verbs ----

    def _unsupported(self, what: str) -> Unsupported:
        return Unsupported(f"{self.name}: the document of {self._kind()} has no {what}")

    def _stopped(self, check: Callable[[], Script[bool]], limit: float) -> Script[None]:
        """Wait until `check` sees that the drive has stopped. Raises Unconfirmed after `limit` seconds."""
        if not (yield from until(check, limit=limit)):
            raise Unconfirmed(self.name, "the stop", f"the drive does not report a stop within {limit:g} s")

    def _write_setpoint(self, register: Register[float], value: float) -> Script[None]:
        """Write the setpoint. Raises NotVerified if the drive then holds another value."""
        held = yield from write(register, value)
        if held != register.decode(register.encode(value)):
            what = f"{register.name} = {register.format(value)}"
            raise NotVerified(self.name, what, f"the drive holds {register.format(held)}")

    def _setpoint_in_force(self) -> Script[None]:
        """Raise WriteForbidden if the drive's setpoint is unknown, 0, or not the one written last."""
        register = self.register(self.setpoint_name)
        held = (yield from read(register)) if register.readable else self.commanded
        if held is None:
            problem = f"{self.name} cannot report its setpoint:"
        elif held == 0:
            problem = f"the setpoint of {self.name} is 0:"
        elif self.commanded is not None and held != self.commanded:
            shown = f"the setpoint {register.format(held)}, not the written {register.format(self.commanded)}"
            problem = f"{self.name} holds {shown}, perhaps after a power loss:"
        else:
            return
        raise WriteForbidden(f"{problem} call set_frequency before start", advice=_SETPOINT_FIRST)

    def _stop_first(self, problem: str) -> WriteForbidden:
        return WriteForbidden(f"{problem}: call stop() first", advice=Advice.call("stop"))

    def _reset_first(self, fault: str = "") -> WriteForbidden:
        shown = f"a fault, {fault}" if fault else "a fault"
        why = f"{self.name} has {shown}: remove its cause, then call reset_fault()"
        return WriteForbidden(why, advice=Advice.call("reset_fault"))

    def _started(self, direction: Direction | None = None) -> Script[None]:
        """Wait until the drive reports that the motor turns, in `direction` if that is given.

        The direction is ignored if the drive does not show one. A motor that turned in the other direction
        gets more time for its ramps. Raises NotVerified if the drive trips, and Unconfirmed if the motor is
        not seen to run in time.
        """
        if not (yield from until(self._runs, limit=START_TIME)):
            seen = f"the drive reports no run within {START_TIME:g} s. Stop it, or its motor may start later"
            raise Unconfirmed(self.name, "the start", f"{seen}; {self.remote}")
        if direction is None:
            return
        limit = self.option.get("stop_time", REVERSAL_TIME) + START_TIME
        if not (yield from until(lambda: self._turns_in(direction), limit=limit)):
            way = "in reverse" if direction is Direction.REVERSE else "forward"
            seen = f"the drive does not report it within {limit:g} s. Stop it, or it may turn {way} later"
            raise Unconfirmed(self.name, f"the start {way}", seen)

    def _runs(self) -> Script[bool]:
        state = yield from self._without_trip()
        return state.condition in _TURNING

    def _turns_in(self, direction: Direction) -> Script[bool]:
        """Return True if the motor turns in this direction, or turns and the drive reports no direction."""
        state = yield from self._without_trip()
        if state.direction is None:
            return (yield from self._runs())
        return state.condition in _TURNING and state.direction is direction

    def _without_trip(self) -> Script[State]:
        state = yield from self.state.script()
        if state.condition is Condition.FAULT:
            raise NotVerified(self.name, "the start", f"it tripped: {state.fault or 'it shows a fault'}")
        return state

    # ---- verbs; each family replaces those that its document has ----

    @verb
    def identify(self) -> Script[None]:
        """Check the drive's family, if registers show it. Raises WriteForbidden for another family."""
        yield from ()

    def resembles(self) -> Script[bool]:
        """Return True if a scan should report a drive that failed `identify` as possibly of this family."""
        yield from ()
        return False

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor at the present setpoint, and in the present direction unless one is given.

        Raises Unsupported if the family has no such command.
        """
        raise self._unsupported("start command")
        yield

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor along its deceleration ramp, if the family has a stop command."""
        raise self._unsupported("stop command")
        yield

    @verb
    def coast(self) -> Script[None]:
        """Remove the voltage and let the motor coast, if the family has such a command."""
        raise self._unsupported("coast command")
        yield

    @verb
    def emergency_stop(self) -> Script[None]:
        """Stop the motor with the drive's own emergency stop, if it has one."""
        raise self._unsupported("emergency stop")
        yield

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Turn the motor slowly until a stop is called, if the family has such a command."""
        raise self._unsupported("jog command")
        yield

    @verb
    def reset_fault(self) -> Script[None]:
        """Reset a fault, if the family has such a command. This never starts the motor."""
        raise self._unsupported("fault reset")
        yield

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the frequency setpoint in Hz, if the family has one."""
        raise self._unsupported("frequency setpoint")
        yield

    @verb
    def release_control(self) -> Script[None]:
        """At rest, return control of the motor to the panel or terminals, if the family has this command."""
        raise self._unsupported("release_control command")
        yield

    @verb
    def state(self) -> Script[State]:
        """Return the motor's condition and direction, and the drive's fault."""
        raise self._unsupported("state")
        yield


_OF_A_DRIVE = "address framing settings own_settings agreed_silence response_delay name option ram link"
TAKEN_NAMES = frozenset({*dir(Drive), *_OF_A_DRIVE.split()})  # names that a register must not have


def verbs_of(drive: Drive) -> list[str]:
    """Return the names of the verbs that command this drive."""
    return [name for name in VERB_OPTIONS if getattr(type(drive), name) is not getattr(Drive, name)]
