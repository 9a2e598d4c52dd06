"""Work that no signal breaks off: what a handler raises in the main thread ends its waiting, not the work.

Python raises KeyboardInterrupt, and what else a signal's handler raises, between any two steps of the main
thread, also in `finally` and `__exit__`. So ports are opened and closed, and lines come and go, on threads
of their own, which nothing interrupts.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from contextvars import copy_context
from functools import partial, wraps
from queue import Empty, SimpleQueue
from typing import Any, ParamSpec, TypeVar

HANDLING_S = 0.05  # the longest that a signal waits to be handled, where another thread was given it

P = ParamSpec("P")
R = TypeVar("R")


class _Act:
    """Work that is carried out once, by the thread that takes it first."""

    def __init__(self, act: Callable[[], Any]) -> None:
        self._untaken = SimpleQueue[Callable[[], Any]]()
        self._untaken.put(act)
        self._outcome = SimpleQueue[tuple[Any, BaseException | None]]()

    def run(self) -> None:
        """Carry it out, unless it was taken."""
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
        """Wait until it is over; return what it returned, or raise what it raised."""
        while True:
            with suppress(Empty):
                found, failure = self._outcome.get(timeout=HANDLING_S)
                break
        try:
            if failure is not None:
                raise failure
            return found
        finally:
            del failure  # which has this frame in its traceback


def undisturbed(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function that does the same, on a thread of its own where the main thread calls it.

    What interrupts the main thread meanwhile leaves it at once, and the work goes on to its end. Where the
    system gives no thread the main thread does the work itself.
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
