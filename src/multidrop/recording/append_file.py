"""A new file that grows by whole pieces: each in one write, none by half."""

from __future__ import annotations

from contextlib import suppress
from io import FileIO
from pathlib import Path


def already_there(path: Path) -> ValueError:
    return ValueError(f"{path} is there already: name another file, or remove it first")


def new_file(path: Path) -> FileIO:
    """Open a file that is not there yet: an existing one may hold months of data.

    A device or a pipe exists and has no data to lose. Raises ValueError and OSError.
    """
    mode = "wb" if path.exists() and not path.is_file() else "xb"
    try:
        return FileIO(path, mode)
    except FileExistsError:
        raise already_there(path) from None


class AppendFile:
    """A new file. Raises ValueError when there is one at this path, and OSError, as do its methods."""

    def __init__(self, path: Path) -> None:
        self._file = new_file(path)
        self._length = 0
        self._is_truncated = False  # a piece was begun and not finished

    def append(self, piece: bytes | memoryview) -> None:
        """Give the piece to the system at once; when it does not fit, the file stays as it was.

        The same holds when a signal handler raises. If the file cannot be cut back at once, that is
        done before the next piece.
        """
        if self._is_truncated:
            self._cut()
        self._is_truncated = True
        written = 0
        try:
            while written < len(piece):
                # Released at once: a view that an exception's traceback keeps forbids its buffer to grow.
                with memoryview(piece)[written:] as left:
                    written += self._file.write(left)
        except BaseException:
            with suppress(OSError, ValueError):
                self._cut()
            raise
        self._length += len(piece)
        self._is_truncated = False

    def _cut(self) -> None:
        self._file.truncate(self._length)
        self._file.seek(self._length)
        self._is_truncated = False

    def close(self) -> None:
        if self._is_truncated and not self._file.closed:
            with suppress(OSError):
                self._cut()
        self._file.close()
