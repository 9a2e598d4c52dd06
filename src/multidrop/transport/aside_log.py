"""Log from a thread of its own, so that a handler whose disk hangs holds up no stop and no port."""

from __future__ import annotations

import logging
import threading
from contextlib import suppress
from queue import Full, Queue

from multidrop.core.fork import register_at_fork

MOST_WAITING = 10_000  # entries for a handler that hangs; what comes then is dropped

Entry = tuple[logging.Logger, int, str, tuple[object, ...]]


class _AsideLog:
    def __init__(self) -> None:
        self.forked()
        register_at_fork(self)

    def forked(self) -> None:
        self._entries: Queue[Entry | threading.Event] = Queue(MOST_WAITING)
        self._starting = threading.Lock()
        self.has_begun = False

    def put(self, entry: Entry | threading.Event) -> None:
        with suppress(Full):
            self._entries.put_nowait(entry)
        with self._starting:
            if not self.has_begun:
                with suppress(RuntimeError, MemoryError):  # there is none now, or at the interpreter's end
                    threading.Thread(target=self._run, name="multidrop log", daemon=True).start()
                    self.has_begun = True

    def _run(self) -> None:
        while True:
            entry = self._entries.get()
            if isinstance(entry, threading.Event):
                entry.set()
                continue
            logger, level, text, details = entry
            with suppress(Exception):  # a handler's own failure
                logger.log(level, text, *details)


_aside = _AsideLog()


def log_aside(logger: logging.Logger, level: int, text: str, *details: object) -> None:
    """Log this soon, in the order of the calls; return at once."""
    if logger.isEnabledFor(level):
        _aside.put((logger, level, text, details))


def flush(seconds: float) -> None:
    """Wait until all is logged, for `seconds` s at most."""
    if _aside.has_begun:
        done = threading.Event()
        _aside.put(done)
        done.wait(seconds)
