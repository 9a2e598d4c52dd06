"""A file that grows by whole pieces: each in one write, and none by half."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path


class WholeFile:
    """A new file, in the place of any other at this path. Raises OSError, as do its methods."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self._length = 0

    def append(self, piece: memoryview) -> None:
        """Give the piece to the system at once; when it does not fit, the file stays as it was."""
        left = piece
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            with suppress(OSError):
                self._file.truncate(self._length)
                self._file.seek(self._length)
            raise
        self._length += len(piece)

    def close(self) -> None:
        self._file.close()
