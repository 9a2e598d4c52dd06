"""Recordings in segments: rotation, numbers, removal of old segments, and the state after a kill."""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow as pa
import pytest
from interruptions import full_at
from recordings import ABOUT, row
from tables import table

from multidrop.polling.batch import Row
from multidrop.recording import RecordingError, open_recording
from multidrop.recording import segments as segments_module
from multidrop.recording.rows import RecordedRows, from_rows
from multidrop.recording.segments import (
    SegmentWriter,
    StoredFile,
    outlived,
    parse_age,
    parse_size,
    segments_of,
)
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


def test_a_long_unreadable_end_is_never_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_the_oldest_segments_beyond_the_size_are_removed(tmp_path: Path, hand: Hand) -> None:
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


def test_a_clock_that_jumps_removes_no_segment() -> None:
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
