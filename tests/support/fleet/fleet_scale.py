"""A large fleet: gateway state machines in several processes, a real NATS cluster, and fake lines."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from multidrop.fleet.lines.lease import boottime_ns
from multidrop.fleet.lines.member import Member
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import Bucket
from multidrop.fleet.servers.connections import paths_of
from multidrop.fleet.servers.plant_store import store
from multidrop.fleet.servers.setup import open_all, set_up

if TYPE_CHECKING:
    from nats_clusters import Cluster

PATIENCE_S = 240.0


class MemberProcess:
    """A process that runs gateways; records each gateway's number of lines and when it changed last."""

    def __init__(self, urls: Sequence[str], gateways: Sequence[str]) -> None:
        self.gateways = list(gateways)
        self.counts = dict.fromkeys(gateways, 0)
        self.changed_s = 0.0  # time of the last change, CLOCK_MONOTONIC
        self.is_ready = False
        self.polled: dict[str, list[str]] = {}
        command = [sys.executable, __file__, ",".join(urls), *gateways]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for text in self._process.stdout:
            said: dict[str, Any] = json.loads(text)
            if "polled" in said:
                self.polled[said["gateway"]] = said["polled"]
            elif "ready" in said:
                self.is_ready = True
            else:
                self.changed_s = said["at"]
                self.counts[said["gateway"]] = said["lines"]

    def ask(self) -> dict[str, list[str]]:
        """Return the lines that each gateway polls, by gateway name."""
        self.polled = {}
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        until(lambda: len(self.polled) == len(self.gateways), "a process answers")
        return self.polled

    def cpu_s(self) -> float:
        return cpu_s_of(self._process.pid)

    def is_alive(self) -> bool:
        return self._process.poll() is None

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()


def cpu_s_of(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def until(condition: Callable[[], bool], what: str) -> None:
    ends = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < ends, what
        time.sleep(0.02)


class LargeFleet:
    """A fleet whose lines are shared by the gateways of several processes."""

    def __init__(self, nats: Cluster, lines: dict[str, Any]) -> None:
        self.nats = nats
        self.lines = lines
        self.processes: list[MemberProcess] = []
        asyncio.run(self._make())

    async def _make(self) -> None:
        paths = paths_of(self.nats.urls)
        await set_up(paths)
        await store(Bucket(names.PLANT, lambda: paths[0]), self.lines)
        for path in paths:
            await path.close()

    def start(self, *groups: Sequence[str]) -> float:
        """Start a process per group of gateways; return the time when all were ready (CLOCK_MONOTONIC, s)."""
        started = [MemberProcess(self.nats.urls, group) for group in groups]
        self.processes += started
        until(lambda: all(process.is_ready for process in started), "the processes are ready")
        return time.monotonic()

    def cpu_s(self) -> float:
        """Return the total CPU time (s) used by gateways and servers."""
        servers = sum(cpu_s_of(node.process.pid) for node in self.nats.nodes)
        return servers + sum(process.cpu_s() for process in self.processes)

    def polled(self) -> int:
        return sum(sum(process.counts.values()) for process in self.processes)

    def settled(self, since_s: float) -> float:
        """Wait until all lines are polled; return the seconds from `since_s` to the last change."""
        until(lambda: self.polled() == len(self.lines), "all lines are polled")
        return max(process.changed_s for process in self.processes) - since_s

    def kill(self, process: MemberProcess) -> float:
        """Kill a process; return the seconds until other gateways poll all its lines."""
        self.processes.remove(process)
        begun = time.monotonic()
        process.kill()
        return self.settled(begun)

    def check(self) -> None:
        """Wait until each line is polled by exactly one gateway."""
        wanted = sorted(self.lines)

        def found() -> list[str]:
            answers = [process.ask().values() for process in self.processes]
            return sorted(line for gateways in answers for lines in gateways for line in lines)

        until(lambda: found() == wanted, "each line has one gateway")

    def loads(self) -> list[int]:
        return sorted(count for process in self.processes for count in process.counts.values())

    def close(self) -> None:
        for process in self.processes:
            process.kill()


def plant_of_fake_lines(lines: int) -> dict[str, Any]:
    return {f"line-{at}": {"line": {"name": f"line-{at}"}, "files": {}} for at in range(lines)}


@contextmanager
def large_fleet(nats: Cluster, lines: dict[str, Any]) -> Iterator[LargeFleet]:
    """Yield a fleet for this plant, without any gateway yet."""
    with closing(LargeFleet(nats, lines)) as fleet:
        yield fleet


def groups(gateways: int, processes: int) -> list[list[str]]:
    """Return the names of gateways, split evenly among the processes."""
    found = [f"gw-{at:02}" for at in range(gateways)]
    return [found[at::processes] for at in range(processes)]


# ---- the process: gateways' state machines on fake lines; `python fleet_scale.py URLS NAME...` ----


LOOK_S = 0.02


class NoLines:
    """Fake lines that open and close immediately."""

    async def take(self, line: str, description: Any) -> None:
        pass

    async def let_go(self, line: str) -> None:
        pass

    def port_loss(self, line: str) -> None:
        return None


class NoMastership:
    """A fake of the engine's right to send, which raises the same errors."""

    def extend(self, until_ns: int) -> None:
        if until_ns <= boottime_ns():
            raise ValueError("armed at a time that is past")

    def end(self) -> None:
        pass


def report(**what: object) -> None:
    print(json.dumps(what), flush=True)


async def live(urls: list[str], names: list[str]) -> None:
    members = []
    mastership: Any = NoMastership()
    for name in names:
        paths = paths_of(urls)
        await open_all(paths)
        members.append(Member(name, paths, NoLines(), mastership))
    tasks = [asyncio.create_task(member.run()) for member in members]
    asks = asyncio.create_task(answer(members))
    counts = dict.fromkeys(names, 0)
    report(ready=True)
    while not any(task.done() for task in (*tasks, asks)):
        for member in members:
            if counts[member.name] != len(member.polled):
                counts[member.name] = len(member.polled)
                report(gateway=member.name, at=time.monotonic(), lines=counts[member.name])
        await asyncio.sleep(LOOK_S)
    for task in tasks:
        task.cancel()
    for result in await asyncio.gather(*tasks, return_exceptions=True):
        if isinstance(result, Exception):
            raise result


async def answer(members: list[Member]) -> None:
    while await asyncio.to_thread(sys.stdin.readline):
        for member in members:
            report(gateway=member.name, polled=sorted(member.polled), margin_s=member.lease.left_s)


if __name__ == "__main__":
    asyncio.run(live(sys.argv[1].split(","), sys.argv[2:]))
