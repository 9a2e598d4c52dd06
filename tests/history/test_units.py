"""If a register has another unit in a new segment, values of the two units are never mixed."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from histories import DAY, NOON, SECOND, batch

import multidrop
from multidrop import History
from multidrop.core.columns import Names
from multidrop.history import Buckets, HistoryWriter
from multidrop.history.compact import compact
from multidrop.history.units import units_by_series
from multidrop.polling.batch import Row, Rows
from multidrop.recording.rows import from_rows
from multidrop.recording.segments import SegmentWriter

SERIES, OTHER = "pump-1.load", "pump-2.load"
AMPERE, PERCENT, RAW = {"unit": "A"}, {"unit": "%"}, {"unit": "A", "step": None}
STATES, OTHER_STATES = {"values": {"RUN": 1, "STOP": 2}}, {"values": {"STOP": 1, "RUN": 2}}


def described(about: dict[str, Any]) -> dict[str, Any]:
    """Return metadata of two pumps. `about` describes the `load` of pump-1; that of pump-2 is in A."""
    drives = {"pump-1": {"registers": {"load": about}}, "pump-2": {"registers": {"load": AMPERE}}}
    return {"drives": drives}


def recorded(folder: Path, *segments: dict[str, Any]) -> None:
    """Record one segment for each description of the register, each with its own value."""
    with SegmentWriter(folder / "rows.arrows", {}, every=1e9) as writer:
        for number, about in enumerate(segments):
            writer.rotate(described(about))
            begin = NOON + number * 60 * SECOND
            writer.write(
                from_rows(
                    [
                        Row(begin + at * SECOND, at, 0, drive, "load", 10.0**number, "ok")
                        for at in range(30)
                        for drive in ("pump-1", "pump-2")
                    ]
                )
            )


@pytest.fixture(params=["segments", "files", "days"])
def how(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def kept(folder: Path, how: str, count: int) -> None:
    """Keep the history as "segments", compacted "files", or "days" with merged summaries."""
    if how == "segments":
        return
    pytest.importorskip("duckdb", reason="needs duckdb")
    if how == "days":
        with SegmentWriter(folder / "rows.arrows", {}, every=1e9) as writer:
            writer.write(from_rows([Row(NOON + 2 * DAY, 0, 0, "fan", "load", 1.0, "ok")]))
        count += 1
    compact(folder, count + 1)


def of(
    folder: Path, points: int, begin: int = NOON, end: int = NOON + 300 * SECOND
) -> tuple[Buckets, Buckets]:
    with History(folder) as history:
        for _ in range(2):  # the second query uses cached metadata
            found = history.buckets([SERIES, OTHER], begin, end, points)
    return found[SERIES], found[OTHER]


@pytest.mark.slow
@pytest.mark.parametrize("points", [300, 30])
def test_a_summary_leaves_out_values_in_an_earlier_unit(tmp_path: Path, how: str, points: int) -> None:
    recorded(tmp_path, AMPERE, PERCENT, AMPERE, PERCENT)
    kept(tmp_path, how, 4)
    found, other = of(tmp_path, points)
    assert {value for value in (*found.least, *found.most) if value is not None} == {10.0, 1000.0}
    assert (sum(found.n), found.unit, found.left_out) == (60, "%", ("A",))
    assert (sum(other.n), other.unit, other.left_out) == (120, "A", ())


@pytest.mark.slow
def test_buckets_of_a_range_with_one_unit_have_that_unit(tmp_path: Path, how: str) -> None:
    recorded(tmp_path, AMPERE, PERCENT)
    kept(tmp_path, how, 2)
    before, _ = of(tmp_path, 40, end=NOON + 40 * SECOND)
    after, _ = of(tmp_path, 40, begin=NOON + 50 * SECOND)
    assert (sum(before.n), max(filter(None, before.most)), before.unit, before.left_out) == (30, 1.0, "A", ())
    assert (sum(after.n), max(filter(None, after.most)), after.unit, after.left_out) == (30, 10.0, "%", ())


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        (AMPERE, {"unit": "A", "step": 0.01}, ("A", 60, ())),  # only the step differs: the same quantity
        (RAW, AMPERE, ("A", 30, ("raw count",))),
        (STATES, OTHER_STATES, ("names", 30, ("names",))),
        (STATES, STATES, ("names", 60, ())),
        ({}, AMPERE, ("A", 30, ("",))),
    ],
)
def test_values_with_equal_units_or_value_names_are_combined(
    tmp_path: Path, first: dict[str, Any], second: dict[str, Any], told: tuple[str, int, tuple[str, ...]]
) -> None:
    recorded(tmp_path, first, second)
    found, _ = of(tmp_path, 300)
    assert (found.unit, sum(found.n), found.left_out) == told


def test_units_are_not_read_from_invalid_metadata() -> None:
    for strange in (
        None,
        [],
        {"drives": []},
        {"drives": {"pump-1": None}},
        {"drives": {"a": {"registers": 3}}},
    ):
        assert units_by_series(strange) == {}
    assert units_by_series({"drives": {"a": {"registers": {"b": 3, "c": {"values": [1]}}}}}).keys() == {
        ("a", "c")
    }


def test_rows_polled_before_a_plant_change_are_in_the_earlier_segment(tmp_path: Path) -> None:
    writer = HistoryWriter(tmp_path, {"drives": {"pump-1": {"registers": {"speed": AMPERE}}}})
    names = Names(["pump-1"])
    for first, unit in ((0, PERCENT), (10, AMPERE), (20, AMPERE)):
        writer.take(batch(names, 0, range(first, first + 9), NOON, SECOND))
        writer.begin({"drives": {"pump-1": {"registers": {"speed": unit}}}})
    writer.close()
    with History(tmp_path) as history:
        found = history.buckets("pump-1.speed", NOON, NOON + 30 * SECOND, 30)["pump-1.speed"]
    assert found.n == [1] * 9 + [0] * 11 + [1] * 9 + [0]
    assert (found.unit, found.left_out) == ("A", ("%",))


def columns_of(recording: Iterable[Rows]) -> dict[str, set[float | None]]:
    """Return the set of values in each column."""
    found: dict[str, set[float | None]] = {}
    for rows in recording:
        for row in rows:
            found.setdefault(f"{row.drive}.{row.register}", set()).add(row.value)
    return found


PARTED = {SERIES: {10.0, 1000.0}, f"{SERIES} [A]": {1.0, 100.0}, OTHER: {1.0, 10.0, 100.0, 1000.0}}


@pytest.mark.long
def test_rows_with_an_earlier_unit_have_a_separate_column(tmp_path: Path, how: str) -> None:
    """The column's name has the unit, in queries and in every export."""
    (tmp_path / "h").mkdir()
    recorded(tmp_path / "h", AMPERE, PERCENT, AMPERE, PERCENT)
    kept(tmp_path / "h", how, 4)
    with History(tmp_path / "h") as history:
        rows = history.read([SERIES, OTHER], end=NOON + 300 * SECOND)
        assert columns_of(rows) == PARTED
        about = rows.metadata["drives"]["pump-1"]["registers"]
        assert (about["load"]["unit"], about["load [A]"]["unit"]) == ("%", "A")
        assert columns_of(history.read(SERIES, NOON, NOON + 40 * SECOND)) == {SERIES: {1.0}}
        old = history.read(None, NOON, NOON + 40 * SECOND)
        assert (columns_of(old), old.metadata["drives"]["pump-1"]["registers"]["load"]["unit"]) == (
            {SERIES: {1.0}, OTHER: {1.0}},
            "A",
        )
        for kind in ("csv", "arrows", "parquet"):
            path = tmp_path / f"out.{kind}"
            if kind == "parquet":
                pytest.importorskip("duckdb", reason="needs duckdb")
            history.export(path, [SERIES, OTHER], end=NOON + 300 * SECOND)
            found = multidrop.open_recording(path)
            assert columns_of(found) == PARTED
            if kind != "csv":
                assert found.metadata["drives"]["pump-1"]["registers"]["load [A]"]["unit"] == "A"


def test_columns_keep_their_unit_while_the_history_grows(tmp_path: Path) -> None:
    recorded(tmp_path, AMPERE)
    with History(tmp_path) as history:
        rows = history.read(SERIES)
        assert columns_of(rows) == {SERIES: {1.0}}
        with SegmentWriter(tmp_path / "rows.arrows", described(PERCENT), every=1e9) as writer:
            writer.write(from_rows([Row(NOON + DAY, DAY, 0, "pump-1", "load", 50.0, "ok")]))
        assert columns_of(rows) == {SERIES: {1.0}, f"{SERIES} [%]": {50.0}}
        assert columns_of(history.read(SERIES)) == {SERIES: {50.0}, f"{SERIES} [A]": {1.0}}


def test_register_gets_two_columns_if_its_value_names_change(tmp_path: Path) -> None:
    recorded(tmp_path, STATES, OTHER_STATES, AMPERE)
    with History(tmp_path) as history:
        rows = history.read(SERIES)
        registers = rows.metadata["drives"]["pump-1"]["registers"]
        found = columns_of(rows)
    assert found == {SERIES: {100.0}, f"{SERIES} [names]": {10.0}, f"{SERIES} [names 2]": {1.0}}
    assert registers["load [names]"]["values"] == OTHER_STATES["values"]
    assert registers["load [names 2]"]["values"] == STATES["values"]


@pytest.mark.long
def test_compacted_files_have_the_unit_of_each_row(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb", reason="needs duckdb")
    recorded(tmp_path, AMPERE, RAW, STATES, {})
    kept(tmp_path, "days", 4)
    for files, column in (("rows", "value"), ("tens", "mean")):
        query = f"""select {column}, min(unit), max(unit) from read_parquet($path, union_by_name = true)
            where drive = 'pump-1' group by all order by 1"""
        found = duckdb.execute(query, {"path": f"{tmp_path}/{files}/*.parquet"}).fetchall()
        assert found == [
            (1.0, "A", "A"),
            (10.0, "raw count", "raw count"),
            (100.0, "names", "names"),
            (1000.0, "", ""),
        ]
