"""State: a drive's condition, direction and fault. KnownSetpoint: the setpoint that it holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum


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


class _PendingWrite:
    """A write of the setpoint that has not ended yet."""

    def __init__(self, before: float | _PendingWrite | None) -> None:
        self.before = before


class KnownSetpoint:
    """The setpoint that was written last; None unless the drive is known to hold it."""

    def __init__(self) -> None:
        self._held: float | _PendingWrite | None = None

    @property
    def value(self) -> float | None:
        return None if isinstance(self._held, _PendingWrite) else self._held

    @value.setter
    def value(self, value: float | None) -> None:
        self._held = value

    def begin_write(self) -> Callable[[], None]:
        """Forget the setpoint until the write ends; return a function that restores it.

        The caller calls that function if the write was not sent or was refused. The function does nothing if
        another thread has written a setpoint since.
        """
        write = self._held = _PendingWrite(self._held)

        def restore() -> None:
            if self._held is write:
                self._held = write.before

        return restore
