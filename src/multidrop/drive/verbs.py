"""Verbs: methods of a drive that are scripts, carried out on the bus that the drive is on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any, Concatenate, Generic, ParamSpec, TypeVar, cast, overload

from multidrop.drive.script import (
    Script,
)
from multidrop.drive.state import Direction

if TYPE_CHECKING:
    from multidrop.drive.family import Drive

R = TypeVar("R")
P = ParamSpec("P")


@dataclass(frozen=True)
class Option:
    """A fact about one drive that only its owner knows, such as its maximum frequency.

    One without a unit is a choice or a number of something: a whole number.
    """

    unit: str
    span: tuple[float, float]
    meaning: str


# Verbs before which the drive must be known to be of its family, and which a stop ends.
MOVING = ("start", "jog", "reset_fault", "set_frequency")


# A stop goes to a silent drive too, again and again.
STOPPING = ("stop", "coast", "emergency_stop")


# What a verb is given, its types, and in words: "reverse" is not Direction.REVERSE, and would go forward.
_TAKES: Mapping[str, tuple[str, tuple[type, ...], str]] = {
    "start": ("direction", (Direction, type(None)), "Direction.FORWARD or Direction.REVERSE"),
    "jog": ("direction", (Direction, type(None)), "Direction.FORWARD or Direction.REVERSE"),
    "set_frequency": ("hz", (Real,), "a number in Hz"),
}


class _BoundVerb(Generic[P, R]):
    """A verb of one drive: calling it carries it out.

    A stop takes `seconds`: for so long it is repeated until the motor is seen to stand; without it for 30 s
    at least, and as long as the motor's ramp may take.
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
            return cast(
                R, self.drive.carry_out_stop(self.name, lambda: self.script(*args, **kwargs), seconds)
            )
        script = self.script(*args, **kwargs)
        if self.name in MOVING:
            self.drive.check_confirmed(self.name)
            return cast(R, self.drive.carry_out_move(script, self.drive.begin_call(self.name)))
        return cast(R, self.drive.perform(script))

    def script(self, *args: P.args, **kwargs: P.kwargs) -> Script[R]:
        """The steps, to be carried out by someone else: another verb or a test."""
        if self.name in _TAKES:
            keyword, types, right = _TAKES[self.name]
            for given in (*args[:1], *(it for key, it in kwargs.items() if key == keyword)):
                if isinstance(given, bool) or not isinstance(given, types):
                    raise TypeError(f"{self.name} of {self.drive.name} takes {right}, not {given!r}")
        return self._script(self.drive, *args, **kwargs)


class Verb(Generic[P, R]):
    """A method that is a script, and is carried out on the drive's bus when it is called."""

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


verb = Verb  # as a decorator


VERBS = (
    "start",
    "stop",
    "coast",
    "emergency_stop",
    "jog",
    "reset_fault",
    "set_frequency",
    "state",
)
