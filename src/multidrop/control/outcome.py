"""Outcome and Stopped: the known effect of a write, and of a stop."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

from multidrop.drive.register import Register
from multidrop.errors import BusError


class Effect(Enum):
    DONE = "done"
    TAKEN_AS = "taken as"  # the drive holds another value
    REFUSED = "refused by the drive"
    UNCONFIRMED = "unconfirmed"  # no reply: the write may have had its effect


@dataclass(frozen=True)
class Outcome:
    """The effect of one write.

    `asked` is the value written, `held` the value read back (None if it could not be read). `failure` is the
    error that `Drive.write` raises for this outcome.
    """

    drive: str
    register: Register[Any]
    asked: Any
    effect: Effect
    held: Any = None
    failure: BusError | None = None

    @property
    def ok(self) -> bool:
        """True if the drive took the value."""
        return self.effect is Effect.DONE

    @property
    def value(self) -> Any:
        """The value that the drive holds, as far as it is known. Raises `failure` if there is one."""
        if self.failure is not None:
            raise self.failure
        return self.asked if self.held is None else self.held

    def __str__(self) -> str:
        return f"{self.drive}: {self.register.name} = {self.register.format(self.asked)}: {self._in_words()}"

    def _in_words(self) -> str:
        if self.failure is not None:
            return f"{self.effect.value}: {self.failure}"
        if self.effect is Effect.TAKEN_AS:
            return f"taken as {self.register.format(self.held)}"
        return "done (cannot be read back)" if self.held is None else "done (read back)"


class Seen(Enum):
    STOPPED = "stopped"  # the motor was seen to stand
    SENT = "sent but unknown"
    REFUSED = "refused by the drive"  # each time that the stop was sent
    FAILED = "failed"  # no stop was sent


@dataclass(frozen=True)
class Stopped:
    """The result of one drive's stop, its duration in s, and why the motor was not seen to stop."""

    drive: str
    seen: Seen
    seconds: float
    why: str = ""

    @property
    def ok(self) -> bool:
        """True if the motor is seen to stand."""
        return self.seen is Seen.STOPPED

    def __str__(self) -> str:
        why = f": {self.why}" if self.why else ""
        return f"{self.drive}: {self.seen.value} after {self.seconds:.1f} s{why}"
