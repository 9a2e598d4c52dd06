"""What the writer and the reader of every format offer, and how they fail."""

from __future__ import annotations

import json
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from multidrop.polling.batch import Rows

Metadata = Mapping[str, Any]


class RecordingError(OSError):
    """A recording cannot be written: the disk is full or read-only, or a library is missing.

    `rows` is how many rows were written before that and can be read.
    """

    def __init__(self, path: Path, reason: str, rows: int = 0) -> None:
        saved = f"; the {rows} rows before that can be read" if rows else ""
        super().__init__(f"{path}: {reason}{saved}")
        self.path = path
        self.reason = reason
        self.rows = rows

    @classmethod
    def of(cls, failure: OSError, path: Path, rows: int = 0) -> RecordingError:
        return cls(path, f"cannot be written: {failure.strerror or failure}", rows)


class RecordingWriter(ABC):
    """A recording that is being written; leaving the `with` block closes it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows = 0

    @abstractmethod
    def write(self, batch: Rows) -> None:
        """Append the batch's rows. Raises RecordingError."""

    @abstractmethod
    def close(self) -> None:
        """Nothing can be written any more. Raises RecordingError."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All that the recording lies in."""
        return (self.path,)

    def discard(self) -> None:
        """Close it, and leave nothing of it."""
        with suppress(OSError):
            self.close()
        for path in filter(Path.is_file, self.files):  # a device is not ours to remove
            with suppress(OSError):
                path.unlink()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class RecordingReader(ABC):
    """A recording as it was when it was opened; may be iterated over more than once.

    `torn` is how many bytes at its end are left out: their writer was killed, or the disk was full,
    before they were whole.
    """

    path: Path
    metadata: Metadata
    torn: int

    @abstractmethod
    def __iter__(self) -> Iterator[Rows]:
        """The rows, some thousands at a time. Raises ValueError where the file is damaged."""


def dump_metadata(metadata: Metadata) -> str:
    """The metadata as it stands in a recording."""
    return json.dumps(metadata, ensure_ascii=False)


def load_metadata(text: str | bytes, path: Path) -> Metadata:
    """Metadata out of a recording; ValueError when it is not what `dump` makes."""
    try:
        metadata = json.loads(text)
    except ValueError as mistake:
        raise not_a_recording(path, f"its metadata is not JSON: {mistake}") from mistake
    except RecursionError as mistake:
        raise not_a_recording(path, "its metadata is nested too deeply") from mistake
    if not isinstance(metadata, dict):
        raise not_a_recording(path, "its metadata is not a JSON object")
    return metadata


_IN_OUR_WORDS = {  # a library's are about its own insides
    UnicodeDecodeError: "its text is not UTF-8",
    struct.error: "its lengths do not fit together",
    RuntimeError: "its lengths do not fit together",  # nanoarrow's
}


def damaged(path: Path, rows: int, mistake: Exception) -> ValueError:
    """What says that so many rows can be read, and why no more."""
    why = next((words for kind, words in _IN_OUR_WORDS.items() if isinstance(mistake, kind)), mistake)
    return ValueError(f"{path} is damaged after row {rows}: {why}")


def not_a_recording(path: Path, why: str) -> ValueError:
    return ValueError(f"{path} is not a recording: {why}")
