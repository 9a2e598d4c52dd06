"""LineLog: a line in the log `multidrop.line`: its port's coming and going, other masters, and frames."""

from __future__ import annotations

import logging
import threading

from multidrop.core import STATUSES, Completion, Exchange, Port, build_request
from multidrop.transport.aside_log import log_aside

_log = logging.getLogger("multidrop.line")

FOREIGN = (
    "%s: another master: %d bytes came before anything was asked; nothing but stops is sent until the "
    "line has been silent"
)


class LineLog:
    """The log of one line, in which each loss stands once, and foreign bytes are counted too."""

    def __init__(self, port: str) -> None:
        self.foreign = 0  # bytes that came while the line was listened to before a request
        self.shows = _log.isEnabledFor  # a level
        self._port = port
        self._foreign_here = 0  # of these on the port that is open now
        self._is_lost = False
        self._why_unopened = ""
        self.forked()

    def forked(self) -> None:
        """Hold no lock of the parent's."""
        self._noting = threading.Lock()

    def opened(self, identity: str) -> None:
        """Log that the port was opened; no foreign byte has come on it yet."""
        again = " again" if self._is_lost else ""
        log_aside(_log, logging.INFO, "%s: opened%s (%s)", self._port, again, identity)
        self._is_lost, self._foreign_here, self._why_unopened = False, 0, ""

    def lost(self, why: str) -> None:
        """Log that the port was lost, unless that is in the log already."""
        if not self._is_lost:
            self._is_lost = True
            log_aside(_log, logging.WARNING, "%s: lost (%s)", self._port, why)

    def unopened(self, why: str) -> None:
        """Log why a port is not opened, or not again, unless that is the last thing in the log."""
        if why != self._why_unopened:
            self._why_unopened = why
            again = " again" if self._is_lost else ""
            log_aside(_log, logging.WARNING, "%s: not opened%s: %s", self._port, again, why)

    def closed(self) -> None:
        log_aside(_log, logging.INFO, "%s: closed", self._port)

    def note_foreign(self, core: Port) -> None:
        """Log the foreign bytes that came since this was called last; any thread may call it."""
        if core.foreign == self._foreign_here:
            return
        with self._noting:
            now = core.foreign
            came, self._foreign_here = now - self._foreign_here, now
            self.foreign += came
        if came > 0:
            log_aside(_log, logging.WARNING, FOREIGN, self._port, came)

    def frames(self, exchange: Exchange, found: Completion) -> None:
        """Log both frames: direction, CLOCK_MONOTONIC in s, bytes, meaning."""
        if found.sent_ns:
            frame = build_request(exchange.framing, exchange.request).hex(" ").upper()
            at = found.sent_ns / 1e9
            log_aside(_log, logging.DEBUG, "%s > %.6f %s %s", self._port, at, frame, exchange.request)
        meaning = found.reply if found.result > 0 else STATUSES[-found.result]
        at = (found.first_ns or found.begun_ns) / 1e9
        came = found.raw.hex(" ").upper() or "nothing"
        log_aside(_log, logging.DEBUG, "%s < %.6f %s %s", self._port, at, came, meaning)
