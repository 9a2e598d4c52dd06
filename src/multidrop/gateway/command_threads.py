"""Threads of commands: one for each. It runs to its end, though nobody may wait for it any more."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from multidrop import written_by
from multidrop.gateway.rights import Caller

R = TypeVar("R")
_log = logging.getLogger("multidrop.gateway")


def begin_stop(work: Callable[[], R], caller: Caller) -> asyncio.Future[R]:
    """Begin a stop in a thread, or here and now where the system gives none: a stop is always sent."""
    try:
        return in_thread(work, caller)
    except RuntimeError:
        future: asyncio.Future[R] = asyncio.get_running_loop().create_future()
        with written_by(*_author(caller)):
            future.set_result(work())
        return future


def in_thread(work: Callable[[], R], caller: Caller) -> asyncio.Future[R]:
    """Do work in a thread of its own, in this caller's name; it goes on though its waiter is cancelled."""
    loop = asyncio.get_running_loop()
    future: asyncio.Future[R] = loop.create_future()

    def finish(settle: Callable[[], None]) -> None:
        if not future.done():
            settle()

    def run() -> None:
        settle: partial[None]
        try:
            with written_by(*_author(caller)):
                settle = partial(future.set_result, work())
        except BaseException as failure:
            settle = partial(future.set_exception, failure)
        try:
            loop.call_soon_threadsafe(finish, settle)
        except RuntimeError:  # the loop is closed: nobody waits any more
            _log.warning("a command ended after the gateway: %s", settle.args[0])

    threading.Thread(target=run, name="multidrop command", daemon=True).start()
    return future


def _author(caller: Caller) -> tuple[str, str]:
    """Return the caller as the audit log takes him."""
    clean = [_printable(text) for text in (caller.name, f"{caller.way} from {caller.address}")]
    return clean[0] or "anyone", clean[1]


def _printable(text: str) -> str:
    return "".join(sign if sign.isprintable() else "?" for sign in text)[:200].strip()
