"""Line: a port that carries out exchanges, and that can be reopened after it was lost."""

from __future__ import annotations

import errno
import logging
import threading
from logging import DEBUG
from typing import Self

from multidrop.core import (
    RS485,
    STATUSES,
    Completion,
    Echo,
    Exchange,
    Failure,
    Mastership,
    Peer,
    Port,
    Tap,
    TransactionIds,
    build_request,
)
from multidrop.core.process import register_at_fork, undisturbed
from multidrop.drive.line_settings import check_settle, speaks_tcp
from multidrop.errors import LineError, NoSuchPort, PortLost
from multidrop.transport import clock
from multidrop.transport.aside_log import flush_log, log_aside, words_of
from multidrop.transport.network_port import PORT_FAILURES
from multidrop.transport.open_port import (
    CLOSING_S,
    STALLED,
    OpenPort,
    check_port,
    is_lost_by,
    reason_of,
    why_lost,
)

_log = logging.getLogger("multidrop.line")

MISCOUNTS = (
    "%s: its driver counts unsent bytes although replies came; the count is ignored, so a stall of the port "
    "will not be noticed"
)
DISCARDED = "its adapter takes no bytes; they are discarded"
FOREIGN = "%s: another master: %d unexpected bytes came; only stops are sent until the line has been silent"
MOST_LOSSES = 5  # limit of the losses of a port that are logged within LOSSES_NS
LOSSES_NS = 60_000_000_000
UNLOGGED = "; it is lost often, so further losses are not logged until a minute after the first"


class LineLog:
    """The log of one line: reports losses of its port, but not too often."""

    def __init__(self, port: str) -> None:
        self.shows = _log.isEnabledFor  # returns whether a log level is enabled
        self._port = port
        self._foreign = 0  # how many of another master's bytes are logged, since the port was last opened
        self._is_lost = self._is_stalled = self._miscounts = False
        self._why_unopened = ""
        self._losses = 0  # number of losses since `_losses_ns`
        self._losses_ns = 0

    def opened(self, identity: str) -> None:
        """Log that the port was opened; from now on, a loss of the port is logged again."""
        again = " again" if self._is_lost else ""
        if not self._is_lost or self._losses <= MOST_LOSSES or self._why_unopened:
            log_aside(_log, logging.INFO, "%s: opened%s (%s)", self._port, again, identity)
        self._is_lost, self._is_stalled, self._foreign, self._why_unopened = False, False, 0, ""

    def lost(self, why: str) -> None:
        """Log that the port was lost, unless this loss is already logged."""
        if self._is_lost:
            return
        self._is_lost = True
        now_ns = clock.now_ns()
        if now_ns >= self._losses_ns + LOSSES_NS:
            self._losses, self._losses_ns = 0, now_ns
        self._losses += 1
        if self._losses <= MOST_LOSSES:
            more = UNLOGGED if self._losses == MOST_LOSSES else ""
            log_aside(_log, logging.WARNING, "%s: lost (%s)%s", self._port, why, more)

    def note_stall(self, is_stalled: bool) -> None:
        """Log that the adapter accepts no bytes, or accepts bytes again, unless this is already logged."""
        if is_stalled != self._is_stalled:
            self._is_stalled = is_stalled
            said = STALLED if is_stalled else "its adapter takes bytes again"
            log_aside(_log, logging.WARNING, "%s: %s", self._port, said)

    def note_miscount(self) -> None:
        """Log that the driver's count of unsent bytes is wrong, unless this is already logged."""
        if not self._miscounts:
            self._miscounts = True
            log_aside(_log, logging.WARNING, MISCOUNTS, self._port)

    def unopened(self, why: str) -> None:
        """Log why the port could not be opened or reopened, unless the last attempt had the same reason."""
        if why != self._why_unopened:
            self._why_unopened = why
            again = " again" if self._is_lost else ""
            log_aside(_log, logging.WARNING, "%s: not opened%s: %s", self._port, again, why)

    def holds_bytes(self, seconds: float) -> None:
        """Log that the port is being closed although the driver still holds bytes."""
        wait = f"waiting {seconds:.2g} s for its adapter, which takes no bytes; then they are discarded"
        log_aside(_log, logging.WARNING, "%s: %s", self._port, wait if seconds else DISCARDED)

    def closed(self) -> None:
        log_aside(_log, logging.INFO, "%s: closed", self._port)

    def note_foreign(self, core: Port) -> None:
        came, self._foreign = core.foreign - self._foreign, core.foreign
        if came > 0:
            log_aside(_log, logging.WARNING, FOREIGN, self._port, came)

    def frames(self, exchange: Exchange, found: Completion) -> None:
        """Log request and reply, each with direction, CLOCK_MONOTONIC in s, bytes and meaning."""
        if found.sent_ns:
            frame = build_request(exchange.framing, exchange.request).hex(" ").upper()
            at = found.sent_ns / 1e9
            log_aside(_log, logging.DEBUG, "%s > %.6f %s %s", self._port, at, frame, exchange.request)
        meaning = found.reply if found.result > 0 else STATUSES[-found.result]
        at = (found.first_ns or found.begun_ns) / 1e9
        came = found.raw.hex(" ").upper() or "nothing"
        log_aside(_log, logging.DEBUG, "%s < %.6f %s %s", self._port, at, came, meaning)


LOGGING_S = 1.0  # s; limit of the wait for the log thread when a line is closed

UNOPENED = (
    "it is not opened: this process is not its master, and opening it could end the master's connection"
)


class Line:
    """A port that carries out exchanges, urgent ones before queued ones.

    `port` is a device, a URL of socket:// or rfc2217://, or tcp://host:port for Modbus TCP. `ids` says
    whether a Modbus TCP reply must have the transaction id of its request. `rs485` says who switches the
    transceiver. For `settle` seconds after each opening, the line sends nothing and discards its input. With
    a `mastership`, requests are sent only while this process holds it. Every failure of the port is raised
    as a LineError.
    """

    def __init__(
        self,
        port: str,
        echo: Echo = Echo.AUTO,
        ids: TransactionIds = TransactionIds.MATCH,
        rs485: RS485 = RS485.OFF,
        mastership: Mastership | None = None,
        settle: float = 0.0,
    ) -> None:
        check_settle(settle)
        if mastership is not None:
            check_port(port, mastership)
        self.port = port
        self.rs485 = rs485
        self.mastership = mastership
        self.is_tcp = isinstance(port, str) and speaks_tcp(port)
        self.ids = ids
        self._echo = echo
        self._opened = OpenPort(port, ids, rs485, mastership, settle)
        # The C core's port, on which exchanges are queued; None before `open`, and after `drop`.
        self.queue: Port | None = None
        self._tap: Tap | None = None
        self._log = LineLog(port)
        self._foreign = 0  # as the property `foreign`, but only on earlier openings of the port
        self._is_over = False
        self._why_closed = "it is closed"
        self._why_lost: str | None = None
        # why calls fail although the line is not closed yet; None: they do not fail
        self.why_closing: str | None = None
        # When polling ended; None: not yet. A stalled adapter has until CLOSING_S after this time to take the
        # last bytes. So a process that closes several stalled lines in turn waits no longer than for one
        # line.
        self.ended_ns: int | None = None
        self._make_locks()
        register_at_fork(self)

    def _make_locks(self) -> None:
        self._lock = threading.RLock()  # only one thread at a time opens or closes the port

    def forked(self) -> None:
        """Close the line in a forked child: a descriptor that stays open there would keep the port busy."""
        self._make_locks()
        self._is_over = True
        self._why_closed = "it was opened before this process was forked; open it again here"
        self.queue = None
        self._opened.forget()

    @property
    def identity(self) -> str:
        """The identity of the port once it is open: the same for all of its names, see port_identity."""
        return self._opened.identity

    # ---- opening and closing ----

    def open(self) -> Self:
        """Open the line and return it. Raises LineError if the port is absent, or if the line was closed."""
        self._open_first()
        return self

    @undisturbed
    def _open_first(self) -> None:
        with self._lock:
            if self._is_over:  # an interrupted earlier call of `open` has closed the line
                raise self._closed()
            self.reopen()

    def _open(self) -> None:
        self._is_over = False
        if not self.may_send:
            raise LineError(self.port, UNOPENED)
        try:
            core = self._opened.open()
            core.set_echo(Echo.OFF if self.is_tcp else self._echo)
            if self._tap:
                core.tap(self._tap)
            self._log.opened(self.identity)
            self.queue, self._why_lost = core, None
        except LineError as failure:
            if not isinstance(failure, NoSuchPort):
                self._let_go()
            raise
        except PORT_FAILURES as failure:
            self._let_go()
            raise LineError(self.port, reason_of(failure)) from None

    def drop(self, why: str = "it is closed") -> None:
        """End all exchanges and discard queued ones, without closing the port. Later calls raise PortLost.

        `why` is the reason in their error sentence.
        """
        if self.queue is None:  # checked before the lock, which an attempt to reopen the port may hold
            return
        with self._lock:
            core, self.queue = self.queue, None
            if core is None:
                return
            self._why_closed = why
            if core.lost:
                lost = why_lost(self.port, core.lost_error)
                self._why_lost = self._why_closed = f"the port was lost ({lost})"
                self._log.lost(lost)
            core.stop()
            self._foreign += core.foreign
            self._opened.must_discard |= bool(core.called_off)

    def drop_lost(self) -> None:
        """Drop the port as `drop` does if it is lost; another thread may have reopened it meanwhile."""
        with self._lock:
            if self.queue is not None and self.queue.lost:
                self.drop()

    @undisturbed
    def close(self) -> None:
        """Close the port for good: `regain` then raises LineError."""
        with self._lock:
            if not self._is_over:
                self._log.closed()
            self._is_over = True
            self._let_go()
        flush_log(LOGGING_S)

    def end(self) -> bool:
        """Start no more queued exchanges. Return True while a queued exchange is in flight."""
        if self.queue is None:  # checked before the lock, which an attempt to reopen the port may hold
            return False
        with self._lock:  # held, because otherwise another thread could free the port
            return self.queue is not None and self.queue.end()

    def _let_go(self) -> None:
        with self._lock:
            self.drop()
            seconds = self._closing_s()
            if not self._opened.must_discard and self._opened.holds_bytes():
                self._log.holds_bytes(seconds)
            self._opened.close(seconds)

    def _closing_s(self) -> float:
        """Return how long closing the port may wait for its adapter, in s."""
        past_ns = clock.now_ns() - self.ended_ns if self.ended_ns else 0
        return max(0.0, CLOSING_S - past_ns / 1e9)

    def reopen(self) -> None:
        """Close the port and open it again. Raises LineError if the port is absent."""
        with self._lock:
            self._let_go()
            self._open()

    @property
    def is_lost(self) -> bool:
        """True if the port has failed, and was neither reopened nor closed since then."""
        core = self.queue
        return not self._is_over and (core is None or core.lost)

    @property
    def is_stalled(self) -> bool:
        """True if the driver still held the request at the last timeout, and no reply has come since."""
        core = self.queue
        return core is not None and core.is_stalled

    @property
    def why_lost(self) -> str | None:
        """Why the port is stalled, lost, or could not be reopened, with its name; None if it works."""
        if self.is_stalled:
            return f"{self.port}: {STALLED}"
        return f"{self.port}: {self._why_lost}" if self.is_lost and self._why_lost else None

    @undisturbed
    def regain(self) -> None:
        """Reopen a lost port. Raises PortLost if that fails, LineError if the line was closed."""
        with self._lock:
            if self._is_over:
                raise self._closed()
            if not self.is_lost:
                return
            try:
                self.reopen()
            except Exception as failure:  # pyserial and its backends may raise any exception
                reason = failure.reason if isinstance(failure, LineError) else words_of(failure)
                self._why_closed = self._why_lost = reason
                self._log.unopened(reason)
                raise PortLost(self.port, reason) from failure

    # ---- taps, settings and peers ----

    def tap(self, tap: Tap) -> None:
        """Copy all bytes of the line to this tap from now on, and none to an earlier tap."""
        with self._lock:
            self._tap = tap
            if self.queue:
                self.queue.tap(tap)

    def require(self, settings: tuple[int, str]) -> None:
        """Set the baud rate and format of a bridged port, whose settings cannot change later.

        Raises LineError if other settings are in use, or if the port rejects these.
        """
        with self._lock:
            self._opened.require(settings)

    @property
    def only_settings(self) -> tuple[int, str] | None:
        """The fixed settings of a port whose requests a thread forwards (a bridge); None for other ports."""
        return self._opened.settings if self._opened.bridge else None

    def inherit(self, peer: Peer, before: Peer) -> None:
        """Expect late replies to requests of `before` too: an earlier drive at the same address."""
        with self._lock:
            if self.queue:
                self.queue.inherit(peer, before)
            else:
                peer.inherit(before)

    # ---- exchanges ----

    def carry_out(
        self,
        exchange: Exchange,
        *,
        not_before_ns: int = 0,
        expires_ns: int = 0,
        into: Completion | None = None,
    ) -> Completion:
        """Carry out an exchange before all queued ones; wait for its completion and return it.

        `not_before_ns` is the earliest time to send it (CLOCK_MONOTONIC), `expires_ns` the latest
        (CLOCK_BOOTTIME); 0 means no limit. `into` is a completion to reuse. Raises LineError if the port
        fails.
        """
        if self._opened.bridge and self.queue and self._opened.settings != exchange.settings:
            self.require(exchange.settings)
        core = self.queue
        if core is None:
            raise self._closed()
        failure = None
        try:
            found = core.carry_out(exchange, not_before_ns, expires_ns, into)
            is_lost = found.count < 0 and is_lost_by(found.result, core)
            self.note_news()
            if self._log.shows(DEBUG):
                self._log.frames(exchange, found)
            if is_lost:
                failure = self._failure(found, exchange, core)
                failure.is_sent, failure.received = found.sent_ns > 0, found.raw
        finally:  # reached even if Ctrl-C interrupts the exchange
            if core.called_off:
                self._discard(core)
        if failure:
            raise failure
        return found

    @undisturbed
    def _discard(self, core: Port) -> None:
        """Close the port now, so that the driver discards the unsent bytes of a command that has ended."""
        with self._lock:
            if self.queue in (core, None):  # otherwise another thread has already reopened the port
                self._let_go()

    def is_asking(self, peer: Peer) -> bool:
        """Return True while an exchange with this drive is queued or in flight on the port."""
        with self._lock:
            return self.queue is not None and self.queue.is_asking(peer)

    def _failure(self, found: Completion, exchange: Exchange, core: Port) -> LineError:
        if found.result == Failure.SETTINGS_REFUSED:
            return LineError(self.port, self._opened.refusal(found.error, exchange.settings[0]))
        if self.queue is not core or self.why_closing:  # another thread has dropped the port
            return self._closed()
        why = why_lost(self.port, found.error, found.raw)
        if found.error == errno.ETIMEDOUT and not core.lost:
            self.note_stall()
            sent = "the request was sent only in part" if found.sent_ns else "nothing was sent"
            return PortLost(self.port, f"{sent}: the port took no bytes until the time-out ({why})")
        self._log.lost(why)
        return PortLost(self.port, f"the port was lost ({why})")

    def _closed(self) -> LineError:
        is_over = self._is_over or self.why_closing
        return (LineError if is_over else PortLost)(self.port, self.why_closing or self._why_closed)

    def counted_ns(self, now_ns: int) -> int:
        """Return the time (ns) up to which exchanges are counted: now, or the start of the one in flight."""
        return now_ns if (core := self.queue) is None else min(now_ns, core.counted_ns())

    def overruns(self) -> int | None:
        """Return how many received characters the UART has lost (overruns); None if that is unknown."""
        return self._opened.overruns()

    @property
    def may_send(self) -> bool:
        """True if this process may send now: if the line has a mastership, this process must hold it."""
        return self.mastership is None or self.mastership.holds

    def note_stall(self) -> None:
        """Log that the port is stalled, or no longer stalled, unless this is already logged."""
        self._log.note_stall(self.is_stalled)

    def note_news(self) -> None:
        """Log that the driver counts unsent bytes wrongly, or that another master has sent bytes.

        Another master's bytes are noticed only on a line with a mastership.
        """
        core = self.queue
        if core is None:
            return
        if core.miscounts:
            self._log.note_miscount()
        if self.mastership is not None:
            self._log.note_foreign(core)

    @property
    def foreign(self) -> int:
        """Number of another master's bytes, received while the line listened before a request."""
        core = self.queue
        return self._foreign + (core.foreign if core else 0)

    @property
    def has_echo(self) -> bool:
        return self.queue is not None and self.queue.has_echo
