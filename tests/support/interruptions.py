"""Interruptions: Ctrl-C before any chosen line of the code under test."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


@contextmanager
def interrupted_at(nth: int, counts: Callable[[FrameType], bool]) -> Iterator[None]:
    """Raise KeyboardInterrupt before the nth line that counts; not at all where there are fewer."""
    left, before = nth, sys.gettrace()

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal left
        is_counted = counts(frame)
        if event == "line" and is_counted:
            left -= 1
            if left == 0:
                raise KeyboardInterrupt
        return trace if is_counted or event != "call" else None

    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)
