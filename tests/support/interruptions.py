"""Interruptions: Ctrl-C, or any failure, before any chosen line of the code under test."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from types import FrameType
from typing import Any


def interrupted_at(nth: int, counts: Callable[[FrameType], bool]) -> AbstractContextManager[list[str]]:
    """Raise KeyboardInterrupt before the nth line that counts; not at all where there are fewer."""
    return failing_at(nth, counts, KeyboardInterrupt())


@contextmanager
def failing_at(nth: int, counts: Callable[[FrameType], bool], failure: BaseException) -> Iterator[list[str]]:
    """Raise this before the nth line that counts; give a list, which then has the line."""
    left, before = nth, sys.gettrace()
    found: list[str] = []

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal left
        is_counted = counts(frame)
        if event == "line" and is_counted:
            left -= 1
            if left == 0:
                found.append(f"{frame.f_code.co_qualname}, line {frame.f_lineno}")
                raise failure
        return trace if is_counted or event != "call" else None

    sys.settrace(trace)
    try:
        yield found
    finally:
        sys.settrace(before)
