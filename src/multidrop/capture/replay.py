"""Replay a capture: registers of simulated drives get the captured values, at the captured times."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from multidrop.capture.decoding import Pairing, RegisterLookup, Sniffed, SniffedExchange, data_of, line_of
from multidrop.capture.pcapng import Capture
from multidrop.core import Message, Splitter
from multidrop.drive.family import Drive
from multidrop.plant.model import Plant
from multidrop.sim import SimulatedDrive


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
        lookups: list[RegisterLookup] = []
        pairings: list[tuple[Splitter, Pairing]] = []
        found: list[tuple[RegisterLookup, Sniffed]] = []
        with Capture(path) as capture:
            for _ in capture:
                for name in capture.lines[len(lookups) :]:
                    lookups.append(RegisterLookup(line_of(plant, name)))
                    pairings.append((Splitter(), Pairing()))
                for lookup, (splitter, pairing), stream in zip(
                    lookups, pairings, capture.streams, strict=True
                ):
                    found += [(lookup, one) for one in pairing.pair(splitter.spans(stream))]
        for lookup, (_, pairing) in zip(lookups, pairings, strict=True):
            found += [(lookup, one) for one in pairing.flush()]
        found.sort(key=lambda one: one[1].time_ns)
        for lookup, sniffed in found:
            if isinstance(sniffed, SniffedExchange) and sniffed.request and not sniffed.is_broadcast:
                after_s = (sniffed.time_ns - found[0][1].time_ns) / 1e9
                self._note(lookup, sniffed, sniffed.request, after_s)
        names = {polled.drive.name for polled in plant.drives}
        if not self._replies.keys() & names:
            raise ValueError(f"the capture {path} has no exchange with {', '.join(sorted(names))}")

    def _note(
        self, lookup: RegisterLookup, exchange: SniffedExchange, request: Message, after_s: float
    ) -> None:
        target = lookup.find(exchange.framing, request)
        if exchange.reply is None:
            self._replies[target.drive].append(CapturedReply(after_s, None))
            return
        data = b"" if exchange.reply.exception else data_of(exchange, request)
        values = {
            place.name: place.register.number_in(data, place.at)
            for place in target.places
            if place.register is not None and data
        }
        self._replies[target.drive].append(CapturedReply(after_s, values))

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
