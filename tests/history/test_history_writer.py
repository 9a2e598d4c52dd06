"""HistoryWriter: its callers never wait for the disk, and lost rows are counted."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from math import inf, nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import histories
import pytest
from commands import BoundProcess
from gateways import serving, simulated_plant
from histories import DAY, METADATA, NOON, RUN, SECOND, STEP, batch, random_rows, record, rows_in
from interruptions import full_at, read_only_directory
from lines import PATIENCE, until
from tables import first_in_ci

from multidrop import History, Plant, Poller
from multidrop.control import Seen
from multidrop.core.columns import Names
from multidrop.families import InnovertIBD
from multidrop.gateway import historian
from multidrop.gateway.historian import MOST_BUCKETS, HistorySettings, as_json, build
from multidrop.gateway.http.files import Exports
from multidrop.history import Buckets, HistoryWriter
from multidrop.history import writer as writer_module
from multidrop.history.compact import main as compact
from multidrop.history.folder import HistoryFile, file_name, listing, parquet_files, widest
from multidrop.recording import open_recording
from multidrop.recording.format import AppendFile
from multidrop.sim import Simulator, Wire, simulated
from multidrop.transport import clock

Writers = Callable[..., HistoryWriter]

NAMES = Names(["pump-1", "pump-2"])


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer_module, "WRITING_S", 0.01)


@pytest.fixture
def writers() -> Iterator[Writers]:
    made: list[HistoryWriter] = []

    def make(folder: Path, **how: float) -> HistoryWriter:
        made.append(HistoryWriter(folder, METADATA, **how))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for writer in made:
        writer.close()


def some(number: int, drive: int = 0) -> object:
    return batch(NAMES, drive, range(number * 20, number * 20 + 20), NOON, SECOND)


def test_closing_a_history_writer_writes_all_rows(tmp_path: Path, writers: Writers) -> None:
    writer = writers(tmp_path / "new" / "history")
    taken = [some(number, number % 2) for number in range(50)]
    for one in taken:
        writer.take(one)
    writer.close()
    assert writer.state() == (1000, 0, None)
    with History(tmp_path / "new" / "history") as history:
        expected = [row for one in taken for row in one]
        assert rows_in(history) == [row._replace(uncertainty_ns=row.uncertainty_ns) for row in expected]
        assert history.metadata() == METADATA
    writer.take(some(0))
    assert writer.state().dropped == 20


def test_batches_of_several_pollers_are_recorded(tmp_path: Path, writers: Writers) -> None:
    """Batches come from several pollers, and each poller numbers its drives from 0."""
    writer = writers(tmp_path)
    taken = [
        batch(Names([name]), 0, range(20), NOON, SECOND) for name in ("pump-1", "fan", "pump-1", "mixer")
    ]
    for one in taken:
        writer.take(one)
    writer.close()
    with History(tmp_path) as history:
        assert rows_in(history) == [row for one in taken for row in one]


def test_the_writer_copies_rows_out_of_the_cores_memory(tmp_path: Path, writers: Writers) -> None:
    """Rows are copied, because the core reuses a batch's memory."""
    writer = writers(tmp_path)
    one = some(0)
    expected = list(one)
    writer.take(one)
    columns, *_ = one.parts()
    for name in ("time", "sent", "value"):
        columns.array(name)[:] = columns.array(name)[::-1]
    writer.close()
    with History(tmp_path) as history:
        assert rows_in(history) == expected


def test_a_changed_plant_starts_a_new_segment(tmp_path: Path, writers: Writers) -> None:
    writer = writers(tmp_path)
    writer.take(some(0))
    until(lambda: writer.state().rows == 20)
    writer.begin({"plant": "other.toml"})
    writer.take(some(1))
    writer.close()
    assert len(listing(tmp_path).segments) == 2
    with History(tmp_path) as history:
        assert history.metadata() == {"plant": "other.toml"}


def test_a_full_disk_is_reported_and_recording_continues(
    tmp_path: Path, writers: Writers, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [10**12]
    monkeypatch.setattr(clock, "now_ns", lambda: now[0])
    writer = writers(tmp_path)
    writer.take(some(0))
    until(lambda: writer.state().rows == 20)
    with full_at(10), caplog.at_level(logging.WARNING):
        for number in range(1, 6):
            writer.take(some(number))
            until(lambda number=number: writer.state().dropped == 20 * number)
        trouble = writer.state().trouble
        assert trouble is not None
        assert "File too large" in trouble
        assert [record.message for record in caplog.records] == [f"nothing is recorded: {trouble}"]
    now[0] += 2 * SECOND
    writer.take(some(6))
    until(lambda: writer.state() == (40, 100, None))
    writer.close()
    assert "rows are recorded again; 100 were lost so far" in caplog.text
    with History(tmp_path) as history:
        assert rows_in(history) == [*some(0), *some(6)]
        assert history.damage == []


def test_a_hanging_disk_delays_no_polling(
    tmp_path: Path, writers: Writers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "MOST_WAITING", 200)
    is_hanging, goes_on = threading.Event(), threading.Event()
    append = AppendFile.append

    def hang(file: AppendFile, piece: bytes) -> None:
        is_hanging.set()
        goes_on.wait(PATIENCE)
        append(file, piece)

    monkeypatch.setattr(AppendFile, "append", hang)
    writer = writers(tmp_path)
    writer.take(some(0))
    assert is_hanging.wait(PATIENCE)
    for number in range(1, 31):
        writer.take(some(number))  # this call must not wait for the disk
    assert writer.state().dropped == 20 * 20
    goes_on.set()
    writer.close()
    assert writer.state() == (220, 400, None)


@pytest.mark.long
def test_a_full_disk_delays_neither_polling_nor_stops(tmp_path: Path, writers: Writers) -> None:
    writer = writers(tmp_path / "history")
    with Simulator([Wire([simulated(InnovertIBD(address=1))])]) as line:
        (tmp_path / "plant.toml").write_text(
            f'[[line]]\nname = "hall"\nport = "{line.wires[0].path}"\n[[line.drive]]\nname = "pump-1"\n'
            'model = "innovert-ibd"\naddress = 1\npoll = ["output_current"]\n'
        )
        with full_at(10), Poller(Plant.load(tmp_path / "plant.toml")) as poller:
            poller.on_batch(writer.take, every=0.02)
            until(lambda: writer.state().dropped > 20)
            stopped = poller.bus("hall").stop_all()["pump-1"]
            assert poller.summary()["dropped"] == 0
    assert stopped.seen is Seen.STOPPED
    assert writer.state().trouble


def test_an_unwritable_folder_raises_permission_error_immediately() -> None:
    with read_only_directory() as directory, pytest.raises(PermissionError):
        HistoryWriter(directory / "history", METADATA)


def test_only_one_process_records_into_a_history(tmp_path: Path, writers: Writers) -> None:
    writers(tmp_path)
    with pytest.raises(ValueError, match="is being recorded by another process"):
        HistoryWriter(tmp_path, METADATA)


def test_history_writer_thread_survives_an_exception(
    tmp_path: Path, writers: Writers, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(*_: object) -> object:
        raise RuntimeError("a mistake")

    writer = writers(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(writer_module, "stored_files", wrong)
        writer._tended_ns = None
        writer.take(some(0))
        until(lambda: writer.state().rows == 20)
    writer.take(some(1))
    until(lambda: writer.state().rows == 40)


@pytest.mark.long
def test_closed_segments_are_compacted_and_old_files_removed(tmp_path: Path, writers: Writers) -> None:
    pytest.importorskip("duckdb", reason="needs duckdb")
    begin = time.time_ns() - 10 * DAY
    record(tmp_path, [random_rows(number, begin + number * DAY, 20) for number in range(4)])
    writer = writers(tmp_path)
    until(lambda: len(parquet_files(tmp_path / "rows")) == 4 and not listing(tmp_path).segments)
    writer.take(some(0))
    writer.close()
    assert [*listing(tmp_path).segments] == [5]
    writer = writers(tmp_path, keep=7.5 * DAY / SECOND)
    until(lambda: min(listing(tmp_path).rows, default=9) == 4)
    until(lambda: {file.first for file in parquet_files(tmp_path / "tens")} == {4})


def test_the_oldest_files_are_removed_if_the_history_is_too_large(
    tmp_path: Path, writers: Writers, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("rows", "tens", "damaged"):
        (tmp_path / name).mkdir()
    for number in range(1, 21):
        name = file_name(number, number, NOON + number * DAY, NOON + number * DAY)
        for kind in ("rows", "tens"):
            (tmp_path / kind / name).write_bytes(bytes(1000))
    (tmp_path / "damaged" / "rows.00000002.arrows").write_bytes(bytes(5000))
    (tmp_path / "rows.00000021.arrows").write_bytes(bytes(1000))
    monkeypatch.setattr(writer_module.Compactor, "tend", lambda *_: None)
    writers(tmp_path, most=10_000)
    until(lambda: len(parquet_files(tmp_path / "rows")) == 4)
    assert [file.first for file in parquet_files(tmp_path / "rows")] == [17, 18, 19, 20]
    assert [file.first for file in parquet_files(tmp_path / "tens")] == [16, 17, 18, 19, 20]
    assert not [*(tmp_path / "damaged").iterdir()]
    assert (tmp_path / "rows.00000021.arrows").exists()


@pytest.mark.long
def test_a_failed_compaction_is_reported_and_started_again(
    tmp_path: Path, writers: Writers, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("duckdb", reason="needs duckdb")
    monkeypatch.setattr(writer_module.Compactor, "PAUSE_S", 0.0)
    rows = random_rows(1, NOON, 20)
    record(tmp_path, [rows])
    (tmp_path / "tens").write_bytes(b"in the way")
    writers(tmp_path)
    until(lambda: "compaction ended with 1" in caplog.text)
    (tmp_path / "tens").unlink()
    until(lambda: len(parquet_files(tmp_path / "rows")) == 1)
    with History(tmp_path) as history:
        assert sorted(rows_in(history)) == sorted(rows)


def test_a_compaction_error_with_invalid_utf_8_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\nprintf 'no \\377 file' >&2\nexit 1\n", "utf-8")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    compactor = writer_module.Compactor(tmp_path)
    compactor.is_possible = True

    def is_told() -> bool:
        compactor.tend(1)
        return "compaction ended with 1: no \ufffd file" in caplog.text

    until(is_told)


def test_the_names_of_history_files_have_segment_numbers_and_times() -> None:
    name = file_name(7, 7, NOON + 1, NOON + 600 * SECOND)
    assert name == "00000007.20261121T120000Z-20261121T121000Z.parquet"
    assert file_name(7, 9, 0, 1) == "00000007-00000009.19700101T000000Z-19700101T000001Z.parquet"


def test_file_is_omitted_if_a_merged_file_has_all_its_segments() -> None:
    def file(first: int, last: int) -> HistoryFile:
        return HistoryFile(Path(f"{first}-{last}"), first, last, 0, 0)

    files = [file(1, 144), file(1, 1), file(2, 2), file(144, 144), file(145, 145)]
    files.sort(key=lambda one: (one.first, -one.last))
    assert [(one.first, one.last) for one in widest(files)] == [(1, 144), (145, 145)]


SUPPORT = os.pathsep.join(map(str, Path(histories.__file__).parents[1].iterdir()))


def killed_recorder(folder: Path, run: int, dice: random.Random) -> int:
    """Run a recorder for a while, and kill it; return the number of rows that it reported as written."""
    words = [sys.executable, histories.__file__, str(folder), str(run)]
    here = {**os.environ, "PYTHONPATH": SUPPORT}
    with BoundProcess(words, stdout=subprocess.PIPE, text=True, env=here, start_new_session=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline()  # wait until the recorder writes
        with History(folder) as history:  # read while the recorder writes
            check_runs(history, {}, NOON + run * RUN)
        time.sleep(dice.uniform(0, 1.2))
        if dice.random() < 0.5:
            child.kill()  # kills only the recorder: its child process, which compacts files, lives on
        else:
            os.killpg(child.pid, signal.SIGKILL)
        said = child.stdout.read().split("\n")[:-1]
    return int(said[-1]) if said else 0


def check_runs(history: History, written: dict[str, int], begin: int | None = None) -> int:
    """Return the number of rows from `begin` on; check that each run's rows have no gap."""
    runs: dict[str, list[int]] = defaultdict(list)
    for rows in history.read(None, begin):
        for row in rows:
            runs[row.drive].append(row.monotonic_ns // STEP)
    for run, numbers in runs.items():
        assert numbers == list(range(len(numbers))), run  # in order, without gaps or duplicates
    for run, count in written.items():
        assert len(runs.get(run, ())) >= count, run
    return sum(map(len, runs.values()))


def total_of_tens(history: History, runs: int) -> int:
    names = [f"run-{run}.speed" for run in range(runs)]
    found = history.buckets(names, NOON, NOON + (runs + 1) * RUN, points=1000)
    return sum(sum(buckets.n) + sum(buckets.missed) for buckets in found.values())


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("kills", first_in_ci(3, 200))
def test_killing_the_recorder_and_compaction_loses_no_row(tmp_path: Path, kills: int) -> None:
    pytest.importorskip("duckdb", reason="needs duckdb")
    dice = random.Random(kills)
    written: dict[str, int] = {}
    for run in range(kills):
        written[f"run-{run}"] = killed_recorder(tmp_path, run, dice)
        with History(tmp_path) as history:
            name = f"run-{run}"
            assert check_runs(history, {name: written[name]}, NOON + run * RUN) >= written[name]
        if run < 15 or run % 20 == 0 or run == kills - 1:
            with History(tmp_path) as history:
                total = check_runs(history, written)
                assert total_of_tens(history, run + 1) == total
    assert sum(written.values()) > 100 * kills
    for _ in range(1200):  # the killed recorder's child may still compact
        compact([str(tmp_path), "--below", "99999999"])
        found = listing(tmp_path)
        if not found.segments:
            break
        time.sleep(0.1)
    assert not found.segments
    assert len(found.rows) > kills // 2
    assert any(file.first < file.last for file in found.tens)  # some summaries were merged
    assert not [*tmp_path.rglob("*.tmp"), *(tmp_path / "damaged").iterdir()]
    with History(tmp_path) as history:
        assert check_runs(history, written) == total
        assert total_of_tens(history, kills) == total


MS = 1_000_000


def inside(folder: Path) -> SimpleNamespace:
    """Return a fake gateway with the attributes that a Historian uses."""
    return SimpleNamespace(plant=Plant((), Path("plant.toml")), folder=folder)


@asynccontextmanager
async def historian_in(folder: Path) -> AsyncIterator[historian.Historian]:
    """Yield the gateway's recorder of this folder; it is closed after the block."""
    made = build(HistorySettings(), inside(folder))
    try:
        yield made
    finally:
        await made.close()


def test_all_mistakes_in_the_history_settings_are_reported_together() -> None:
    with pytest.raises(ValueError, match="invalid time") as failure:
        HistorySettings(keep="for ever", most="20", rotate="0 s")
    lines = str(failure.value).splitlines()
    assert [line.split(" = ")[0] for line in lines] == ["keep", "most", "rotate"]
    assert "invalid time 'for ever': write 1 s to 100 years" in lines[0]
    assert "invalid size '20': write 1 kB or more" in lines[1]
    HistorySettings()


def test_a_folder_that_cannot_be_created_raises_a_one_sentence_error(tmp_path: Path) -> None:
    """The test uses /sys, where not even root may create a folder."""
    with pytest.raises(OSError, match="folder /sys/history cannot be written: ") as failure:
        build(HistorySettings(folder="/sys/history"), inside(tmp_path))
    assert "Errno" not in str(failure.value)


def test_infinity_and_nan_are_null_in_json() -> None:
    """JSON has neither infinity nor NaN: a browser could not parse an answer that has them."""
    found = as_json(Buckets(0, MS, [1, 2], [0, 0], [-inf, 1.0], [nan, 1.5], [inf, 2.0]))
    assert [found[key] for key in ("least", "mean", "most")] == [[None, 1.0], [None, 1.5], [None, 2.0]]


async def test_large_history_queries_run_outside_the_event_loop_or_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stop command also needs the event loop, so it would wait for a computation there."""
    makers: list[int] = []

    def noted(made: Buckets) -> dict[str, Any]:
        makers.append(threading.get_ident())
        return as_json(made)

    monkeypatch.setattr(historian, "as_json", noted)
    async with historian_in(tmp_path) as part:
        many = [f"pump-{at}.speed" for at in range(3)]
        found = json.loads(await part.series([*many, *many], 0, 1000, MOST_BUCKETS // 1000))
        assert list(found["series"]) == many
        assert len(makers) == 3
        assert threading.get_ident() not in makers
        with pytest.raises(ValueError, match="3 series of 70000 points exceed the limit of 200000 points"):
            await part.series(many, 0, 1000, 70_000)


@pytest.mark.parametrize("kind", ["csv", "parquet"])
async def test_an_export_of_a_history_starts_outside_the_event_loop(tmp_path: Path, kind: str) -> None:
    """An export first reads the metadata of up to thousands of files."""
    readers: list[int] = []

    class Noted(History):
        def read(self, *of: Any) -> Any:
            readers.append(threading.get_ident())
            return super().read(*of)

    async with historian_in(tmp_path) as part:
        part.history = Noted(part.history.folder)
        await Exports().respond(part, [], 0, 1000, kind)
        assert readers
        assert threading.get_ident() not in readers


async def test_unfinished_exports_of_a_killed_process_are_removed(tmp_path: Path) -> None:
    left = tmp_path / "history" / ".export-x1y2"
    left.mkdir(parents=True)
    (left / "export.parquet").write_bytes(b"PAR1")
    async with historian_in(tmp_path):
        assert not left.exists()


@pytest.mark.slow
async def test_the_gateways_history_records_rows_and_answers_queries(tmp_path: Path) -> None:
    part = build(HistorySettings(folder="kept"), inside(tmp_path))
    running = asyncio.create_task(part.run())
    taken = batch(Names(["pump-1"]), 0, range(100), NOON, SECOND)
    part.take(taken)
    await asyncio.to_thread(until, lambda: part.state.rows)
    assert part.state == (100, 0, None)
    begin, end = NOON // MS, NOON // MS + 100_000
    found = json.loads(await part.series(["pump-1.speed", "fan.speed"], begin, end, 10))
    assert found["step_ms"] == 10_000
    pump, fan = found["series"]["pump-1.speed"], found["series"]["fan.speed"]
    assert pump["time"] == [begin + 10_000 * number for number in range(10)]
    assert pump["least"] == [10.0 * number for number in range(10)]  # every tenth row has no value
    assert pump["most"] == [10.0 * number + 8 for number in range(10)]
    assert pump["mean"] == [10.0 * number + 4 for number in range(10)]
    assert fan["mean"] == [None] * 10
    for kind in ("csv", "parquet"):
        path = tmp_path / f"got.{kind}"
        path.write_bytes(b"".join(part.export(["pump-1.speed"], begin, end, kind)))
        assert [row for rows in open_recording(path) for row in rows] == list(taken)
    with pytest.raises(ValueError, match="invalid series"):
        part.export(["pump"], begin, end, "csv")
    await part.close()
    await asyncio.wait_for(running, 60)
    assert [path.name for path in (tmp_path / "kept").glob("*.arrows")] == ["rows.00000001.arrows"]


@pytest.mark.slow
def test_duckdb_is_loaded_before_the_first_query(tmp_path: Path) -> None:
    pytest.importorskip("duckdb", reason="needs duckdb")
    serve = "[serve]\nlisten = '127.0.0.1:0'\n[serve.history]\n"
    with simulated_plant(tmp_path, serve) as path, serving(path) as (process, _):
        assert "duckdb" in Path(f"/proc/{process.pid}/maps").read_text()
