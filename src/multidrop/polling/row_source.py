"""RowSource: the rows of a poller, as batches.

The core collects rows in a limited number of chunks; consumers take the oldest chunk first.
"""

from __future__ import annotations

import inspect
import logging
import socket
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Generator, Iterable, Iterator
from contextlib import suppress
from functools import partial

from multidrop.core import Realtime, RowQueue
from multidrop.core.process import undisturbed
from multidrop.errors import PollingFailed
from multidrop.polling.added_rows import COMMENT, AddedRows
from multidrop.polling.batch import Batch
from multidrop.polling.jobs import RowNames
from multidrop.polling.line_set import NO_LINE
from multidrop.transport import clock

_log = logging.getLogger("multidrop.polling")


_DEFERRED = (inspect.iscoroutinefunction, inspect.isgeneratorfunction, inspect.isasyncgenfunction)


def check_function(function: object) -> None:
    """Raise TypeError for an async or generator function, because a call would not run it."""
    if not callable(function):
        raise TypeError(f"on_batch takes a function with one argument, the batch, not {function!r}")
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
            pass  # the poller logs this error, and raises it when it is closed
        except BaseException as failure:  # any failure: close() raises it to its caller
            self._failure = failure
            _log.error("on_batch: the function failed and is no longer called", exc_info=failure)

    def join(self) -> None:
        """Wait until the user's function has returned from the last call.

        If that function itself calls this, return immediately.
        """
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def raise_failure(self) -> None:
        """If the function has raised an exception, raise it again, but only at the first call."""
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure


class WakeUp:
    """A descriptor that is readable from a call of `set` until `clear` is called, for select or an asyncio
    loop.

    It is a socket, because select on Windows takes only sockets.
    """

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)
        self._number = self._reader.fileno()
        self._closed = False

    def fileno(self) -> int:
        return self._number

    def set(self) -> None:
        if not self._closed:
            with suppress(BlockingIOError):
                self._writer.send(b"\0")

    def clear(self) -> None:
        if not self._closed:
            with suppress(BlockingIOError):
                while self._reader.recv(64):
                    pass

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._reader.close()
            self._writer.close()


FILLING_NS = 10_000_000  # minimum interval between two batches that are taken from a chunk that is not full
BATCHES_S = 0.1  # interval between checks for rows in `batches` and `on_batch`
ASYNC_LOOK_S = 0.05  # interval between checks for rows in `async for`
PROMPT_S = 0.02  # interval between checks for rows if realtime scheduling was granted


class RowSource:
    """The rows in the core's queue, and the methods by which consumers take rows."""

    def __init__(self, row_queue: RowQueue, names: RowNames, realtime: Realtime) -> None:
        self._row_queue = row_queue
        self._realtime = realtime
        self._names = names
        self._added = AddedRows(names)  # adds the rows of computed channels and of events
        self._wakeup = WakeUp()
        self._is_watched = False  # True once `fileno` was called: `_wakeup` must then show whether rows wait
        self._taken_ns = 0  # when `take` last took a chunk of rows that was not full; see FILLING_NS
        self._is_started = False  # True once polling has started
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
        """Return the oldest queued rows without waiting; None if there are none.

        A chunk that is not full is returned only if FILLING_NS have passed since the last such chunk.
        Raises PollingFailed if polling has failed and no rows are left.

        If realtime scheduling was granted, the calling thread runs before most normal threads from now on.
        """
        with suppress(OSError):  # the poller's own thread logs why the system refuses this
            self._realtime.lower_nice()
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
        batch = Batch(columns, self._names.drives, self._names.registers) if columns else None
        if not self._added:
            return batch
        if batch is None and self._closing:
            self._added.save()
        return self._added.added_to(batch)

    def mark(self, text: str, *, kind: str = COMMENT, ago: float = 0.0) -> None:
        """Add an event to the rows, at the time `ago` s before now.

        In its row, the drive is "event", the register is the kind of event, and the status is the text. Any
        thread may call this. Raises ValueError for a text that is empty, longer than 500 characters or not
        printable.
        """
        self._added.mark(kind, text, ago)

    def _interval_s(self, usual: float) -> float:
        return PROMPT_S if self._realtime.is_held else usual

    def batches(self, seconds: float | None = None, *, every: float | None = None) -> Iterator[Batch]:
        """Yield batches, about one every `every` s, for `seconds` s or until the poller is closed.

        `every` None means 0.1 s, or 0.02 s if realtime scheduling was granted.

        Once the poller is closed, the remaining batches are yielded immediately. Raises PollingFailed like
        `take`. Raises ValueError before the poller's `with` block, which starts polling.
        """
        self._check_started()
        return self._yield_batches(seconds, every)

    def _check_started(self) -> None:
        if not (self._is_started or self._closing):
            raise ValueError("this poller does not poll yet: iterate over it inside `with poller:`")

    def _yield_batches(self, seconds: float | None, every: float | None) -> Iterator[Batch]:
        end_ns = None if seconds is None else clock.now_ns() + round(seconds * 1e9)
        is_over = False
        while not is_over and (end_ns is None or clock.now_ns() < end_ns):
            pause = self._interval_s(BATCHES_S) if every is None else every
            left = pause if end_ns is None else max(0.0, (end_ns - clock.now_ns()) / 1e9)
            is_over = self._over.wait(min(pause, left))
            while batch := self.take():
                yield batch

    def __iter__(self) -> Iterator[Batch]:
        """Yield batches until the poller is closed, like `batches()`."""
        return self.batches()

    async def __aiter__(self) -> AsyncIterator[Batch]:
        """Yield batches until the poller is closed, without blocking the event loop.

        A batch is taken only when it is yielded. So if the task is cancelled, queued rows stay for the next
        consumer, even after the poller is closed. Raises ValueError before the `with` block.
        """
        self._check_started()
        import asyncio  # imported here: only `async for` needs its 4 MB

        is_over = False
        while not is_over:
            is_over = self._over.is_set()
            while batch := self.take():
                yield batch
            if not is_over:
                await asyncio.sleep(self._interval_s(ASYNC_LOOK_S))

    @undisturbed
    def on_batch(self, function: Callable[[Batch], object], *, every: float | None = None) -> None:
        """On a separate thread, call `function` with each of `batches()`, until the poller is closed.

        A slow function delays no line: rows wait in the core's queue, and if it is full, further rows are
        dropped and counted in `summary()`. Closing the poller waits until the call with the last batch has
        returned. If the function raises, the failure is logged immediately, the calls end, and closing raises
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
            self._caller = BatchCaller(self._yield_batches(None, every), function)

    def _call_thread(self) -> None:
        self._row_queue.call(NO_LINE)
