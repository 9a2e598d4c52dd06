"""Call: the deadline and the progress of one call that may move a motor."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from math import inf

from multidrop.control.exit_hook import await_signal
from multidrop.control.outcome import Outcome
from multidrop.core import Permit
from multidrop.drive.family import Drive
from multidrop.errors import CancelledByStop, Expired, Unconfirmed, WriteForbidden
from multidrop.transport import clock

MOST_CHARACTERS = 64  # characters of a request for one register plus its reply, at most

_log = logging.getLogger("multidrop.control")


class Call:
    """One call of the verb `verb`, or of a plain write (`verb` is then empty).

    The call sends no write after a stop was called, nor when it is late by more than `expiry` seconds.
    Lateness is the time since the call, minus the time allowed for its own reads, writes and waits. So
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
        self.is_confirmed = False  # whether the drive confirmed that write
        self.unverified: Outcome | None = None  # outcome of that write, until a later read succeeds
        self.expiry = expiry
        self._due_ns = clock.boottime_ns()
        self._limit_ns = limit_ns

    def restarted(self) -> Call:
        """Return a copy of the call that starts now. Stops since the original call still cancel the copy."""
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
        """Allow `seconds` for the block; only time beyond that makes the call late."""
        begun_ns = clock.boottime_ns()
        try:
            yield
        finally:
            self._due_ns += min(clock.boottime_ns() - begun_ns, round(seconds * 1e9))

    def look(self) -> AbstractContextManager[None]:
        """Return a block like `step` that allows the time of one exchange with the drive."""
        drive = self.drive
        wire = 2 * drive.needed_silence() + MOST_CHARACTERS * drive.settings.character
        return self.step(drive.least_interval + drive.response_timeout + wire)

    def check(self, what: str) -> None:
        """Raise CancelledByStop if a stop was called, Expired if the caller's limit is over."""
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
