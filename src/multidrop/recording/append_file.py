"""A file that grows by whole pieces: each in one write, and none by half. It is never another's."""

from __future__ import annotations

from contextlib import suppress
from io import FileIO
from pathlib import Path


def already_there(path: Path) -> ValueError:
    return ValueError(f"{path} is there already: name another file, or remove it first")


def new_file(path: Path) -> FileIO:
    """Open a file that is not there yet: what is in another one may be months of data.

    A device or a pipe is there, and has none to lose. Raises ValueError and OSError.
    """
    mode = "wb" if path.exists() and not path.is_file() else "xb"
    try:
        return FileIO(path, mode)
    except FileExistsError:
        raise already_there(path) from None


class WholeFile:
    """A new file. Raises ValueError when there is one at this path, and OSError, as do its methods."""

    def __init__(self, path: Path) -> None:
        self._file = new_file(path)
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
