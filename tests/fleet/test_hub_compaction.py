"""Compaction of a hub's files: readers get each row exactly once before, during and after it."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from peers import require_module
from spooled import NOON, STEP, exchanges_in, numbered

from multidrop import History
from multidrop.fleet.samples.hub import Commit, KeptPlace
from multidrop.fleet.samples.message import RowBuffer, unpack
from multidrop.fleet.samples.parquet_sink import ParquetSink, compact_for_ever
from multidrop.history import compact as compact_module
from multidrop.history.compact import main as compact

HOUR = 360_000  # exchanges in an hour, one every STEP
FILES, EXCHANGES = 12, 10  # four files per hour


@pytest.fixture
def sink(tmp_path: Path) -> Iterator[ParquetSink]:
    require_module("duckdb")
    made = ParquetSink(tmp_path)
    yield made
    made.close()


def first_of(file: int) -> int:
    return file // 4 * HOUR + file % 4 * EXCHANGES


def write(sink: ParquetSink, files: range) -> None:
    """Write these files, with two messages each."""
    for file in files:
        buffer = RowBuffer()
        assert buffer.add(numbered(first_of(file), EXCHANGES).columns())
        tables = [unpack(message.data) for message in buffer.messages()]
        last = 2 * file + 2
        sink.write(Commit("made", last - 1, last, {"a.x": last}, tables, 10 * EXCHANGES))


def check(folder: Path, files: int) -> None:
    with History(folder) as history:
        rows = sorted(tuple(row) for batch in history.read() for row in batch)
        end = NOON + (files // 4 + 1) * HOUR * STEP
        found = history.buckets("pump-2.value_3", NOON, end, points=10)["pump-2.value_3"]
    wanted = [number for file in range(files) for number in range(first_of(file), first_of(file) + EXCHANGES)]
    assert exchanges_in(rows) == wanted
    of = [row for row in rows if row[3:5] == ("pump-2", "value_3")]
    assert sum(found.n) + sum(found.missed) == len(of)
    assert sum(found.n) == sum(row[5] is not None for row in of)


def names(folder: Path, kind: str) -> list[str]:
    return sorted(path.name.split(".")[0] for path in (folder / kind).glob("*.parquet"))


def merge(folder: Path) -> None:
    assert compact([str(folder), "--below", "0", "--merge-rows"]) == 0


@pytest.mark.long
def test_the_files_of_a_past_hour_are_merged_into_one(sink: ParquetSink, tmp_path: Path) -> None:
    write(sink, range(FILES))
    merge(tmp_path)
    newest = [f"{2 * file + 1:08d}-{2 * file + 2:08d}" for file in range(8, FILES)]
    assert names(tmp_path, "rows") == ["00000001-00000008", "00000009-00000016", *newest]
    assert names(tmp_path, "tens") == ["00000001-00000008", "00000009-00000016", *newest[:-1]]
    check(tmp_path, FILES)
    assert sink.begin("made") == KeptPlace(24, {"a.x": 24})
    merge(tmp_path)
    check(tmp_path, FILES)
    write(sink, range(FILES, FILES + 2))
    merge(tmp_path)
    check(tmp_path, FILES + 2)
    for path in sorted((tmp_path / "rows").glob("*.parquet"))[3:]:
        path.unlink()
    assert names(tmp_path, "rows")[-1] == "00000017-00000024"
    assert sink.begin("made") == KeptPlace(24, {"a.x": 24})  # a merged file contains the hub's position too


class Broken(Exception):
    """Simulates the end of the process."""


@pytest.mark.long
@pytest.mark.slow
def test_compaction_interrupted_before_any_step_loses_no_row(
    sink: ParquetSink, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The interruption comes after each possible number of written or removed files, also repeatedly."""
    write(sink, range(FILES))
    steps = {"replace": Path.replace, "unlink": Path.unlink}
    left = 0

    def counted(name: str) -> Any:
        def act(path: Path, *details: Any, **more: Any) -> Any:
            nonlocal left
            left -= 1
            if left < 0:
                raise Broken
            return steps[name](path, *details, **more)

        return act

    for name in steps:
        monkeypatch.setattr(Path, name, counted(name))
    breaks = 0
    for least in range(100):
        left = least % 4
        try:
            merge(tmp_path)
        except Broken:
            breaks += 1
            check(tmp_path, FILES)
        else:
            break
    monkeypatch.undo()
    assert breaks > 10
    check(tmp_path, FILES)
    assert names(tmp_path, "rows")[:2] == ["00000001-00000008", "00000009-00000016"]


@pytest.mark.long
def test_a_reader_of_files_being_merged_fails_or_gets_every_row_once(
    sink: ParquetSink, tmp_path: Path
) -> None:
    write(sink, range(FILES))
    told = []
    for at in (0, 1, 2, 5):
        folder = tmp_path / "copies" / str(at)
        (folder / "rows").mkdir(parents=True)
        for path in (tmp_path / "rows").glob("*.parquet"):
            (folder / "rows" / path.name).write_bytes(path.read_bytes())
        with History(folder) as history:
            batches = iter(history.read())
            rows = [tuple(row) for _ in range(at) for row in next(batches)]
            merge(folder)
            try:
                rows += [tuple(row) for batch in batches for row in batch]
            except OSError as error:
                told.append((at, str(error)))
            else:
                assert len(rows) == len(set(rows)) == FILES * EXCHANGES * 10
    sentence = "files were merged while they were read: read them again"
    assert [at for at, _ in told] == [1, 2, 5]
    assert all(text.endswith(sentence) for _, text in told)


@pytest.mark.long
def test_merged_files_keep_the_size_limit(
    sink: ParquetSink, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(sink, range(FILES))
    size = max(path.stat().st_size for path in (tmp_path / "rows").glob("*.parquet"))
    monkeypatch.setattr(compact_module, "MOST_MERGED", 2 * size)
    merge(tmp_path)
    assert names(tmp_path, "rows")[:2] == ["00000001-00000004", "00000005-00000008"]
    check(tmp_path, FILES)


@pytest.mark.long
async def test_the_hub_compacts_files_while_it_reads_the_stream(sink: ParquetSink, tmp_path: Path) -> None:
    write(sink, range(FILES))
    task = asyncio.create_task(compact_for_ever(tmp_path, every=0.01))
    async with asyncio.timeout(60.0):
        while len(names(tmp_path, "rows")) > 6:
            await asyncio.sleep(random.uniform(0.01, 0.05))
    task.cancel()
    await asyncio.wait([task])
    check(tmp_path, FILES)
