"""Is a sample lost or doubled between a poller and the sinks if any of the processes are killed?

Two gateways append known samples, and note which samples their spool reported as stored. Three NATS nodes
forward the samples. One hub stores them in Parquet files, another in PostgreSQL. For some minutes all these
processes are killed (SIGKILL) at random moments, alone or together, and some restart only after seconds. Then
all processes run until every sample is forwarded, and both sinks are compared with the notes. Exits with 1
if a noted sample is missing, or if any sample is stored twice.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import duckdb
from nats_clusters import Cluster, cluster
from postgres_clusters import Postgres, postgres
from spooled import NOON, STEP

from bench.players.fleet_gateway import GAP
from bench.support import tables
from multidrop.fleet.errors import FleetError
from multidrop.fleet.samples.samples_stream import create_stream, last_of, samples_path, subject_of

ROOT = Path(__file__).parents[3]
GATEWAYS = ("gateway-1", "gateway-2")
PATIENCE_S = 300.0  # longest wait after the last kill until every sample is stored

Numbers = dict[str, Counter[int]]  # numbers of stored copies, by gateway and exchange number


class Process:
    """A program that is restarted after each kill."""

    def __init__(self, folder: Path, name: str, *words: str) -> None:
        self._words, self._log = [sys.executable, "-m", *words], folder / f"{name}.log"
        self.start()

    def start(self) -> None:
        with self._log.open("ab") as log:  # cwd=ROOT makes `bench` importable
            self.process = subprocess.Popen(
                self._words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=ROOT
            )

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def is_over(self) -> bool:
        return self.process.poll() is not None

    def check_alive(self) -> None:
        """Raise AssertionError with the end of the program's log if the program ended by itself."""
        assert not self.is_over(), f"it ended by itself: {self._log.read_text()[-1000:]}"


class Chaos:
    """All processes, and the attacks on them."""

    def __init__(self, folder: Path, servers: Cluster, database: Postgres, dice: random.Random) -> None:
        self.folder, self.servers, self.database, self._dice = folder, servers, database, dice
        self.counts: Counter[str] = Counter()
        self.gateways = [self.gateway(name, str(folder / f"{name}.told")) for name in GATEWAYS]
        urls = servers.urls
        every = ("--every", "0.5")
        self.hubs = [
            Process(
                folder, "hub-parquet", "multidrop", "hub", *urls, "--parquet", str(folder / "hub"), *every
            ),
            Process(folder, "hub-postgres", "multidrop", "hub", *urls, "--postgres", database.where, *every),
        ]

    def gateway(self, name: str, told: str) -> Process:
        words = ("bench.players.fleet_gateway", name, str(self.folder / name), told, *self.servers.urls)
        return Process(self.folder, name, *words)

    def await_told(self) -> None:
        """Wait until each gateway has reported stored samples: only reported samples are looked for later."""
        ends = time.monotonic() + PATIENCE_S
        while not all(sum(runs.values()) for runs in told(self.folder).values()):
            for gateway in self.gateways:
                gateway.check_alive()
            assert time.monotonic() < ends, f"a gateway stores nothing: see {self.folder}"
            time.sleep(0.1)

    def round(self) -> None:
        """Make one random attack; then let all processes run for a while."""
        attacks: tuple[tuple[str, Callable[[], None]], ...] = (
            ("gateway", self._gateway),
            ("node", self._node),
            ("all nodes", self._nodes),
            ("hub", self._hub),
            ("PostgreSQL", self._database),
            ("gateway and node", self._pair),
            ("NATS away for seconds", self._outage),
            ("hubs away for seconds", self._absence),
        )
        name, attack = self._dice.choice(attacks)
        attack()
        self.counts[name] += 1
        self._wait(0.2, 6.0)  # often shorter than an election of a NATS leader, which takes 4 to 9 s
        for hub in self.hubs:
            if hub.is_over():  # the hub has ended without an attack
                self.counts["hub ended by itself"] += 1
                hub.start()

    def close(self) -> None:
        for process in (*self.gateways, *self.hubs):
            if not process.is_over():
                process.kill()

    def _wait(self, least: float, most: float) -> None:
        time.sleep(self._dice.uniform(least, most))

    def _gateway(self) -> None:
        victim = self._dice.choice(self.gateways)
        victim.kill()
        victim.start()

    def _hub(self) -> None:
        victim = self._dice.choice(self.hubs)
        victim.kill()
        victim.start()

    def _node(self) -> None:
        victim = self._dice.choice(self.servers.nodes)
        victim.kill()
        self._wait(0.1, 1.5)
        victim.start()

    def _pair(self) -> None:
        self._dice.choice(self.gateways).kill()
        self._node()
        self._start_gateways()

    def _nodes(self) -> None:
        for node in self.servers.nodes:
            node.kill()
        for node in self.servers.nodes:
            node.start()

    def _outage(self) -> None:
        for node in self.servers.nodes:
            node.kill()
        self._wait(3.0, 8.0)
        for node in self.servers.nodes:
            node.start()

    def _absence(self) -> None:
        for hub in self.hubs:
            hub.kill()
        self._wait(3.0, 8.0)
        for hub in self.hubs:
            hub.start()

    def _database(self) -> None:
        self.database.kill()
        self._wait(0.0, 1.0)
        self.database.start()

    def _start_gateways(self) -> None:
        for gateway in self.gateways:
            if gateway.is_over():
                gateway.start()

    def settle(self) -> None:
        """Kill and restart all gateways and hubs; wait until all stored samples have reached the sinks."""
        self.close()
        self.servers.wait()
        self.database.wait()
        self.gateways = [self.gateway(name, "-") for name in GATEWAYS]
        asyncio.run(self._forwarded())
        self.close()
        for at, kind in enumerate(
            (("--parquet", str(self.folder / "hub")), ("--postgres", self.database.where))
        ):
            words = ("multidrop", "hub", *self.servers.urls, *kind, "--once")
            self.hubs[at] = Process(self.folder, f"last-{at}", *words)
            self.hubs[at].process.wait(PATIENCE_S)

    async def _forwarded(self) -> None:
        """Wait until the NATS stream has the newest message of each gateway's spool."""
        ends = time.monotonic() + PATIENCE_S
        async with samples_path(self.servers.urls) as path:
            for name, gateway in zip(GATEWAYS, self.gateways, strict=True):
                stored = [int(file.name[:12]) for file in (self.folder / name).glob("*.arrows")]
                if not stored:  # each run of the gateway was killed before it stored a sample
                    continue
                log = subject_of(name, _log_of(self.folder / name))
                while True:
                    last = None
                    with suppress(FleetError):
                        last = await last_of(path, log)
                    if last and last.sequence >= max(stored):
                        break
                    gateway.check_alive()
                    assert time.monotonic() < ends, f"{name} does not forward: see {self.folder}"
                    await asyncio.sleep(0.1)


def _log_of(folder: Path) -> str:
    return str(json.loads((folder / "spool.json").read_text())["log"])


def told(folder: Path) -> dict[str, dict[int, int]]:
    """Return how many exchanges each run of a gateway has reported as stored.

    The outer key is the gateway's name. The inner key is the number of the run's first exchange.
    """
    found: dict[str, dict[int, int]] = {}
    for name in GATEWAYS:
        runs: dict[int, int] = defaultdict(int)
        path = folder / f"{name}.told"
        for line in path.read_text().splitlines() if path.exists() else ():
            first, count = map(int, line.split())
            runs[first] = max(runs[first], count)
        found[name] = runs
    return found


def in_parquet(folder: Path) -> Numbers:
    query = f"""
        select drive, monotonic_ns // {STEP} as number, count(*), count(distinct register)
        from '{folder}/hub/rows/*.parquet' group by all"""
    found: Numbers = {name: Counter() for name in GATEWAYS}
    for drive, number, rows, registers in duckdb.connect().execute(query).fetchall():
        assert registers == 10
        found[drive.rpartition("-")[0]][number] += rows // 10 if rows % 10 == 0 else 99
    return found


def in_postgres(database: Postgres) -> Numbers:
    query = f"""
        select d.name, (e.time_ns - {NOON}) / {STEP}, count(*), min(array_length(e.values, 1))
        from multidrop.exchanges e join multidrop.drives d on d.id = e.drive group by 1, 2"""
    found: Numbers = {name: Counter() for name in GATEWAYS}
    for drive, number, rows, registers in database.ask(query):
        assert registers == 10
        found[str(drive).rpartition("-")[0]][int(str(number))] += int(str(rows))
    return found


def compare(of: dict[str, dict[int, int]], kept: Numbers) -> tuple[int, int, int, int]:
    """Compare the exchanges that gateways reported as stored with those that a sink has kept.

    Return four counts: exchanges reported; reported but not kept; not kept although a later exchange of the
    same run is kept; and kept more than once.
    """
    missing = holes = 0
    for name, runs in of.items():
        numbers = kept[name]
        for first, count in runs.items():
            missing += sum(number not in numbers for number in range(first, first + count))
            there = [number for number in numbers if first <= number < first + GAP]
            holes += (max(there) + 1 - first - len(there)) if there else 0
    doubled = sum(count > 1 for numbers in kept.values() for count in numbers.values())
    return sum(sum(runs.values()) for runs in of.values()), missing, holes, doubled


@contextmanager
def everything(folder: Path, dice: random.Random) -> Iterator[Chaos]:
    with ExitStack() as stack:
        servers = stack.enter_context(cluster(folder / "nats", 3))
        database = stack.enter_context(postgres())

        async def make() -> None:
            async with samples_path(servers.urls) as path:
                while True:
                    with suppress(FleetError):
                        await create_stream(path, replicas=3)
                        return
                    await asyncio.sleep(0.2)  # the NATS cluster has no leader yet

        asyncio.run(make())
        chaos = Chaos(folder, servers, database, dice)
        stack.callback(chaos.close)
        yield chaos


def run(folder: Path, seconds: float, dice: random.Random) -> int:
    """Attack for `seconds`, compare both sinks with the gateways' reports, and print the results.

    Return the number of exchanges that are lost, missing between others, or doubled.
    """
    with everything(folder, dice) as chaos:
        chaos.await_told()
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            chaos.round()
        chaos.settle()
        of = told(folder)
        rows, wrong = [], 0
        for sink, kept in (("Parquet", in_parquet(folder)), ("PostgreSQL", in_postgres(chaos.database))):
            count, missing, holes, doubled = compare(of, kept)
            rows.append((sink, 10 * count, 10 * missing, 10 * holes, 10 * doubled))
            wrong += missing + holes + doubled
        tables.show(("sink", "samples told", "lost", "in holes", "doubled"), rows)
        kinds = ", ".join(f"{name} {count}" for name, count in sorted(chaos.counts.items()))
        print(f"\n{sum(chaos.counts.values())} attacks: {kinds}")
        print(f"sentences of the hubs about what is missing or doubled: {len(alarms(chaos.folder))}")
        assert all(sum(runs.values()) for runs in of.values()), "a gateway was never told anything"
        return wrong


def alarms(folder: Path) -> list[str]:
    lines = [line for path in sorted(folder.glob("*.log")) for line in path.read_text().splitlines()]
    return [line for line in lines if line.endswith("are missing") or " came again after " in line]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    tables.heading(f"Kills for {arguments.minutes:g} minutes.")
    with TemporaryDirectory(prefix="multidrop-chaos-") as folder:
        return int(run(Path(folder), arguments.minutes * 60, random.Random(arguments.seed)) > 0)


if __name__ == "__main__":
    raise SystemExit(main())
