"""CommandResult: the result of a command to a drive, as far as it is certain."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

from multidrop.errors import BusError


class CommandOutcome(StrEnum):
    """The outcome of a command; UNKNOWN unless its effect is certain."""

    DONE = "done"
    FAILED = "failed"  # sent, but the drive refused it, or was seen not to do it
    REFUSED = "refused"  # forbidden by the library's rules or the plant's lists; not sent
    NOT_SENT = "not sent"  # it is certain that nothing was sent
    UNKNOWN = "unknown"  # the command may have been carried out
    UNDER_WAY = "under way"  # not over yet: ask again later


class CommandResult(NamedTuple):
    """The result of a command.

    `text` is one sentence for a person. `error` is the library's error if a server's command failed; a verb
    raises its error instead. `held` is the value that the drive holds after a write, as text with its unit.
    """

    outcome: CommandOutcome
    text: str
    error: BusError | ValueError | None = None
    held: str = ""

    @property
    def ok(self) -> bool:
        """True if the command was carried out; for a stop, if the motor was seen to stand."""
        return self.outcome is CommandOutcome.DONE
