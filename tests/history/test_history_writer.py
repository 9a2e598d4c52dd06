"""HistoryWriter: its callers never wait for the disk, and lost rows are counted."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from disks import full_at, read_only_directory
from histories import DAY, METADATA, NOON, SECOND, batch, random_rows, record, rows_in

from multidrop import History, Plant, Poller
from multidrop.control import Seen
from multidrop.core.columns import Names
from multidrop.families import InnovertIBD
from multidrop.history import HistoryWriter
from multidrop.history import writer as writer_module
from multidrop.history.folder import HistoryFile, file_name, listing, parquet_files, widest
from multidrop.recording.format import AppendFile
from multidrop.sim import Simulator, Wire, simulated
from multidrop.transport import clock

PATIENCE = 60.0
NAMES = Names(["pump-1", "pump-2"])


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer_module, "WRITING_S", 0.01)


@pytest.fixture
def writers() -> Iterator[Callable[..., HistoryWriter]]:
    made: list[HistoryWriter] = []

    def make(folder: Path, **how: float) -> HistoryWriter:
        made.append(HistoryWriter(folder, METADATA, **how))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for writer in made:
        writer.close()


def until(is_so: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.01)


def some(number: int, drive: int = 0) -> object:
    return batch(NAMES, drive, range(number * 20, number * 20 + 20), NOON, SECOND)


def test_closing_writes_all_rows(tmp_path: Path, writers: Callable[..., HistoryWriter]) -> None:
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


def test_batches_of_two_pollers_are_recorded(tmp_path: Path, writers: Callable[..., HistoryWriter]) -> None:
    """The two pollers use the same codes for different names."""
    writer = writers(tmp_path)
    taken = [
        batch(Names([name]), 0, range(20), NOON, SECOND) for name in ("pump-1", "fan", "pump-1", "mixer")
    ]
    for one in taken:
        writer.take(one)
    writer.close()
    with History(tmp_path) as history:
        assert rows_in(history) == [row for one in taken for row in one]


def test_the_writer_keeps_no_memory_of_the_core(
    tmp_path: Path, writers: Callable[..., HistoryWriter]
) -> None:
    """The writer copies rows, because the core reuses a batch's memory."""
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


def test_another_plant_starts_a_segment(tmp_path: Path, writers: Callable[..., HistoryWriter]) -> None:
    writer = writers(tmp_path)
    writer.take(some(0))
    until(lambda: writer.state().rows == 20)
    writer.begin({"plant": "other.toml"})
    writer.take(some(1))
    writer.close()
    assert len(listing(tmp_path).segments) == 2
    with History(tmp_path) as history:
        assert history.metadata() == {"plant": "other.toml"}


# ---- a disk that is full, slow, or gone ----


def test_a_full_disk_is_reported_and_recording_continues(
    tmp_path: Path,
    writers: Callable[..., HistoryWriter],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
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
    tmp_path: Path, writers: Callable[..., HistoryWriter], monkeypatch: pytest.MonkeyPatch
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
        writer.take(some(number))  # must not wait for the disk
    assert writer.state().dropped == 20 * 20
    goes_on.set()
    writer.close()
    assert writer.state() == (220, 400, None)


@pytest.mark.long
def test_a_full_disk_delays_neither_polling_nor_stops(
    tmp_path: Path, writers: Callable[..., HistoryWriter]
) -> None:
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


def test_one_process_records_at_a_time(tmp_path: Path, writers: Callable[..., HistoryWriter]) -> None:
    writers(tmp_path)
    with pytest.raises(ValueError, match="is being recorded by another process"):
        HistoryWriter(tmp_path, METADATA)


def test_an_exception_does_not_end_the_recording(
    tmp_path: Path, writers: Callable[..., HistoryWriter], monkeypatch: pytest.MonkeyPatch
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


# ---- compaction and retention ----


@pytest.mark.long
def test_closed_segments_are_compacted_and_old_files_removed(
    tmp_path: Path, writers: Callable[..., HistoryWriter]
) -> None:
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


def test_the_oldest_files_beyond_the_size_are_removed(
    tmp_path: Path, writers: Callable[..., HistoryWriter], monkeypatch: pytest.MonkeyPatch
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
def test_a_failed_child_is_reported_and_started_again(
    tmp_path: Path,
    writers: Callable[..., HistoryWriter],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
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


def test_any_bytes_in_a_child_s_output_are_reported(
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


def test_file_names_have_numbers_and_times() -> None:
    name = file_name(7, 7, NOON + 1, NOON + 600 * SECOND)
    assert name == "00000007.20261121T120000Z-20261121T121000Z.parquet"
    assert file_name(7, 9, 0, 1) == "00000007-00000009.19700101T000000Z-19700101T000001Z.parquet"


def test_the_widest_file_hides_the_files_it_contains() -> None:
    def file(first: int, last: int) -> HistoryFile:
        return HistoryFile(Path(f"{first}-{last}"), first, last, 0, 0)

    files = [file(1, 144), file(1, 1), file(2, 2), file(144, 144), file(145, 145)]
    files.sort(key=lambda one: (one.first, -one.last))
    assert [(one.first, one.last) for one in widest(files)] == [(1, 144), (145, 145)]
