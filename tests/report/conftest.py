"""Recordings for the tests of reports."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from recordings import record, row

from multidrop.polling.batch import Row

if TYPE_CHECKING:
    from multidrop.report import Recording


@pytest.fixture(scope="module")
def ramp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a pump whose speed rises for 100 s. From 30 Hz on, every second value of `fault` is missed."""
    rows = []
    for tick in range(1000):
        second, hz = tick / 10, tick / 20
        damaged = hz >= 30 and tick % 2
        fault = 8 if 400 <= tick < 500 else 0
        rows.append(row(second, "pump", "output_frequency", hz))
        value, status = (None, "bad checksum") if damaged else (fault, "ok")
        rows.append(row(second, "pump", "fault", value, status))
        rows.append(row(second, "fan", "output_current", 5.0, ms=12.0 + tick % 10))
    rows.append(row(100, "fan", "output_current", None, "no reply"))
    return record(tmp_path_factory.mktemp("ramp") / "ramp.arrows", rows)


@pytest.fixture(scope="module")
def look(ramp: Path) -> Recording:
    from multidrop.report import load  # imported here, because matplotlib takes 0.5 s

    return load(ramp)


def drive_plan(silence_ms: float, reply_characters: int, *registers: str) -> dict[str, Any]:
    """Return a drive's entry in a plan. A character takes 1 ms, and a request has 8 characters."""
    block = {"registers": [*registers], "every_ms": None, "request_characters": 8}
    return {
        "exchanges_per_second": 20.0,
        "silence_ms": silence_ms,
        "character_ms": 1.0,
        "response_delay_ms": 5.0,
        "blocks": [block | {"reply_characters": reply_characters}],
    }


@pytest.fixture
def planned() -> dict[str, Any]:
    """Return the plan of a line with a pump and a fan."""
    drives = {
        "pump": drive_plan(4.0, 9, "output_frequency", "fault"),
        "fan": drive_plan(10.0, 7, "output_current"),
    }
    return {"hall-1": {"utilisation": 1.0, "cycle_ms": 70.0, "drives": drives}}


@pytest.fixture
def turns() -> list[Row]:
    """Return rows of two registers of a pump and one of a fan, every 100 ms. Then the fan falls silent."""
    rows = []
    for tick in range(100):
        second = tick / 10
        rows += [row(second, "pump", name, 1.0, ms=14.0) for name in ("output_frequency", "fault")]
        lost = tick >= 50
        rows.append(
            row(second + 0.05, "fan", "output_current", *((None, "no reply") if lost else (1.0,)), ms=13.0)
        )
    return rows
