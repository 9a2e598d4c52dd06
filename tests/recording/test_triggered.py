"""Recordings of triggers: the rows around each trigger are in a separate file."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from pathlib import Path

import pytest
from batches import SECOND, UTC_0
from recordings import ABOUT, recorded, row

from multidrop.core import Names
from multidrop.polling.added_rows import EVENT, TRIGGER, AddedRow, JoinedColumns
from multidrop.polling.batch import Batch, status_code
from multidrop.recording import convert, open_recording, open_writer
from multidrop.recording.rows import from_rows, phase_row, with_phases
from multidrop.recording.triggered import MOST_OPEN, TriggeredWriter

DRIVES, REGISTERS = Names(["pump-1", EVENT]), Names(["output_current", "trigger_1", TRIGGER])
CONDITION = "output_current > 30"


def batch(begin: int, end: int, true_at: range = range(0), key_at: int | None = None) -> Batch:
    """Return a batch with a current and the trigger's value, 0 or 1, for each tenth of a second."""
    rows = []
    for at in range(begin, end):
        ns = at * SECOND // 10
        rows.append(AddedRow(UTC_0 + ns, ns, 0, 0, 0, 0, float(at)))
        rows.append(AddedRow(UTC_0 + ns, ns, 0, 0, 1, 0, float(at in true_at)))
        if at == key_at:
            rows.append(AddedRow(UTC_0 + ns, ns, 0, 1, 2, status_code("key t"), 0.0))
    return Batch(JoinedColumns(None, rows), DRIVES, REGISTERS)


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[TriggeredWriter]:
    conditions = {("pump-1", "trigger_1"): CONDITION}
    with TriggeredWriter(
        tmp_path / "trip.arrows", {"plant": "p"}, pre=1.0, post=2.0, conditions=conditions
    ) as made:
        yield made


def currents(path: Path) -> list[float | None]:
    return [row.value for row in recorded(path) if row.register == "output_current"]


def test_each_trigger_is_recorded_in_its_own_file(writer: TriggeredWriter) -> None:
    for begin in range(0, 300, 7):
        writer.write(
            batch(begin, begin + 7, range(50, 60))
            if begin < 150
            else batch(begin, begin + 7, range(200, 201))
        )
    first, second = writer.files
    assert [path.name for path in writer.files] == ["trip.00000001.arrows", "trip.00000002.arrows"]
    assert currents(first) == [float(at) for at in range(40, 71)]
    assert currents(second) == [float(at) for at in range(190, 221)]
    about = open_recording(second).metadata
    assert about["plant"] == "p"
    assert about["trigger"] == {
        "condition": CONDITION,
        "time": "2026-11-21T09:30:19.123457+00:00",
        "time_ns": UTC_0 + 20 * SECOND,
        "pre_s": 1.0,
        "post_s": 2.0,
    }


def test_a_condition_that_is_true_from_the_start_triggers_no_recording(writer: TriggeredWriter) -> None:
    writer.write(batch(0, 100, range(0, 50)))
    assert writer.files == ()


def test_triggers_close_together_each_have_a_complete_file(writer: TriggeredWriter) -> None:
    writer.write(batch(0, 20, range(15, 16), key_at=18))
    writer.write(batch(20, 60))
    assert [currents(path) for path in writer.files] == [
        [float(at) for at in range(5, 36)],
        [float(at) for at in range(8, 39)],
    ]
    assert open_recording(writer.files[1]).metadata["trigger"]["condition"] == "key t"


def test_an_event_does_not_end_a_trigger_recording_early(writer: TriggeredWriter) -> None:
    writer.write(batch(0, 20, range(15, 16)))
    comment = AddedRow(UTC_0 + 60 * SECOND, 60 * SECOND, 0, 1, 0, status_code("late"), 0.0)
    writer.write(Batch(JoinedColumns(None, [comment]), DRIVES, REGISTERS))
    writer.write(batch(20, 60))
    assert currents(writer.files[0]) == [float(at) for at in range(5, 36)]


def test_all_recordings_close_if_one_fails(writer: TriggeredWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    writer.write(batch(0, 20, range(15, 16), key_at=18))
    first, last = (recording.writer for recording in writer._open)
    close_last, close_first, closed = last.close, first.close, list[str]()

    def fail() -> None:
        close_last()
        raise OSError(errno.ENOSPC, "the disk is full")

    monkeypatch.setattr(last, "close", fail)
    monkeypatch.setattr(first, "close", lambda: closed.append("first") or close_first())
    with pytest.raises(OSError, match="the disk is full"):
        writer.close()
    assert closed == ["first"]


def test_numbers_of_trigger_files_continue_after_existing_files(tmp_path: Path) -> None:
    (tmp_path / "trip.00000041.arrows").touch()
    with TriggeredWriter(tmp_path / "trip.arrows", {}, pre=1, post=1, conditions={}) as writer:
        writer.write(batch(0, 5, key_at=2))
    assert [path.name for path in writer.files] == ["trip.00000042.arrows"]


def test_triggers_beyond_the_limit_of_open_recordings_are_counted(writer: TriggeredWriter) -> None:
    for at in range(1, MOST_OPEN + 4):
        writer.write(batch(at, at + 1, key_at=at))
    assert len(writer.files) == MOST_OPEN
    assert writer.dropped == 3


def test_trigger_recording_keeps_only_the_rows_of_the_pre_trigger_time(writer: TriggeredWriter) -> None:
    for at in range(1000):
        writer.write(batch(at, at + 1))
    assert len(writer._before) < 40


NAMES = ["warm up", "cool", "stop"]
EXPECTED = ["", "warm up", "warm up", "warm up", "cool", "cool", "warm up"]


@pytest.mark.parametrize("suffix", [".arrows", ".csv", ".parquet"])
def test_each_row_has_the_phase_in_which_it_was_requested(suffix: str, tmp_path: Path) -> None:
    """The last row was requested in the first phase, and received in the second."""
    pytest.importorskip("pandas")
    path = tmp_path / f"run{suffix}"
    rows = [row(at / 10, "pump", "output_frequency", 1.0) for at in (1, 3, 4, 6, 4.5)]
    with open_writer(path, with_phases(ABOUT, NAMES)) as writer:
        writer.write(from_rows(rows[:1]))
        writer.write(phase_row(0, rows[1].time_ns - 7, rows[1].monotonic_ns - 7))
        writer.write(from_rows(rows[1:3]))
        writer.write(phase_row(1, rows[3].time_ns, rows[3].monotonic_ns))
        writer.write(from_rows(rows[3:]))
    for name in (path, tmp_path / "copy.arrows", tmp_path / "copy.csv"):
        if name != path and name.suffix != suffix:
            convert(path, name)
        if name.exists():
            found = open_recording(name).to_pandas()
            assert found["phase"].to_list() == EXPECTED
            assert found[found.drive == "test"].value.to_list() == [0.0, 1.0]


def test_recording_without_phases_has_no_column_phase(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    path = tmp_path / "run.csv"
    with open_writer(path, ABOUT) as writer:
        writer.write(from_rows([row(0.1, "pump", "output_frequency", 1.0)]))
    assert "phase" not in open_recording(path).to_pandas().columns
