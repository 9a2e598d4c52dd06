"""Log from a thread of its own: a handler, whose disk may hang, holds up no stop and no port."""

from __future__ import annotations

import logging
import threading
from contextlib import suppress
from queue import SimpleQueue

from multidrop.core.fork import register_at_fork

Message = tuple[logging.Logger, int, str, tuple[object, ...]]


class _AsideLog:
    def __init__(self) -> None:
        self.forked()
        register_at_fork(self)

    def forked(self) -> None:
        self._queue: SimpleQueue[Message | threading.Event] = SimpleQueue()
        self._thread: threading.Thread | None = None

    @property
    def has_begun(self) -> bool:
        return self._thread is not None

    def put(self, message: Message | threading.Event) -> None:
        self._queue.put(message)
        if self._thread is None:
            self._thread = threading.Thread(
                target=self._run, args=(self._queue,), name="multidrop log", daemon=True
            )
            with suppress(RuntimeError):  # the interpreter is ending: nothing is logged any more
                self._thread.start()

    @staticmethod
    def _run(queue: SimpleQueue[Message | threading.Event]) -> None:
        while True:
            message = queue.get()
            if isinstance(message, threading.Event):
                message.set()
                continue
            logger, level, text, details = message
            with suppress(Exception):  # a handler's own failure
                logger.log(level, text, *details)


_aside = _AsideLog()


def log_aside(logger: logging.Logger, level: int, text: str, *details: object) -> None:
    """Log this soon, in the order of the calls; return at once."""
    if logger.isEnabledFor(level):
        _aside.put((logger, level, text, details))


def flush(seconds: float) -> None:
    """Wait until all is logged, for at most so long."""
    if _aside.has_begun:
        done = threading.Event()
        _aside.put(done)
        done.wait(seconds)
