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


def failing_at(
    nth: int, counts: Callable[[FrameType], bool], failure: BaseException
) -> AbstractContextManager[list[str]]:
    """Raise this before the nth line that counts; give a list, which then has the line."""

    def fail() -> None:
        raise failure

    return calling_at(nth, counts, fail, "line")


@contextmanager
def calling_at(
    nth: int, counts: Callable[[FrameType], bool], call: Callable[[], object], event: str = "opcode"
) -> Iterator[list[str]]:
    """Call this before the nth opcode, or line, that counts; give a list, which then has its place."""
    left, before = nth, sys.gettrace()
    found: list[str] = []

    def trace(frame: FrameType, happens: str, argument: object) -> Any:
        nonlocal left
        is_counted = counts(frame)
        frame.f_trace_opcodes = is_counted and event == "opcode"
        if happens == event and is_counted and left:
            left -= 1
            if left == 0:
                found.append(f"{frame.f_code.co_qualname}, line {frame.f_lineno}, opcode {frame.f_lasti}")
                call()
        return trace if is_counted or happens != "call" else None

    sys.settrace(trace)
    try:
        yield found
    finally:
        sys.settrace(before)
