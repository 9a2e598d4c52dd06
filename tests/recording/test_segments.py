"""Recordings in several files: segments, and a file with the rows around each trigger."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pytest
from batches import SECOND, UTC_0
from interruptions import full_at
from recordings import ABOUT, recorded, row
from tables import table

from multidrop.core import Names
from multidrop.polling.added_rows import EVENT, TRIGGER, AddedRow, JoinedColumns
from multidrop.polling.batch import Batch, Row, status_code
from multidrop.recording import RecordingError, convert, open_recording, open_writer
from multidrop.recording import segments as segments_module
from multidrop.recording.rows import RecordedRows, from_rows, phase_row, with_phases
from multidrop.recording.segments import (
    SegmentWriter,
    StoredFile,
    outlived,
    parse_age,
    parse_size,
    segments_of,
)
from multidrop.recording.triggered import MOST_OPEN, TriggeredWriter
from multidrop.transport import clock

DAY = 86400.0


class Hand:
    """A clock that the test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        self.utc = 1_700_000_000.0
        monkeypatch.setattr(clock, "now_ns", lambda: round(self.now * 1e9))
        monkeypatch.setattr(segments_module.time, "time", lambda: self.utc)


@pytest.fixture
def hand(monkeypatch: pytest.MonkeyPatch) -> Hand:
    return Hand(monkeypatch)


def rows(number: int) -> RecordedRows:
    return from_rows([row(number + part / 10, "pump", "output_frequency", number) for part in range(3)])


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("*.arrows"))


def read(path: Path) -> list[Row]:
    return [found for batch in open_recording(path) for found in batch]


def test_a_new_segment_starts_when_the_last_one_is_old_enough(tmp_path: Path, hand: Hand) -> None:
    with SegmentWriter(tmp_path / "run.arrows", ABOUT, every=60) as writer:
        assert names(tmp_path) == []  # no file is created before the first rows
        for number in range(5):
            writer.write(rows(number))
            hand.now += 30
        assert writer.rows == 15
        assert [path.name for path in writer.files] == names(tmp_path)
    assert names(tmp_path) == [f"run.0000000{number}.arrows" for number in (1, 2, 3)]
    found = [read(path) for _, path in segments_of(tmp_path / "run.arrows")]
    assert found == [[*rows(0), *rows(1)], [*rows(2), *rows(3)], [*rows(4)]]
    for path in tmp_path.glob("*.arrows"):
        assert open_recording(path).metadata == ABOUT
        assert pa.ipc.open_stream(path.read_bytes()).read_all().num_rows in (3, 6)


def test_segment_numbers_grow_after_a_restart(tmp_path: Path, hand: Hand) -> None:
    for number in range(3):
        with SegmentWriter(tmp_path / "run.arrows", ABOUT, every=60) as writer:
            writer.write(rows(number))
        hand.now, hand.utc = 5.0, hand.utc - 10 * DAY
    assert [number for number, _ in segments_of(tmp_path / "run.arrows")] == [1, 2, 3]
    with SegmentWriter(tmp_path / "run.arrows", ABOUT, every=60, after=70) as writer:
        writer.write(rows(0))
    assert names(tmp_path)[-1] == "run.00000071.arrows"


def test_files_with_other_names_are_not_segments(tmp_path: Path) -> None:
    for name in ("run.arrows", "run.1.arrows", "other.00000009.arrows", "run.00000009.arrows.bak"):
        (tmp_path / name).write_bytes(b"precious")
    with SegmentWriter(tmp_path / "run.arrows", ABOUT, every=60, keep=1.0, most=1000) as writer:
        writer.write(rows(0))
        assert writer.number == 1
    assert len([*tmp_path.iterdir()]) == 6  # six: the four files above, the new segment, and its lock file


def test_changed_metadata_starts_a_new_segment(tmp_path: Path) -> None:
    with SegmentWriter(tmp_path / "run.arrows", ABOUT, every=60) as writer:
        writer.write(rows(0))
        writer.rotate({"plant": "other.toml"})
        writer.write(rows(1))
    (_, first), (_, second) = segments_of(tmp_path / "run.arrows")
    assert (open_recording(first).metadata, open_recording(second).metadata) == (
        ABOUT,
        {"plant": "other.toml"},
    )


def test_only_one_process_records_into_the_same_segments(tmp_path: Path) -> None:
    path = tmp_path / "run.arrows"
    with SegmentWriter(path, ABOUT, every=60):
        with pytest.raises(ValueError, match=r"run\.arrows is being recorded by another process"):
            SegmentWriter(path, ABOUT, every=60)
        SegmentWriter(tmp_path / "other.arrows", ABOUT, every=60).close()
    SegmentWriter(path, ABOUT, every=60).close()


def test_a_recording_in_segments_needs_the_suffix_arrows(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"the name of a recording in segments must end in \.arrows"):
        SegmentWriter(tmp_path / "run.csv", ABOUT, every=60)
    with pytest.raises(RecordingError, match="cannot be written: No such file or directory"):
        SegmentWriter(tmp_path / "none" / "run.arrows", ABOUT, every=60)
    assert [*tmp_path.iterdir()] == []


def test_an_incomplete_batch_of_a_killed_writer_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "run.arrows"
    with SegmentWriter(path, ABOUT, every=60) as writer:
        writer.write(rows(0))
        writer.write(rows(1))
    (_, segment), *_ = segments_of(path)
    os.truncate(segment, segment.stat().st_size - 20)
    SegmentWriter(path, ABOUT, every=60).close()
    # pyarrow would raise an exception if the incomplete batch were still there
    assert pa.ipc.open_stream(segment.read_bytes()).read_all().num_rows == 3


def test_long_unreadable_end_of_a_segment_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segments_module, "MOST_CUT", 100)
    path = tmp_path / "run.arrows"
    with SegmentWriter(path, ABOUT, every=60) as writer:
        writer.write(rows(0))
    (_, segment), *_ = segments_of(path)
    segment.write_bytes(segment.read_bytes() + bytes(101))
    size = segment.stat().st_size
    SegmentWriter(path, ABOUT, every=60).close()
    assert segment.stat().st_size == size


def test_a_full_disk_is_reported_and_the_segment_continues(tmp_path: Path) -> None:
    with SegmentWriter(tmp_path / "run.arrows", ABOUT, every=60) as writer:
        writer.write(rows(0))
        (path,) = writer.files
        with full_at(path.stat().st_size + 10), pytest.raises(RecordingError, match="File too large"):
            writer.write(rows(1))
        writer.write(rows(2))
        assert writer.rows == 6
    assert read(path) == [*rows(0), *rows(2)]


def test_a_failed_segment_leaves_no_file_and_its_number_is_skipped(tmp_path: Path) -> None:
    with SegmentWriter(tmp_path / "run.arrows", ABOUT, every=60) as writer:
        with full_at(10), pytest.raises(RecordingError):
            writer.write(rows(0))
        assert names(tmp_path) == []
        writer.write(rows(1))
        assert names(tmp_path) == ["run.00000002.arrows"]


def test_old_segments_are_removed_when_a_segment_starts(tmp_path: Path, hand: Hand) -> None:
    with SegmentWriter(tmp_path / "run.arrows", ABOUT, every=DAY, keep=3 * DAY) as writer:
        for number in range(8):
            writer.write(rows(number))
            os.utime(writer.files[-1], (hand.utc, hand.utc))
            hand.now += DAY
            hand.utc += DAY
    assert names(tmp_path) == [f"run.0000000{number}.arrows" for number in (5, 6, 7, 8)]
    hand.utc += 1.5 * DAY
    SegmentWriter(tmp_path / "run.arrows", ABOUT, every=DAY, keep=3 * DAY).close()
    assert names(tmp_path) == ["run.00000008.arrows"]


def test_oldest_segments_are_removed_above_the_size_limit(tmp_path: Path, hand: Hand) -> None:
    with SegmentWriter(tmp_path / "run.arrows", ABOUT, every=DAY, most=10_000) as writer:
        for number in range(20):
            writer.write(rows(number))
            hand.now += DAY
            sizes = [path.stat().st_size for path in writer.files[:-1]]
            assert sum(sizes) <= 10_000
        kept = [number for number, _ in segments_of(tmp_path / "run.arrows")]
    assert kept == list(range(kept[0], 21))
    assert 2 <= len(kept) <= 10_000 // sizes[0] + 1


def test_the_current_segment_is_never_removed(tmp_path: Path, hand: Hand) -> None:
    with SegmentWriter(tmp_path / "run.arrows", ABOUT, every=DAY, keep=1.0, most=1000) as writer:
        writer.write(rows(0))
        hand.utc += 100 * DAY
        hand.now += DAY
        writer.write(rows(1))
        assert names(tmp_path) == ["run.00000002.arrows"]


def test_files_beyond_the_limit_of_age_or_size_are_removed() -> None:
    files = [StoredFile(Path(str(number)), number, number * 10.0, 100) for number in (3, 1, 2, 4)]

    def gone(now: float, keep: float | None, most: int | None) -> list[int]:
        return [file.number for file in outlived(files, now, keep, most)]

    assert gone(1000.0, None, None) == []
    assert gone(45.0, 20.0, None) == [1, 2]
    assert gone(45.0, None, 250) == [1, 2]
    assert gone(45.0, 30.0, 250) == [1, 2]
    assert gone(45.0, None, 99) == [1, 2, 3, 4]
    assert gone(5.0, 1.0, None) == []  # the clock was set back: all files count as new


def test_clock_jump_removes_no_segment() -> None:
    week = [StoredFile(Path(str(number)), number, number * DAY, 100) for number in range(1, 8)]

    def left(now: float, files: list[StoredFile]) -> list[int]:
        gone = outlived(files, now, 5 * DAY, None)
        return [file.number for file in files if file not in gone]

    assert left(8 * DAY, week) == [3, 4, 5, 6, 7]
    assert left(4000 * DAY, week) == [2, 3, 4, 5, 6, 7]  # the clock jumped ahead
    ahead = [*week, *(StoredFile(Path(str(n)), n, (4000 + n) * DAY, 100) for n in (8, 9))]
    assert left(4010 * DAY, ahead) == [4, 5, 6, 7, 8, 9]  # ten days later, the oldest files are removed
    corrected = [*ahead, StoredFile(Path("10"), 10, 10 * DAY, 100)]
    assert left(11 * DAY, corrected) == [6, 7, 8, 9, 10]  # the clock was corrected
    assert left(16.5 * DAY, corrected) == [5, 6, 7, 8, 9, 10]  # recording paused for more than `keep`
    booted_in_1970 = [*week, StoredFile(Path("8"), 8, 60.0, 100)]
    assert left(9 * DAY, booted_in_1970) == [1, 2, 3, 4, 5, 6, 7, 8]
    two = [file._replace(path=Path(f"tens/{file.number}"), end=file.end + 5) for file in week]
    assert left(8 * DAY, sorted(week + two, key=lambda file: file.number)) == [3, 3, 4, 4, 5, 5, 6, 6, 7, 7]


@table(
    ("text", "seconds"),
    [("30 days", 30 * DAY), ("1 day", DAY), ("1.5 h", 5400.0), ("10min", 600.0), ("2 weeks", 14 * DAY)],
)
def test_ages_are_parsed_to_seconds(text: str, seconds: float) -> None:
    assert parse_age(text) == seconds


@table(
    "text", ["", "30", "-1 h", "1 month", "0.5 s", "1 hs", "\u0661 h", "nan s", "1e9 weeks", 30, None, b"1 h"]
)
def test_invalid_ages_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r'invalid time .*: write 1 s to 100 years, such as "10 min"'):
        parse_age(text)


@pytest.mark.parametrize(("text", "size"), [("20 GB", 20 * 10**9), ("1.5kB", 1500), ("2 TB", 2 * 10**12)])
def test_sizes_are_parsed_to_bytes(text: str, size: int) -> None:
    assert parse_size(text) == size


@table("text", ["", "20", "20 gb", "-1 GB", "0.5 kB", "1 GiB", 20, None, b"1 GB"])
def test_invalid_sizes_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r'invalid size .*: write 1 kB or more, such as "500 MB"'):
        parse_size(text)


# ---- triggers ----


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


def test_later_comment_row_does_not_end_a_trigger_recording_early(writer: TriggeredWriter) -> None:
    writer.write(batch(0, 20, range(15, 16)))
    comment = AddedRow(UTC_0 + 60 * SECOND, 60 * SECOND, 0, 1, 0, status_code("late"), 0.0)
    writer.write(Batch(JoinedColumns(None, [comment]), DRIVES, REGISTERS))
    writer.write(batch(20, 60))
    assert currents(writer.files[0]) == [float(at) for at in range(5, 36)]


def test_all_trigger_recordings_are_closed_if_closing_one_fails(
    writer: TriggeredWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_rows_older_than_the_pre_trigger_time_are_dropped(writer: TriggeredWriter) -> None:
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


def test_a_recording_without_test_phases_has_no_column_phase(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    path = tmp_path / "run.csv"
    with open_writer(path, ABOUT) as writer:
        writer.write(from_rows([row(0.1, "pump", "output_frequency", 1.0)]))
    assert "phase" not in open_recording(path).to_pandas().columns
