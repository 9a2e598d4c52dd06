"""Run several gateways' state machines on fake lines.

    python member_process.py URLS NAME...

Each output line is JSON. When a gateway's number of lines changes: {"gateway": ..., "at": CLOCK_MONOTONIC in
s, "lines": number}. For each input line, of every gateway: {"gateway": ..., "polled": [...]}.
"""

from __future__ import annotations

import asyncio
import json
import sys
from time import monotonic
from typing import Any

from multidrop.fleet.leases.lease import boottime_ns
from multidrop.fleet.leases.member import Member
from multidrop.fleet.servers.connections import paths_of
from multidrop.fleet.servers.setup import open_all

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
    """A fake mastership that raises the same errors as the engine."""

    def extend(self, until_ns: int) -> None:
        if until_ns <= boottime_ns():
            raise ValueError("armed at a time that is past")

    def end(self) -> None:
        pass


def report(**what: object) -> None:
    print(json.dumps(what), flush=True)


async def live(urls: list[str], names: list[str]) -> None:
    members = []
    for name in names:
        paths = paths_of(urls)
        await open_all(paths)
        members.append(Member(name, paths, NoLines(), NoMastership()))
    tasks = [asyncio.create_task(member.run()) for member in members]
    asks = asyncio.create_task(answer(members))
    counts = dict.fromkeys(names, 0)
    report(ready=True)
    while not any(task.done() for task in (*tasks, asks)):
        for member in members:
            if counts[member.name] != len(member.polled):
                counts[member.name] = len(member.polled)
                report(gateway=member.name, at=monotonic(), lines=counts[member.name])
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
