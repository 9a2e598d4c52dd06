"""A file that grows by whole pieces: each in one write, and none by half."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path


class WholeFile:
    """A new file, in the place of any other at this path. Raises OSError, as do its methods."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self._length = 0
        self._is_torn = False  # a piece was begun and not finished

    def append(self, piece: memoryview) -> None:
        """Give the piece to the system at once; when it does not fit, the file stays as it was.

        So too when a signal's handler raises. What cannot be cut off at once is before the next piece.
        """
        if self._is_torn:
            self._cut()
        self._is_torn = True
        left = piece
        try:
            while left:
                left = left[self._file.write(left) :]
        except BaseException:
            with suppress(OSError, ValueError):
                self._cut()
            raise
        self._length += len(piece)
        self._is_torn = False

    def _cut(self) -> None:
        self._file.truncate(self._length)
        self._file.seek(self._length)
        self._is_torn = False

    def close(self) -> None:
        if self._is_torn and not self._file.closed:
            with suppress(OSError):
                self._cut()
        self._file.close()
