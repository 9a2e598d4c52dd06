"""Protect objects from forks, work from signals, and stops from work that hangs.

A forked child inherits all objects of its parent, but no threads: a lock that another thread held stays
locked forever, and work of other threads never ends.

Python raises KeyboardInterrupt and other exceptions of signal handlers between any two bytecodes of the main
thread, even in `finally` and `__exit__`. Therefore separate threads open and close ports and lines.

Work that may hang, such as logging to a disk, is done on a separate thread, so that no stop waits for it.
"""

from __future__ import annotations

import _thread
import logging
import os
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from contextvars import copy_context
from functools import partial, wraps
from queue import Empty, SimpleQueue
from typing import Any, ParamSpec, Protocol, TypeVar
from weakref import WeakSet


class Inherited(Protocol):
    def forked(self) -> None:
        """Give up the parent's resources without waiting; called in the child process."""


_registered: WeakSet[Inherited] = WeakSet()


def register_at_fork(inherited: Inherited) -> None:
    """Call the object's `forked` in every child process while the object exists."""
    _registered.add(inherited)


def _call_all() -> None:
    for inherited in list(_registered):  # the list keeps every object alive during the calls
        inherited.forked()


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_call_all)


def only_here(act: Callable[..., object]) -> Callable[..., None]:
    """Return a function that calls `act` in this process, and does nothing in forked children."""
    here = os.getpid()

    def act_here(*details: object) -> None:
        if os.getpid() == here:
            act(*details)

    return act_here


# ---- signals ----


HANDLING_S = 0.05  # s; longest delay in handling a signal that the kernel gave to another thread

P = ParamSpec("P")
R = TypeVar("R")


class _Act:
    """A call that is carried out once, by the first thread that calls `run`."""

    def __init__(self, act: Callable[[], Any]) -> None:
        self._untaken = SimpleQueue[Callable[[], Any]]()
        self._untaken.put(act)
        self._outcome = SimpleQueue[tuple[Any, BaseException | None]]()

    def run(self) -> None:
        """Carry out the call, unless another thread has started it."""
        try:
            act = self._untaken.get_nowait()
        except Empty:
            return
        try:
            found = act()
        except BaseException as failure:
            self._outcome.put((None, failure))
        else:
            self._outcome.put((found, None))

    def result(self) -> Any:
        """Wait for the call; return its result or raise its exception."""
        while True:
            with suppress(Empty):
                found, failure = self._outcome.get(timeout=HANDLING_S)
                break
        try:
            if failure is not None:
                raise failure
            return found
        finally:
            del failure  # avoids a reference cycle: the exception's traceback refers to this frame


def undisturbed(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function that runs in a separate thread when the main thread calls it.

    An exception that interrupts the main thread ends the call immediately, while the work continues. If no
    thread can be started, the main thread does the work itself.
    """

    @wraps(function)
    def carry_out(*details: P.args, **more: P.kwargs) -> R:
        if threading.current_thread() is not threading.main_thread():
            return function(*details, **more)
        work = _Act(partial(function, *details, **more))
        thread = threading.Thread(
            target=copy_context().run, args=(work.run,), name="multidrop undisturbed", daemon=True
        )
        try:
            thread.start()
        except (RuntimeError, MemoryError):
            work.run()
        found: R = work.result()
        if thread.is_alive():
            thread.join()
        return found

    return carry_out


# ---- work that may hang ----


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

    def put(self, work: Callable[[], object], most: int = MOST_WAITING) -> None:
        """Queue this work unless `most` pieces are queued; return immediately. Work is done in order."""
        if self._work.qsize() < most:
            self._work.put(work)
        if self._begun.acquire(blocking=False):
            try:
                _thread.start_new_thread(self._run, ())  # `Thread.start` would wait until the thread runs
            except BaseException as failure:  # the system has no more threads, or the interpreter is ending
                self._begun.release()
                if not isinstance(failure, (RuntimeError, MemoryError)):
                    raise

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
