"""Verbs: methods of a drive that are scripts, and are carried out on its bus."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum
from inspect import Signature, signature
from numbers import Real
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

from multidrop.drive.script import Script
from multidrop.drive.state import Direction
from multidrop.errors import BusError

if TYPE_CHECKING:
    from multidrop.drive.family import Drive


class CommandOutcome(StrEnum):
    """The outcome of a command; UNKNOWN unless its effect is certain."""

    DONE = "done"
    FAILED = "failed"  # sent, but the drive refused it, or was seen not to do it
    REFUSED = "refused"  # forbidden by the library's rules or the plant's lists; not sent
    NOT_SENT = "not sent"  # it is certain that nothing was sent
    UNKNOWN = "unknown"  # the command may have been carried out
    UNDER_WAY = "under way"  # not over yet: ask again later


class CommandResult(NamedTuple):
    """The result of a command.

    `text` is one sentence for a person. `error` is the library's error if a server's command failed; a verb
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


R = TypeVar("R")
P = ParamSpec("P")

# Verbs that are sent only to an identified drive, and not after a stop was called.
MOVING = ("start", "jog", "reset_fault", "set_frequency", "release_control")

# Verbs that are sent repeatedly, even to a silent drive.
STOPPING = ("stop", "coast", "emergency_stop")

VERBS = (
    *("start", "stop", "coast", "emergency_stop", "jog", "reset_fault", "set_frequency"),
    *("release_control", "state"),
)

# By verb: its argument, the argument's types, and a description. Without the check of types, the text
# "reverse" would count as forward.
_TAKES: Mapping[str, tuple[str, tuple[type, ...], str]] = {
    "start": ("direction", (Direction, type(None)), "Direction.FORWARD or Direction.REVERSE"),
    "jog": ("direction", (Direction, type(None)), "Direction.FORWARD or Direction.REVERSE"),
    "set_frequency": ("hz", (Real,), "a number in Hz"),
}

TRIES = 150  # attempts of a stop while the system has no memory or file descriptors left


class CalledStop(Protocol):
    """A stop that was called. `carry_out` may be called again after it failed, and then resumes the stop."""

    def carry_out(self) -> None: ...
    def interrupted(self, interruption: BaseException) -> None: ...
    def result(self) -> CommandResult: ...


class UnattachedStop:
    """The stop of a drive that is not attached to a bus."""

    def __init__(self, drive: Drive, make: Callable[[], Script[Any]]) -> None:
        self._drive = drive
        self._make = make

    def carry_out(self) -> None:
        """Do nothing, because without a bus no stop can be sent."""

    def interrupted(self, interruption: BaseException) -> None:
        """Do nothing, because no stop was in progress."""

    def result(self) -> CommandResult:
        """Raise NotAttached, because the drive has no bus."""
        return cast(CommandResult, self._drive.perform(self._make()))


class _BoundVerb(Generic[P, R]):
    """A verb of one drive; calling it carries out the verb.

    The call returns what the script returns, or if that is None, a CommandResult.

    A stop takes `seconds`: it is repeated for that long, or until the motor is seen to be at rest. Without a
    valid `seconds`, it is repeated for the duration of the motor's ramp, but for at least 30 s. A stop that
    is called with wrong arguments is carried out before TypeError is raised.
    """

    def __init__(self, name: str, drive: Drive, script: Callable[..., Script[R]]) -> None:
        self.name = name
        self.drive = drive
        self._script = script
        self.__doc__ = script.__doc__

    @property
    def __signature__(self) -> Signature:
        whole = signature(self._script)
        return whole.replace(parameters=[*whole.parameters.values()][1:], return_annotation=Signature.empty)

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
        """Return the verb's script, for another verb or a test. Raises TypeError for a wrong argument."""
        if self.name in _TAKES:
            keyword, types, right = _TAKES[self.name]
            for given in (*args[:1], *(value for key, value in kwargs.items() if key == keyword)):
                if isinstance(given, bool) or not isinstance(given, types):
                    raise TypeError(f"{self.name} of {self.drive.name} takes {right}, not {given!r}")
        return self._script(self.drive, *args, **kwargs)


class _BoundMove(_BoundVerb[P, R]):
    """A verb that may move the motor. Any later stop of the drive cancels the call."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        # Read the number of stops first, without calling a Python function. Then a signal handler that stops
        # the drive either runs before this line, or cancels the call.
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
        """Return a TypeError if the stop does not take these arguments, else None."""
        if not args and not kwargs:
            return None
        try:
            signature(self._script).bind(self.drive, *args, **kwargs)
        except TypeError as mistake:
            return mistake
        return None


_BOUND: Mapping[str, type[_BoundVerb[Any, Any]]] = {
    **dict.fromkeys(MOVING, _BoundMove),
    **dict.fromkeys(STOPPING, _BoundStop),
}


class Verb(Generic[P, R]):
    """Decorator that makes a script a verb: a call of the verb carries out the script on the drive's bus."""

    def __init__(self, script: Callable[Concatenate[Any, P], Script[R]]) -> None:
        self._script = script
        self.__doc__ = script.__doc__
        self.__module__ = script.__module__
        self.__qualname__ = script.__qualname__
        self.name = self.__name__ = script.__name__

    @property
    def __signature__(self) -> Signature:
        return signature(self._script).replace(return_annotation=Signature.empty)

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
    """Return a sentence for each method that has a verb's name and lacks the decorator.

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
