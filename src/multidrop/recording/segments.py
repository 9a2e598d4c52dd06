"""Recordings in segments: `run.arrows` becomes run.00000001.arrows, run.00000002.arrows, and so on.

Each segment is a complete recording, as crash-safe as any other. Segment numbers only grow, also across
restarts. So a segment with a lower number is older, even if the clock was set back.
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from multidrop.polling.batch import Rows
from multidrop.recording.arrows import ArrowsReader, ArrowsWriter
from multidrop.recording.format import Metadata, RecordingWriter, writing
from multidrop.transport import clock

MOST_CUT = 1 << 24  # length, in bytes, of the longest incomplete batch that is removed from a file's end


def segments_of(path: Path, suffix: str = ".arrows") -> list[tuple[int, Path]]:
    """Return the number and the path of each segment of the recording `path`, the oldest first."""
    name = re.compile(re.escape(path.stem) + r"\.(\d{8,})" + re.escape(suffix))
    found = [(name.fullmatch(file.name), file) for file in path.parent.iterdir()]
    return sorted((int(match[1]), file) for match, file in found if match)


class SegmentWriter(RecordingWriter):
    """A recording that starts a new segment file every `every` seconds (monotonic clock).

    A segment's file is created with its first rows. Whenever a segment starts, segments that ended more than
    `keep` s ago are removed. Then the oldest segments are removed while all segments together take more than
    `most` bytes. The segment in progress is never removed. The numbers of new segments are greater than
    `after`. Raises ValueError if another process records this recording or the name does not end in .arrows,
    TypeError for metadata that JSON cannot hold, and RecordingError.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        metadata: Metadata,
        *,
        every: float,
        keep: float | None = None,
        most: int | None = None,
        after: int = 0,
    ) -> None:
        super().__init__(Path(path))
        if self.path.suffix != ".arrows":
            raise ValueError(f"{path}: the name of a recording in segments must end in .arrows")
        self._metadata, self._every_ns, self._keep, self._most = metadata, round(every * 1e9), keep, most
        self._segment: ArrowsWriter | None = None
        self._begun_ns = 0
        self._written: list[Path] = []
        with writing(self.path):
            try:
                self._lock = FileLock(self.path.with_name(f".{self.path.stem}.lock"))
            except BlockingIOError:
                raise ValueError(f"{self.path} is being recorded by another process") from None
            before = segments_of(self.path)
        self.number = max([after, *(number for number, _ in before)])  # the highest segment number so far
        for _, newest in before[-1:]:
            _cut_truncated(newest)
        self._retire()

    @property
    def files(self) -> tuple[Path, ...]:
        """The paths of the segments that this writer wrote and that still exist."""
        return tuple(filter(Path.exists, self._written))

    @property
    def open_number(self) -> int:
        """Number of the open segment, or else of the next one. Segments with lower numbers are closed."""
        return self.number if self._segment else self.number + 1

    def write(self, batch: Rows) -> None:
        if self._segment and clock.now_ns() - self._begun_ns >= self._every_ns:
            self.rotate()
        if not self._segment:
            self._begin()
        if self._segment:
            self._segment.write(batch)
            self.rows += len(batch)

    def rotate(self, metadata: Metadata | None = None) -> None:
        """Close the open segment, or remove it if it has no rows. The next rows start a new segment.

        The new segment has this metadata, or by default the metadata of the last segment.
        """
        segment, self._segment = self._segment, None
        self._metadata = self._metadata if metadata is None else metadata
        if segment and segment.rows:
            segment.close()
        elif segment:
            segment.discard()

    def close(self) -> None:
        try:
            self.rotate()
        finally:
            self._lock.close()

    def _begin(self) -> None:
        self.number += 1
        path = self.path.with_name(f"{self.path.stem}.{self.number:08d}.arrows")
        self._segment = ArrowsWriter(path, self._metadata)
        self._begun_ns = clock.now_ns()
        self._written.append(path)
        self._retire()

    def _retire(self) -> None:
        if self._keep is None and self._most is None:
            return
        stored = []
        for number, path in segments_of(self.path):
            with suppress(OSError):
                about = path.stat()
                stored.append(StoredFile(path, number, about.st_mtime, about.st_size))
        for file in outlived(stored, time.time(), self._keep, self._most):
            if self._segment is None or file.path != self._segment.path:
                with suppress(OSError):
                    file.path.unlink()
        self._written = list(self.files)


def _cut_truncated(path: Path) -> None:
    """Remove the incomplete batch of a killed writer from the file's end: other libraries cannot read it."""
    with suppress(OSError, ValueError):  # a file that is not a recording is kept
        truncated = ArrowsReader(path).truncated
        if 0 < truncated <= MOST_CUT:
            os.truncate(path, path.stat().st_size - truncated)


AGES = {"s": 1.0, "min": 60.0, "h": 3600.0, "day": 86400.0, "week": 604800.0}  # length in s, by unit
SIZES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}  # size in bytes, by unit


class StoredFile(NamedTuple):
    """A file that holds one or more segments of a recording."""

    path: Path
    number: int  # number of the newest segment in the file
    end: float  # time of the file's newest row, in s since 1970
    size: int  # in bytes


def outlived(
    files: Iterable[StoredFile], now: float, keep: float | None, most: int | None
) -> list[StoredFile]:
    """Return the files to remove: files older than `keep` s, and then the oldest until `most` bytes are left.

    `now` is in s since 1970. None for `keep` or `most` means unlimited. A file with a lower number is older,
    even if the clock was set back.

    A file's age is the time from its newest row to `now`. The time between the newest rows of two successive
    files does not count if it is longer than `keep`. So a clock jump or a pause in recording cannot remove
    every file.
    """
    in_order = sorted(files, key=lambda file: file.number)
    ages = {} if keep is None else _ages(in_order, now, keep)
    gone = [file for file in in_order if keep is not None and ages[file.number] > keep]
    left = [file for file in in_order if file not in gone]
    total = sum(file.size for file in left)
    for file in left:
        if most is None or total <= most:
            break
        gone.append(file)
        total -= file.size
    return gone


def _ages(files: Iterable[StoredFile], now: float, longest: float) -> dict[int, float]:
    """Return each file's age in s, by file number.

    A file's age is the sum of the times from its end to the end of the next file, and so on until now. The
    sum leaves out times longer than `longest` s: a pause in recording, or a change of the clock.
    """
    ends: dict[int, float] = {}
    for file in files:
        # If a segment is in two files, use the earlier end, because a copy may have a later time.
        ends[file.number] = min(file.end, ends.get(file.number, file.end))
    ages, age, later = {}, 0.0, now
    for number in sorted(ends, reverse=True):
        step = later - ends[number]
        if 0.0 < step <= longest:
            age += step
        ages[number], later = age, min(later, ends[number])
    return ages


def parse_age(text: str) -> float:
    """Return the seconds in an age such as "30 days". Raises ValueError for other texts."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(?:(s|min|h)|(day|week)s?)", str(text).strip(), re.ASCII)
    seconds = float(match[1]) * AGES[match[2] or match[3]] if match else 0.0
    if not 1.0 <= seconds <= 36525 * AGES["day"]:
        raise ValueError(
            f'invalid time {text!r}: write 1 s to 100 years, such as "10 min", "1 h" or "30 days"'
        )
    return seconds


def parse_size(text: str) -> int:
    """Return the bytes in a size such as "20 GB". Raises ValueError for other texts."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(kB|MB|GB|TB)", str(text).strip(), re.ASCII)
    size = round(float(match[1]) * SIZES[match[2]]) if match else 0
    if not SIZES["kB"] <= size <= 10**18:
        raise ValueError(f'invalid size {text!r}: write 1 kB or more, such as "500 MB" or "20 GB"')
    return size


_CLOSED_IN_CHILDREN = getattr(os, "O_CLOEXEC", 0) or getattr(os, "O_NOINHERIT", 0)


class FileLock:
    """A file lock, held until `close` or the end of the process.

    The file is never removed: a process that just opened it would lock a removed file.

    Raises BlockingIOError while another process holds the lock, and OSError if the file cannot be created.
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
    """Lock an open file. Raises BlockingIOError while another process holds the lock."""
    if sys.platform != "win32":
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    import msvcrt

    try:
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
    except PermissionError as taken:
        raise BlockingIOError(*taken.args) from taken
