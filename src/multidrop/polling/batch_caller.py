"""BatchCaller: a thread that hands batches to a function."""

from __future__ import annotations

import inspect
import logging
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Generator, Iterable
from functools import partial

from multidrop.errors import PollingFailed
from multidrop.polling.batch import Batch

_log = logging.getLogger("multidrop.polling")


_DEFERRED = (inspect.iscoroutinefunction, inspect.isgeneratorfunction, inspect.isasyncgenfunction)


def check_function(function: object) -> None:
    """Raise TypeError unless a call carries it out: that of an async or generator function begins nothing."""
    if not callable(function):
        raise TypeError(f"on_batch takes a function of one batch, not {function!r}")
    while isinstance(function, partial):
        function = function.func
    calls = (function, getattr(type(function), "__call__", None))  # noqa: B004 (its class's own)
    if any(is_deferred(call) for is_deferred in _DEFERRED for call in calls):
        raise TypeError(_DEFERS.format(function))


_DEFERS = (
    "on_batch takes a plain function, and {!r} is async or a generator: it would be called and never carried "
    "out. In asyncio, wait for poller.fileno() to be readable and call poller.take(): docs/howto/asyncio.md"
)


def _check_returned(function: object, returned: object) -> None:
    """Raise TypeError for what is still to be carried out."""
    if isinstance(returned, Awaitable | Generator | AsyncIterator):
        if inspect.iscoroutine(returned):
            returned.close()  # else Python warns, too
        raise TypeError(_DEFERS.format(function))


class BatchCaller:
    """Calls a function with one batch after another, on a thread of its own, until there are no more.

    The first failure of the function ends that, is logged at once, and is raised by `raise_failure`.
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
        except BaseException as failure:  # whatever it is, the caller of close() must see it
            self._failure = failure
            _log.error("on_batch: the function failed, and is called no more", exc_info=failure)

    def join(self) -> None:
        """Wait until the last batch is handed out; not in the function itself."""
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def raise_failure(self) -> None:
        """Raise the function's failure, once."""
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
