"""Verbs: a drive's commands, such as `start`, and their results, such as the drive's state. No I/O.

The script of a verb is a generator; the drive's bus carries out its steps.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from enum import Enum, StrEnum
from inspect import Parameter, Signature, signature
from numbers import Real
from sys import float_info
from typing import (
    TYPE_CHECKING,
    Any,
    Concatenate,
    Generic,
    NamedTuple,
    ParamSpec,
    Protocol,
    TypeVar,
    cast,
    overload,
)

from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.errors import BadReply, BusError, DriveException, NoReply, Unconfirmed
from multidrop.printable import is_number

if TYPE_CHECKING:
    from multidrop.drive.family import Drive

MOST_UNANSWERED = 3  # after this many checks in a row without a valid reply, `until` raises the error

T = TypeVar("T", bound=float)
R = TypeVar("R")
P = ParamSpec("P")


# ---- scripts ----


@dataclass(frozen=True)
class Read:
    register: Register[Any] | Text


@dataclass(frozen=True)
class Write:
    register: Register[Any]
    value: Any


@dataclass(frozen=True)
class Insist(Write):
    """A write that is safe to repeat at any time, such as a stop."""


@dataclass(frozen=True)
class Pulse(Insist):
    """A write that stops the motor but trips the drive, so it is sent only once in a call."""


@dataclass(frozen=True)
class Wait:
    seconds: float


Step = Read | Write | Wait
Script = Generator[Step, Any, R]


@overload
def read(register: Register[T]) -> Script[T]: ...
@overload
def read(register: Text) -> Script[str]: ...
def read(register: Register[Any] | Text) -> Script[Any]:
    """Read a register's value, or a text: `value = yield from read(register)`."""
    return (yield Read(register))


def write(register: Register[T], value: T) -> Script[T]:
    """Write a value once; return the value read back, or `value` if the register cannot be read."""
    return cast(T, (yield Write(register, value)))


def wait(seconds: float) -> Script[None]:
    yield Wait(seconds)


def carry_out(script: Script[R], do: Callable[[Step], Any]) -> R:
    """Carry out a script: call `do` for each step that it yields, and return the script's result.

    A BusError or ValueError that `do` raises is raised again inside the script.
    """
    try:
        step = next(script)
        while True:
            try:
                result = do(step)
            except (BusError, ValueError) as failure:
                step = script.throw(failure)
            else:
                step = script.send(result)
    except StopIteration as end:
        return cast(R, end.value)


def insist(register: Register[T], value: T, attempts: int = 3) -> Script[None]:
    """Write a harmless value, such as a stop. Repeat the write after a lost reply or an exception reply."""
    for attempt in range(1, attempts + 1):
        try:
            yield Insist(register, value)
        except (Unconfirmed, DriveException):
            if attempt == attempts:
                raise
        else:
            return


def until(look: Callable[[], Script[bool]], *, limit: float, every: float = 0.1) -> Script[bool]:
    """Repeat the check `look` every `every` seconds until it is true; return False after `limit` seconds.

    A starting motor causes noise, so a check without a valid reply counts as false. The third such check in
    a row raises its NoReply or BadReply.
    """
    waited = 0.0
    unanswered = 0
    while True:
        try:
            if (yield from look()):
                return True
            unanswered = 0
        except (NoReply, BadReply):
            unanswered += 1
            if unanswered == MOST_UNANSWERED:
                raise
        if waited >= limit:
            return False
        yield from wait(every)
        waited += every


# ---- results ----


class Direction(Enum):
    FORWARD = "forward"
    REVERSE = "reverse"


class Condition(Enum):
    STOPPED = "stopped"
    RUNNING = "running"
    ACCELERATING = "accelerating"
    DECELERATING = "decelerating"
    FAULT = "fault"
    UNKNOWN = "unknown"  # the drive cannot report its state; never treat it as stopped


@dataclass(frozen=True)
class State:
    """A drive's state. Attributes that the drive's document does not define have no value."""

    condition: Condition
    direction: Direction | None = None
    fault: str | None = None
    note: str = ""

    def __str__(self) -> str:
        words = [self.condition.value]
        if self.direction:
            words.append(self.direction.value)
        if self.fault:
            words.append(f"({self.fault})")
        if self.note:
            words.append(f"- {self.note}")
        return " ".join(words)


class CommandOutcome(StrEnum):
    """The outcome of a command. It is UNKNOWN unless the effect is certain."""

    DONE = "done"
    FAILED = "failed"  # sent, but the drive refused the command or did not obey it
    REFUSED = "refused"  # forbidden by the library's rules or the plant's lists; not sent
    NOT_SENT = "not sent"  # certainly not sent
    UNKNOWN = "unknown"  # the command may have been carried out
    UNDER_WAY = "under way"  # not finished yet: ask again later


class CommandResult(NamedTuple):
    """The result of a command.

    `text` is one sentence for a person. `error` is the error of a command that a server carried out; a verb
    raises its error instead. `held` is the value that the drive holds after a write, as text with its unit.
    """

    outcome: CommandOutcome
    text: str
    error: BusError | ValueError | None = None
    held: str = ""

    @property
    def ok(self) -> bool:
        """True if the command was carried out; for a stop, if the motor was seen at rest."""
        return self.outcome is CommandOutcome.DONE


# ---- verbs ----


# Verbs that are sent only to an identified drive, and that a later stop cancels.
MOVING = ("start", "jog", "reset_fault", "set_frequency", "release_control")

# Verbs that stop the motor. They are sent repeatedly, even to a drive that does not reply.
STOPPING = ("stop", "coast", "emergency_stop")

VERBS = (
    *("start", "stop", "coast", "emergency_stop", "jog", "reset_fault", "set_frequency"),
    *("release_control", "state"),
)

# Name of each verb's argument, its allowed types, and their description in errors. If the types were not
# checked, the text "reverse" would run the motor forward.
_TAKES: Mapping[str, tuple[str, tuple[type, ...], str]] = {
    "start": ("direction", (Direction, type(None)), "Direction.FORWARD or Direction.REVERSE"),
    "jog": ("direction", (Direction, type(None)), "Direction.FORWARD or Direction.REVERSE"),
    "set_frequency": ("hz", (Real,), "a number in Hz"),
}

TRIES = 150  # limit of attempts to begin a stop while the system lacks memory or file descriptors


class CalledStop(Protocol):
    """A stop that was called. If `carry_out` failed, another call of `carry_out` resumes the stop."""

    def carry_out(self) -> None: ...
    def interrupted(self, interruption: BaseException) -> None: ...
    def result(self) -> CommandResult: ...


class UnattachedStop:
    """The stop of a drive that is not attached to a bus."""

    def __init__(self, drive: Drive, make: Callable[[], Script[Any]]) -> None:
        self._drive = drive
        self._make = make

    def carry_out(self) -> None:
        """Do nothing: without a bus no stop can be sent."""

    def interrupted(self, interruption: BaseException) -> None:
        """Do nothing: no stop was in progress."""

    def result(self) -> CommandResult:
        """Perform the stop, which raises NotAttached: the drive has no bus."""
        return cast(CommandResult, self._drive.perform(self._make()))


def _signature(verb: str, script: Callable[..., Any]) -> Signature:
    """Return the signature of a verb: that of its script, and for a stop also `seconds`."""
    whole = signature(script).replace(return_annotation=Signature.empty)
    if verb not in STOPPING:
        return whole
    seconds = Parameter("seconds", Parameter.KEYWORD_ONLY, default=None, annotation="float | None")
    return whole.replace(parameters=[*whole.parameters.values(), seconds])


class _BoundVerb(Generic[P, R]):
    """A verb of one drive, such as `start`; calling it carries out the verb.

    The call returns the result of the verb's script, or a CommandResult if the script returns None.

    A verb that stops the motor has the argument `seconds`: the stop is repeated for that time, or until the
    motor is seen to be at rest. Without a valid `seconds`, it is repeated for as long as the motor's ramp
    takes, but for at least 30 s. A stop with wrong arguments is carried out before TypeError is raised.
    """

    def __init__(self, name: str, drive: Drive, script: Callable[..., Script[R]]) -> None:
        self.name = name
        self.drive = drive
        self._script = script
        self.__doc__ = script.__doc__

    @property
    def __signature__(self) -> Signature:
        whole = _signature(self.name, self._script)
        return whole.replace(parameters=[*whole.parameters.values()][1:])

    @overload
    def __call__(self: _BoundVerb[P, None], *args: P.args, **kwargs: P.kwargs) -> CommandResult: ...
    @overload
    def __call__(self: _BoundVerb[P, None], *, seconds: float | None) -> CommandResult: ...
    @overload
    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R: ...
    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._result(self.drive.perform(self.script(*args, **kwargs)))

    def _result(self, returned: Any) -> Any:
        if returned is None:
            return CommandResult(CommandOutcome.DONE, f"{self.drive.name}: {self.name} is done")
        return returned

    def script(self, *args: P.args, **kwargs: P.kwargs) -> Script[R]:
        """Return the verb's script, for use in another verb or a test.

        Raises TypeError for a wrong argument.
        """
        if self.name in _TAKES:
            keyword, types, right = _TAKES[self.name]
            for given in (*args[:1], *(value for key, value in kwargs.items() if key == keyword)):
                if isinstance(given, bool) or not isinstance(given, types):
                    raise TypeError(f"{self.name} of {self.drive.name} takes {right}, not {given!r}")
        return self._script(self.drive, *args, **kwargs)


class _BoundMove(_BoundVerb[P, R]):
    """A verb that may move the motor. A later stop of the drive cancels it."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        # Read the number of stops first, without calling a Python function. If a signal handler stops the
        # drive after this line, the stop is newer than the number, and cancels this call.
        seen = self.drive.stops_called[0]
        script = self.script(*args, **kwargs)
        self.drive.check_confirmed(self.name)
        return self._result(self.drive.carry_out_move(script, self.drive.begin_call(self.name, seen)))


class _BoundStop(_BoundVerb[P, R]):
    """A verb that stops the motor, even if the call is interrupted."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        run: CalledStop | None = None
        tried = 0
        while True:
            try:
                tried += 1
                run = run or self._called(args, **kwargs)
                run.carry_out()
                break
            except BaseException as failure:
                if tried < TRIES and isinstance(failure, (MemoryError, OSError)):
                    continue
                (run or self._called(args, **kwargs)).interrupted(failure)
                raise
        result = run.result()
        if mistake := self._mistake(args, **kwargs):
            mistake.add_note(f"{self.name} of {self.drive.name} was sent all the same, without them")
            raise mistake
        return result

    def _called(self, args: tuple[Any, ...], seconds: float | None = None, **kwargs: Any) -> CalledStop:
        if self._mistake(args, **kwargs):
            args, kwargs = (), {}
        return self.drive.begin_stop(self.name, lambda: self.script(*args, **kwargs), seconds)

    def _mistake(
        self, args: tuple[Any, ...], seconds: float | None = None, **kwargs: Any
    ) -> TypeError | None:
        """Return a TypeError if the stop's script does not take these arguments, else None."""
        if not args and not kwargs:
            return None
        try:
            signature(self._script).bind(self.drive, *args, **kwargs)
        except TypeError as mistake:
            return TypeError(f"{self.name} of {self.drive.name}: {mistake}")
        return None


_BOUND: Mapping[str, type[_BoundVerb[Any, Any]]] = {
    **dict.fromkeys(MOVING, _BoundMove),
    **dict.fromkeys(STOPPING, _BoundStop),
}


class Verb(Generic[P, R]):
    """Decorator that makes a script a verb: calling the verb carries out the script on the drive's bus."""

    def __init__(self, script: Callable[Concatenate[Any, P], Script[R]]) -> None:
        self._script = script
        self.__doc__ = script.__doc__
        self.__module__ = script.__module__
        self.__qualname__ = script.__qualname__
        self.name = self.__name__ = script.__name__

    @property
    def __signature__(self) -> Signature:
        return _signature(self.name, self._script)

    @overload
    def __call__(self: Verb[P, None], drive: Drive, *args: P.args, **kwargs: P.kwargs) -> CommandResult: ...
    @overload
    def __call__(self, drive: Drive, *args: P.args, **kwargs: P.kwargs) -> R: ...
    def __call__(self, drive: Drive, *args: Any, **kwargs: Any) -> Any:
        """Carry out the verb on a drive: `YD1000.start(pump)` is `pump.start()`."""
        return self.__get__(drive, type(drive))(*args, **kwargs)

    @overload
    def __get__(self, drive: None, owner: type) -> Verb[P, R]: ...
    @overload
    def __get__(self, drive: Drive, owner: type) -> _BoundVerb[P, R]: ...
    def __get__(self, drive: Drive | None, owner: type) -> Verb[P, R] | _BoundVerb[P, R]:
        return self if drive is None else _BOUND.get(self.name, _BoundVerb)(self.name, drive, self._script)


verb = Verb


def verb_errors(family: Any) -> list[str]:
    """Return an error sentence for each method that has a verb's name but not the decorator `verb`.

    A call of such a method would only create a generator, and send no request. A register or text with such
    a name is reported elsewhere.
    """
    return [
        f"{name}: without the decorator @verb a call would send nothing; write @verb above it"
        for name in (*VERBS, "identify")
        if name not in family.registers
        and name not in family.texts
        and not isinstance(getattr(family, name), Verb)
    ]


# ---- verbs by name, with options from JSON ----


def _direction(value: object) -> Direction:
    try:
        return Direction(value)
    except ValueError:
        raise ValueError(f"direction = {value!r} is neither forward nor reverse") from None


def _hertz(value: object) -> float:
    if not is_number(value) or not abs(value) <= float_info.max:
        raise ValueError(f"hz = {value!r} is not a number")
    return float(value)


# options of each verb, with the functions that convert JSON values
VERB_OPTIONS: Mapping[str, Mapping[str, Callable[[object], Any]]] = {
    "start": {"direction": _direction},
    "jog": {"direction": _direction},
    "reset_fault": {},
    "set_frequency": {"hz": _hertz},
    "coast": {},  # a separate verb, not a variant of "stop", because coasting lets a hoist drop its load
    "emergency_stop": {},
    "stop": {},
}
# verbs that the tables `may` of a plant file can allow
LISTED_VERBS = tuple(name for name in VERB_OPTIONS if name != "stop")


def verb_arguments(verb: str, options: Mapping[str, object]) -> dict[str, Any]:
    """Convert options with JSON values into the keyword arguments of a verb.

    `{"direction": "reverse"}` becomes Direction.REVERSE; `hz` is in Hz. An option that is None is omitted.
    Raises ValueError for an unknown, missing or invalid option, KeyError for an unknown verb.
    """
    takes = VERB_OPTIONS[verb]
    for name in options:
        if name not in takes:
            raise ValueError(f"{verb} has no option {name!r}; it has {', '.join(takes) or 'none'}")
    if "hz" in takes and options.get("hz") is None:
        raise ValueError(f"{verb} needs a frequency: hz = 20.0")
    return {name: takes[name](value) for name, value in options.items() if value is not None}
