"""BatchCaller: a thread that hands batches to a function."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable

from multidrop.polling.batch import Batch

_log = logging.getLogger("multidrop.polling")


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
                self._function(batch)
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
