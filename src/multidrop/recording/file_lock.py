"""A lock on a file, which ends with the process that has it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

_CLOSED_IN_CHILDREN = getattr(os, "O_CLOEXEC", 0) or getattr(os, "O_NOINHERIT", 0)


class FileLock:
    """A lock, had from the beginning until `close`; the file stays, because removing it would be a race.

    Raises BlockingIOError while another process has it, and OSError when the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | _CLOSED_IN_CHILDREN, 0o666)
        try:
            _lock(self._file)
        except OSError:
            os.close(self._file)
            raise

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def _lock(file: int) -> None:
    """Lock an open file for this process alone. Raises BlockingIOError while another one has it."""
    if sys.platform != "win32":
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    import msvcrt

    try:
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
    except PermissionError as taken:
        raise BlockingIOError(*taken.args) from taken
