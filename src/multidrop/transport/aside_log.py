"""A thread for work that may hang, such as a log handler's disk: stops and ports never wait for it."""

from __future__ import annotations

import _thread
import logging
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue

from multidrop.core.fork import register_at_fork

MOST_FRAMES = 30  # of a traceback, the innermost
MOST_WAITING = 10_000  # queued pieces of work; further ones are dropped


class AsideThread:
    """A thread that does one piece of work after another. A signal handler may call each method."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.forked()
        register_at_fork(self)

    def forked(self) -> None:
        self._work: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._begun = threading.Lock()  # held once the thread has started
        # The queue of a flush that timed out, and its time limit in s.
        self._late: tuple[SimpleQueue[None], float] | None = None

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
            if not self.hangs(seconds):
                self._late = done, seconds
            return False
        return True

    def hangs(self, seconds: float) -> bool:
        """Return True if a `flush` of at least `seconds` s timed out, and its work is still pending."""
        late = self._late
        return late is not None and late[1] >= seconds and late[0].empty()

    def _run(self) -> None:
        with suppress(Exception):
            threading.current_thread().name = self._name
        while True:
            with suppress(BaseException):  # a handler's own failure, SystemExit too
                self._work.get()()


_log_thread = AsideThread("multidrop log")


def log_aside(logger: logging.Logger, level: int, text: str, *details: object) -> None:
    """Log this soon, in the order of the calls; return at once."""
    if logger.isEnabledFor(level):
        _log_thread.put(partial(logger.log, level, text, *details))


def words_of(failure: BaseException) -> str:
    """Return an exception's type and message on one line; its type alone if the message cannot be made."""
    try:
        return " ".join(f"{type(failure).__name__}: {failure}".split()).removesuffix(":")
    except BaseException:  # of a class that a user wrote
        return type(failure).__name__


def traceback_of(failure: BaseException) -> str:
    """Return an exception's traceback as text; "" if it cannot be made."""
    try:
        return "".join(traceback.format_exception(failure, limit=-MOST_FRAMES)).rstrip()
    except BaseException:
        return ""


def flush(seconds: float) -> None:
    """Wait until all is logged, for `seconds` s at most."""
    _log_thread.flush(seconds)
