"""Parting: what is done once before a process leaves a line, however it leaves but by SIGKILL."""

from __future__ import annotations

import atexit
import signal
from collections.abc import Callable
from types import FrameType
from typing import Any

from multidrop.forks import only_here

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Parting:
    """Does `last` at `now()`, at exit, or on SIGINT or SIGTERM, whichever comes first.

    A signal then has the effect that it had before. A child made by fork() does
    nothing. Made in the main thread, or ValueError.
    """

    def __init__(self, last: Callable[[], object]) -> None:
        self._last: Callable[[], object] | None = only_here(last)
        self._before: dict[signal.Signals, Any] = {it: signal.signal(it, self._on_signal) for it in _SIGNALS}
        atexit.register(self.now)

    def now(self) -> None:
        last, self._last = self._last, None
        if last is None:
            return
        try:
            last()
        finally:
            atexit.unregister(self.now)
            for number, handler in self._before.items():
                if signal.getsignal(number) == self._on_signal:
                    signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.now()
        signal.signal(number, self._before[signal.Signals(number)])
        signal.raise_signal(number)
