"""Compaction of a history loses no row if it is interrupted at any step, killed and repeated."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from commands import BoundProcess
from histories import DAY, METADATA, NOON, SECOND, check_buckets, random_rows, record, rows_in
from interruptions import full_at
from tables import usually

from multidrop import open_recording, whole_file
from multidrop.history import compact as compact_module
from multidrop.history import database
from multidrop.history.compact import compact, main
from multidrop.history.database import connect
from multidrop.history.folder import listing, parquet_files
from multidrop.history.history import History
from multidrop.polling.batch import Row
from multidrop.recording.segments import FileLock

duckdb = pytest.importorskip("duckdb", reason="needs duckdb")
SERIES = "pump-1.speed"


def segments() -> list[list[Row]]:
    """Return the rows of five segments: two on each of two days, and one on the next day."""
    begins = (NOON, NOON + 600 * SECOND, NOON + DAY, NOON + DAY + 600 * SECOND, NOON + 2 * DAY)
    return [random_rows(seed, begin, 120) for seed, begin in enumerate(begins)]


@pytest.fixture
def rows(tmp_path: Path) -> list[list[Row]]:
    """Record five segments in `tmp_path`, and return the rows of each."""
    made = segments()
    record(tmp_path, made)
    return made


def check(folder: Path, rows: list[Row]) -> None:
    """Check that the rows and buckets that History returns for this folder agree with these rows."""
    with History(folder) as history:
        assert sorted(rows_in(history)) == sorted(rows)
        for points in (6, 4000):
            found = history.buckets(SERIES, NOON, NOON + 3 * DAY, points)[SERIES]
            mine = [row for row in rows if f"{row.drive}.{row.register}" == SERIES]
            assert sum(found.n) + sum(found.missed) == len(mine)
            assert max(most for most in found.most if most is not None) == max(
                row.value or -99 for row in mine
            )
        check_buckets(history.buckets(SERIES, NOON, NOON + 700 * SECOND, 50)[SERIES], rows, SERIES)


@pytest.mark.slow
def test_a_compacted_file_has_the_rows_of_its_segment(tmp_path: Path) -> None:
    rows = random_rows(1, NOON, 500)
    record(tmp_path, [rows, random_rows(2, NOON + DAY, 5)])
    compact(tmp_path, 2)
    (file,) = parquet_files(tmp_path / "rows")
    assert [path.name for path in tmp_path.glob("*.arrows")] == ["rows.00000002.arrows"]
    recording = open_recording(file.path)  # pyarrow reads the file like any recording
    assert recording.metadata == METADATA
    found = [row for batch in recording for row in batch]
    assert found == sorted(rows, key=lambda row: (row.drive, row.time_ns))
    assert file.begin * SECOND <= rows[0].time_ns <= rows[-1].time_ns <= file.end * SECOND


@pytest.mark.slow
def test_ten_second_summaries_equal_those_computed_in_plain_python(tmp_path: Path) -> None:
    rows = random_rows(1, NOON, 500)
    record(tmp_path, [rows])
    compact(tmp_path, 2)
    (file,) = parquet_files(tmp_path / "tens")
    query = f"select epoch_ns(time), drive, register, n, missed, least, mean, most, last from '{file.path}'"
    found = {tuple(row[:3]): row[3:] for row in duckdb.sql(query).fetchall()}
    expected: dict[tuple[object, ...], list[Row]] = {}
    for row in rows:
        key = row.time_ns // (10 * SECOND) * 10 * SECOND, row.drive, row.register
        expected.setdefault(key, []).append(row)
    assert found.keys() == expected.keys()
    for key, some in expected.items():
        values = [row.value for row in some if row.value is not None]
        n, missed, least, mean, most, last = found[key]
        assert (n, missed) == (len(values), len(some) - len(values))
        if values:
            assert (least, most, last) == (min(values), max(values), values[-1])
            assert mean == pytest.approx(sum(values) / len(values))
        else:
            assert (least, mean, most, last) == (None, None, None, None)


@pytest.mark.long
def test_summaries_of_past_hours_are_merged_into_one_file(tmp_path: Path) -> None:
    begins = [NOON + 1200 * SECOND * number for number in range(5)]
    record(tmp_path, [random_rows(number, begin, 20) for number, begin in enumerate(begins)])
    compact(tmp_path, 6)
    tens = listing(tmp_path).tens
    assert [(file.first, file.last) for file in tens] == [(1, 3), (4, 4), (5, 5)]
    record(tmp_path, [random_rows(9, NOON + DAY, 20)], after=5)
    compact(tmp_path, 7)
    assert [(file.first, file.last) for file in listing(tmp_path).tens] == [(1, 5), (6, 6)]
    assert len(parquet_files(tmp_path / "tens")) == 2


@pytest.mark.long
def test_summaries_of_past_days_are_merged_into_one_file(tmp_path: Path, rows: list[list[Row]]) -> None:
    compact(tmp_path, 6)
    tens = parquet_files(tmp_path / "tens")
    assert [(file.first, file.last) for file in tens] == [(1, 2), (3, 4), (5, 5)]
    assert len(parquet_files(tmp_path / "rows")) == 5
    check(tmp_path, [*chain(*rows)])


@pytest.mark.long
@pytest.mark.usefixtures("rows")
def test_compaction_opens_a_database_only_if_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []

    def noted(memory: str, spill: Path) -> Any:
        opened.append(memory)
        return connect(memory, spill)

    monkeypatch.setattr(database, "connect", noted)
    for _ in range(2):
        compact(tmp_path, 6)
        assert len(opened) == 1


class BrokenOff(BaseException):
    """Ends compaction, as a kill of the process would."""


class Breaker:
    """Wraps functions. The first `calls` calls succeed, and the next call raises BrokenOff."""

    def __init__(self, calls: int) -> None:
        self.left = calls

    def around(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            if self.left == 0:
                raise BrokenOff
            self.left -= 1
            return function(*arguments, **named)

        return call


# Every `apart`-th step of a compaction of five segments is interrupted. A segment takes 10 steps. With
# `apart` = 7, each kind of step is interrupted in some segment.
@pytest.mark.long
@pytest.mark.parametrize("apart", usually(23, 7))
def test_compaction_interrupted_before_each_step_loses_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, apart: int
) -> None:
    rows = segments()
    expected = [*chain(*rows)]
    for calls in range(0, 200, apart):
        folder = tmp_path / str(calls)
        record(folder, rows)
        breaker = Breaker(calls)
        with monkeypatch.context() as patched:
            for name in ("replace", "unlink", "mkdir"):
                patched.setattr(Path, name, breaker.around(getattr(Path, name)))
            steps = ((compact_module, "copy_out"), (compact_module, "insert"), (whole_file, "sync_to_disk"))
            for module, name in steps:
                patched.setattr(module, name, breaker.around(getattr(module, name)))
            try:
                compact(folder, 6)
                is_over = True
            except BrokenOff:
                is_over = False
        check(folder, expected)
        compact(folder, 6)
        check(folder, expected)
        assert not [*folder.rglob("*.tmp"), *folder.glob("*.arrows")]
        assert len(parquet_files(folder / "tens")) == 3
        if is_over:
            break
    assert 40 < calls < 200


@pytest.mark.long
@pytest.mark.slow
def test_compaction_killed_at_any_step_loses_no_row(tmp_path: Path, rows: list[list[Row]]) -> None:
    # Not `-m multidrop.history.compact`, because it runs at a low priority, which takes long on a busy
    # machine.
    code = "import duckdb; from multidrop.history.compact import main; print(flush=True); main()"
    words = [sys.executable, "-c", code, str(tmp_path), "--below", "6"]
    dice, delay = random.Random(1), 0.05
    for _ in range(40):
        with BoundProcess(words, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            child.stdout.readline()  # waits until compaction starts
            time.sleep(dice.uniform(0, delay))
            child.send_signal(signal.SIGKILL)
            ended = child.wait()
        check(tmp_path, [*chain(*rows)])
        if ended == 0:
            break
        delay *= 1.3  # give a busy machine more time
    assert ended == 0
    assert not listing(tmp_path).segments


@pytest.mark.long
@pytest.mark.usefixtures("rows")
def test_only_one_process_compacts_at_a_time(tmp_path: Path) -> None:
    lock = FileLock(tmp_path / ".compact.lock")
    assert main([str(tmp_path), "--below", "6"]) == 0
    assert len(listing(tmp_path).segments) == 5
    lock.close()
    assert main([str(tmp_path), "--below", "6"]) == 0
    assert len(listing(tmp_path).segments) == 0


@pytest.mark.long
def test_the_readable_part_of_a_damaged_segment_is_read(
    tmp_path: Path, rows: list[list[Row]], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rows.00000002.arrows"
    data = bytearray(path.read_bytes())
    at = data.rindex(b"no reply")  # this text is in the file's last dictionary
    data[at] = 0xFF
    path.write_bytes(data)
    whole = _readable(path)
    assert len(whole) < len(rows[1])
    with History(tmp_path) as history:
        before = rows_in(history)
        assert len(history.damage) == 1
        assert "is damaged" in history.damage[0]
    assert sorted(before) == sorted(chain(rows[0], *rows[2:], whole))
    compact(tmp_path, 6)
    assert str(path) in capsys.readouterr().err
    assert (tmp_path / "damaged" / path.name).read_bytes() == data
    with History(tmp_path) as history:
        assert sorted(rows_in(history)) == sorted(before)


def test_reports_of_many_damaged_segments_fit_into_a_pipe(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The recorder reads these reports only after the process has ended, and a pipe holds 64 KiB."""
    for number in range(1, 401):
        (tmp_path / f"rows.{number:08d}.arrows").write_bytes(bytes(100))
    compact(tmp_path, 401)
    reports = capsys.readouterr().err
    assert len(reports) < 60_000
    assert reports.splitlines()[-1] == "300 more damaged segments are not listed"
    assert len([*(tmp_path / "damaged").iterdir()]) == 400


def _readable(path: Path) -> list[Row]:
    found: list[Row] = []
    try:
        for batch in open_recording(path):
            found += batch
    except ValueError:
        pass
    return found


@pytest.mark.long
@pytest.mark.parametrize("content", usually(b"\0" * 5000, b"", b"\xff\xff\xff\xff"))
def test_other_segments_are_read_if_one_is_empty(
    tmp_path: Path, rows: list[list[Row]], content: bytes
) -> None:
    """After a power cut a file may be empty or contain zeros."""
    (tmp_path / "rows.00000002.arrows").write_bytes(content)
    left = [*chain(rows[0], *rows[2:])]
    with History(tmp_path) as history:
        assert sorted(rows_in(history)) == sorted(left)
        assert len(history.damage) == bool(content)
    compact(tmp_path, 6)
    assert len([*(tmp_path / "damaged").iterdir()]) == bool(content)
    with History(tmp_path) as history:
        assert sorted(rows_in(history)) == sorted(left)


@pytest.mark.long
def test_compaction_keeps_a_segment_if_the_disk_is_full(tmp_path: Path, rows: list[list[Row]]) -> None:
    with full_at(900), pytest.raises(duckdb.IOException, match="File too large"):
        compact(tmp_path, 6)
    assert len(listing(tmp_path).segments) == 5
    for _ in range(2):
        check(tmp_path, [*chain(*rows)])
        compact(tmp_path, 6)


def test_compaction_runs_at_the_lowest_priority_if_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []

    def forbidden(*given: object) -> None:
        asked.append(given)
        raise PermissionError

    monkeypatch.setattr(os, "nice", forbidden)
    monkeypatch.setattr(os, "sched_setscheduler", forbidden)
    compact_module.be_low()
    assert asked == [(0, os.SCHED_BATCH, os.sched_param(0)), (19,)]


@pytest.mark.slow
def test_compaction_process_does_not_inherit_real_time_scheduling() -> None:
    """If this process may not use SCHED_RR, the recorder has the usual scheduling."""
    lines = (
        "import contextlib, os",
        "from multidrop.history.compact import be_low",
        "with contextlib.suppress(PermissionError):",
        "    os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))",
        "be_low()",
        "print(os.sched_getscheduler(0) == os.SCHED_BATCH, os.nice(0))",
    )
    ended = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True)
    assert ended.stdout == f"True {min(19, os.nice(0) + 19)}\n", ended.stderr
