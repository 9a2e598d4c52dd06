"""A line is released only while other gateways can claim it, now and immediately afterwards."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from multidrop.fleet.lines import releases
from multidrop.fleet.lines.releases import WAIT_S, Releases
from multidrop.fleet.servers import names
from multidrop.fleet.servers.leaders import Cluster, Replica

FIRST = {names.owner_buckets(line)[0]: line for line in (f"line-{at}" for at in range(30))}  # a line of each
LINES = set(FIRST.values())


class Trial:
    """The releases of a gateway, the buckets with a leader, and the buckets with a silent server."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.led = set(names.OWNERS)
        self.maimed: set[str] = set()
        self.asked: list[str] = []
        self.changes = 0
        self.now_s = 0.0
        nowhere: Any = None
        self.releases = Releases(lambda: nowhere, self.note, lambda: self.now_s)
        monkeypatch.setattr(releases, "known_cluster", self.known_cluster)

    def note(self) -> None:
        self.changes += 1

    async def known_cluster(self, path: Any, bucket: str) -> Cluster:
        self.asked.append(bucket)
        silent = Replica("n3", is_current=bucket not in self.maimed, is_offline=False, active_ns=0)
        return Cluster("n1" if bucket in self.led else "", (silent,))

    def look(self) -> None:
        asyncio.run(self.releases.look())


def test_lines_are_not_released_until_two_buckets_have_a_leader(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = Trial(monkeypatch)
    trial.led = {"own_1"}
    assert trial.releases.due(LINES) == set()
    trial.look()
    assert trial.changes == 1
    assert trial.releases.due(LINES) == set()
    trial.led.add("own_2")
    trial.look()
    assert trial.changes == 2
    assert trial.releases.due(LINES) == {FIRST["own_1"], FIRST["own_2"]}


def test_servers_are_checked_only_while_lines_wait_for_release(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trial = Trial(monkeypatch)
    trial.look()
    assert trial.asked == []
    trial.releases.due(LINES)
    trial.look()
    assert trial.asked == [*names.OWNERS]
    assert trial.releases.due(set()) == set()
    trial.look()
    trial.led.clear()
    assert trial.releases.due(LINES) == set()


def test_lines_are_not_released_while_two_ownership_buckets_do_not_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trial = Trial(monkeypatch)
    trial.maimed = {"own_0", "own_1"}
    trial.releases.due(LINES)
    trial.look()
    assert trial.releases.due(LINES) == set()
    trial.maimed.remove("own_0")
    trial.look()
    assert trial.changes == 2
    assert trial.releases.due(LINES) == LINES - {FIRST["own_1"]}


def test_releases_ignore_a_long_silent_server(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = Trial(monkeypatch)
    trial.maimed = {"own_0", "own_1"}
    trial.releases.due(LINES)
    trial.look()
    trial.now_s = WAIT_S - 1
    trial.look()
    assert trial.releases.due(LINES) == set()
    trial.now_s = WAIT_S
    trial.look()
    assert trial.releases.due(LINES) == LINES
    trial.maimed.clear()  # the server was heard and is silent again, so the wait restarts
    trial.look()
    trial.maimed = {"own_0", "own_1"}
    trial.look()
    assert trial.releases.due(LINES) == set()


def test_a_drained_gateway_waits_only_for_leaders(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = Trial(monkeypatch)
    trial.maimed = set(names.OWNERS)
    trial.led.remove("own_2")
    trial.releases.due(LINES, 0)
    trial.look()
    assert trial.releases.due(LINES, 0) == LINES - {FIRST["own_2"]}
    assert trial.releases.due(LINES) == set()
    trial.led.remove("own_1")
    trial.look()
    assert trial.releases.due(LINES, 0) == set()
