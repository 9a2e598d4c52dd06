"""The files of a history: their names, and the rows they hold."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from multidrop.recording.segments import StoredFile, segments_of

SECOND_NS = 1_000_000_000
TEN_NS = 10 * SECOND_NS
STEM = "rows.arrows"
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_FORM = "%Y%m%dT%H%M%SZ"
_NAME = re.compile(r"(\d{8,})(?:-(\d{8,}))?\.(\d{8}T\d{6}Z)-(\d{8}T\d{6}Z)\.parquet")


class HistoryFile(NamedTuple):
    """A Parquet file: path, first and last segment number, and the time span of its rows, in s UTC."""

    path: Path
    first: int
    last: int
    begin: int
    end: int

    def may_have(self, begin: int, end: int) -> bool:
        """Return True if the file may have rows from `begin` to `end`, in ns."""
        return self.begin * SECOND_NS < end and begin <= self.end * SECOND_NS


def file_name(first: int, last: int, least_ns: int, most_ns: int) -> str:
    """Return the file name for segments `first` to `last` with row times from `least_ns` to `most_ns`."""
    numbers = f"{first:08d}" if first == last else f"{first:08d}-{last:08d}"
    begin, end = least_ns // SECOND_NS, -(-most_ns // SECOND_NS)
    return f"{numbers}.{_text(begin)}-{_text(end)}.parquet"


def _text(second: int) -> str:
    return f"{_EPOCH + timedelta(seconds=second):{_FORM}}"


def _second(text: str) -> int:
    return (datetime.strptime(text, _FORM).replace(tzinfo=UTC) - _EPOCH) // timedelta(seconds=1)


def parquet_files(directory: Path) -> list[HistoryFile]:
    """Return a directory's Parquet files, the oldest first; [] if the directory does not exist."""
    found = []
    with suppress(FileNotFoundError, NotADirectoryError):
        for path in directory.iterdir():
            if match := _NAME.fullmatch(path.name):
                first, last, begin, end = match.groups()
                with suppress(ValueError):  # skip a file without valid dates in its name
                    file = HistoryFile(path, int(first), int(last or first), _second(begin), _second(end))
                    found.append(file)
    return sorted(found, key=lambda file: (file.first, -file.last))


def widest(files: list[HistoryFile]) -> list[HistoryFile]:
    """Return the files in order of segments, without those whose segments are all in another file, too."""
    found: list[HistoryFile] = []
    for file in files:
        if not found or file.first > found[-1].last:
            found.append(file)
    return found


@dataclass(frozen=True)
class Listing:
    """The current files of a history; each row is in exactly one file."""

    segments: dict[int, Path] = field(default_factory=dict)  # segments that are not in `rows`, by number
    rows: dict[int, HistoryFile] = field(default_factory=dict)
    tens: list[HistoryFile] = field(default_factory=list)

    @property
    def newest(self) -> int:
        """The highest segment number; 0 for an empty history."""
        return max([0, *self.segments, *self.rows, *(file.last for file in self.tens)])


def listing(folder: Path) -> Listing:
    """List the files of a history, or of a recording in segments such as run.arrows. Raises OSError if
    neither exists.
    """
    if folder.suffix == ".arrows":
        return Listing(dict(segments_of(folder)))
    # Keep this order of listing: the segments, then `rows/`, then `tens/`. Rule 3 of the package's docstring
    # needs it.
    segments = dict(segments_of(folder / STEM))
    rows = {file.first: file for file in widest(parquet_files(folder / "rows"))}
    tens = widest(parquet_files(folder / "tens"))
    left = {number: path for number, path in segments.items() if number not in rows}
    return Listing(left, rows, tens)


def stored_files(folder: Path) -> list[StoredFile]:
    """Return all files of a history that may be removed when they are too old."""
    found = []
    for directory in (folder, folder / "damaged"):
        with suppress(OSError):
            for number, path in segments_of(directory / STEM):
                about = path.stat()
                found.append(StoredFile(path, number, about.st_mtime, about.st_size))
    for file in (*parquet_files(folder / "rows"), *parquet_files(folder / "tens")):
        with suppress(OSError):
            found.append(StoredFile(file.path, file.last, file.end, file.path.stat().st_size))
    return found
