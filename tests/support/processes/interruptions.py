"""Raise KeyboardInterrupt or another exception before a chosen line or bytecode of the code under test."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from itertools import count
from pathlib import Path
from types import FrameType
from typing import Any

import multidrop

PACKAGE = str(Path(multidrop.__file__).parent)


def interrupted_at(nth: int, counts: Callable[[FrameType], bool]) -> AbstractContextManager[list[str]]:
    """Raise KeyboardInterrupt before the nth line in frames for which `counts` is true, if there is one."""
    return failing_at(nth, counts, KeyboardInterrupt())


def failing_at(
    nth: int, counts: Callable[[FrameType], bool], failure: BaseException
) -> AbstractContextManager[list[str]]:
    """Raise `failure` before the nth line for which `counts(frame)` is true; yield a list for its place."""

    def fail() -> None:
        raise failure

    return calling_at(nth, counts, fail, "line")


@contextmanager
def calling_at(
    nth: int, counts: Callable[[FrameType], bool], call: Callable[[], object], event: str = "opcode"
) -> Iterator[list[str]]:
    """Call `call` before the nth opcode or line for which `counts(frame)` is true.

    Yields a list to which the place of this opcode or line is added.
    """
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


# ---- before each bytecode ----


class Interruption(BaseException):
    """Raised instead of KeyboardInterrupt, which would end the test run."""


@contextmanager
def interrupted_before(nth: int, failure: type[BaseException] = Interruption) -> Iterator[list[str]]:
    """Raise `failure` before the package's nth bytecode on this thread; yield a list for its place."""
    left = nth
    found: list[str] = []

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal left
        if not frame.f_code.co_filename.startswith(PACKAGE):
            return None
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        if event == "opcode" and not found:
            left -= 1
            if left == 0:
                found.append(f"{frame.f_code.co_qualname}, line {frame.f_lineno}")
                raise failure
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield found
    finally:
        sys.settrace(before)


def every(step: int, act: Callable[[int], bool]) -> int:
    """Call `act` with 1, 1 + step, ... until it returns False; return the number of calls before that."""
    for times in count():
        if not act(1 + times * step):
            return times
    raise AssertionError


def interrupted(act: Callable[[], object], nth: int, places: set[str]) -> bool:
    with suppress(Interruption), interrupted_before(nth) as found:
        act()
    places.update(found)
    return bool(found)
