"""A gateway's command desks, with a simulated drive on a line and a clock that the test sets."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fleets import HandClock

from multidrop import YD1000, Bus
from multidrop.control import commands, read_audit, written_before
from multidrop.fleet.commands.desk import CommandDesk, StopDesk
from multidrop.fleet.commands.held_lines import HeldLines
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.messages import CommandAnswer, CommandOutcome, Offered
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated
from multidrop.supervisor import supervisor

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
    """The command desks of one gateway, which is master of its line while `is_master` is set.

    While `is_guarded` is set, frames of the former master may still arrive.
    """

    def __init__(self, bus: Bus, sim: SimulatedDrive, folder: Path, may: Mapping[str, Any]) -> None:
        self.sim = sim
        self._bus = bus
        self.is_master = True
        self.is_guarded = False
        self.clock = HandClock()
        self.path = folder / "commands.jsonl"
        self.log = FailingLog(self.path)
        self.lines = HeldLines(
            self,
            may_command=lambda line: self.is_master and not self.is_guarded,
            may_stop=lambda line: self.is_master,
        )
        self.desk = CommandDesk("gw-1", "do.gw-1.run", self.lines, self.log, self.clock)
        self.stops = StopDesk("gw-1", self.lines, self.desk.offers, self.log)
        self.may = may
        self.take()

    def bus(self, line: str) -> Bus:
        return self._bus

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
    sim = simulated(YD1000(address=1, name=name))
    audit = folder / "audit.jsonl"
    with Simulator([Wire([sim], unpaced=True)]) as line, Bus(line.wires[0].path, audit=audit) as bus:
        bus.attach(YD1000(address=1, name=name))
        made = Desks(bus, sim, folder, may)
        try:
            with _patiently(patience_s):
                yield made
        finally:
            made.log.close()
