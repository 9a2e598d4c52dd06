"""Supervisor: starts and watches a process's tasks and threads, some permanent, some that end by themselves.

The gateway starts all its tasks and threads here, a gateway of a fleet only the permanent ones. The
supervisor notes which permanent ones have ended: /health of the gateway reports them, and a gateway of a
fleet shuts down. The supervisor also notes which work takes too long, such as a read from a file system that
hangs. Its threads are daemons: they never keep the process from ending.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from contextvars import copy_context
from functools import partial
from math import inf
from time import monotonic
from typing import Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

R = TypeVar("R")

CANCEL_AGAIN_S = 0.2

_log = logging.getLogger("multidrop.supervisor")


class Hung(OSError):
    """Raised for work that exceeded its time limit; the work's thread continues."""


class Ended(OSError):
    """Raised when a permanent task or thread has ended; the text says which one, and why."""


class _Work(NamedTuple):
    name: str
    begun: float  # monotonic time in s
    limit_s: float  # work that takes longer counts as hanging


class Supervisor:
    """The tasks and threads of one event loop. All methods must be called in the loop."""

    def __init__(self) -> None:
        self.dead: dict[str, str] = {}  # permanent tasks and threads that have ended, and why
        self.has_dead = asyncio.Event()  # set once `dead` has an entry
        self._kept: dict[str, asyncio.Task[Any]] = {}
        self._watched: dict[str, Callable[[], bool]] = {}
        self._short: set[asyncio.Task[Any]] = set()
        self._works: dict[asyncio.Future[Any], _Work] = {}

    # ---- tasks ----

    @property
    def kept(self) -> dict[str, asyncio.Task[Any]]:
        """The permanent tasks, by name."""
        return dict(self._kept)

    @property
    def started(self) -> list[asyncio.Task[Any]]:
        """The tasks that end by themselves and are still running."""
        return [*self._short]

    @property
    def watched(self) -> list[str]:
        """The names of the watched threads."""
        return [*self._watched]

    def keep(self, name: str, work: Coroutine[Any, Any, R]) -> asyncio.Task[R]:
        """Start a permanent task, which must run until `release`. If it ends earlier, `dead` says why."""
        task = asyncio.get_running_loop().create_task(work, name=name)
        self.dead.pop(name, None)
        self._kept[name] = task
        task.add_done_callback(lambda ended: self._note_end(name, ended))
        return task

    def _note_end(self, name: str, task: asyncio.Task[Any]) -> None:
        failure = None if task.cancelled() else task.exception()
        if self._kept.get(name) is not task:
            return  # `let_go` or `release` removed the task, so its end is expected
        del self._kept[name]
        self.note_dead(name, "it was cancelled" if task.cancelled() else reason_of(failure), failure)

    def let_go(self, name: str) -> asyncio.Task[Any] | None:
        """Let a permanent task end without being reported. Return the task; None if it has already ended."""
        return self._kept.pop(name, None)

    async def release(self, *names: str) -> None:
        """Cancel these permanent tasks, and wait until they have ended."""
        tasks = [task for name in names if (task := self._kept.pop(name, None))]
        for name in names:
            self.dead.pop(name, None)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def start(self, name: str, work: Coroutine[Any, Any, R]) -> asyncio.Task[R]:
        """Start a task that ends by itself. Its failure is logged unless the task is awaited."""
        task = asyncio.get_running_loop().create_task(work, name=name)
        self._short.add(task)  # the event loop itself keeps only weak references to tasks
        task.add_done_callback(self._short.discard)
        return task

    # ---- threads started by other modules ----

    def watch(self, name: str, is_alive: Callable[[], bool]) -> None:
        """Watch a thread that another module started; `look` calls `is_alive`."""
        self._watched[name] = is_alive

    def look(self) -> None:
        """Check the watched threads, and note those that have ended."""
        for name in [name for name, is_alive in self._watched.items() if not is_alive()]:
            del self._watched[name]
            self.note_dead(name, "its thread has ended")

    def note_dead(self, name: str, why: str, failure: BaseException | None = None) -> None:
        """Note and log that a permanent task or thread has ended."""
        self.dead[name] = why
        self.has_dead.set()
        _log.error("%s has ended and is not restarted: %s", name, why, exc_info=failure)

    def check(self) -> None:
        """Raise Ended if a permanent task or thread is known to have ended."""
        if self.dead:
            raise Ended("; ".join(f"{name} has ended: {why}" for name, why in self.dead.items()))

    # ---- threads ----

    def thread(self, name: str, limit_s: float, work: Callable[[], R]) -> asyncio.Future[R]:
        """Do work in its own thread, and return a future of its result.

        The thread continues even if the future is cancelled. Work that takes longer than `limit_s` seconds is
        in `hung`, and /health is degraded, until it ends. Raises RuntimeError or MemoryError if the system
        has no thread left.
        """
        loop = asyncio.get_running_loop()
        future: asyncio.Future[R] = loop.create_future()
        # read the exception, because asyncio logs an error for one that is never read
        future.add_done_callback(lambda done: done.cancelled() or done.exception())

        def finish(settle: Callable[[], None]) -> None:
            del self._works[future]
            if not future.done():
                settle()

        def run(call: Callable[[Callable[[], R]], R]) -> None:
            settle: partial[None]
            failure = None
            try:
                settle = partial(future.set_result, call(work))
            except BaseException as raised:
                failure = for_a_future(raised)
                settle = partial(future.set_exception, failure)
            try:
                loop.call_soon_threadsafe(finish, settle)
            except RuntimeError:  # the event loop was closed while the thread worked
                if failure is not None:
                    _log.warning("%s failed after the end of the gateway: %s", name, failure)

        thread = threading.Thread(
            target=run, args=[copy_context().run], name=f"multidrop {name}", daemon=True
        )
        self._works[future] = _Work(name, monotonic(), limit_s)
        try:
            thread.start()
        except BaseException:
            del self._works[future]
            raise
        return future

    def keep_thread(self, name: str, work: Callable[[], object]) -> None:
        """Start a permanent thread. If the thread ends before `let_go`, `dead` says why."""
        thread = self.thread(name, inf, work)

        async def wait() -> None:
            await asyncio.shield(thread)

        self.keep(name, wait())

    async def within(self, name: str, limit_s: float, work: Callable[[], R], *, most: int = 4) -> R:
        """Call `work` in its own thread, and return the result.

        At most `most` calls with this name run concurrently; further calls wait. Raises Hung if `work` cannot
        start within `limit_s` seconds, or has not returned `limit_s` seconds after its start. Once a call
        has returned, earlier calls with the same name no longer count as hanging.
        """
        begin_by = monotonic() + limit_s
        while len(going := [future for future, one in self._works.items() if one.name == name]) >= most:
            await asyncio.wait(
                going, timeout=max(0.0, begin_by - monotonic()), return_when=asyncio.FIRST_COMPLETED
            )
            if monotonic() >= begin_by:
                raise Hung(f"{name}: {most} earlier tasks of this name are not done; does the disk answer?")
        before = [future for future, one in self._works.items() if one.name == name]
        future = self.thread(name, limit_s, work)
        await asyncio.wait([future], timeout=limit_s)
        if not future.done():
            raise Hung(f"{name}: not done within {limit_s:g} s; does the disk answer?")
        for late in before:
            if late in self._works:
                self._works[late] = self._works[late]._replace(limit_s=inf)
        return future.result()

    @property
    def hung(self) -> dict[str, str]:
        """A sentence about each work that takes longer than its limit, by the name of the work."""
        now = monotonic()
        late = {one.name: one for one in reversed(self._works.values()) if now - one.begun > one.limit_s}
        return {name: f"it has gone on for {now - one.begun:.0f} s" for name, one in late.items()}

    @property
    def under_way(self) -> list[str]:
        """The names of all work whose thread has not ended."""
        return [one.name for one in self._works.values()]


_supervisors: WeakKeyDictionary[asyncio.AbstractEventLoop, Supervisor] = WeakKeyDictionary()


def supervisor() -> Supervisor:
    """Return the supervisor of the running loop."""
    loop = asyncio.get_running_loop()
    if loop not in _supervisors:
        _supervisors[loop] = Supervisor()
    return _supervisors[loop]


async def end_tasks(*tasks: asyncio.Task[Any]) -> list[Any]:
    """Cancel tasks until each is over; return their results and exceptions.

    One cancellation is not enough: `asyncio.wait_for` of Python 3.11 swallows one that coincides with its
    timeout.
    """
    left = set(tasks)
    while left:
        for task in left:
            task.cancel()
        _, left = await asyncio.wait(left, timeout=CANCEL_AGAIN_S)
    return await asyncio.gather(*tasks, return_exceptions=True)


def in_time(name: str, seconds: float, work: Callable[[], R]) -> R:
    """Return the result of work done in a thread, without a loop. Raises Hung if that exceeds `seconds`."""
    ended: Future[R] = Future()

    def run() -> None:
        try:
            ended.set_result(work())
        except BaseException as failure:
            ended.set_exception(failure)

    threading.Thread(target=run, name=f"multidrop {name}", daemon=True).start()
    try:
        return ended.result(seconds)
    except TimeoutError as late:
        if ended.done():  # not a timeout of the wait: the work itself raised TimeoutError
            raise
        raise Hung(f"{name}: not done within {seconds:g} s; does the disk answer?") from late


def for_a_future(failure: BaseException) -> Exception:
    """Return `failure`, or a RuntimeError in its place if a future would not accept it.

    SystemExit would end the loop, and a future refuses StopIteration.
    """
    if isinstance(failure, Exception) and not isinstance(failure, StopIteration):
        return failure
    return RuntimeError(reason_of(failure))


def reason_of(failure: BaseException | None) -> str:
    """Return why a task or thread ended; `failure` is the exception it raised, or None if it returned."""
    return "it returned" if failure is None else f"{type(failure).__name__}: {failure}"
