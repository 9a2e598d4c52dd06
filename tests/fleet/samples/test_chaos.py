"""Kills of every process between a poller and the sinks: no reported sample is lost or duplicated."""

from __future__ import annotations

import importlib
import random
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from peers import require_module

ROOT = Path(__file__).parents[3]


@pytest.fixture
def chaos(monkeypatch: pytest.MonkeyPatch) -> Any:
    require_module("duckdb")
    monkeypatch.syspath_prepend(str(ROOT))
    return importlib.import_module("bench.questions.fleet_chaos")


def test_lost_and_duplicated_rows_are_found(chaos: Any) -> None:
    told = {"gateway-1": {0: 4, 1_000_000: 2}, "gateway-2": {0: 3}}
    whole = {
        "gateway-1": Counter([0, 1, 2, 3, 4, 5, 1_000_000, 1_000_001]),  # two more rows than reported
        "gateway-2": Counter([0, 1, 2]),
    }
    assert chaos.compare(told, whole) == (9, 0, 0, 0)
    lost = {**whole, "gateway-2": Counter([0, 1])}
    assert chaos.compare(told, lost) == (9, 1, 0, 0)
    hole = {**whole, "gateway-1": Counter([0, 1, 2, 3, 5, 1_000_000, 1_000_001])}
    assert chaos.compare(told, hole) == (9, 0, 1, 0)
    doubled = {**whole, "gateway-2": Counter([0, 1, 1, 2])}
    assert chaos.compare(told, doubled) == (9, 0, 0, 1)


@pytest.mark.long
@pytest.mark.slow
def test_no_sample_is_lost_during_half_a_minute_of_kills(chaos: Any, tmp_path: Path) -> None:
    wrong = chaos.run(tmp_path, 25.0, random.Random(2))
    print(*(f"{path.name}: {path.read_text()[-2000:]}" for path in tmp_path.glob("*.log")), sep="\n")
    assert wrong == 0
    assert chaos.alarms(tmp_path) == []
