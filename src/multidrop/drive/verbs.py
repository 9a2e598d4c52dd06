"""Verbs: methods of a drive that are scripts, and are carried out on its bus."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from inspect import signature
from numbers import Real
from typing import TYPE_CHECKING, Any, Concatenate, Generic, ParamSpec, TypeVar, cast, overload

from multidrop.drive.script import Script
from multidrop.drive.state import Direction

if TYPE_CHECKING:
    from multidrop.drive.family import Drive

R = TypeVar("R")
P = ParamSpec("P")


# Sent only to a drive that is known to be of its family, and not after a stop was called.
MOVING = ("start", "jog", "reset_fault", "set_frequency", "release_control")

# Sent to a silent drive too, again and again.
STOPPING = ("stop", "coast", "emergency_stop")

VERBS = (
    *("start", "stop", "coast", "emergency_stop", "jog", "reset_fault", "set_frequency"),
    *("release_control", "state"),
)

# Each verb's argument, its types, and these in words: "reverse", a string, would go forward.
_TAKES: Mapping[str, tuple[str, tuple[type, ...], str]] = {
    "start": ("direction", (Direction, type(None)), "Direction.FORWARD or Direction.REVERSE"),
    "jog": ("direction", (Direction, type(None)), "Direction.FORWARD or Direction.REVERSE"),
    "set_frequency": ("hz", (Real,), "a number in Hz"),
}


class _BoundVerb(Generic[P, R]):
    """A verb of one drive; a call carries it out.

    A stop takes `seconds`: it is repeated for so long until the motor is seen to stand; without it, or with
    what is no time, for 30 s at least, and as long as the motor's ramp may take. One that is called with
    arguments that it does not take is carried out before it raises TypeError.
    """

    def __init__(self, name: str, drive: Drive, script: Callable[..., Script[R]]) -> None:
        self.name = name
        self.drive = drive
        self._script = script

    @overload
    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R: ...
    @overload
    def __call__(self, *, seconds: float | None) -> R: ...
    def __call__(self, *args: Any, **kwargs: Any) -> R:
        if self.name in STOPPING:
            seconds = kwargs.pop("seconds", None)
            if args or kwargs:
                self._check_stop(seconds, args, kwargs)
            return cast(
                R, self.drive.carry_out_stop(self.name, lambda: self.script(*args, **kwargs), seconds)
            )
        script = self.script(*args, **kwargs)
        if self.name in MOVING:
            self.drive.check_confirmed(self.name)
            return cast(R, self.drive.carry_out_move(script, self.drive.begin_call(self.name)))
        return cast(R, self.drive.perform(script))

    def _check_stop(self, seconds: float | None, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Raise TypeError for arguments that the stop does not take, once it was carried out without them."""
        try:
            signature(self._script).bind(self.drive, *args, **kwargs)
        except TypeError as mistake:
            mistake.add_note(f"{self.name} of {self.drive.name} was sent all the same, without them")
            self.drive.carry_out_stop(self.name, lambda: self._script(self.drive), seconds)
            raise

    def script(self, *args: P.args, **kwargs: P.kwargs) -> Script[R]:
        """Return the steps, for another verb or a test. Raises TypeError for a wrong argument."""
        if self.name in _TAKES:
            keyword, types, right = _TAKES[self.name]
            for given in (*args[:1], *(value for key, value in kwargs.items() if key == keyword)):
                if isinstance(given, bool) or not isinstance(given, types):
                    raise TypeError(f"{self.name} of {self.drive.name} takes {right}, not {given!r}")
        return self._script(self.drive, *args, **kwargs)


class Verb(Generic[P, R]):
    """Decorator of a script that becomes a verb: a call carries it out on the drive's bus."""

    def __init__(self, script: Callable[Concatenate[Any, P], Script[R]]) -> None:
        self._script = script
        self.__doc__ = script.__doc__
        self.name = script.__name__

    @overload
    def __get__(self, drive: None, owner: type) -> Verb[P, R]: ...
    @overload
    def __get__(self, drive: Drive, owner: type) -> _BoundVerb[P, R]: ...
    def __get__(self, drive: Drive | None, owner: type) -> Verb[P, R] | _BoundVerb[P, R]:
        return self if drive is None else _BoundVerb(self.name, drive, self._script)


verb = Verb


def verb_errors(family: Any) -> list[str]:
    """Return a sentence for each method that has a verb's name and is none.

    A call of it would send nothing: it makes a generator that nobody carries out. A register of such a name
    is told as that.
    """
    return [
        f"{name}: it is no verb, and a call of it would send nothing: write @verb above it"
        for name in (*VERBS, "identify")
        if name not in family.registers
        and name not in family.texts
        and not isinstance(getattr(family, name), Verb)
    ]
