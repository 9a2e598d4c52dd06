"""Call: one call of what may move a motor: until when it may be sent, and what of it was."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

from multidrop.control.outcome import Outcome
from multidrop.core import Permit
from multidrop.drive.family import Drive
from multidrop.errors import Expired, Overtaken
from multidrop.transport.clock import now_ns

FRAMES = 64  # characters that a request and its reply have at most, where they are about one register


class Call:
    """One call of a verb, `verb`, or of a plain write.

    Nothing of it is written once a stop was called, nor when it is late by more than `expiry` seconds.
    It is late by all the time since it began that its own steps do not account for: what a look takes at
    most by the drive's document, and the waits of its script. So a process that was held up sends nothing.
    """

    def __init__(self, drive: Drive, permit: Permit, expiry: float, verb: str = "") -> None:
        self.drive = drive
        self.permit = permit
        self.expiry = expiry
        self.verb = verb
        self.sent = ""  # the latest write that may have left
        self.is_confirmed = False  # that one
        self.unheard: Outcome | None = None  # of that one, if nothing was read of the drive after it
        self._due_ns = now_ns()

    def anew(self) -> Call:
        """The same, as if it was called now; but for stops, which end it as before."""
        return Call(self.drive, self.permit, self.expiry, self.verb)

    @property
    def expires_ns(self) -> int:
        """When it is too late to send anything, by CLOCK_MONOTONIC."""
        return self._due_ns + round(self.expiry * 1e9)

    @contextmanager
    def step(self, seconds: float) -> Iterator[None]:
        """Account for a step that may take so long; what it takes beyond that makes the call late."""
        begun_ns = now_ns()
        try:
            yield
        finally:
            self._due_ns += min(now_ns() - begun_ns, round(seconds * 1e9))

    def look(self) -> AbstractContextManager[None]:
        """Account for one exchange with the drive."""
        drive = self.drive
        wire = 2 * drive.needed_silence() + FRAMES * drive.settings.character
        return self.step(drive.response_timeout + wire)

    def check(self, what: str) -> None:
        """Raise Overtaken once a stop was called."""
        if not self.permit.is_good:
            raise Overtaken(self.drive.name, what, self.permit.latch.why)

    def unsent(self, what: str) -> Overtaken | Expired:
        """Say why the core did not send it."""
        if not self.permit.is_good:
            return Overtaken(self.drive.name, what, self.permit.latch.why)
        return Expired(self.drive.name, what, self.expiry)

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Add what was sent, and what is known of it, to an interruption."""
        try:
            yield
        except KeyboardInterrupt as interruption:
            interruption.add_note(f"{self.drive.name}: {self._known()}")
            raise

    def _known(self) -> str:
        if not self.sent:
            return f"nothing of the {self.verb or 'write'} was sent"
        if self.is_confirmed:
            return f"{self.sent} was sent and confirmed; what came of it was not seen"
        return f"{self.sent} may have been sent, and nothing is known of its effect"
