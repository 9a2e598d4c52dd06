"""A History returns the recorded rows, and its buckets equal those of a plain Python implementation."""

from __future__ import annotations

import random
import stat
import sys
import tempfile
from contextlib import closing
from datetime import UTC, datetime, timedelta, timezone
from math import inf
from pathlib import Path
from typing import Any

import pytest
from histories import DAY, METADATA, NOON, SECOND, check_buckets, random_rows, record, rows_in
from recordings import record_as_before
from tables import examples, usually

from multidrop import History
from multidrop.history import growing
from multidrop.history.buckets import Accumulator, grid_of
from multidrop.history.compact import compact
from multidrop.history.database import Database
from multidrop.history.sources import Replaced, Sources
from multidrop.polling.batch import Row
from multidrop.recording import open_recording
from multidrop.recording.arrow_decoder import MOST_CODES
from multidrop.recording.rows import from_rows
from multidrop.recording.segments import SegmentWriter

SERIES = [f"pump-{number}.{register}" for number in range(3) for register in ("speed", "current")]
COMPACTED = pytest.mark.parametrize("compacted", usually(2, 0, 4), ids="{} compacted".format)


@pytest.fixture(scope="module")
def rows() -> list[list[Row]]:
    """Return rows of four segments, with a gap before the third and a clock set back before the fourth."""
    begins = (NOON, NOON + 80 * SECOND, NOON + 300 * SECOND, NOON + 60 * SECOND)
    made = [random_rows(seed, begin, 400) for seed, begin in enumerate(begins)]
    return [
        [row._replace(monotonic_ns=number * DAY + row.monotonic_ns) for row in some]
        for number, some in enumerate(made)
    ]


@pytest.fixture
def folder(tmp_path: Path, rows: list[list[Row]], compacted: int) -> Path:
    record(tmp_path, rows)
    if compacted:
        pytest.importorskip("duckdb", reason="needs duckdb")
        compact(tmp_path, compacted + 1)
    return tmp_path


def flat(rows: list[list[Row]]) -> list[Row]:
    return [row for some in rows for row in some]


@pytest.mark.slow
@COMPACTED
def test_a_history_returns_rows_in_the_order_of_recording(folder: Path, rows: list[list[Row]]) -> None:
    with History(folder) as history:
        found = history.read()
        assert found.metadata == METADATA
        assert [row for batch in found for row in batch] == flat(rows)
        assert [row for batch in found for row in batch] == flat(rows)  # also at a second iteration
        assert history.damage == []


@pytest.mark.slow
@COMPACTED
def test_a_history_reads_the_given_series_in_the_given_time_range(
    folder: Path, rows: list[list[Row]]
) -> None:
    dice = random.Random(5)
    times = [row.time_ns for row in flat(rows)]
    with History(folder) as history:
        for _ in range(examples(30)):
            begin, end = sorted(dice.sample(times, 2))
            names = dice.sample(SERIES, dice.randrange(1, 4))
            wanted = [
                row
                for row in flat(rows)
                if begin <= row.time_ns < end and f"{row.drive}.{row.register}" in names
            ]
            assert rows_in(history, names, begin, end) == wanted


@pytest.mark.long
@COMPACTED
def test_buckets_of_a_history_equal_those_of_plain_python(folder: Path, rows: list[list[Row]]) -> None:
    dice = random.Random(6)
    times = [row.time_ns for row in flat(rows)]
    with History(folder) as history:
        for _ in range(examples(30)):
            begin, end = sorted(dice.sample(times, 2))
            points = dice.choice((1, 3, 17, 40, 800))
            found = history.buckets(SERIES, begin, end, points)
            assert list(found) == SERIES
            for series, buckets in found.items():
                assert len(buckets) <= max(points, 2)
                assert buckets.begin <= begin
                assert buckets.begin + buckets.step * len(buckets) >= end
                check_buckets(buckets, flat(rows), series)


@pytest.mark.slow
@COMPACTED
def test_buckets_without_rows_have_no_values(folder: Path) -> None:
    with History(folder) as history:
        found = history.buckets("pump-1.speed", NOON - 600 * SECOND, NOON + DAY, 10_000)["pump-1.speed"]
        nothing = history.buckets("pump-9.speed", NOON, NOON + DAY, 10)["pump-9.speed"]
    assert found.step == 10 * SECOND
    assert found.n[:60] == found.missed[:60] == [0] * 60
    assert found.least[:60] == found.mean[:60] == found.most[:60] == [None] * 60
    assert set(found.n[60:70]) != {0}
    assert set(nothing.mean) == {None}


@pytest.mark.slow
@COMPACTED
def test_an_export_of_a_history_has_the_rows_that_read_returns(folder: Path, rows: list[list[Row]]) -> None:
    begin, end = NOON + 20 * SECOND, NOON + 320 * SECOND
    wanted = [row for row in flat(rows) if begin <= row.time_ns < end and row.drive == "pump-1"]
    names = ["pump-1.speed", "pump-1.current"]
    with History(folder) as history:
        for name in ("a.csv", "a.arrows", "a.parquet"):
            assert history.export(folder / name, names, begin, end) == len(wanted)
            reader = open_recording(folder / name)
            assert sorted(row for batch in reader for row in batch) == sorted(wanted)
            assert reader.metadata == METADATA
            with pytest.raises(ValueError, match="exists already"):
                history.export(folder / name, names, begin, end)
        text = b"".join(history.csv(names, begin, end))
    without = [line.rpartition(b",") for line in text.splitlines()]
    assert b"".join(line + b"\n" for line, _, _ in without) == (folder / "a.csv").read_bytes()
    assert {unit for _, _, unit in without} == {b"unit", b"rpm", b""}
    (folder / "units.csv").write_bytes(text)
    assert [row for batch in open_recording(folder / "units.csv") for row in batch] == [
        row for batch in open_recording(folder / "a.csv") for row in batch
    ]


@pytest.mark.slow
@COMPACTED
def test_history_rows_convert_to_a_pandas_table(folder: Path, rows: list[list[Row]]) -> None:
    pytest.importorskip("pandas", reason="needs pandas")
    with History(folder) as history:
        frame = history.read("pump-2.current").to_pandas()
    mine = [row for row in flat(rows) if (row.drive, row.register) == ("pump-2", "current")]
    assert frame.status.tolist() == [row.status for row in mine]
    assert frame.value.dropna().tolist() == [row.value for row in mine if row.value is not None]


def test_a_time_range_may_be_given_in_ns_or_as_datetimes(tmp_path: Path) -> None:
    rows = random_rows(1, NOON, 300)
    record(tmp_path, [rows])
    moment = datetime(2026, 11, 21, 12, 0, 20, tzinfo=UTC)
    with History(tmp_path) as history:
        wanted = [row for row in rows if row.time_ns >= NOON + 20 * SECOND]
        assert rows_in(history, None, moment) == wanted
        assert rows_in(history, None, moment.astimezone(timezone(timedelta(hours=3)))) == wanted
        with pytest.raises(ValueError, match="has no time zone"):
            history.read(None, moment.replace(tzinfo=None))
        with pytest.raises(TypeError, match="a time must be UTC in ns, or a datetime"):
            history.read(None, 1.5)  # type: ignore[arg-type]


def test_invalid_queries_of_a_history_raise_errors(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        History(tmp_path / "none")
    with History(tmp_path) as history:
        assert rows_in(history) == []
        for name in ("pump-1", "", ".speed", "pump-1."):
            with pytest.raises(ValueError, match=r"invalid series .*: write a drive and a register, such as"):
                history.buckets(name, NOON, NOON + DAY)
        with pytest.raises(ValueError, match="name at least one series"):
            history.buckets([], NOON, NOON + DAY)
        with pytest.raises(ValueError, match="empty range: it starts at"):
            history.buckets("a.b", NOON, NOON)
        with pytest.raises(ValueError, match="invalid points = 0: write 1 to 100000"):
            history.buckets("a.b", NOON, NOON + DAY, 0)


def test_buckets_cover_the_requested_range() -> None:
    dice = random.Random(7)
    for _ in range(examples(6700)):
        begin = NOON + dice.randrange(DAY)
        end = begin + round(10 ** dice.uniform(0, 18))
        points = round(10 ** dice.uniform(0, 5))
        grid = grid_of(begin, end, points)
        assert grid.begin <= begin
        assert grid.end >= end
        assert grid.points <= max(points, 2)
        assert grid.begin + grid.step > begin
        assert grid.end - grid.step < end
        assert grid.step < 10 * SECOND or grid.is_of_tens


def test_requested_buckets_of_2_s_or_more_use_the_ten_second_summaries() -> None:
    hour = NOON, NOON + 3600 * SECOND
    assert grid_of(*hour, 1800).is_of_tens
    assert grid_of(*hour, 1801).step < 2 * SECOND


@pytest.mark.long
def test_a_reader_sees_new_rows_exactly_once(tmp_path: Path) -> None:
    pytest.importorskip("duckdb", reason="needs duckdb")
    rows: list[Row] = []
    with SegmentWriter(tmp_path / "rows.arrows", METADATA, every=1e9) as writer, History(tmp_path) as history:
        for number in range(30):
            some = random_rows(number, NOON + number * 20 * SECOND, 50)
            writer.write(from_rows(some))
            rows += some
            assert rows_in(history) == rows
            check_buckets(
                history.buckets("pump-0.speed", NOON, NOON + 600 * SECOND, 60)["pump-0.speed"],
                rows,
                "pump-0.speed",
            )
            if number % 4 == 3:
                writer.rotate()
            if number % 8 == 5:
                compact(tmp_path, writer.open_number)


@pytest.mark.slow
def test_a_reader_loses_no_row_when_files_are_compacted_meanwhile(tmp_path: Path) -> None:
    """Files are compacted after they were listed and before they are read."""
    pytest.importorskip("duckdb", reason="needs duckdb")
    rows = [random_rows(number, NOON + number * 60 * SECOND, 200) for number in range(4)]
    record(tmp_path, rows)
    with History(tmp_path) as history:
        found = iter(history.read())
        first = list(next(found))
        compact(tmp_path, 4)  # the reader has opened only the first segment
        assert first + [row for batch in found for row in batch] == flat(rows)
    with History(tmp_path) as history:
        found = iter(history.read())
        first = list(next(found))
        for path in tmp_path.glob("rows/00000003.*"):
            path.unlink()  # as the recorder does with old files
        left = first + [row for batch in found for row in batch]
    assert left == flat([*rows[:2], rows[3]])


@pytest.mark.slow
def test_series_that_first_appear_in_a_later_segment_are_read(tmp_path: Path) -> None:
    rows = random_rows(1, NOON, 60)
    later = [row._replace(drive="насос, «новый»", register="torque") for row in random_rows(2, NOON, 60)]
    record(tmp_path, [[*rows, *later], later])
    with History(tmp_path) as history:
        for _ in range(2):
            assert rows_in(history, "насос, «новый».torque") == [*later, *later]
            pytest.importorskip("duckdb", reason="needs duckdb")
            compact(tmp_path, 2)


def test_segments_written_by_poll_are_read_as_a_history(tmp_path: Path) -> None:
    rows = random_rows(1, NOON, 100)
    with SegmentWriter(tmp_path / "run.arrows", METADATA, every=1e9) as writer:
        for at in (0, 50):
            writer.write(from_rows(rows[at : at + 50]))
            writer.rotate()
    with History(tmp_path / "run.arrows") as history:
        assert rows_in(history) == rows


@pytest.mark.long
def test_other_segments_are_read_if_one_is_damaged(tmp_path: Path) -> None:
    rows = [
        random_rows(number, NOON + number * 60 * SECOND, count) for number, count in enumerate((20, 120, 20))
    ]
    record(tmp_path, rows)
    path, dice = tmp_path / "rows.00000002.arrows", random.Random(9)
    whole = path.read_bytes()
    damaged = 0
    for _ in range(examples(340)):
        data = bytearray(whole)
        for _ in range(dice.choice((1, 1, 8))):
            data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
        path.write_bytes(data)
        with History(tmp_path) as history:
            found = rows_in(history)
            assert found[:20] == rows[0]
            assert found[-20:] == rows[2]
            history.buckets(SERIES, NOON, NOON + DAY, 700)
            history.buckets(SERIES, NOON, NOON + 300 * SECOND, 700)
            damaged += bool(history.damage)
    assert damaged


def test_an_incomplete_end_of_a_closed_segment_is_reported(tmp_path: Path) -> None:
    rows = [random_rows(number, NOON + number * 60 * SECOND, 120) for number in range(2)]
    record(tmp_path, rows)
    # Segment 2 is the newest one. Its incomplete end is not damage, because a recorder may still write to it.
    for number in (2, 1):
        path = tmp_path / f"rows.0000000{number}.arrows"
        path.write_bytes(path.read_bytes() + b"\0" * 7)
        with History(tmp_path) as history:
            assert rows_in(history) == flat(rows)
            told = [] if number == 2 else [f"{path} ends within a batch: its last 7 bytes were skipped"]
            assert history.damage == told


def test_an_export_without_duckdb_uses_pyarrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("duckdb", reason="needs duckdb")
    rows = [random_rows(number, NOON + number * 60 * SECOND, 200) for number in range(2)]
    record(tmp_path, rows)
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "duckdb", None)
        with History(tmp_path) as history:
            assert rows_in(history) == flat(rows)
            check_buckets(
                history.buckets("pump-0.speed", NOON, NOON + 99 * SECOND)["pump-0.speed"],
                flat(rows),
                "pump-0.speed",
            )
            # pyarrow writes this file, because duckdb cannot be imported here
            assert history.export(tmp_path / "a.parquet") == 400
    compact(tmp_path, 2)
    monkeypatch.setitem(sys.modules, "duckdb", None)
    with History(tmp_path) as history:
        assert history.metadata() == METADATA
        for ask in (lambda: rows_in(history), lambda: history.buckets("pump-0.speed", NOON, NOON + DAY)):
            with pytest.raises(ImportError, match=r"needs duckdb.*pip install 'duckdb>"):
                ask()


@pytest.mark.slow
@pytest.mark.parametrize("most", [0, 150, 100_000], ids="{} rows are kept".format)
def test_buckets_include_all_new_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """Some ranges start before the cached rows, others long after them."""
    monkeypatch.setattr(growing, "MOST_KEPT", most)
    monkeypatch.setattr(growing, "MOST_TENS", 3 if most else 0)
    dice = random.Random(most)
    rows = random_rows(5, NOON, 400) + random_rows(6, NOON + 20 * SECOND, 200)  # the clock was set back
    with SegmentWriter(tmp_path / "rows.arrows", METADATA, every=1e9) as writer, History(tmp_path) as history:
        for at in range(0, len(rows), 40):
            writer.write(from_rows(rows[at : at + 40]))
            for _ in range(5):
                begin = NOON + dice.randrange(-5, 120) * SECOND
                end = begin + dice.randrange(1, 100) * SECOND
                series = dice.sample(SERIES, dice.randrange(1, 4))
                for points in (97, 4):
                    for name, found in history.buckets(series, begin, end, points).items():
                        check_buckets(found, rows[: at + 40], name)
                assert not grid_of(begin, end, 97).is_of_tens
                assert end - begin < 8 * SECOND or grid_of(begin, end, 4).is_of_tens


def test_the_cache_of_unknown_series_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growing, "MOST_SERIES", 3)
    with SegmentWriter(tmp_path / "rows.arrows", METADATA, every=1e9) as writer, History(tmp_path) as history:
        writer.write(from_rows(random_rows(1, NOON, 200)))
        for at in range(9):
            (found,) = history.buckets(f"nobody.register-{at}", NOON, NOON + SECOND, 97).values()
            assert sum(found.n) == 0
            (segment,) = history._sources._growing.values()
            assert len(segment._kept) == min(at + 1, 3)


def test_ten_second_summaries_are_computed_for_requested_series_only(tmp_path: Path) -> None:
    with SegmentWriter(tmp_path / "rows.arrows", METADATA, every=1e9) as writer, History(tmp_path) as history:
        for number, name in enumerate(SERIES[:2]):
            writer.write(from_rows(random_rows(number, NOON + number * 60 * SECOND, 200)))
            history.buckets(name, NOON, NOON + DAY)
            (segment,) = history._sources._growing.values()
            assert [".".join(one) for one in segment._tens] == SERIES[: number + 1][::-1]


def test_duckdb_uses_a_private_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("duckdb", reason="needs duckdb")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    database = Database("100MB")
    with closing(database.cursor()) as cursor:
        [(spill,)] = cursor.execute("select current_setting('temp_directory')").fetchall()
    assert [Path(spill)] == list(tmp_path.iterdir())
    assert stat.S_IMODE(Path(spill).stat().st_mode) == 0o700
    database.close()
    assert list(tmp_path.iterdir()) == []


def test_history_read_is_repeated_if_files_are_replaced_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each file that the reader lists is replaced before it is read, as may happen on a busy machine."""
    record(tmp_path, [random_rows(1, NOON, 100)])
    replaced = iter(range(20))

    def known(self: Sources, *given: Any) -> Any:
        if next(replaced, None) is not None:
            raise Replaced
        return real(self, *given)

    real = Sources.known
    monkeypatch.setattr(Sources, "known", known)
    with History(tmp_path) as history:
        assert sum(map(len, history.read(None))) == 100
    assert next(replaced, None) is None


def test_segments_of_version_0_1_are_read(tmp_path: Path, rows: list[list[Row]]) -> None:
    """In this format, names have no codes. The value of one row has no uncertainty."""
    first = [rows[0][0]._replace(uncertainty_ns=None), *rows[0][1:]]
    record_as_before(tmp_path / "run.00000001.arrows", from_rows(first))
    with SegmentWriter(tmp_path / "run.arrows", METADATA, every=60.0) as writer:
        writer.write(from_rows(rows[1]))
    wanted = [*first, *rows[1]]
    begin, end = first[0].time_ns, max(row.time_ns for row in wanted) + 1
    with History(tmp_path / "run.arrows") as history:
        assert rows_in(history) == wanted
        assert rows_in(history, ["pump-1.speed"], begin, end) == [
            row for row in wanted if (row.drive, row.register) == ("pump-1", "speed")
        ]
        for points in (5, 800):
            for series, buckets in history.buckets(SERIES, begin, end, points).items():
                check_buckets(buckets, wanted, series)
        assert history.damage == []


def test_a_segment_of_version_0_1_with_too_many_names_is_damaged(tmp_path: Path) -> None:
    rows = [Row(at, at, None, "pump", f"r{at}", None, "no reply") for at in range(MOST_CODES + 1)]
    record_as_before(tmp_path / "run.00000001.arrows", from_rows(rows))
    with History(tmp_path / "run.arrows") as history:
        assert rows_in(history) == []
        assert "65537 names; the limit is 65536" in history.damage[0]


@pytest.mark.slow
@pytest.mark.parametrize("points", [5, 20], ids=["ten-second summaries", "rows"])
@pytest.mark.parametrize("compacted", [0, 1], ids="{} compacted".format)
def test_buckets_count_infinite_values_as_missed(tmp_path: Path, compacted: int, points: int) -> None:
    values = [1.0, inf, 3.0, -inf, 1.5]
    rows = [
        Row(NOON + at * SECOND // 10, DAY + at, 1, "pump-1", "speed", value, "ok")
        for at, value in enumerate(values)
    ]
    record(tmp_path, [rows])
    if compacted:
        pytest.importorskip("duckdb", reason="needs duckdb")
        compact(tmp_path, compacted + 1)
    end = NOON + (20 if points == 20 else 50) * SECOND
    with History(tmp_path) as history:
        found = history.buckets("pump-1.speed", NOON, end, points)["pump-1.speed"]
        assert [row.value for row in rows_in(history)] == values
    assert (found.n[0], found.missed[0]) == (3, 2)
    assert (found.least[0], found.most[0]) == (1.0, 3.0)
    assert found.mean[0] == pytest.approx(5.5 / 3)


@pytest.mark.parametrize("value", [0.1, 1.7e308, -1.7e308])
def test_mean_of_equal_values_is_exactly_that_value(value: float) -> None:
    """Their sum is rounded, or exceeds the largest float."""
    gathered = Accumulator(grid_of(0, 10, 1))
    gathered.add_rows([1] * 1000, [value] * 1000, [1] * 1000)
    assert gathered.buckets().mean == [value]
