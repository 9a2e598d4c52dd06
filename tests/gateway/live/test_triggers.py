"""Triggers of the gateway: their conditions, the last moment of each, the settings, and /api/triggers."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from batches import SECOND, UTC_0
from gateways import served, written
from lines import until

from multidrop.core import Names, Status
from multidrop.gateway.live.triggers import Triggers, TriggerSettings, build
from multidrop.polling.added_rows import AddedRow, JoinedColumns
from multidrop.polling.batch import Batch
from multidrop.printable import iso_time

REGISTERS = ("output_current", "output_frequency", "fault", "load")
DRIVES = Names(["pump-1", "pump-2"])
CHANNEL = '[[line.drive.channel]]\nname = "load"\nvalue = "output_current * 2"\nunit = "A"\n'
MISS = None


def rows(*found: tuple[float, str, float | None], drive: int = 0) -> Batch:
    """Return rows of a drive. Each is given as (time in s, register, value or None for a failed read)."""
    made = []
    for at, register, value in found:
        ns, status = round(at * SECOND), 0 if value is not None else int(Status.NO_REPLY)
        code = REGISTERS.index(register)
        made.append(AddedRow(UTC_0 + ns, ns, 0, drive, code, status, value or 0.0))
    return Batch(JoinedColumns(None, made), DRIVES, Names(REGISTERS))


def triggers(folder: Path, conditions: dict[str, str], serve: str = "") -> Triggers:
    context: Any = SimpleNamespace(plant=written(folder, serve))
    return build(TriggerSettings(conditions), context)


def moments(found: Triggers) -> dict[str, float]:
    """Return the time of the last trigger by name, in s."""
    return {name: (one.time_ns - UTC_0) / SECOND for name, one in found.last.items()}


def test_a_trigger_fires_once_when_its_condition_becomes_true(tmp_path: Path) -> None:
    """A condition that is true from the start fires no trigger, and neither does a failed read."""
    found = triggers(tmp_path, {"trip": "pump-1.output_current > 30"})
    seen = []
    for at, value in enumerate((40.0, MISS, 41.0, 20.0, MISS, 21.0, 35.0, MISS, 36.0, 5.0, 50.0)):
        found.take(rows((at, "output_current", value), (at, "output_frequency", 50.0)))
        found.take(rows((at, "output_current", 99.0 * (at % 2)), drive=1))
        seen.append(moments(found).get("trip"))
    assert seen == [None] * 6 + [6.0] * 4 + [10.0]
    (one,) = found.as_answer()
    assert one == {
        "name": "trip",
        "condition": "pump-1.output_current > 30",
        "time": iso_time(UTC_0 // 10**6 + 10_000),
        "from": iso_time(UTC_0 // 10**6 + 5_000),
        "to": iso_time(UTC_0 // 10**6 + 20_000),
        "signals": [{"drive": "pump-1", "register": "output_current"}],
    }


def test_a_fault_of_any_drive_fires_the_trigger_fault(tmp_path: Path) -> None:
    found = triggers(tmp_path, {"any": "fault", "fast": "pump-1.output_frequency > 40"})
    for drive in (0, 1):
        found.take(rows((1, "fault", 0.0), (2, "fault", 0.0), drive=drive))
    found.take(rows((3, "fault", 4.0), drive=1))
    found.take(rows((1, "output_frequency", 0.0), (4, "output_frequency", 50.0)))
    first, second = found.as_answer()
    assert (first["name"], second["name"], second["condition"]) == ("fast", "any", "fault of pump-2")
    assert {"drive": "pump-2", "register": "output_current"} in second["signals"]


def test_a_trigger_condition_uses_values_of_a_computed_channel_in_time_order(tmp_path: Path) -> None:
    """In a batch of rows, those of computed channels follow those of all registers."""
    found = triggers(tmp_path, {"odd": "pump-2.load != pump-2.output_current * 2"}, CHANNEL)
    for times in ((0,), (1, 2, 3)):
        currents = [(at, "output_current", float(at)) for at in times]
        found.take(rows(*currents, *((at, "load", 2.0 * at) for at in times), drive=1))
    assert moments(found) == {}
    found.take(rows((4, "output_current", 4.0), (4, "load", 9.0), drive=1))
    assert moments(found) == {"odd": 4.0}


def test_trigger_conditions_use_the_new_plant_after_a_reload(tmp_path: Path) -> None:
    found = triggers(tmp_path, {"trip": "pump-1.output_current > 30"})
    found.take(rows((1, "output_current", 1.0)))

    async def adopted() -> None:
        found.adopt(written(tmp_path))
        # ignored, because `run` has not yet prepared the conditions for the new plant
        found.take(rows((2, "output_current", 40.0)))
        running = asyncio.create_task(found.run())
        while found._conditions is None:
            await asyncio.sleep(0.001)
        running.cancel()

    asyncio.run(adopted())
    found.take(rows((3, "output_current", 40.0)))
    assert moments(found) == {}
    found.take(rows((4, "output_current", 1.0), (5, "output_current", 40.0)))
    assert moments(found) == {"trip": 5.0}


@pytest.mark.slow
def test_http_returns_the_last_triggers(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    condition = "integral(pump-1.output_current >= 0) > 0.2"
    with served(tmp_path, f'[serve.trigger]\nconditions = {{ trip = "{condition}" }}\n') as gateway:
        until(lambda: gateway.get("/api/triggers").json["triggers"])
        (one,) = gateway.get("/api/triggers").json["triggers"]
        assert (one["name"], one["condition"]) == ("trip", condition)
        assert gateway.get("/health").json["parts"] == {"trigger": "ok"}
    assert f"trigger trip: {condition}" in caplog.text
