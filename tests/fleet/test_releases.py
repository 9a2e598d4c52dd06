"""Lines are let go for others only while these can claim them."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from peers import require_module

require_module("nats")

from multidrop.fleet import names, releases  # noqa: E402
from multidrop.fleet.releases import Releases  # noqa: E402

LINES = {names.owner_bucket(line): line for line in (f"line-{at}" for at in range(30))}  # one of each bucket


class Trial:
    """Releases of a gateway, and the buckets that have a leader."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.led = set(names.OWNERS)
        self.asked: list[str] = []
        self.changes = 0
        nowhere: Any = None
        self.releases = Releases(lambda: nowhere, self.note)
        monkeypatch.setattr(releases, "has_leader", self.has_leader)

    def note(self) -> None:
        self.changes += 1

    async def has_leader(self, path: Any, bucket: str) -> bool:
        self.asked.append(bucket)
        return bucket in self.led

    def look(self) -> None:
        asyncio.run(self.releases.look())


def test_a_line_waits_until_its_bucket_is_known_to_have_a_leader(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = Trial(monkeypatch)
    trial.led.remove("own_1")
    lines = set(LINES.values())
    assert trial.releases.due(lines) == set()
    trial.look()
    assert trial.changes == 1
    assert trial.releases.due(lines) == lines - {LINES["own_1"]}
    trial.led = {"own_1"}
    trial.look()
    assert trial.changes == 2
    assert trial.releases.due(lines) == {LINES["own_1"]}


def test_nothing_is_asked_where_no_line_is_to_be_released_and_nothing_is_believed_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trial = Trial(monkeypatch)
    trial.look()
    assert trial.asked == []
    trial.releases.due({LINES["own_2"]})
    trial.look()
    assert trial.asked == ["own_2"]
    trial.releases.due(set())
    trial.look()
    trial.led.clear()
    assert trial.releases.due({LINES["own_2"]}) == set()
