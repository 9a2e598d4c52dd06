"""State: condition, direction and fault, as a drive reports them."""

from __future__ import annotations

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
    UNKNOWN = "unknown"  # the drive cannot say; never to be taken for stopped


@dataclass(frozen=True)
class State:
    """A drive's report of itself: never more than its document lets it say."""

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
