"""A lock on a file, which ends with the process that has it."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path


class FileLock:
    """A lock, had from the beginning until `close`; the file stays, because removing it would be a race.

    Raises BlockingIOError while another process has it, and OSError when the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._file)
            raise

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
