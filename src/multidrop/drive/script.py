"""Scripts: generators that yield the steps of a verb (read, write, wait) and receive the results. No I/O."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, TypeVar, cast, overload

from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.errors import BadReply, BusError, DriveException, NoReply, Unconfirmed

MOST_UNANSWERED = 3  # number of checks in a row without a valid reply after which `until` raises the error

T = TypeVar("T", bound=float)
R = TypeVar("R")


@dataclass(frozen=True)
class Read:
    register: Register[Any] | Text


@dataclass(frozen=True)
class Write:
    register: Register[Any]
    value: Any


@dataclass(frozen=True)
class Insist(Write):
    """A write that is harmless at any time, even if repeated, such as a stop."""


@dataclass(frozen=True)
class Pulse(Insist):
    """A harmless write that is sent only once in a call, such as a stop that trips the drive."""


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
    """Run a script, calling `do` for each step, and return the script's result.

    A BusError or ValueError that `do` raises is raised in the script.
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
    """Write a harmless value, such as a stop; repeat the write if the reply is lost or is an exception."""
    for attempt in range(1, attempts + 1):
        try:
            yield Insist(register, value)
        except (Unconfirmed, DriveException):
            if attempt == attempts:
                raise
        else:
            return


def until(look: Callable[[], Script[bool]], *, limit: float, every: float = 0.1) -> Script[bool]:
    """Repeat a check every `every` seconds until it is true; return False after `limit` seconds.

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
