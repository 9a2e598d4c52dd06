"""Do work that may hang, such as logging to a disk, on a separate thread, so that no stop waits for it."""

from __future__ import annotations

import _thread
import logging
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue

from multidrop.core.process import register_at_fork

MOST_FRAMES = 30  # number of innermost frames in a logged traceback
MOST_WAITING = 10_000  # limit of the queued pieces of work; further pieces are dropped


class AsideThread:
    """A thread that does one piece of work after another. All methods are safe in a signal handler."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.forked()
        register_at_fork(self)

    def forked(self) -> None:
        self._work: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._begun = threading.Lock()  # locked once the thread was started, by the first `put`
        # The newest `flush` that timed out: a queue that is empty until all work before this `flush` is done,
        # and the timeout in s. None if no `flush` has timed out.
        self._late: tuple[SimpleQueue[None], float] | None = None

    def put(self, work: Callable[[], object], most: int = MOST_WAITING) -> bool:
        """Queue this work, or return False if `most` pieces are queued. Does not wait.

        Work is done in order.
        """
        is_queued = self._work.qsize() < most
        if is_queued:
            self._work.put(work)
        if self._begun.acquire(blocking=False):
            try:
                _thread.start_new_thread(self._run, ())  # `Thread.start` would wait until the thread runs
            except BaseException as failure:  # the system has no more threads, or the interpreter is ending
                self._begun.release()
                if not isinstance(failure, (RuntimeError, MemoryError)):
                    raise
        return is_queued

    def flush(self, seconds: float) -> bool:
        """Wait up to `seconds` s until all queued work is done; return True if it is done."""
        if not self._begun.locked():
            return self._work.empty()
        done: SimpleQueue[None] = SimpleQueue()
        # a higher limit, because the queue may be full of other work
        self.put(partial(done.put, None), 2 * MOST_WAITING)
        try:
            done.get(timeout=seconds)
        except Empty:
            if not self.hangs(seconds):
                self._late = done, seconds
            return False
        return True

    def hangs(self, seconds: float) -> bool:
        """Return True if a `flush` timed out after at least `seconds` s, and the work is still not done."""
        late = self._late
        return late is not None and late[1] >= seconds and late[0].empty()

    def _run(self) -> None:
        with suppress(Exception):
            threading.current_thread().name = self._name
        while True:
            with suppress(BaseException):  # a log handler may raise anything, even SystemExit
                self._work.get()()


_log_thread = AsideThread("multidrop log")


def log_aside(logger: logging.Logger, level: int, text: str, *details: object) -> None:
    """Log this message on the log thread, in the order of the calls; return immediately."""
    if logger.isEnabledFor(level):
        _log_thread.put(partial(logger.log, level, text, *details))


def words_of(failure: BaseException) -> str:
    """Return an exception's type and message on one line; only its type if `str` fails."""
    try:
        return " ".join(f"{type(failure).__name__}: {failure}".split()).removesuffix(":")
    except BaseException:  # a user's exception class may raise anything
        return type(failure).__name__


def traceback_of(failure: BaseException) -> str:
    """Return an exception's traceback as text; "" if formatting it fails."""
    try:
        return "".join(traceback.format_exception(failure, limit=-MOST_FRAMES)).rstrip()
    except BaseException:
        return ""


def flush_log(seconds: float) -> None:
    """Wait up to `seconds` s until the log thread has logged everything."""
    _log_thread.flush(seconds)
