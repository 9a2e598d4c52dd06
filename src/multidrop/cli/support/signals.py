"""SIGINT (Ctrl-C), SIGTERM and SIGHUP while a command runs.

The first two interrupt a command at once, but for polling and sniffing: there the first one is noted, so that
what is under way is finished and recorded, and the second one interrupts. SIGHUP ends any command but a stop
and a monitor, whose keys stop too.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from types import FrameType


@contextmanager
def handling(handler: Callable[[int, FrameType | None], object], *numbers: signal.Signals) -> Iterator[None]:
    """Call `handler` for these signals. Only the main thread can: in another one nothing changes."""
    try:
        before = {number: signal.signal(number, handler) for number in numbers}
    except ValueError:
        before = {}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def sigterm_interrupts() -> AbstractContextManager[None]:
    """Raise KeyboardInterrupt on SIGTERM too."""
    return handling(signal.default_int_handler, signal.SIGTERM)


class Interruption:
    """The first signal sets `came`; the second one raises KeyboardInterrupt."""

    def __init__(self) -> None:
        self.came = False

    def note(self, number: int, frame: FrameType | None) -> None:
        if self.came:
            raise KeyboardInterrupt
        self.came = True


@contextmanager
def outliving_the_terminal() -> Iterator[Interruption]:
    """Go on though the terminal is closed (SIGHUP), which is noted: a stop is repeated until its end."""
    closing = Interruption()

    def note(number: int, frame: FrameType | None) -> None:
        closing.came = True  # several may come: a shell and the system send one each

    if sys.platform == "win32":  # which has no such signal
        yield closing
        return
    with handling(note, signal.SIGHUP):
        yield closing


@contextmanager
def noting_signals() -> Iterator[Interruption]:
    """Note the first SIGINT or SIGTERM instead of being interrupted by it."""
    interruption = Interruption()
    with handling(interruption.note, signal.SIGINT, signal.SIGTERM):
        yield interruption


def on_end_signals(end: Callable[[], object]) -> None:
    """Call `end` in the running asyncio loop at the first SIGINT or SIGTERM; a second one interrupts."""
    import asyncio

    loop = asyncio.get_running_loop()

    def first(number: signal.Signals) -> None:
        if sys.platform != "win32":
            loop.remove_signal_handler(number)
        signal.signal(number, signal.default_int_handler)
        end()

    for number in (signal.SIGINT, signal.SIGTERM):
        if sys.platform == "win32":  # whose loops handle none
            signal.signal(number, lambda came, frame: loop.call_soon_threadsafe(first, signal.Signals(came)))
        else:
            loop.add_signal_handler(number, first, number)
