"""Statistics of the last hour, from few stored readings."""

from __future__ import annotations

import weakref
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from gateways import written

from multidrop.core import Counters, Status
from multidrop.gateway.live.hub import Hub
from multidrop.gateway.live.recent_statistics import MINUTES, RecentStatistics
from multidrop.gateway.live.views import line_views
from multidrop.gateway.metrics import plant_families
from multidrop.transport.statistics import LineStatistics, line_statistics

MINUTE_MS = 60_000


def reading(seconds: int, *, per_s: int = 10) -> LineStatistics:
    """Return a line's statistics after `seconds` of samples, with a miss every 30 s."""
    missed = Counter({int(Status.NO_REPLY): seconds // 30})
    counters = Counters()._replace(values=seconds * per_s, sent=seconds * per_s, missed=missed)
    return line_statistics(float(seconds), {"pump-1": counters}, None)


@pytest.fixture
def recent(tmp_path: Path) -> RecentStatistics:
    return RecentStatistics(written(tmp_path))


@pytest.mark.slow
def test_hour_has_60_minutes_of_figures_but_few_readings_are_stored(recent: RecentStatistics) -> None:
    alive: list[weakref.ref[LineStatistics]] = []
    for second in range(0, 70 * 60 + 31, 5):
        found = reading(second)
        alive.append(weakref.ref(found))
        recent.tick(float(second), second * 1000, {"hall": found})
    del found
    hour = recent.hour("hall")
    assert len(hour) == MINUTES
    assert [one["time"] for one in hour] == [minute * MINUTE_MS for minute in range(11, 71)]
    assert all(one["asked"] == 602 and one["misses"] == {"no reply": 2} for one in hour[:-1])
    assert hour[-1] == {"time": 70 * MINUTE_MS, "asked": 301, "misses": {"no reply": 1}}
    assert sum(one() is not None for one in alive) < 10
    assert recent.hour("roof") == []


def test_line_figures_cover_the_last_seconds(recent: RecentStatistics) -> None:
    for second in range(200):
        recent.tick(float(second), second * 1000, {"hall": reading(second)})
        if second == 100:
            assert recent.line("hall")["misses"] == 3
    assert recent.line("hall")["rate"] == 10.0
    assert recent.drive_figures("pump-1")["missed"] == pytest.approx(2 / 600, abs=1e-3)
    assert recent.line("roof")["rate"] is None


def test_figures_without_replies_are_none_not_zero(recent: RecentStatistics, tmp_path: Path) -> None:
    assert recent.line("hall")["misses"] is None
    for second in range(100):
        recent.tick(float(second), second * 1000, {"hall": reading(second)})  # without any reply
    assert recent.line("hall")["p99"] is None
    plant = written(tmp_path)
    gateway: Any = SimpleNamespace(plant=plant, hub=Hub(plant), recent=recent)
    drive = line_views(gateway)["hall"]["drives"]["pump-1"]
    assert (drive["p50"], drive["p99"]) == (None, None)
    families = plant_families(gateway.hub, recent.newest)
    (delays,) = [one for one in families if one.name == "multidrop_response_delay_seconds"]
    assert delays.samples == [("_count", {"line": "hall", "drive": "pump-1"}, 0.0)]


def test_a_reopened_line_has_figures_from_its_second_reading(recent: RecentStatistics) -> None:
    recent.tick(100.0, 100_000, {"hall": replace(reading(100), epoch=1)})
    recent.tick(101.0, 101_000, {"hall": replace(reading(1), epoch=2)})
    assert (recent.line("hall")["rate"], recent.line("hall")["used"]) == (None, None)
    recent.tick(106.0, 106_000, {"hall": replace(reading(6), epoch=2)})
    assert recent.line("hall")["rate"] == 10.0


def test_a_removed_drive_never_makes_a_rate_negative(recent: RecentStatistics) -> None:
    recent.tick(100.0, 100_000, {"hall": reading(100)})
    recent.tick(101.0, 101_000, {"hall": replace(reading(1), seconds=101.0)})
    assert recent.line("hall")["rate"] == 0.0
