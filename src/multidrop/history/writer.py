"""HistoryWriter: records rows into a folder on its own thread, so that a slow disk cannot delay polling."""

from __future__ import annotations

import importlib.util
import logging
import os
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from multidrop.history.folder import STEM, listing, stored_files
from multidrop.polling.batch import Batch, GatheredRows, gather
from multidrop.recording.format import Metadata
from multidrop.recording.segments import SegmentWriter, outlived, segments_of
from multidrop.transport import clock

MOST_WAITING = 250_000  # limit of rows (12 MB) that wait for a slow disk; further rows are dropped
WRITING_S = 0.4  # time between writes: each write makes a batch, and many small batches slow down queries
TENDING_S = 60.0  # time between removals of old files, in s
HANGING_S = 5.0  # time in s after which a write is reported as too slow
ENDING_S = 10.0  # how long `close` waits for the disk

_log = logging.getLogger("multidrop.history")


class HistoryState(NamedTuple):
    """The state of a HistoryWriter: number of rows written, number lost, and the present problem or None."""

    rows: int
    dropped: int
    trouble: str | None


class HistoryWriter:
    """Records batches into the history in a folder, which is created: `poller.on_batch(writer.take)`.

    A new segment starts every `rotate` s. If duckdb is installed, a process of low priority compacts closed
    segments. Files older than `keep` s are removed. Then the oldest files are removed while all files
    together take more than `most` bytes.

    A full or failing disk does not delay polling. Rows are dropped, `state()` has their number and the
    reason, and writing is tried again each second. Raises ValueError while another process records into the
    folder, OSError if the folder cannot be written, and TypeError for metadata that JSON cannot hold.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        metadata: Metadata,
        *,
        rotate: float = 600.0,
        keep: float | None = None,
        most: int | None = None,
    ) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._keep, self._most = keep, most
        newest = max([listing(self.folder).newest, *self._damaged()])
        self._segments = SegmentWriter(self.folder / STEM, metadata, every=rotate, after=newest)
        self._compactor = Compactor(self.folder)
        self._waiting: list[GatheredRows] = []
        self._waiting_rows = 0
        # for each ended segment: its unwritten rows, and the next segment's metadata
        self._ended: list[tuple[list[GatheredRows], Metadata]] = []
        self._changing = threading.Lock()
        self._dropped = 0
        self._trouble: str | None = None
        self._again_ns = 0
        self._tended_ns: int | None = None
        self._busy_since_ns: int | None = None  # start of the disk access in progress; None: idle
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="multidrop history", daemon=True)
        self._thread.start()

    def _damaged(self) -> list[int]:
        with suppress(OSError):
            return [number for number, _ in segments_of(self.folder / "damaged" / STEM)]
        return []

    def take(self, batch: Batch) -> None:
        """Queue a copy of a batch's rows for the writing thread; drop the rows if the queue is full.

        This takes microseconds, and never raises an error of the disk.
        """
        with self._changing:
            if self._over.is_set() or self._waiting_rows + len(batch) > MOST_WAITING:
                self._dropped += len(batch)
                return
            gather(self._waiting, batch)
            self._waiting_rows += len(batch)

    def begin(self, metadata: Metadata) -> None:
        """Start a new segment with the metadata of a changed plant. Earlier rows stay in the old segment."""
        with self._changing:
            self._ended.append((self._waiting, metadata))
            self._waiting = []

    def state(self) -> HistoryState:
        """Return the numbers of rows written and dropped so far, and the present problem."""
        return HistoryState(self._segments.rows, self._dropped, self._hang() or self._trouble)

    def _hang(self) -> str:
        """Return a sentence about a disk access that takes too long, or "" without one."""
        since_ns = self._busy_since_ns
        seconds = 0.0 if since_ns is None else (clock.now_ns() - since_ns) / 1e9
        return f"the disk has not answered for {seconds:.0f} s" if seconds > HANGING_S else ""

    @property
    def is_alive(self) -> bool:
        """True while the thread that writes the rows runs."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Write the queued rows and end the thread; wait at most 10 s for the disk."""
        self._over.set()
        self._thread.join(ENDING_S)

    # ---- the thread ----

    def _run(self) -> None:
        while not self._over.wait(WRITING_S):
            self._busy_since_ns = clock.now_ns()
            try:
                self._write_waiting()
                self._tend()
            except Exception:  # a bug must not end the recording
                _log.exception("the history's thread continues after an exception")
            self._busy_since_ns = None
        self._write_waiting()
        self._compactor.end()
        with suppress(OSError):
            self._segments.close()

    def _write_waiting(self) -> None:
        with self._changing:
            waiting, self._waiting, self._waiting_rows = self._waiting, [], 0
            ended, self._ended = self._ended, []
        for rows, metadata in ended:
            self._write_all(rows)
            self._rotate(metadata)
        self._write_all(waiting)

    def _write_all(self, waiting: list[GatheredRows]) -> None:
        for gathered in waiting:
            self._write(gathered.batch())

    def _write(self, batch: Batch) -> None:
        if self._trouble and clock.now_ns() < self._again_ns:
            self._drop(batch)
            return
        try:
            self._segments.write(batch)
        except Exception as failure:  # polling must continue
            self._drop(batch)
            self._again_ns = clock.now_ns() + 10**9
            if not self._trouble:
                _log.error("nothing is recorded: %s", failure)
            self._trouble = str(failure)
            self._rotate()
            self._tended_ns = None  # remove old files soon, because that may free space
            return
        if self._trouble:
            _log.warning("rows are recorded again; %d were lost so far", self._dropped)
            self._trouble = None

    def _drop(self, batch: Batch) -> None:
        with self._changing:
            self._dropped += len(batch)

    def _rotate(self, metadata: Metadata | None = None) -> None:
        try:
            self._segments.rotate(metadata)
        except OSError as failure:
            _log.error("a segment could not be closed: %s", failure)

    def _tend(self) -> None:
        """Remove old files, and start the compaction of closed segments."""
        self._compactor.tend(self._segments.open_number)
        now = clock.now_ns()
        if self._tended_ns is not None and now - self._tended_ns < TENDING_S * 1e9:
            return
        self._tended_ns = now
        try:
            for file in outlived(stored_files(self.folder), time.time(), self._keep, self._most):
                if file.number < self._segments.open_number:
                    file.path.unlink(missing_ok=True)
        except OSError as failure:
            _log.error("old files cannot be removed: %s", failure)


class Compactor:
    """Compacts closed segments in a child process. When more segments are closed, starts the next child."""

    PAUSE_S = 60.0  # pause after a failed compaction

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._child: subprocess.Popen[str] | None = None
        self._done = 0  # all segments below this number are compacted
        self._not_before_ns = 0
        self.is_possible = importlib.util.find_spec("duckdb") is not None

    def tend(self, below: int) -> None:
        """Start the compaction of the segments with numbers less than `below`, in a child process.

        Do nothing while the previous process runs. If it has ended, log its errors.
        """
        if self._child and self._child.poll() is not None:
            self._note(self._child)
            self._child = None
        if self._child or not self.is_possible or below <= self._done or clock.now_ns() < self._not_before_ns:
            return
        program = [sys.executable, "-X", "utf8", "-m", "multidrop.history.compact"]
        options: dict[str, Any] = {"stderr": subprocess.PIPE, "encoding": "utf-8", "errors": "replace"}
        try:
            self._child = subprocess.Popen(
                [*program, str(self._folder), "--below", str(below)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                **options,
            )
            self._below = below
        except OSError as failure:
            self._pause(f"cannot be started: {failure}")

    def _note(self, child: subprocess.Popen[str]) -> None:
        said = child.communicate()[1].strip()
        if child.returncode:
            self._pause(f"ended with {child.returncode}: {said.splitlines()[-1] if said else 'no output'}")
            return
        if said:
            _log.warning("%s", said)
        self._done = self._below

    def _pause(self, sentence: str) -> None:
        _log.error("compaction %s; next try in a minute", sentence)
        self._not_before_ns = clock.now_ns() + round(self.PAUSE_S * 1e9)

    def end(self) -> None:
        """Kill the child process, which is safe: compaction can be interrupted at each step."""
        if self._child:
            self._child.kill()
            self._child.communicate()
            self._child = None
