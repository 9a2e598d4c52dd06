"""Forks: a child made by fork() inherits all objects of its parent, but none of the threads behind them.

In the child a lock that another thread held is held for ever, and what a thread was to answer never comes.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Protocol
from weakref import WeakSet


class Inherited(Protocol):
    def forked(self) -> None:
        """In the child: leave to the parent what is the parent's, and wait for nobody."""


_registered: WeakSet[Inherited] = WeakSet()


def register_at_fork(inherited: Inherited) -> None:
    """Call its `forked` in every child, as long as it lives."""
    _registered.add(inherited)


def _call_all() -> None:
    for inherited in list(_registered):  # the list keeps all of them until the last one was called
        inherited.forked()


if hasattr(os, "register_at_fork"):  # Windows knows no fork
    os.register_at_fork(after_in_child=_call_all)


def only_here(act: Callable[..., object]) -> Callable[..., None]:
    """Return a function that does the same in this process, and nothing in its children."""
    here = os.getpid()

    def act_here(*details: object) -> None:
        if os.getpid() == here:
            act(*details)

    return act_here
