"""Call: one call that may move a motor, its progress, and its deadline, which `written_before` can set."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from math import inf

from multidrop.control.exit_hook import await_signal
from multidrop.control.outcome import Outcome
from multidrop.core import Permit
from multidrop.drive.family import Drive
from multidrop.errors import CancelledByStop, Expired, Unconfirmed, WriteForbidden
from multidrop.printable import is_number
from multidrop.transport import clock

MOST_CHARACTERS = 64  # longest request for one register plus its reply, in characters

_log = logging.getLogger("multidrop.control")


class Call:
    """One call of the verb `verb`, or of a plain write (`verb` is then empty).

    The call sends no write after a stop was called, or when the call is late by more than `expiry` seconds.
    Lateness is the time since the call, minus the time allowed for the call's own reads, writes and waits. So
    nothing is sent late after the process was suspended or the computer slept. The first write is not sent
    after `limit_ns` (CLOCK_BOOTTIME) either.
    """

    def __init__(
        self, drive: Drive, permit: Permit, expiry: float, verb: str = "", limit_ns: float = inf
    ) -> None:
        self.drive = drive
        self.permit = permit
        self.verb = verb
        self.sent = ""  # the latest write that may have been sent
        self.is_confirmed = False  # whether the drive confirmed the write in `sent`
        self.unverified: Outcome | None = None  # outcome of the write in `sent`, until a later read succeeds
        self.expiry = expiry
        self._due_ns = clock.boottime_ns()
        self._limit_ns = limit_ns

    def restarted(self) -> Call:
        """Return a copy of the call that starts now. A stop called since the original call cancels it too."""
        return Call(self.drive, self.permit, self.expiry, self.verb, self._limit_ns)

    @property
    def expires_ns(self) -> int:
        """The CLOCK_BOOTTIME in ns after which the next write is not sent.

        The time includes the interval that the drive needs between two requests.
        """
        expires_ns = self._due_ns + round((self.expiry + self.drive.least_interval) * 1e9)
        return expires_ns if self.sent else int(min(expires_ns, self._limit_ns))

    @contextmanager
    def step(self, seconds: float) -> Iterator[None]:
        """Within the block, do not count the first `seconds` seconds as lateness of the call."""
        begun_ns = clock.boottime_ns()
        try:
            yield
        finally:
            self._due_ns += min(clock.boottime_ns() - begun_ns, round(seconds * 1e9))

    def look(self) -> AbstractContextManager[None]:
        """Return a `step` block whose time limit is enough for one exchange with the drive."""
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

        If the call was cancelled because a signal stops the drives, raise what the signal raises, such as
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


def _none() -> float:
    return inf


_limit: ContextVar[Limit] = ContextVar("multidrop time limit", default=_none)


def present_limit_ns() -> float:
    """Return the deadline of calls in this context (CLOCK_BOOTTIME, ns); inf if there is none."""
    return _limit.get()()


def check_expiry(expiry: float) -> None:
    """Raise ValueError unless `expiry` is a positive number of seconds."""
    if not is_number(expiry) or not 0 < expiry <= MOST_EXPIRY_S:
        raise ValueError(
            f"expiry = {expiry!r} must be a number of seconds above 0, at most {MOST_EXPIRY_S:.0f}"
        )


def _called(limit: Limit) -> float:
    if not callable(limit):
        raise TypeError(f"limit = {limit!r} must be a function that returns a time of CLOCK_MONOTONIC in ns")
    at_ns = limit()
    return at_ns if at_ns == at_ns else 0  # a deadline of NaN would never pass: 0 has always passed


@contextmanager
def written_before(limit: Limit) -> Iterator[None]:
    """Within the block, raise Expired if a call's first write cannot be sent by the time of `limit`.

    `limit` is called at the start of each call. It returns a time in ns on the clock of
    `time.monotonic_ns()`; a time of 0 has always passed. A stop that is called after `limit` returned cancels
    the call. So no write is sent after a stop if `limit` returns 0 as soon as the program knows of that stop.
    Time that the computer sleeps within the block counts. A verb's later writes expire by the bus's own
    `expiry`. Stops are always sent.

    The block applies to this thread, or to this task and its calls of `asyncio.to_thread`. If `limit` is not
    a function, each call except a stop raises TypeError.
    """
    outer = _limit.get()
    # boot time is read first: a pause between the two reads cannot make the difference too large
    slept_ns = clock.boottime_ns() - clock.now_ns()
    token = _limit.set(lambda: min(outer(), _called(limit) + slept_ns))
    try:
        yield
    finally:
        _limit.reset(token)
