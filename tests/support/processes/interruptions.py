"""Raise an exception before a chosen line or bytecode of the code under test; simulate full disks."""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

import multidrop

PACKAGE = str(Path(multidrop.__file__).parent)


def interrupted_at(nth: int, counts: Callable[[FrameType], bool]) -> AbstractContextManager[list[str]]:
    """Raise KeyboardInterrupt before the nth executed line in frames for which `counts` is true."""
    return failing_at(nth, counts, KeyboardInterrupt())


@contextmanager
def failing_at(nth: int, counts: Callable[[FrameType], bool], failure: BaseException) -> Iterator[list[str]]:
    """Raise `failure` before the nth line for which `counts(frame)` is true; add its place to a list."""
    left, before = nth, sys.gettrace()
    found: list[str] = []

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal left
        is_counted = counts(frame)
        if event == "line" and is_counted and left:
            left -= 1
            if left == 0:
                found.append(place(frame))
                raise failure
        return trace if is_counted or event != "call" else None

    sys.settrace(trace)
    try:
        yield found
    finally:
        sys.settrace(before)


def place(frame: FrameType) -> str:
    return f"{frame.f_code.co_qualname}, line {frame.f_lineno}, opcode {frame.f_lasti}"


@contextmanager
def calling_at(
    nth: int, counts: Callable[[FrameType], bool], call: Callable[[], object]
) -> Iterator[list[str]]:
    """Call `call` before the nth opcode in frames for which `counts` is true; add its place to a list."""
    left, before = nth, sys.gettrace()
    found: list[str] = []

    def enter(frame: FrameType, event: str, argument: object) -> Any:
        if not counts(frame):
            return None
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        return step

    def step(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal left
        if event == "opcode":
            left -= 1
            if left == 0:
                sys.settrace(None)
                found.append(place(frame))
                call()
        return step

    sys.settrace(enter)
    try:
        yield found
    finally:
        sys.settrace(before)


class Interruption(BaseException):
    """Raised instead of KeyboardInterrupt, which would end the test run."""


def interrupted_before(
    nth: int, failure: type[BaseException] = Interruption
) -> AbstractContextManager[list[str]]:
    """Raise `failure` before the package's nth bytecode on this thread; add its place to a list."""

    def fail() -> None:
        raise failure

    return calling_at(nth, lambda frame: frame.f_code.co_filename.startswith(PACKAGE), fail)


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


# ---- simulate full and read-only disks: needs no mount, and works for root too ----


NOBODY = 65534


@contextmanager
def full_at(size: int) -> Iterator[None]:
    """Limit files of this process to `size` bytes; writes beyond the limit are cut off."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def read_only_directory() -> Iterator[Path]:
    """Yield a directory that rejects new files; root becomes `nobody`, because root can write anywhere."""
    user = os.geteuid()
    with TemporaryDirectory() as directory:
        Path(directory).chmod(0o555)
        if user == 0:
            os.seteuid(NOBODY)
        try:
            yield Path(directory)
        finally:
            os.seteuid(user)
            Path(directory).chmod(0o755)
