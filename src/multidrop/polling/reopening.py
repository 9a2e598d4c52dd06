"""Reopening: a lost port opened again in a thread, so that one that takes its time holds no other line up."""

from __future__ import annotations

import logging
import threading
from contextlib import suppress

from multidrop.bus import Bus
from multidrop.errors import LineError
from multidrop.transport.aside_log import log_aside, traceback_of

_log = logging.getLogger("multidrop.polling")


class Reopening:
    """Attempts to open the port of a bus again, one at a time."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._thread: threading.Thread | None = None

    @property
    def is_under_way(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def begin(self) -> None:
        """Begin an attempt. Where the system gives no thread a stop opens the port, until there is one."""
        thread = threading.Thread(target=self._attempt, name="multidrop reopening", daemon=True)
        self._thread = None
        with suppress(RuntimeError, MemoryError):
            thread.start()
            self._thread = thread
        self._bus.tended(self._thread is not None)

    def join(self) -> None:
        """Wait for the end of an attempt that is under way."""
        if self._thread is not None:
            self._thread.join()

    def _attempt(self) -> None:
        try:
            self._bus.line.regain()
        except LineError:
            pass  # the line has logged it
        except BaseException as failure:
            log_aside(
                _log, logging.ERROR, "%s: not opened again\n%s", self._bus.line.port, traceback_of(failure)
            )
