"""Tell of a command that is interrupted what of it was sent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from multidrop.drive.family import Drive
from multidrop.errors import BusError


@contextmanager
def telling_what_was_sent(drive: Drive, command: str) -> Iterator[list[str]]:
    """Add notes to an interruption, also to one that comes while the port is opened or closed.

    The notes are those of the list, which begins with the one that nothing was sent, and the failure under
    which the port was being closed.
    """
    known = [f"{drive.name}: nothing of the {command} was sent"]
    try:
        yield known
    except KeyboardInterrupt as interruption:
        before = interruption.__context__
        for text in [*known, *([str(before)] if isinstance(before, BusError) else [])]:
            interruption.add_note(text)
        raise
