"""Simulated time for tests: an asyncio loop whose timers take no real time, and a clock."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

R = TypeVar("R")


class _PassingSelector(selectors.SelectSelector):
    now = 1000.0

    def select(self, timeout: float | None = None) -> list[Any]:
        ready = super().select(0)
        if not ready:
            assert timeout is not None, "no event is pending"
            self.now += max(timeout, 0.0)
        return ready


class ControlledLoop(asyncio.SelectorEventLoop):
    """An event loop with simulated time in s."""

    def __init__(self) -> None:
        self.passing = _PassingSelector()
        super().__init__(self.passing)

    def time(self) -> float:
        return self.passing.now


def run_controlled(main: Coroutine[Any, Any, R]) -> R:
    """Run a coroutine to its end on a loop with simulated time; return its result."""
    with asyncio.Runner(loop_factory=ControlledLoop) as runner:
        return runner.run(main)


class Clock:
    """A clock in monotonic seconds that the test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now
