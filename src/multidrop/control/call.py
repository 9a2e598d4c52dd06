"""Call: one call that may move a motor: until when it may be sent, and what of it was sent."""

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

MOST_CHARACTERS = 64  # of a request and its reply about one register

_log = logging.getLogger("multidrop.control")


class Call:
    """One call of a verb, `verb`, or of a plain write.

    Nothing of it is written once a stop was called, nor when it is late by more than `expiry` seconds.
    Its lateness is the time since it began, less what its own steps may take: its reads and writes, by the
    drive's document, and the waits of its script. So a process that was held up sends nothing, nor does one
    whose machine slept. Its first write is not sent after `limit_ns` either, a time of CLOCK_BOOTTIME.
    """

    def __init__(
        self, drive: Drive, permit: Permit, expiry: float, verb: str = "", limit_ns: float = inf
    ) -> None:
        self.drive = drive
        self.permit = permit
        self.verb = verb
        self.sent = ""  # the latest write that may have left
        self.is_confirmed = False  # that one
        self.unverified: Outcome | None = None  # of that one, if nothing was read of the drive after it
        self.expiry = expiry
        self._due_ns = clock.boottime_ns()
        self._limit_ns = limit_ns

    def anew(self) -> Call:
        """Return the same call, made now. Stops that were called since the first one still end it."""
        return Call(self.drive, self.permit, self.expiry, self.verb, self._limit_ns)

    @property
    def expires_ns(self) -> int:
        """The time of CLOCK_BOOTTIME after which nothing is sent; its drive may be given a rest before."""
        expires_ns = self._due_ns + round((self.expiry + self.drive.least_interval) * 1e9)
        return expires_ns if self.sent else int(min(expires_ns, self._limit_ns))

    @contextmanager
    def step(self, seconds: float) -> Iterator[None]:
        """Account for a step that may take so long; any time beyond that makes the call late."""
        begun_ns = clock.boottime_ns()
        try:
            yield
        finally:
            self._due_ns += min(clock.boottime_ns() - begun_ns, round(seconds * 1e9))

    def look(self) -> AbstractContextManager[None]:
        """Account for one exchange with the drive."""
        drive = self.drive
        wire = 2 * drive.needed_silence() + MOST_CHARACTERS * drive.settings.character
        return self.step(drive.least_interval + drive.response_timeout + wire)

    def check(self, what: str) -> None:
        """Raise CancelledByStop once a stop was called, and Expired where the limit of its caller is over."""
        if not self.permit.is_good:
            raise self.overtaken(what)
        if not self.sent and clock.boottime_ns() >= self._limit_ns:
            raise Expired(self.drive.name, what, self.expiry)

    def overtaken(self, what: str) -> CancelledByStop:
        return CancelledByStop(self.drive.name, what, self.permit.latch.why)

    def unsent(self, what: str) -> CancelledByStop | Expired:
        """Return the reason why the core did not send it."""
        return (
            self.overtaken(what) if not self.permit.is_good else Expired(self.drive.name, what, self.expiry)
        )

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Log a refusal; add what was sent, and what is known of it, to an interruption.

        What a signal's stops ended raises what the signal does, such as KeyboardInterrupt.
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
            return f"nothing of the {self.verb or 'write'} was sent"
        if self.is_confirmed:
            return f"{self.sent} was sent and confirmed; what came of it was not seen"
        return f"{self.sent} may have been sent, and nothing is known of its effect"
