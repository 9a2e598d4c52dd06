"""Forks: a child process inherits all objects of its parent, but no threads.

In the child, a lock that another thread held stays locked forever, and work of other threads never ends.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Protocol
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
