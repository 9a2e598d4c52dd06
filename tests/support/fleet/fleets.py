"""Fakes for fleet tests: a bucket in memory, lines and a mastership that record calls, and command desks."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import patch

from motors import quick

from multidrop import Bus
from multidrop.control import CommandOutcome, commands, read_audit, written_before
from multidrop.fleet.commands.desk import CommandDesk, StopDesk
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.messages import CommandAnswer, Offered
from multidrop.fleet.commands.offers import HeldLines
from multidrop.fleet.errors import Conflict, OutcomeUnknown
from multidrop.fleet.lines.line_keeper import PortLoss
from multidrop.fleet.lines.rules import SECOND
from multidrop.fleet.servers.buckets import Record, WriteAnswers
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated
from multidrop.supervisor import supervisor


def plant_text(
    name: str = "hall-1", port: str = "socket://127.0.0.1:4001", model: str = "innovert-ibd"
) -> str:
    """Return a plant file with one line, whose drive is polled."""
    return (
        f'[[line]]\nname = "{name}"\nport = "{port}"\n'
        f'[[line.drive]]\nname = "pump-{name}"\nmodel = "{model}"\naddress = 1\npoll = ["output_current"]\n'
    )


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
        self.asked = 0  # how often `newest` was called
        self.is_down = False
        self.loses_answers = False
        self.before_put: Callable[[str], object] = lambda key: None  # called with the key before each put

    async def put(self, key: str, value: Any, revision: int) -> int:
        self.before_put(key)
        if self.is_down:
            raise OutcomeUnknown("down")
        if self.revision(key) != revision:
            raise Conflict(key)
        self.store(key, value)
        if self.loses_answers:
            raise OutcomeUnknown("no answer")
        return self.last

    async def put_all(self, records: Sequence[Record]) -> WriteAnswers:
        written = WriteAnswers([], set())
        for record in records:
            try:
                revision = await self.put(record.key, record.value, record.revision)
            except Conflict:
                written.refused.add(record.key)
            except OutcomeUnknown:
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
            raise OutcomeUnknown("down")
        return self.records.get(key, Record(key, 0, None))

    async def newest(self, keys: Sequence[str]) -> list[Record]:
        if self.is_down:
            raise OutcomeUnknown("down")
        self.asked += 1
        return [self.records[key] for key in keys if key in self.records]

    async def changes(self, after: int) -> list[Record]:
        if self.is_down:
            raise OutcomeUnknown("down")
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
    """A fake of the engine's right to send: it records deadlines and calls, and raises the same errors."""

    def __init__(self, clock: Callable[[], int]) -> None:
        self.clock = clock
        self.until = 0
        self.ends = 0
        self.events: list[str] = []
        self.lines: RecordingLines | None = None

    def extend(self, until_ns: int) -> None:
        if until_ns <= self.clock():  # this process was suspended after the caller read the clock
            raise ValueError("armed at a time that is past")
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
    """The fake lines of one gateway; `hall` records its claims, even of a line that another gateway has."""

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
    """All gateways of a fake fleet; it records claims of lines on which another gateway may still send."""

    def __init__(self) -> None:
        self.gateways: list[RecordingLines] = []
        self.overlaps: list[str] = []
        self.at: dict[str, float] = {}  # time of the last claim (s), by line

    def add(self, name: str, mastership: RecordingMastership) -> RecordingLines:
        lines = RecordingLines(name, mastership, self)
        self.gateways.append(lines)
        return lines

    def look(self, line: str, taker: RecordingLines) -> None:
        for other in self.gateways:
            if other is not taker and line in other.taken and other.mastership.may_send:
                self.overlaps.append(f"{line}: {other.name} and {taker.name}")


# ---- a gateway's command desks, with a simulated drive on a line and a clock that the test sets ----


LINE = "hall-1"
PATIENCE_S = 60.0
MAY = {"write": ["pump.frequency"], "verbs": ["pump.start"]}
_ids = count(1)


class FailingLog(CommandLog):
    """A command log that calls a function of the test before each record, to simulate disk failures."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.before: Any = lambda record: None

    async def note(self, record: Mapping[str, Any]) -> None:
        self.before(record)
        await super().note(record)


class Desks:
    """The objects with which one gateway answers requests for commands to its line's drives.

    The gateway is master of the line while `is_master` is set. While `is_guarded` is set, frames of
    the former master may still arrive.
    """

    def __init__(self, bus: Bus, sim: SimulatedDrive, folder: Path, may: Mapping[str, Any]) -> None:
        self.sim = sim
        self.bus = bus
        self.is_master = True
        self.is_guarded = False
        self.clock = HandClock()
        self.path = folder / "commands.jsonl"
        self.log = FailingLog(self.path)
        self.lines = HeldLines(
            lambda line: bus,
            may_command=lambda line: self.is_master and not self.is_guarded,
            may_stop=lambda line: self.is_master,
        )
        self.desk = CommandDesk("gw-1", "do.gw-1.run", self.lines, self.log, self.clock)
        self.stops = StopDesk("gw-1", self.lines, self.desk.offers, self.log)
        self.may = may
        self.take()

    def take(self) -> None:
        self.lines.open(LINE, {"may": self.may})

    @property
    def writes(self) -> list[tuple[str, int]]:
        """Return the writes that the drive has accepted, as (register name, raw value)."""
        return [(one.name, one.raw) for one in self.sim.counters.writes]

    @property
    def written(self) -> set[str]:
        """Return the names of written registers; a set, because a stop is repeated if its reply is slow."""
        return {name for name, _ in self.writes}

    @property
    def notes(self) -> list[dict[str, Any]]:
        return list(read_audit(self.path)) if self.path.exists() else []

    def ask(self, **what: Any) -> Offered | CommandAnswer | None:
        what = {"id": f"id-{next(_ids)}", "by": "anna", "drive": "pump", **what}
        return self.desk.offer(LINE, json.dumps(what).encode())

    def offered(self, hz: float = 20.0, **what: Any) -> str:
        """Offer a command, by default a setpoint write; return the offer's token."""
        answer = self.ask(**(what or {"register": "frequency", "value": hz}))
        assert isinstance(answer, Offered), answer
        return answer.token

    async def do(self, token: str) -> CommandAnswer:
        answer = await self.desk.do(json.dumps({"do": token}).encode())
        while answer.outcome is CommandOutcome.UNDER_WAY:
            answer = await self.desk.do(json.dumps({"ask": token}).encode())
        return answer

    async def stop(self, **what: Any) -> CommandAnswer | None:
        what = {"id": f"id-{next(_ids)}", "by": "anna", "drives": ["pump"], **what}
        return await self.stop_by(json.dumps(what).encode())

    async def stop_by(self, data: bytes) -> CommandAnswer | None:
        """Pass a stop message to the desk; repeat it until the stop is over; return the answer, or None."""
        answer = await self.stops.stop(LINE, data)
        while answer is not None and answer.outcome is CommandOutcome.UNDER_WAY:
            answer = await self.stops.stop(LINE, data)
        await asyncio.gather(*(one for one in supervisor().started if one.get_name() == "note of a stop"))
        return answer


def _patiently(patience_s: float) -> AbstractContextManager[Any]:
    """Lengthen the library's timeouts for a busy test machine; the desk uses the test's clock."""

    def patient(limit: Callable[[], float]) -> AbstractContextManager[None]:
        return written_before(lambda: (until := limit()) and until + patience_s * 1e9)

    return patch.object(commands, "written_before", patient)


@contextmanager
def desks(
    folder: Path, may: Mapping[str, Any] = MAY, patience_s: float = PATIENCE_S, name: str = "pump"
) -> Iterator[Desks]:
    family = quick("yd1000")
    sim = simulated(family(address=1, name=name))
    audit = folder / "audit.jsonl"
    with Simulator([Wire([sim], unpaced=True)]) as line, Bus(line.wires[0].path, audit=audit) as bus:
        bus.attach(family(address=1, name=name))
        made = Desks(bus, sim, folder, may)
        try:
            with _patiently(patience_s):
                yield made
        finally:
            made.log.close()
