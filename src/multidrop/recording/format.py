"""The base classes of all formats' writers and readers, and the errors that they raise."""

from __future__ import annotations

import json
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any, Self

from multidrop.polling.batch import ArrowTable, Rows, WideRows, schema, shown_span
from multidrop.recording.rows import PhaseColumn, phase_names

Metadata = Mapping[str, Any]
MOST_SHOWN = 16 << 20  # largest file, in bytes, that a repr reads
METADATA_KEY = "multidrop"  # key in an Arrow schema's metadata


class RecordingError(OSError):
    """A recording cannot be written: the disk is full or read-only, or a library is missing.

    `rows` is the number of readable rows that were written before the error.
    """

    def __init__(self, path: Path, reason: str, rows: int = 0) -> None:
        saved = f"; the {rows} rows before that can be read" if rows else ""
        super().__init__(f"{path}: {reason}{saved}")
        self.path = path
        self.reason = reason
        self.rows = rows


@contextmanager
def writing(path: Path, rows: int = 0) -> Iterator[None]:
    """Convert an OSError of the `with` block to a RecordingError with this number of readable rows."""
    try:
        yield
    except RecordingExists:
        raise
    except OSError as failure:
        raise RecordingError(path, f"cannot be written: {failure.strerror or failure}", rows) from failure


class RecordingWriter(ABC):
    """A recording that is being written; leaving the `with` block closes it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows = 0

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.path}: {self.rows} rows>"

    @abstractmethod
    def write(self, batch: Rows) -> None:
        """Append the batch's rows. Raises RecordingError."""

    @abstractmethod
    def close(self) -> None:
        """Finish and close the recording's file. Raises RecordingError."""

    @property
    def files(self) -> tuple[Path, ...]:
        """The paths of all files of the recording."""
        return (self.path,)

    def discard(self) -> None:
        """Close the recording and remove its files."""
        with suppress(OSError):
            self.close()
        for path in filter(Path.is_file, self.files):  # never remove a device or pipe
            with suppress(OSError):
                path.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class AppendingWriter(RecordingWriter):
    """A recording to which each batch is appended with one system call."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with writing(path):
            self._file = AppendFile(path)

    def _append(self, piece: bytes | memoryview) -> None:
        with writing(self.path, self.rows):
            self._file.append(piece)

    def close(self) -> None:
        with writing(self.path, self.rows):
            self._file.close()


_REASONS = {  # defects of a file, by the exception that a library raises for them
    UnicodeDecodeError: "a text is not UTF-8",
    struct.error: "the stated lengths do not match the data",
    RuntimeError: "the stated lengths do not match the data",  # from nanoarrow
}


class RecordingReader(ArrowTable):
    """Reads the rows that a recording had when it was opened. Each iteration starts at the first row.

    Tables of pandas or polars and the table of `wide()` hold all rows in memory. Arrow libraries accept
    the reader itself: `pyarrow.table(reader)`.

    `truncated` is the number of skipped bytes at the end of the file: an incomplete batch, left by a killed
    writer or a full disk.
    """

    metadata: Metadata
    truncated: int

    def __init__(self, path: Path) -> None:
        self.path = path

    @abstractmethod
    def __iter__(self) -> Iterator[Rows]:
        """Yield batches of some thousand rows. Raises ValueError if the file is damaged."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        """Leave the reader as it is: each iteration opens the file, and closes it at its end."""

    def __repr__(self) -> str:
        try:
            size = self.path.stat().st_size
            if size > MOST_SHOWN:
                return f"<recording {self.path}: {size >> 20} MB>"
            rows = [row for batch in self for row in batch]
        except (OSError, ValueError) as failure:
            return f"<recording {self.path}: {failure}>"
        return f"<recording {self.path}: {shown_span(rows)}>"

    def __arrow_c_stream__(self, requested_schema: object = None) -> Any:
        layout = schema()  # raises if nanoarrow is missing
        from nanoarrow.c_array_stream import CArrayStream

        if names := phase_names(self.metadata):
            column = PhaseColumn(names)
            parts = [column.added(rows) for rows in self]
            return CArrayStream.from_c_arrays(parts, column.schema).__arrow_c_stream__()
        return CArrayStream.from_c_arrays([rows.arrow() for rows in self], layout).__arrow_c_stream__()

    def wide(self, *columns: str) -> WideRows:
        """Return a table with a column per `drive.register` (all, or those in `columns`) and a row per time.

        Values share a row only if the same request read them. A register without a value in a row is null:
        see `WideRows`. Raises ValueError for a column that is not in the recording, or if the recording is
        damaged.
        """
        known = [f"{drive}.{register}" for drive, register, _ in described_registers(self.metadata)]
        return WideRows((row for rows in self for row in rows), columns, known)

    def _damaged(self, rows: int, error: Exception | str) -> ValueError:
        """Return a ValueError that describes the damage and states how many rows before it are readable."""
        reason = next((text for kind, text in _REASONS.items() if isinstance(error, kind)), error)
        return ValueError(f"{self.path} is damaged after row {rows}: {reason}")

    def _not_a_recording(self, reason: str, path: Path | None = None) -> ValueError:
        return ValueError(f"{path or self.path} is not a recording: {reason}")

    def _parse_metadata(self, text: bytes, path: Path | None = None) -> Metadata:
        """Parse the metadata of this file, or of the file at `path`. Raises ValueError if it is invalid."""
        try:
            metadata = json.loads(text)
        except ValueError as error:
            raise self._not_a_recording(f"its metadata is not JSON: {error}", path) from error
        except RecursionError as error:
            raise self._not_a_recording("its metadata is nested too deeply", path) from error
        if not isinstance(metadata, dict):
            raise self._not_a_recording("its metadata is not a JSON object", path)
        return metadata


def described_registers(metadata: object) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Yield drive, name and description of each register in the metadata, without invalid entries."""
    for drive, about in tables_in(metadata, "drives"):
        for register, described in tables_in(about, "registers"):
            yield drive, register, described


def tables_in(table: object, key: str) -> list[tuple[str, dict[str, Any]]]:
    """Return the tables in `table[key]` with their names, without invalid entries."""
    found = table.get(key) if isinstance(table, dict) else None
    entries = found.items() if isinstance(found, dict) else ()
    return [(name, entry) for name, entry in entries if isinstance(entry, dict)]


def dump_metadata(metadata: Metadata) -> str:
    """Return the metadata as JSON. Raises TypeError for values that JSON cannot hold."""
    return json.dumps(metadata, ensure_ascii=False)


class RecordingExists(FileExistsError, ValueError):
    """A new recording cannot be created, because a file exists at its path."""


def already_there(path: Path) -> RecordingExists:
    return RecordingExists(f"{path} exists already: name another file, or remove it first")


def new_file(path: Path) -> FileIO:
    """Create and open a file; open an existing device or pipe.

    Raises RecordingExists if the path is an existing file, which may hold months of data, and OSError.
    """
    mode = "wb" if path.exists() and not path.is_file() else "xb"
    try:
        return FileIO(path, mode)
    except FileExistsError:
        raise already_there(path) from None


class AppendFile:
    """A new file to append to. Raises RecordingExists if a file exists at the path; methods raise OSError."""

    def __init__(self, path: Path) -> None:
        self._file = new_file(path)
        self._length = 0
        self._is_truncated = False  # True if the last piece was appended only in part

    def append(self, piece: bytes | memoryview) -> None:
        """Append the whole piece, or nothing.

        After an error, the file is truncated to its former length, at the latest by the next `append`.
        """
        if self._is_truncated:
            self._cut()
        self._is_truncated = True
        written = 0
        try:
            while written < len(piece):
                # Release the view here: a buffer cannot grow while a traceback keeps a view.
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
