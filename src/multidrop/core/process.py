"""Protect objects from forks, and work from signals.

A forked child inherits all objects of its parent, but no threads: a lock that another thread held stays
locked forever, and work of other threads never ends.

Python raises KeyboardInterrupt and other exceptions of signal handlers between any two bytecodes of the main
thread, even in `finally` and `__exit__`. Therefore separate threads open and close ports and lines.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from contextvars import copy_context
from functools import partial, wraps
from queue import Empty, SimpleQueue
from typing import Any, ParamSpec, Protocol, TypeVar, cast
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


def undisturbed(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function that runs in a separate thread when the main thread calls it.

    An exception that interrupts the main thread ends the call immediately, while the work continues. If no
    thread can be started, the main thread does the work itself.
    """

    @wraps(function)
    def carry_out(*details: P.args, **more: P.kwargs) -> R:
        if threading.current_thread() is not threading.main_thread():
            return function(*details, **more)
        untaken = [partial(function, *details, **more)]
        outcome = SimpleQueue[tuple[Any, BaseException | None]]()

        def work() -> None:
            try:
                act = untaken.pop()
            except IndexError:  # another thread has started the call
                return
            try:
                outcome.put((act(), None))
            except BaseException as failure:
                outcome.put((None, failure))

        thread = threading.Thread(
            target=copy_context().run, args=(work,), name="multidrop undisturbed", daemon=True
        )
        try:
            thread.start()
        except (RuntimeError, MemoryError):
            work()
        while True:
            with suppress(Empty):
                found, failure = outcome.get(timeout=HANDLING_S)
                break
        if thread.is_alive():
            thread.join()
        try:
            if failure is not None:
                raise failure
            return cast(R, found)
        finally:
            del failure  # avoids a reference cycle: the exception's traceback refers to this frame

    return carry_out
