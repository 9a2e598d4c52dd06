"""SIGINT (Ctrl-C), SIGTERM and SIGHUP while a command runs.

SIGINT and SIGTERM interrupt a command immediately. Polling and sniffing are exceptions: at the first signal
they finish and record the exchange in progress, and the second one interrupts them. SIGHUP, from a closing
terminal, ends a command as the first SIGINT does; further SIGHUPs are ignored. A stop continues despite
SIGHUP. Service managers send SIGHUP to a gateway that should reload its plant file.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

T = TypeVar("T")


@contextmanager
def handling(handler: Callable[[int, FrameType | None], object], *numbers: signal.Signals) -> Iterator[None]:
    """While the context lasts, call `handler` for these signals. Outside the main thread, do nothing."""
    try:
        before = {number: signal.signal(number, handler) for number in numbers}
    except ValueError:
        before = {}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _hangup() -> tuple[signal.Signals, ...]:
    """Return SIGHUP in a tuple; () if the system has no SIGHUP, or nohup ignores it."""
    if sys.platform == "win32" or signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        return ()
    return (signal.SIGHUP,)


@contextmanager
def end_signals_interrupt() -> Iterator[None]:
    """While the context lasts, raise KeyboardInterrupt on SIGTERM too, and on the first SIGHUP."""
    is_closed = False

    def close(number: int, frame: FrameType | None) -> None:
        nonlocal is_closed
        if not is_closed:  # further SIGHUPs are ignored: both the shell and the system may send one
            is_closed = True
            raise KeyboardInterrupt

    with handling(signal.default_int_handler, signal.SIGTERM), handling(close, *_hangup()):
        yield


class Interruption:
    """Records signals that end a command. The first sets `came`; a second SIGINT or SIGTERM raises."""

    def __init__(self) -> None:
        self.came = False
        # True after the first SIGINT or SIGTERM; the next one raises KeyboardInterrupt
        self._is_asked = False

    def note(self, number: int, frame: FrameType | None) -> None:
        if self._is_asked:
            raise KeyboardInterrupt
        self._is_asked = self.came = True

    def note_hangup(self, number: int, frame: FrameType | None) -> None:
        self.came = True


@contextmanager
def outliving_the_terminal() -> Iterator[None]:
    """While the context lasts, ignore SIGHUP, so that a stop is repeated until it is done."""
    with handling(lambda number, frame: None, *_hangup()):
        yield


@contextmanager
def noting_signals() -> Iterator[Interruption]:
    """While the context lasts, note the first SIGINT or SIGTERM, and each SIGHUP, without raising."""
    interruption = Interruption()
    with (
        handling(interruption.note, signal.SIGINT, signal.SIGTERM),
        handling(interruption.note_hangup, *_hangup()),
    ):
        yield interruption


def on_end_signals(end: Callable[[], object]) -> None:
    """Call `end` in the running asyncio loop at the first SIGINT, SIGTERM or SIGHUP, and only once.

    A second SIGINT or SIGTERM cancels the present task, and a third one raises KeyboardInterrupt.
    """
    import asyncio

    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    came: set[signal.Signals] = set()
    has_ended = False

    def end_once() -> None:
        nonlocal has_ended
        if not has_ended:
            has_ended = True
            end()

    def come(number: signal.Signals) -> None:
        end_once()
        if number in came:
            if sys.platform != "win32":
                loop.remove_signal_handler(number)
            signal.signal(number, signal.default_int_handler)
            if task is not None:
                task.cancel()
        came.add(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        if sys.platform == "win32":  # asyncio loops on Windows handle no signals
            signal.signal(number, lambda given, frame: loop.call_soon_threadsafe(come, signal.Signals(given)))
        else:
            loop.add_signal_handler(number, come, number)
    for number in _hangup():
        loop.add_signal_handler(number, end_once)


def run_loop(work: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine as `asyncio.run` does. If a signal cancels it, raise KeyboardInterrupt."""
    import asyncio

    try:
        with ExitStack() as stack:
            # Do not let a signal interrupt the construction of the event loop: Python would print a
            # traceback. The signal is only noted here, and raised below.
            with noting_signals() as interruption:
                runner = stack.enter_context(asyncio.Runner())
            if interruption.came:
                raise KeyboardInterrupt
            return runner.run(work)
    except asyncio.CancelledError:
        raise KeyboardInterrupt from None
    finally:
        work.close()  # otherwise Python prints a warning that the coroutine never started


def cancel_at_end_signals() -> None:
    """Cancel the running asyncio task at the first end signal; `run_loop` then raises KeyboardInterrupt.

    If a signal raised an exception directly inside a library's task, other tasks could wait forever.
    """
    import asyncio

    if task := asyncio.current_task():
        on_end_signals(task.cancel)


def on_reload_signal(reload: Callable[[], object], end: Callable[[], object]) -> None:
    """Call `reload` in the running asyncio loop at each SIGHUP, or `end` if SIGHUP means a closed terminal.

    For a process in the background or under nohup, SIGHUP always means a reload. Windows has no SIGHUP.
    """
    if sys.platform == "win32":
        return
    import asyncio

    stands_on_terminal = bool(_hangup()) and _foreground() == os.getpgrp()

    def come() -> None:
        if stands_on_terminal and _foreground() is None:
            end()
        else:
            reload()

    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, come)


def _foreground() -> int | None:
    """Return the foreground process group of this process's terminal; None without a terminal."""
    try:
        with Path("/dev/tty").open("rb", buffering=0) as terminal:
            return os.tcgetpgrp(terminal.fileno())
    except OSError:
        return None
