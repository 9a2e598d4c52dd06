"""The gateway's historian: settings, rows from polling, and answers to requests."""

from __future__ import annotations

import asyncio
import json
import threading
from math import inf, nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from gateways import serving, simulated_plant
from histories import NOON, SECOND, batch

from multidrop import History, Plant
from multidrop.core.columns import Names
from multidrop.gateway import historian
from multidrop.gateway.historian import MOST_BUCKETS, HistorySettings, as_json, build
from multidrop.gateway.http.exports import Exports
from multidrop.history import Buckets
from multidrop.recording import open_recording

MS = 1_000_000


def test_all_mistakes_of_the_history_table_are_reported_together() -> None:
    with pytest.raises(ValueError, match="invalid time") as failure:
        HistorySettings(keep="for ever", most="20", rotate="0 s")
    lines = str(failure.value).splitlines()
    assert [line.split(" = ")[0] for line in lines] == ["keep", "most", "rotate"]
    assert "invalid time 'for ever': write 1 s to 100 years" in lines[0]
    assert "invalid size '20': write 1 kB or more" in lines[1]
    HistorySettings()


def test_a_folder_that_cannot_be_created_raises_one_sentence(tmp_path: Path) -> None:
    """The test uses /sys, where not even root may create a folder."""
    inside = SimpleNamespace(plant=Plant((), Path("plant.toml")), folder=tmp_path)
    with pytest.raises(OSError, match="folder /sys/history cannot be written: ") as failure:
        build(HistorySettings(folder="/sys/history"), inside)
    assert "Errno" not in str(failure.value)


def test_infinity_and_nan_are_null_in_json() -> None:
    """JSON has no infinity and NaN: with them, a browser could not parse the whole answer."""
    found = as_json(Buckets(0, MS, [1, 2], [0, 0], [-inf, 1.0], [nan, 1.5], [inf, 2.0]))
    assert [found[key] for key in ("least", "mean", "most")] == [[None, 1.0], [None, 1.5], [None, 2.0]]


async def test_large_answers_are_refused_and_made_outside_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stop needs the asyncio loop, and would wait for computations in it."""
    makers: list[int] = []

    def noted(made: Buckets) -> dict[str, Any]:
        makers.append(threading.get_ident())
        return as_json(made)

    monkeypatch.setattr(historian, "as_json", noted)
    inside = SimpleNamespace(plant=Plant((), Path("plant.toml")), folder=tmp_path)
    part = build(HistorySettings(), inside)
    try:
        many = [f"pump-{at}.speed" for at in range(3)]
        found = json.loads(await part.series([*many, *many], 0, 1000, MOST_BUCKETS // 1000))
        assert list(found["series"]) == many
        assert len(makers) == 3
        assert threading.get_ident() not in makers
        with pytest.raises(ValueError, match="3 series of 70000 points: an answer has 200000"):
            await part.series(many, 0, 1000, 70_000)
    finally:
        await part.close()


@pytest.mark.parametrize("kind", ["csv", "parquet"])
async def test_no_export_starts_in_the_loop(tmp_path: Path, kind: str) -> None:
    """Reading the metadata of thousands of files takes seconds."""
    readers: list[int] = []

    class Noted(History):
        def parting_of(self, *of: Any) -> Any:
            readers.append(threading.get_ident())
            return super().parting_of(*of)

    inside = SimpleNamespace(plant=Plant((), Path("plant.toml")), folder=tmp_path)
    part = build(HistorySettings(), inside)
    try:
        part.history = Noted(part.history.folder)
        await Exports().respond(part, [], 0, 1000, kind)
        assert readers
        assert threading.get_ident() not in readers
    finally:
        await part.close()


async def test_unfinished_exports_of_a_killed_process_are_removed(tmp_path: Path) -> None:
    left = tmp_path / "history" / ".export-x1y2"
    left.mkdir(parents=True)
    (left / "export.parquet").write_bytes(b"PAR1")
    inside = SimpleNamespace(plant=Plant((), Path("plant.toml")), folder=tmp_path)
    part = build(HistorySettings(), inside)
    try:
        assert not left.exists()
    finally:
        await part.close()


@pytest.mark.slow
async def test_the_historian_records_and_answers(tmp_path: Path) -> None:
    inside = SimpleNamespace(plant=Plant((), Path("plant.toml")), folder=tmp_path)
    part = build(HistorySettings(folder="kept"), inside)
    running = asyncio.create_task(part.run())
    taken = batch(Names(["pump-1"]), 0, range(100), NOON, SECOND)
    part.take(taken)
    for _ in range(600):
        if part.state.rows:
            break
        await asyncio.sleep(0.1)
    assert part.state == (100, 0, None)
    begin, end = NOON // MS, NOON // MS + 100_000
    found = json.loads(await part.series(["pump-1.speed", "fan.speed"], begin, end, 10))
    assert found["step_ms"] == 10_000
    pump, fan = found["series"]["pump-1.speed"], found["series"]["fan.speed"]
    assert pump["time"] == [begin + 10_000 * number for number in range(10)]
    assert pump["least"] == [10.0 * number for number in range(10)]  # every tenth row is a miss
    assert pump["most"] == [10.0 * number + 8 for number in range(10)]
    assert pump["mean"] == [10.0 * number + 4 for number in range(10)]
    assert fan["mean"] == [None] * 10
    for kind in ("csv", "parquet"):
        path = tmp_path / f"got.{kind}"
        path.write_bytes(b"".join(part.export(["pump-1.speed"], begin, end, kind)))
        assert [row for rows in open_recording(path) for row in rows] == list(taken)
    with pytest.raises(ValueError, match="invalid series"):
        part.export(["pump"], begin, end, "csv")
    with pytest.raises(ValueError, match="neither csv nor parquet"):
        part.export([], begin, end, "xlsx")
    await part.close()
    await asyncio.wait_for(running, 60)
    assert [path.name for path in (tmp_path / "kept").glob("*.arrows")] == ["rows.00000001.arrows"]


@pytest.mark.slow
def test_duckdb_is_loaded_before_the_first_query(tmp_path: Path) -> None:
    pytest.importorskip("duckdb", reason="needs duckdb")
    serve = "[serve]\nlisten = '127.0.0.1:0'\n[serve.history]\n"
    with simulated_plant(tmp_path, serve) as path, serving(path) as (process, _):
        assert "duckdb" in Path(f"/proc/{process.pid}/maps").read_text()
