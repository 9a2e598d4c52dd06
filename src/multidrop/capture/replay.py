"""Replay a capture: registers of simulated drives get the captured values, at the captured times."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from multidrop.capture.decoding import Decoding
from multidrop.capture.pcapng import Capture
from multidrop.core import Message, Status
from multidrop.drive.family import Drive
from multidrop.plant.model import Plant
from multidrop.sim import SimulatedDrive

# statuses of rows that state what a register holds
ANSWERED = {str(Status.OK), str(Status.NO_VALUE)}
# statuses of rows without a valid reply; exception replies have other statuses
SILENT = {str(status) for status in Status} - ANSWERED


class CapturedReply(NamedTuple):
    """The captured values of one reply or write. `values` is None if the drive did not reply."""

    after_s: float  # time in s since the capture's first exchange
    values: Mapping[str, float | None] | None


class Replay:
    """The exchanges in a capture, by drive. The replay starts at the first request to a replayed drive.

    `plant` describes the captured lines. If it has only one line, captured lines may have any name. Raises
    CaptureError for an invalid file, and ValueError if the capture has no exchange with a drive of the plant.
    """

    def __init__(self, path: Path | str, plant: Plant) -> None:
        self.start: float | None = None  # time of the first request to a replayed drive
        self._replies: dict[str, list[CapturedReply]] = defaultdict(list)
        with Capture(path) as capture:
            rows = sorted(
                (row for batch in Decoding(capture, plant) for row in batch),
                key=lambda row: (row.time_ns, row.drive),
            )
        for (time_ns, drive), exchange in groupby(rows, key=lambda row: (row.time_ns, row.drive)):
            found = list(exchange)
            values = {row.register: row.value for row in found if row.status in ANSWERED}
            is_silent = found[0].status in SILENT
            reply = CapturedReply((time_ns - rows[0].time_ns) / 1e9, None if is_silent else values)
            self._replies[drive].append(reply)
        names = {polled.drive.name for polled in plant.drives}
        if not self._replies.keys() & names:
            raise ValueError(f"the capture {path} has no exchange with {', '.join(sorted(names))}")

    def drive(self, drive: Drive) -> ReplayedDrive:
        """Return a simulation of this drive with the values captured from the drive of the same name."""
        return ReplayedDrive(drive, self)

    def replies(self, name: str) -> list[CapturedReply]:
        """Return the captured replies of a drive in the order of time."""
        return self._replies.get(name, [])


class ReplayedDrive(SimulatedDrive):
    """A drive with captured values. Each register starts with its first captured value.

    The simulation is silent when the captured drive was silent. It is always silent if the capture has no
    such drive. Registers that were not captured keep their defaults. Replies have the family's response
    delay, not the captured delay.
    """

    def __init__(self, drive: Drive, replay: Replay) -> None:
        super().__init__(drive)
        self._replay = replay
        self._due = deque(replay.replies(drive.name))
        self._is_silent = not self._due
        for reply in reversed(self._due):
            self._store(reply)

    def _store(self, reply: CapturedReply) -> None:
        for name, value in (reply.values or {}).items():
            with suppress(ValueError):  # raised if the family has no raw count for "no value"
                self.memory.set(self.drive.register(name), value)

    def answer(self, request: Message, now: float) -> Message | None:
        if self._replay.start is None:
            self._replay.start = now
        while self._due and self._due[0].after_s <= now - self._replay.start:
            reply = self._due.popleft()
            self._is_silent = reply.values is None
            self._store(reply)
        return None if self._is_silent else super().answer(request, now)
