"""Recordings of triggers: each is a separate file with the rows around one trigger.

`trip.arrows` becomes trip.00000001.arrows, trip.00000002.arrows, and so on.
"""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from multidrop.plant.triggers import TriggerSeries
from multidrop.polling.added_rows import EVENT, TRIGGER
from multidrop.polling.batch import Batch, Rows, copied
from multidrop.recording import open_writer
from multidrop.recording.format import Metadata, RecordingWriter, writing
from multidrop.recording.segments import segments_of

MOST_OPEN = 8  # largest number of recordings at the same time; further triggers are not recorded
LATE_NS = 1_000_000_000  # how long a recording stays open after its end, for rows of slow exchanges

_log = logging.getLogger("multidrop.recording")


class TriggerTime(NamedTuple):
    """The time of a trigger, and the text of its condition."""

    condition: str
    time_ns: int  # UTC
    monotonic_ns: int


class _OpenRecording(NamedTuple):
    """A recording in progress, and the monotonic time at which it ends."""

    writer: RecordingWriter
    end_ns: int


class TriggeredWriter(RecordingWriter):
    """Records from `pre` s before each trigger until `post` s after it.

    `conditions` maps each series that can trigger to the text of its condition. A trigger occurs when the
    series' value changes from 0 to another value. An event of the kind "trigger" is a trigger too. Each file
    has the moment of its trigger in its metadata. File numbers continue after those of existing files. Raises
    RecordingError; `write` also raises ValueError unless the suffix is one of FORMATS.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        metadata: Metadata,
        *,
        pre: float,
        post: float,
        conditions: Mapping[TriggerSeries, str],
    ) -> None:
        super().__init__(Path(path))
        self._metadata, self._conditions = metadata, conditions
        self._pre_ns, self._post_ns = round(pre * 1e9), round(post * 1e9)
        self._before: deque[Batch] = deque()  # the rows of the last `pre` s
        self._was: dict[TriggerSeries, bool] = {}
        self._open: list[_OpenRecording] = []
        self._written: list[Path] = []
        self.dropped = 0  # number of triggers that were not recorded
        self.newest: Path | None = None  # the file that was completed last
        with writing(self.path):
            before = segments_of(self.path, self.path.suffix)
        self._number = max((number for number, _ in before), default=0)

    @property
    def files(self) -> tuple[Path, ...]:
        """The paths of the files that this writer wrote."""
        return tuple(self._written)

    def write(self, batch: Rows) -> None:
        """Record a batch from a poller."""
        assert isinstance(batch, Batch)
        kept = copied(batch)
        # events do not count, because rows that are older than an event may still come after it
        columns = kept.columns()
        times = zip(columns.drive, columns.monotonic_ns, strict=True)
        newest_ns = max((ns for drive, ns in times if columns.drives[drive] != EVENT), default=0)
        for recording in self._open:
            self._append(recording.writer, kept, 0, recording.end_ns)
        self._close_before(newest_ns - LATE_NS)
        self._before.append(kept)
        for moment in self._moments(kept):
            self._begin(moment)
        while (
            self._before and max(self._before[0].columns().monotonic_ns) < newest_ns - self._pre_ns - LATE_NS
        ):
            self._before.popleft()

    def _moments(self, batch: Batch) -> Iterator[TriggerTime]:
        columns = batch.columns()
        for at, register in enumerate(columns.register):
            series = columns.drives[columns.drive[at]], columns.registers[register]
            if series == (EVENT, TRIGGER):
                text = columns.statuses[columns.status[at]]
                yield TriggerTime(text, columns.time[at], columns.monotonic_ns[at])
            elif series in self._conditions and columns.status[at] == 0:
                is_true = bool(columns.value[at])
                if is_true and self._was.get(series) is False:
                    yield TriggerTime(self._conditions[series], columns.time[at], columns.monotonic_ns[at])
                self._was[series] = is_true

    def _begin(self, moment: TriggerTime) -> None:
        if len(self._open) == MOST_OPEN:
            self.dropped += 1
            _log.warning("trigger %s is not recorded: %d recordings are open", moment.condition, MOST_OPEN)
            return
        self._number += 1
        path = self.path.with_name(f"{self.path.stem}.{self._number:08d}{self.path.suffix}")
        about = {
            "condition": moment.condition,
            "time": datetime.fromtimestamp(moment.time_ns / 1e9, UTC).isoformat(),
            "time_ns": moment.time_ns,
            "pre_s": self._pre_ns / 1e9,
            "post_s": self._post_ns / 1e9,
        }
        writer = open_writer(path, {**self._metadata, "trigger": about})
        self._written.append(path)
        recording = _OpenRecording(writer, moment.monotonic_ns + self._post_ns)
        self._open.append(recording)
        for batch in self._before:
            self._append(writer, batch, moment.monotonic_ns - self._pre_ns, recording.end_ns)

    def _append(self, writer: RecordingWriter, batch: Batch, begin_ns: int, end_ns: int) -> None:
        """Write the rows whose requests were sent from `begin_ns` to `end_ns` (monotonic)."""
        times = batch.columns().monotonic_ns
        places = [at for at, time_ns in enumerate(times) if begin_ns <= time_ns <= end_ns]
        if places:
            writer.write(batch if len(places) == len(times) else batch.at(places))
            self.rows += len(places)

    def _close_before(self, time_ns: int) -> None:
        for recording in [one for one in self._open if one.end_ns < time_ns]:
            self._open.remove(recording)
            recording.writer.close()
            self.newest = recording.writer.path

    def close(self) -> None:
        """Close the recordings in progress, even if `post` seconds have not passed since their trigger."""
        with ExitStack() as stack:  # the stack closes all recordings, even if one close fails
            while self._open:
                stack.callback(self._open.pop().writer.close)
