"""Command drill: kill and suspend processes of a fleet, then check the writes that the drives received.

Each line has one simulated drive and one client, which writes a different setpoint each time. So the drive's
list of writes shows how often each command was executed, independent of any log.
"""

from __future__ import annotations

import asyncio
import json
import random
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from fleet_drills import GATEWAYS, PATIENCE_S, FleetProcesses
from nats_clusters import Cluster, cluster

from multidrop import YD1000
from multidrop.control import CommandOutcome, read_audit
from multidrop.fleet.commands.fleet_commands import FleetCommands
from multidrop.fleet.commands.messages import CommandAnswer, Offered
from multidrop.fleet.errors import FleetError
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated

HIGHEST = 4999  # highest raw setpoint; a drive gets each value once
STOP_EVERY = 20  # every 20th command of a drive is a stop
SENT = (CommandOutcome.DONE, CommandOutcome.FAILED)
UNSENT = (CommandOutcome.NOT_SENT, CommandOutcome.REFUSED)


class CommandRecord(NamedTuple):
    """One command: its raw setpoint (None for a stop), how it was requested, and its reported result."""

    drive: str
    raw: int | None
    way: str
    offered_s: float  # monotonic time in s of the client's request
    told: CommandOutcome
    sent: int  # how often the drive received the command


class Verdict(NamedTuple):
    """Counts from comparing the writes that drives received with the results that clients received."""

    told: Counter[str]
    ways: Counter[str]
    deeds: Counter[str]
    twice: int
    wrongly: int
    unknown_sent: int
    unnoted: int  # commands executed without an entry in a gateway's log
    oldest_s: float  # longest time from an offer until the drive received the write


class UnreliableCommands(FleetCommands):
    """A client whose messages are duplicated and delayed at random, as by a faulty network."""

    def __init__(self, urls: Sequence[str], log: Path, dice: random.Random) -> None:
        super().__init__(urls, by="drill", log=log)
        self._dice = dice
        self.way = "plain"
        self.offered_s = 0.0
        self._copies: set[asyncio.Task[None]] = set()

    async def _do(self, offered: Offered) -> CommandAnswer:
        way = self._dice.choices(("plain", "doubled", "doubled later", "late"), (6, 2, 1, 1))[0]
        self.way, self.offered_s = way, time.monotonic()
        if way == "late":
            await asyncio.sleep(self._dice.uniform(0.8, 1.6))
        if way == "doubled":
            for _ in range(3):
                self._copy(offered, 0.0)
        if way == "doubled later":
            self._copy(offered, self._dice.uniform(0.0, 3.0))
        return await super()._do(offered)

    def _copy(self, offered: Offered, seconds: float) -> None:
        async def send() -> None:
            await asyncio.sleep(seconds)
            with suppress(FleetError):
                await self._path().request(offered.subject, json.dumps({"do": offered.token}).encode())

        task = asyncio.create_task(send())
        self._copies.add(task)
        task.add_done_callback(self._copies.discard)

    async def settle(self) -> None:
        await asyncio.gather(*self._copies)


class CommandDrill(FleetProcesses):
    """A fleet of three gateways and three NATS nodes, and lines with one simulated drive each."""

    def __init__(
        self, folder: Path, nats: Cluster, simulator: Simulator, sims: dict[str, SimulatedDrive]
    ) -> None:
        self.sims = sims
        lines = [
            f'[[line]]\nname = "line-{name}"\nport = "{wire.path}"\n'
            f'[[line.drive]]\nname = "{name}"\nmodel = "yd1000"\naddress = 1\n'
            'poll = ["output_frequency"]\nevery = "1 s"\n'
            for name, wire in zip(sims, simulator.wires, strict=True)
        ]
        listed = ", ".join(f'"{name}.frequency"' for name in sims)
        super().__init__(folder, nats, "\n".join([*lines, f"[fleet.may]\nwrite = [{listed}]\n"]))
        self.start(*GATEWAYS)

    def setpoints(self, drive: str) -> Counter[int]:
        return Counter(one.raw for one in list(self.sims[drive].counters.writes) if one.name == "frequency")

    def stops(self, drive: str) -> int:
        return sum(one.name == "control" for one in list(self.sims[drive].counters.writes))

    def written_s(self, drive: str, raw: int) -> float:
        writes = list(self.sims[drive].counters.writes)
        return next(one.time for one in writes if (one.name, one.raw) == ("frequency", raw))

    async def ask(self, commands: int, seconds: float, seed: int = 1, *, is_attacked: bool = True) -> Verdict:
        """Send `commands` commands in `seconds` s while processes are attacked; return the verdict."""
        dice = random.Random(seed)
        await self.await_masters()
        askers = [self._asker(drive, commands, seconds, dice.random()) for drive in self.sims]
        attack = asyncio.create_task(self._attack(random.Random(seed), is_attacked=is_attacked))
        try:
            asked = [one for some in await asyncio.gather(*askers) for one in some]
        finally:
            attack.cancel()
            deeds = (await asyncio.gather(attack, return_exceptions=True))[0]
        await asyncio.sleep(3.0)  # late messages may arrive in this time
        assert isinstance(deeds, Counter), deeds
        return self._judge(asked, deeds)

    async def await_masters(self) -> None:
        """Wait until each line has a master that answers commands."""
        ends = time.monotonic() + PATIENCE_S
        async with FleetCommands(self.nats.urls, by="drill", log=self.folder / "ready.jsonl") as asker:
            for drive in self.sims:
                while True:
                    found = await asker.preview(asker.request(drive, register="frequency", value=0.01))
                    if isinstance(found, Offered):
                        break
                    assert time.monotonic() < ends, found.text
                    await asyncio.sleep(0.1)

    async def _asker(self, drive: str, commands: int, seconds: float, seed: float) -> list[CommandRecord]:
        dice = random.Random(seed)
        number = -(-commands // len(self.sims))
        assert number < HIGHEST
        found = []
        async with UnreliableCommands(self.nats.urls, self.folder / f"{drive}.asked.jsonl", dice) as asker:
            for raw in range(1, number + 1):
                if raw % STOP_EVERY == 0:
                    found.append(await self._stop(asker, drive))
                else:
                    asker.way = "no offer"
                    answer = await asker.write(drive, "frequency", raw / 100)
                    found.append(CommandRecord(drive, raw, asker.way, asker.offered_s, answer.outcome, 0))
                await asyncio.sleep(dice.uniform(0, 2 * seconds / number))
            await asker.settle()
        return found

    async def _stop(self, asker: FleetCommands, drive: str) -> CommandRecord:
        before = self.stops(drive)
        answer = await asker.stop([drive])
        return CommandRecord(drive, None, "stop", 0.0, answer.outcome, self.stops(drive) - before)

    def _judge(self, asked: Sequence[CommandRecord], deeds: Counter[str]) -> Verdict:
        seen = {drive: self.setpoints(drive) for drive in self.sims}
        noted = {
            (note["drive"], note["what"])
            for path in self.folder.glob("state/multidrop/fleet/*/commands.jsonl")
            for note in read_audit(path)
            if note["step"] == "begun" and "drive" in note
        }
        twice = wrongly = unknown_sent = unnoted = 0
        oldest = 0.0
        for one in asked:
            if one.raw is None:  # the command is a stop, which may be sent repeatedly
                wrongly += (one.told in SENT and not one.sent) or (one.told in UNSENT and bool(one.sent))
                continue
            sent = seen[one.drive][one.raw]
            twice += sent > 1
            wrongly += (one.told in SENT and not sent) or (one.told in UNSENT and bool(sent))
            unknown_sent += one.told is CommandOutcome.UNKNOWN and bool(sent)
            if sent:
                oldest = max(oldest, self.written_s(one.drive, one.raw) - one.offered_s)
                unnoted += (one.drive, f"{one.drive}: frequency = {one.raw / 100:.2f} Hz") not in noted
        told = Counter(("stop: " if one.raw is None else "") + one.told.value for one in asked)
        ways = Counter(one.way for one in asked)
        return Verdict(told, ways, deeds, twice, wrongly, unknown_sent, unnoted, oldest)

    async def _attack(self, dice: random.Random, *, is_attacked: bool) -> Counter[str]:
        done: Counter[str] = Counter()
        deeds: dict[str, Callable[[random.Random], object]] = {
            "gateway killed": self._kill_gateway,
            "gateway stopped": self._stop_gateway,
            "node killed": self._kill_node,
            "node stopped": self._stop_node,
        }
        try:
            while True:
                if is_attacked:
                    [deed] = dice.choices(list(deeds), (4, 4, 1, 1))
                    done[deed] += 1
                    await asyncio.to_thread(deeds[deed], dice)
                await asyncio.sleep(dice.uniform(2.0, 10.0))
                for name, running in self.gateways.items():
                    if running.poll() is not None:
                        self.start(name)
        except asyncio.CancelledError:
            return done

    def _kill_gateway(self, dice: random.Random) -> None:
        self.kill(dice.choice(GATEWAYS))

    def _stop_gateway(self, dice: random.Random) -> None:
        """Suspend a gateway for a random time; if that exceeds its lease, the kernel kills it."""
        seconds = dice.choice((dice.uniform(0.05, 1.5), dice.uniform(0.5, 3.5)))
        self.suspend(dice.choice(GATEWAYS), seconds)

    def _kill_node(self, dice: random.Random) -> None:
        victim = dice.choice(self.nats.nodes)
        victim.kill()
        time.sleep(dice.uniform(0.1, 2.0))
        victim.start()

    def _stop_node(self, dice: random.Random) -> None:
        self.suspend_node(dice.choice(self.nats.nodes), dice.uniform(0.1, 2.0))


@contextmanager
def command_drill(folder: Path, lines: int = 12) -> Iterator[CommandDrill]:
    sims = {f"drive-{at}": simulated(YD1000(address=1, name=f"drive-{at}")) for at in range(lines)}
    wires = [Wire([sim], name=name, port="socket://127.0.0.1:0", unpaced=True) for name, sim in sims.items()]
    with (
        cluster(folder / "nats") as nats,
        Simulator(wires) as simulator,
        closing(CommandDrill(folder, nats, simulator, sims)) as drill,
    ):
        yield drill
