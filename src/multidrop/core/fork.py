"""Forks: a child made by fork() inherits all objects of its parent, but none of the threads behind them.

There a lock that another thread held is held for ever, and what a thread was to answer never comes.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Protocol
from weakref import WeakSet


class Heirloom(Protocol):
    def forked(self) -> None:
        """In the child: leave to the parent what is the parent's, and wait for nobody."""


_heirlooms: WeakSet[Heirloom] = WeakSet()


def register_at_fork(it: Heirloom) -> None:
    """Call its `forked` in every child, as long as it is there."""
    _heirlooms.add(it)


def _tell() -> None:
    for it in list(_heirlooms):  # none of them goes before all were told
        it.forked()


os.register_at_fork(after_in_child=_tell)


def only_here(act: Callable[..., object]) -> Callable[..., None]:
    """The same in this process; nothing in its children."""
    here = os.getpid()

    def act_here(*details: object) -> None:
        if os.getpid() == here:
            act(*details)

    return act_here
