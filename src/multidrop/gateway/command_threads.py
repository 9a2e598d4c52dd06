"""Threads of commands: one for each. It runs to its end, though nobody may wait for it any more."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import TypeVar

from multidrop.control import noted_first, written_by
from multidrop.gateway.http.rights import Caller
from multidrop.supervisor import supervisor

COMMAND_S = 60.0  # after which /health says that a command goes on: a stop is repeated for 30 s

R = TypeVar("R")


def begin_stops(works: Sequence[Callable[[float | None], R]], caller: Caller) -> list[asyncio.Future[R]]:
    """Begin stops, each in a thread of its own; `works` take for how many seconds a stop is repeated.

    Where the system gives no more threads they are carried out here and now: a stop is always sent. All of
    them are sent before any motor is waited for.
    """
    begun: list[asyncio.Future[R]] = []
    with suppress(RuntimeError, MemoryError):
        for work in works:
            future = in_thread(partial(work, None), caller)
            begun.append(future)
    left = works[len(begun) :]
    with written_by(*_author(caller)):
        for work in left if len(left) > 1 else ():
            work(0.0)
        for work in left:
            begun.append(asyncio.get_running_loop().create_future())
            begun[-1].set_result(work(None))
    return begun


def begin_stop(work: Callable[[float | None], R], caller: Caller) -> asyncio.Future[R]:
    """Begin one stop, as `begin_stops` does."""
    return begin_stops([work], caller)[0]


def in_thread(work: Callable[[], R], caller: Caller) -> asyncio.Future[R]:
    """Do work in a thread of its own, in this caller's name; it goes on though its waiter is cancelled."""
    with written_by(*_author(caller)), noted_first():  # the thread has the context of its start
        return supervisor().thread("command", COMMAND_S, work)


def _author(caller: Caller) -> tuple[str, str]:
    """Return the caller as the audit log takes him."""
    clean = [_printable(text) for text in (caller.name, f"{caller.way} from {caller.address}")]
    return clean[0] or "anyone", clean[1]


def _printable(text: str) -> str:
    return "".join(sign if sign.isprintable() else "?" for sign in text)[:200].strip()
