"""RowSource: the rows of a poller, as batches.

The core collects rows in a limited number of chunks; consumers take the oldest chunk first.
"""

from __future__ import annotations

import inspect
import logging
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Generator, Iterable, Iterator
from functools import partial

from multidrop.core import RowQueue
from multidrop.core.undisturbed import undisturbed
from multidrop.errors import PollingFailed
from multidrop.polling.batch import Batch
from multidrop.polling.jobs import RowNames
from multidrop.polling.line_set import NO_LINE
from multidrop.transport import clock
from multidrop.transport.wakeup import WakeUp

_log = logging.getLogger("multidrop.polling")


_DEFERRED = (inspect.iscoroutinefunction, inspect.isgeneratorfunction, inspect.isasyncgenfunction)


def check_function(function: object) -> None:
    """Raise TypeError for an async or generator function: a call of it would run nothing."""
    if not callable(function):
        raise TypeError(f"on_batch takes a function of one batch, not {function!r}")
    while isinstance(function, partial):
        function = function.func
    calls = (function, getattr(type(function), "__call__", None))  # noqa: B004 (the `__call__` of its class)
    if any(is_deferred(call) for is_deferred in _DEFERRED for call in calls):
        raise TypeError(_DEFERS.format(function))


_DEFERS = (
    "on_batch takes a plain function, and {!r} is async or a generator: a call would not run it. In asyncio, "
    "iterate over the poller with `async for`: docs/howto/asyncio.md"
)


def _check_returned(function: object, returned: object) -> None:
    """Raise TypeError if the function returned a coroutine or a generator."""
    if isinstance(returned, Awaitable | Generator | AsyncIterator):
        if inspect.iscoroutine(returned):
            returned.close()  # otherwise Python also warns that the coroutine was never awaited
        raise TypeError(_DEFERS.format(function))


class BatchCaller:
    """Calls a function with each batch, on a thread of its own, until the poller is closed.

    The first failure of the function ends the calls, is logged immediately, and is raised by `raise_failure`.
    """

    def __init__(self, batches: Iterable[Batch], function: Callable[[Batch], object]) -> None:
        self._batches = batches
        self._function = function
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="multidrop batches", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            for batch in self._batches:
                _check_returned(self._function, self._function(batch))
        except PollingFailed:
            pass  # the poller has logged it, and raises it itself
        except BaseException as failure:  # any failure: close() raises it to its caller
            self._failure = failure
            _log.error("on_batch: the function failed and is no longer called", exc_info=failure)

    def join(self) -> None:
        """Wait until the function has had the last batch. Does nothing if called by the function itself."""
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def raise_failure(self) -> None:
        """Raise the function's failure, once."""
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure


FILLING_NS = 10_000_000  # minimum interval between batches taken from a chunk that is not full
ASYNC_LOOK_S = 0.05  # interval at which `async for` checks for rows


class RowSource:
    """The rows in the core's queue, and the methods to take them."""

    def __init__(self, row_queue: RowQueue, names: RowNames) -> None:
        self._row_queue = row_queue
        self._names = names
        self._wakeup = WakeUp()
        self._is_watched = False  # whether `fileno` was called
        self._taken_ns = 0  # when rows of the newest chunk were last taken
        self._closing = False
        self._over = threading.Event()  # set once all lines are closed, so that no further rows come
        self._caller: BatchCaller | None = None
        self._changing = threading.Lock()  # held while a drive or line is added or removed
        self.failure: PollingFailed | None = None
        """Why polling has ended by itself on all lines; None if it has not."""

    def fileno(self) -> int:
        """Return a descriptor that is readable while rows wait to be taken, for select or an asyncio loop."""
        self._is_watched = True
        self._call_thread()
        return self._wakeup.fileno()

    def take(self) -> Batch | None:
        """Return the oldest queued rows without waiting; None if there are no rows, or only a few new rows.

        Raises PollingFailed if polling has failed and no rows are left.
        """
        now, chunks = clock.now_ns(), self._row_queue.chunks
        if chunks < 2:
            if self._is_watched:
                self._wakeup.clear()
            if now - self._taken_ns < FILLING_NS and not (self._closing or self.failure):
                return None
            self._taken_ns = now
        columns = self._row_queue.take()
        if columns is None and self.failure and not self._closing:
            raise self.failure
        return Batch(columns, self._names.drives, self._names.registers) if columns else None

    def batches(self, seconds: float | None = None, *, every: float = 0.1) -> Iterator[Batch]:
        """Yield batches, about one every `every` s, for `seconds` s or until the poller is closed.

        Once the poller is closed, the remaining batches are yielded immediately. Raises PollingFailed like
        `take`.
        """
        end_ns = None if seconds is None else clock.now_ns() + round(seconds * 1e9)
        is_over = False
        while not is_over and (end_ns is None or clock.now_ns() < end_ns):
            left = every if end_ns is None else max(0.0, (end_ns - clock.now_ns()) / 1e9)
            is_over = self._over.wait(min(every, left))
            while batch := self.take():
                yield batch

    def __iter__(self) -> Iterator[Batch]:
        """Yield batches until the poller is closed, like `batches()`."""
        return self.batches()

    async def __aiter__(self) -> AsyncIterator[Batch]:
        """Yield batches until the poller is closed, without blocking the event loop.

        A batch is taken only when it is yielded. So if the task is cancelled, queued rows stay for the next
        consumer, even after the poller is closed.
        """
        import asyncio  # imported here, because it uses 4 MB that other programs save

        is_over = False
        while not is_over:
            is_over = self._over.is_set()
            while batch := self.take():
                yield batch
            if not is_over:
                await asyncio.sleep(ASYNC_LOOK_S)

    @undisturbed
    def on_batch(self, function: Callable[[Batch], object], *, every: float = 0.1) -> None:
        """Call `function` with each of `batches()` on a thread of its own, until the poller is closed.

        A slow function delays no line: rows wait in the core's queue, and if it is full, further rows are
        dropped and counted in `summary()`. Closing the poller waits until the function has had the last
        batch. If the function raises, the failure is logged immediately, the calls end, and closing raises
        the same failure. Each batch goes to one consumer only, so do not call `take` or `batches` too. Raises
        ValueError for a second function, and TypeError for an async or generator function, because a call
        would not run it.
        """
        check_function(function)
        with self._changing:
            if self._caller:
                raise ValueError("on_batch already has a function")
            if self._closing:
                raise ValueError("polling has ended: there are no more batches")
            self._caller = BatchCaller(self.batches(every=every), function)

    def _call_thread(self) -> None:
        self._row_queue.call(NO_LINE)
