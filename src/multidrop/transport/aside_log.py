"""Threads of their own for what may hang, such as a log handler's disk: no stop and no port waits for it."""

from __future__ import annotations

import _thread
import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue

from multidrop.core.fork import register_at_fork

MOST_WAITING = 10_000  # pieces of work for what hangs; what comes then is dropped


class AsideThread:
    """A thread that does one piece of work after another. A signal handler may call each method."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.forked()
        register_at_fork(self)

    def forked(self) -> None:
        self._work: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._begun = threading.Lock()  # held once the thread has begun
        self._late: SimpleQueue[None] | None = None  # the newest answer that did not come in time

    def put(self, work: Callable[[], object]) -> None:
        """Do this soon, in the order of the calls; return at once."""
        if self._work.qsize() < MOST_WAITING:
            self._work.put(work)
        if self._begun.acquire(blocking=False):
            try:
                _thread.start_new_thread(self._run, ())  # threading would wait until it runs
            except BaseException as failure:  # there is none now, or at the interpreter's end
                self._begun.release()
                if not isinstance(failure, (RuntimeError, MemoryError)):
                    raise

    def flush(self, seconds: float) -> bool:
        """Wait until all that was put is done, for `seconds` s at most; return whether it is."""
        if not self._begun.locked():
            return self._work.empty()
        done: SimpleQueue[None] = SimpleQueue()
        self.put(partial(done.put, None))
        try:
            done.get(timeout=seconds)
        except Empty:
            self._late = done
            return False
        return True

    @property
    def hangs(self) -> bool:
        """True if the newest `flush` was in vain, and still is."""
        return self._late is not None and self._late.empty()

    def _run(self) -> None:
        with suppress(Exception):
            threading.current_thread().name = self._name
        while True:
            with suppress(Exception):  # a handler's own failure
                self._work.get()()


_log_thread = AsideThread("multidrop log")


def log_aside(logger: logging.Logger, level: int, text: str, *details: object) -> None:
    """Log this soon, in the order of the calls; return at once."""
    if logger.isEnabledFor(level):
        _log_thread.put(partial(logger.log, level, text, *details))


def flush(seconds: float) -> None:
    """Wait until all is logged, for `seconds` s at most."""
    _log_thread.flush(seconds)
