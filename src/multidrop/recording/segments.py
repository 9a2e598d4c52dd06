"""Recordings in segments: `run.arrows` becomes run.00000001.arrows, run.00000002.arrows, and so on.

Each is a recording of its own, and crash-safe as any. Numbers only grow, also over restarts: they, and not
the clock, say which is older.
"""

from __future__ import annotations

import os
import re
import time
from contextlib import suppress
from pathlib import Path

from multidrop.polling.batch import Rows
from multidrop.recording.arrows import ArrowsReader, ArrowsWriter
from multidrop.recording.file_lock import FileLock
from multidrop.recording.format import Metadata, RecordingWriter, writing
from multidrop.recording.retention import StoredFile, outlived
from multidrop.transport import clock

MOST_CUT = 1 << 24  # bytes: a longer end is no truncated batch, but damage, and kept for somebody to mend


def segments_of(path: Path) -> list[tuple[int, Path]]:
    """Return the segments of the recording `path` by number, the oldest first."""
    name = re.compile(re.escape(path.stem) + r"\.(\d{8,})\.arrows")
    found = [(name.fullmatch(file.name), file) for file in path.parent.iterdir()]
    return sorted((int(match[1]), file) for match, file in found if match)


class SegmentWriter(RecordingWriter):
    """A recording that begins a new segment `every` s, counted on the monotonic clock.

    A segment is made when its first rows come. Segments that ended more than `keep` s ago are removed, and
    then the oldest while all take more than `most` bytes; never the one that is written. Both are checked
    whenever a segment begins. `after` is a number that all new segments are above. One process records at a
    time. Raises ValueError while another does, or where the name does not end in .arrows, TypeError for
    metadata that JSON cannot hold, and RecordingError.
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
            raise ValueError(f"{path}: a recording in segments has a name that ends in .arrows")
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
        self.number = max([after, *(number for number, _ in before)])  # of the newest segment
        for _, newest in before[-1:]:
            _cut_truncated(newest)
        self._retire()

    @property
    def files(self) -> tuple[Path, ...]:
        """All segments that were written here, and are still kept."""
        return tuple(filter(Path.exists, self._written))

    @property
    def open_number(self) -> int:
        """The number of the segment that is written, or will be: those below it are closed."""
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
        """End this segment: the next rows begin a new one, with other metadata where it is given.

        A segment without rows is removed.
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
    """Cut off what a killed writer left of its last batch: other libraries refuse such a file."""
    with suppress(OSError, ValueError):  # no recording at all: it stays as it is
        truncated = ArrowsReader(path).truncated
        if 0 < truncated <= MOST_CUT:
            os.truncate(path, path.stat().st_size - truncated)
