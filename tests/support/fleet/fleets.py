"""Fakes for fleet tests: a bucket in memory, and lines and a mastership that record calls."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

from multidrop.fleet.errors import Conflict, Unsure
from multidrop.fleet.leases.rules import SECOND
from multidrop.fleet.lines.line_keeper import PortLoss
from multidrop.fleet.servers.buckets import Record, WriteAnswers


class HandClock:
    """A clock in ns that the test sets."""

    def __init__(self, now: int = 1000 * SECOND) -> None:
        self.now = now

    def __call__(self) -> int:
        return self.now

    def pass_s(self, seconds: float) -> None:
        self.now += round(seconds * SECOND)


class MemoryBucket:
    """A bucket in memory that compares revisions like the servers, and fails if the test asks for it."""

    def __init__(self, name: str = "lease") -> None:
        self.name = name
        self.records: dict[str, Record] = {}
        self.last = 0
        self.asked = 0  # number of calls of `newest`
        self.is_down = False
        self.loses_answers = False
        self.before_put: Callable[[str], object] = lambda key: None  # called before each put

    async def put(self, key: str, value: Any, revision: int) -> int:
        self.before_put(key)
        if self.is_down:
            raise Unsure("down")
        if self.revision(key) != revision:
            raise Conflict(key)
        self.store(key, value)
        if self.loses_answers:
            raise Unsure("no answer")
        return self.last

    async def put_all(self, records: Sequence[Record]) -> WriteAnswers:
        written = WriteAnswers([], set())
        for record in records:
            try:
                revision = await self.put(record.key, record.value, record.revision)
            except Conflict:
                written.refused.add(record.key)
            except Unsure:
                continue
            else:
                written.stored.append(record._replace(revision=revision))
        return written

    def store(self, key: str, value: Any) -> None:
        self.last += 1
        self.records[key] = Record(key, self.last, value)

    def revision(self, key: str) -> int:
        return self.records[key].revision if key in self.records else 0

    async def get(self, key: str) -> Record:
        if self.is_down:
            raise Unsure("down")
        return self.records.get(key, Record(key, 0, None))

    async def newest(self, keys: Sequence[str]) -> list[Record]:
        if self.is_down:
            raise Unsure("down")
        self.asked += 1
        return [self.records[key] for key in keys if key in self.records]

    async def changes(self, after: int) -> list[Record]:
        if self.is_down:
            raise Unsure("down")
        found = [record for record in self.records.values() if record.revision > after]
        return sorted(found, key=lambda record: record.revision)


class GatedBucket(MemoryBucket):
    """A bucket that, from `shut` until `open`, blocks a put before or after storing the record."""

    def __init__(self, name: str = "lease", *, answers: bool = False) -> None:
        super().__init__(name)
        self.arrived = asyncio.Event()
        self._gate: asyncio.Event | None = None
        self._held: asyncio.Event | None = None
        self._holds_answers = answers

    def shut(self) -> None:
        """Block only the next put."""
        self._gate = asyncio.Event()

    def open(self) -> None:
        assert self._held is not None
        self._held.set()

    async def put(self, key: str, value: Any, revision: int) -> int:
        self._gate, gate = None, self._gate
        if gate is None:
            return await super().put(key, value, revision)
        self._held = gate
        stored = await super().put(key, value, revision) if self._holds_answers else 0
        self.arrived.set()
        await gate.wait()
        return stored or await super().put(key, value, revision)


class RecordingMastership:
    """A fake mastership that records its deadline, and raises the same errors as the engine."""

    def __init__(self, clock: Callable[[], int]) -> None:
        self.clock = clock
        self.until = 0
        self.ends = 0
        self.events: list[str] = []
        self.lines: RecordingLines | None = None

    def extend(self, until_ns: int) -> None:
        assert until_ns > self.clock(), "armed at a time that is past"
        assert until_ns >= self.until, "went backwards"
        self.until = until_ns
        if self.events[-1:] != ["extend"]:
            self.events.append("extend")

    def end(self) -> None:
        assert self.lines is None or not self.lines.taken, (
            "the timer is called off before the lines are closed"
        )
        self.until = 0
        self.ends += 1
        self.events.append("end")

    @property
    def may_send(self) -> bool:
        return self.clock() < self.until


class RecordingLines:
    """The fake lines of one gateway; `hall` records when it takes a line, and any overlap."""

    def __init__(self, name: str, mastership: RecordingMastership, hall: Hall) -> None:
        self.name = name
        self.mastership = mastership
        self.hall = hall
        self.taken: set[str] = set()
        mastership.lines = self

    async def take(self, line: str, description: Any) -> None:
        self.hall.look(line, self)
        self.taken.add(line)
        self.hall.at[line] = asyncio.get_running_loop().time()

    async def let_go(self, line: str) -> None:
        self.mastership.events.append("let go")
        self.taken.discard(line)

    def port_loss(self, line: str) -> PortLoss | None:
        return None


class Hall:
    """All gateways of a fake fleet; records each claim of a line, and whether another gateway may send."""

    def __init__(self) -> None:
        self.gateways: list[RecordingLines] = []
        self.overlaps: list[str] = []
        self.at: dict[str, float] = {}  # s, time of each line's last claim

    def add(self, name: str, mastership: RecordingMastership) -> RecordingLines:
        lines = RecordingLines(name, mastership, self)
        self.gateways.append(lines)
        return lines

    def look(self, line: str, taker: RecordingLines) -> None:
        for other in self.gateways:
            if other is not taker and line in other.taken and other.mastership.may_send:
                self.overlaps.append(f"{line}: {other.name} and {taker.name}")
