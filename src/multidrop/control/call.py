"""Calls that may move a motor: their progress, their deadlines, and their cancellation by stops."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from math import inf

from multidrop.control.exit_hook import await_signal
from multidrop.control.outcome import Outcome
from multidrop.core import Latch, Permit
from multidrop.drive.family import Drive
from multidrop.errors import CancelledByStop, Expired, NotAttached, Unconfirmed, WriteForbidden
from multidrop.printable import is_number
from multidrop.transport import clock
from multidrop.transport.exchange import Exchanges

STOPPED = "a stop was called"
REMOVED = "the drive was taken off the bus"
LEFT = "the bus was closed"
POLL_S = 0.005  # seconds between checks whether all stops have ended


class Latches:
    """The unfinished stops of a bus, and one `Latch` for each drive, which cancels the drive's calls.

    A latch is the core's record of the stops of one drive. The core does not send a call's write if a stop
    of the drive is unfinished or was called after the call, or if the latch is shut.
    """

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges
        self._latches: dict[Drive, Latch] = {}
        self.is_shut = False
        # for each unfinished stop: the identifier of the thread that called it, and the drives to stop
        self._stops: dict[object, tuple[int, frozenset[Drive]]] = {}

    def forked(self) -> None:
        """In a forked child, cancel all present and future calls, and forget the parent's pending stops."""
        self._stops = {}
        self.shut()

    def add(self, drive: Drive) -> Latch:
        latch = self._latches[drive] = Latch(drive.stops_called[0])
        # checked after the latch was added, so that a `shut` on another thread is never missed
        if self.is_shut:
            latch.shut(LEFT)
        return latch

    def end(self, drives: Iterable[Drive]) -> None:
        """Cancel all calls that move these drives, and refuse new ones, before the drives are removed."""
        for drive in drives:
            self.latch(drive).shut(REMOVED)

    def remove(self, drive: Drive) -> None:
        """Cancel this drive's calls, wait for its unfinished stops, and forget the drive."""
        self.end([drive])
        self.await_stops([drive])
        self._latches.pop(drive, None)

    def shut(self) -> None:
        """Cancel all present and future calls. Takes no lock, because a signal handler may call it."""
        self.is_shut = True
        for latch in list(self._latches.values()):
            latch.shut(LEFT)

    def await_stops(self, drives: Collection[Drive] | None = None) -> None:
        """Wait until these drives (by default all) have no unfinished stop of another thread."""
        own, asked = threading.get_ident(), None if drives is None else frozenset(drives)
        while any(
            thread != own and (asked is None or not asked.isdisjoint(stopped))
            for thread, stopped in self._stops.copy().values()
        ):
            # not a Condition, whose lock could stay locked if a signal handler raises an exception
            time.sleep(POLL_S)

    def latch(self, drive: Drive) -> Latch:
        """Return the `Latch` that cancels this drive's calls. Raises NotAttached if it is not on this bus."""
        self._exchanges.peers.of(drive)  # raises NotAttached
        latch = self._latches.get(drive)
        if latch is None:  # the drive is being removed
            raise NotAttached(f"{drive.name} is not attached to this bus: use bus.attach(...)")
        return latch

    def rise(self, drives: Sequence[Drive]) -> None:
        """Cancel all calls that move these drives. Called right before a stop is written."""
        for drive in drives:
            self.latch(drive).revoke(STOPPED)

    def begin(self, stop: object, drives: Sequence[Drive]) -> None:
        """Start a stop. Until `over(stop)`, cancel the calls that move these drives, and keep them attached.

        `begin` may be called repeatedly. Neither `begin` nor `over` takes a lock. Each of their steps is
        atomic, so an exception that a signal handler raises leaves no step half done.
        """
        self._stops[stop] = threading.get_ident(), frozenset(drives)
        for drive in drives:
            if latch := self._latches.get(drive):
                latch.hold(stop, STOPPED)

    def over(self, stop: object) -> None:
        """End a stop, and accept calls of its drives again. It may be called twice, or without `begin`."""
        for latch in [*self._latches.values()]:
            latch.let_go(stop)
        self._stops.pop(stop, None)


# ---- calls ----


MOST_CHARACTERS = 64  # number of characters of the longest request for one register, plus its reply

_log = logging.getLogger("multidrop.control")


class Call:
    """One call of a method that writes to a drive. `verb` is its name, such as "start"; "" for a plain write.

    The call sends no write after a stop was called, or when the call is late by more than `expiry` seconds.
    Lateness is the time since the call or its latest write, minus the time allowed for the call's own reads,
    writes and waits. So nothing is sent late after the process was suspended or the computer slept. The first
    write is not sent after `limit_ns` (CLOCK_BOOTTIME) either.
    """

    def __init__(
        self, drive: Drive, permit: Permit, expiry: float, verb: str = "", limit_ns: float = inf
    ) -> None:
        self.drive = drive
        self.permit = permit
        self.verb = verb
        self.sent = ""  # description of the latest write that may have been sent
        self.is_confirmed = False  # whether the drive confirmed the write in `sent`
        # outcome of the write in `sent`; None once a later read has succeeded
        self.unverified: Outcome | None = None
        self.expiry = expiry
        self._due_ns = clock.boottime_ns()
        self._limit_ns = limit_ns

    def restarted(self) -> Call:
        """Return a copy that starts now. A stop since the original call cancels the copy too."""
        return Call(self.drive, self.permit, self.expiry, self.verb, self._limit_ns)

    @property
    def expires_ns(self) -> int:
        """The deadline for sending the call's next write, in ns of CLOCK_BOOTTIME."""
        expires_ns = self._due_ns + round((self.expiry + self.drive.least_interval) * 1e9)
        return expires_ns if self.sent else int(min(expires_ns, self._limit_ns))

    @property
    def late_ns(self) -> int:
        """How late this call is now, in ns. The class defines lateness."""
        return int(clock.boottime_ns() - self._due_ns)

    def excuse(self, late_ns: int) -> None:
        """Do not count this time as lateness of the call. The small delays of a long ramp would add up."""
        self._due_ns += late_ns

    @contextmanager
    def step(self, seconds: float) -> Iterator[None]:
        """Within the block, do not count the first `seconds` seconds as lateness of the call."""
        begun_ns = clock.boottime_ns()
        try:
            yield
        finally:
            self._due_ns += min(clock.boottime_ns() - begun_ns, round(seconds * 1e9))

    def look(self) -> AbstractContextManager[None]:
        """Return a `with` block within which one exchange with the drive does not count as lateness."""
        drive = self.drive
        wire = 2 * drive.needed_silence() + MOST_CHARACTERS * drive.settings.character
        return self.step(drive.least_interval + drive.response_timeout + wire)

    def check(self, what: str) -> None:
        """Raise CancelledByStop after a stop, Expired if the first write's deadline has passed."""
        if not self.permit.is_good:
            raise self.cancelled(what)
        if not self.sent and clock.boottime_ns() >= self._limit_ns:
            raise Expired(self.drive.name, what, self.expiry)

    def cancelled(self, what: str) -> CancelledByStop:
        return CancelledByStop(self.drive.name, what, self.permit.latch.why)

    def unsent(self, what: str) -> CancelledByStop | Expired:
        """Return the error for a write that the core did not send."""
        return (
            self.cancelled(what) if not self.permit.is_good else Expired(self.drive.name, what, self.expiry)
        )

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Log a WriteForbidden from the block; on Ctrl-C, add a note on the writes already sent.

        If a signal that stops the drives has cancelled the call, raise the signal's own exception, such as
        KeyboardInterrupt.
        """
        try:
            yield
        except (CancelledByStop, Unconfirmed):
            await_signal()
            raise
        except WriteForbidden as refusal:
            _log.info("refused: %s", refusal)
            raise
        except KeyboardInterrupt as interruption:
            interruption.add_note(f"{self.drive.name}: {self._known()}")
            raise

    def _known(self) -> str:
        if not self.sent:
            return f"the {self.verb or 'write'} was not sent"
        if self.is_confirmed:
            return f"{self.sent} was sent and confirmed, but its effect was not seen"
        return f"{self.sent} may have been sent; its effect is unknown"


# ---- deadlines of writes ----


Limit = Callable[[], float]

MOST_EXPIRY_S = 1e6


_limit: ContextVar[Limit] = ContextVar("multidrop time limit", default=lambda: inf)


def present_limit_ns() -> float:
    """Return the deadline of calls in this context (CLOCK_BOOTTIME, ns); inf if there is none."""
    return _limit.get()()


def check_expiry(expiry: float) -> None:
    if not is_number(expiry) or not 0 < expiry <= MOST_EXPIRY_S:
        raise ValueError(
            f"expiry = {expiry!r} must be a number of seconds above 0, at most {MOST_EXPIRY_S:.0f}"
        )


def _called(limit: Limit) -> float:
    if not callable(limit):
        raise TypeError(f"limit = {limit!r} must be a function that returns a time of CLOCK_MONOTONIC in ns")
    at_ns = limit()
    # NaN becomes 0, a deadline that has passed: no comparison with NaN is true
    return at_ns if at_ns == at_ns else 0


@contextmanager
def written_before(limit: Limit) -> Iterator[None]:
    """Within the block, raise Expired if a call's first write cannot be sent by the time of `limit`.

    `limit` is called at the start of each call. It returns a time in ns on the clock of
    `time.monotonic_ns()`; a time of 0 has always passed. If the computer sleeps within the block, that time
    counts. A verb's later writes expire by the bus's own `expiry`. Stops are always sent.

    A stop cancels each call whose `limit` has already returned. If `limit` returns 0 from the moment when the
    program knows of the stop, later calls send nothing either. Then no write is sent after the stop.

    The block applies to this thread, or to this task and its calls of `asyncio.to_thread`. If `limit` is not
    a function, each call except a stop raises TypeError.
    """
    outer = _limit.get()
    # `boottime_ns` is called first: a pause between the two calls makes the deadline earlier, never later
    slept_ns = clock.boottime_ns() - clock.now_ns()
    token = _limit.set(lambda: min(outer(), _called(limit) + slept_ns))
    try:
        yield
    finally:
        _limit.reset(token)
