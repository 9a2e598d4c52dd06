"""Batches as tables of pandas and polars, and in the wide form."""

from __future__ import annotations

import builtins
import importlib
import re
import subprocess
import sys
from typing import Any

import pyarrow as pa
import pytest
from batches import EXAMPLE, SECOND, UTC_0, add_miss, add_rows, block, completion, example
from recordings import row

from multidrop.core import Columns, Names, Status
from multidrop.extras import install_command
from multidrop.polling.batch import ROW_COLUMNS, Batch, Row
from multidrop.recording.rows import from_rows

PUMP = "pump-1.output_frequency"
SPEED = "pump-1.motor_speed"


@pytest.mark.slow
def test_to_pandas_returns_times_as_datetime64_in_utc() -> None:
    pytest.importorskip("pandas", reason="needs pandas")
    frame = example().to_pandas()
    assert list(frame.columns) == list(ROW_COLUMNS)
    assert str(frame["time"].dtype) == "datetime64[ns, UTC]"
    assert [time.value for time in frame["time"]] == [row.time_ns for row in EXAMPLE]
    assert list(frame["value"].isna()) == [row.value is None for row in EXAMPLE]
    assert list(frame["value"].dropna()) == [49.99, 0.3]
    assert list(frame["status"]) == [row.status for row in EXAMPLE]


@pytest.mark.slow
def test_to_polars_returns_times_as_datetime_in_utc() -> None:
    polars = pytest.importorskip("polars", reason="needs polars")
    frame = example().to_polars()
    assert frame.schema["time"] == polars.Datetime("ns", "UTC")
    assert [
        Row(*each) for each in frame.with_columns(time=frame["time"].to_physical()).iter_rows()
    ] == EXAMPLE


@pytest.mark.parametrize(
    ("method", "missing", "sentence"),
    [
        ("to_pandas", "pandas", r"to_pandas\(\) needs pandas, which is not installed: .*multidrop\[pandas\]"),
        ("to_pandas", "pyarrow", r"to_pandas\(\) needs pyarrow, which is not .*multidrop\[pandas\]"),
        ("to_polars", "polars", r"to_polars\(\) needs polars, which is not installed: .*multidrop\[polars\]"),
    ],
)
def test_the_error_for_a_missing_library_has_the_install_command(
    monkeypatch: pytest.MonkeyPatch, method: str, missing: str, sentence: str
) -> None:
    pytest.importorskip("pandas", reason="needs pandas")

    def without(name: str) -> Any:
        if name == missing:
            raise ImportError(name)
        return builtins.__import__(name)

    monkeypatch.setattr(importlib, "import_module", without)
    for table in (example(), example().wide()):
        with pytest.raises(ImportError, match=sentence):
            getattr(table, method)()


def test_one_command_installs_the_libraries_of_several_extras() -> None:
    """Everything after the `#` is a comment for the shell, so all libraries must come before the `#`."""
    command, _, comment = install_command("serve", "plot").partition("#")
    assert {"matplotlib", "starlette", "uvicorn"} <= {*re.findall(r"[a-z]{3,}", command)}
    assert comment == " multidrop[serve,plot]"


@pytest.mark.long
def test_no_library_is_imported_before_it_is_needed() -> None:
    code = (
        "import sys, multidrop; multidrop.Poller, multidrop.open_recording, multidrop.Batch; "
        "import multidrop.cli.poll; print(*sys.modules)"
    )
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    late = {"pandas", "polars", "pyarrow", "numpy", "nanoarrow"}
    late |= {
        "importlib.metadata",
        "multidrop.families.files.loader",
    }  # modules that most programs do not need: few use family files or captures
    assert late.isdisjoint(told.stdout.split())


# ---- the wide form ----


def test_registers_of_one_request_share_a_row() -> None:
    wide = example().wide()
    assert wide.columns == [
        *("time", "monotonic_ns", PUMP, SPEED),
        *('fan, the "old" one.output_frequency', "насос.motor_speed", 'fan, the "old" one.motor_speed'),
    ]
    table = pa.table(wide)
    table.validate(full=True)
    assert table.schema.field("time").type == pa.timestamp("ns", "UTC")
    assert table.schema.field(PUMP).type == pa.float64()
    assert len(wide) == table.num_rows == 4
    assert table.column(PUMP).to_pylist() == [49.99, None, None, None]
    assert table.column(SPEED).to_pylist() == [0.3, None, None, None]
    times = table.column("time").cast(pa.int64()).to_pylist()
    assert times == [UTC_0 + second * SECOND for second in (1, 2, 3, 4)]
    assert table.column("monotonic_ns").to_pylist() == [second * SECOND for second in (1, 2, 3, 4)]


def test_pandas_and_polars_read_the_wide_form() -> None:
    pytest.importorskip("pandas", reason="needs pandas")
    polars = pytest.importorskip("polars", reason="needs polars")
    frame = example().wide(PUMP, SPEED).to_pandas()
    assert str(frame["time"].dtype) == "datetime64[ns, UTC]"
    assert list(frame.columns) == ["time", "monotonic_ns", PUMP, SPEED]
    assert frame[SPEED].tolist() == [0.3]
    frame = example().wide(SPEED).to_polars()
    assert frame.schema == {
        "time": polars.Datetime("ns", "UTC"),
        "monotonic_ns": polars.Int64,
        SPEED: polars.Float64,
    }
    assert frame[SPEED].to_list() == [0.3]


def test_chosen_columns_are_all_present_in_the_chosen_order() -> None:
    """Then all batches have the same columns: a column is present even if the batch has no row for it."""

    never = "насос.output_frequency"
    wide = example().wide(never, SPEED, PUMP)
    assert wide.columns == ["time", "monotonic_ns", never, SPEED, PUMP]
    table = pa.table(wide)
    assert table.column(never).to_pylist() == [None]
    assert table.column(PUMP).to_pylist() == [49.99]


def test_an_unknown_column_raises_value_error() -> None:
    with pytest.raises(ValueError, match=r"no column 'pump-1\.motor_sped'; did you mean pump-1\.motor_"):
        example().wide("pump-1.motor_sped")
    with pytest.raises(ValueError, match=r"there is no column 'x'; a column is DRIVE\.REGISTER"):
        example().wide("x")
    with pytest.raises(ValueError, match=f"column '{PUMP}' is chosen twice"):
        example().wide(PUMP, PUMP)


def test_rows_of_the_wide_form_are_sorted_by_time() -> None:
    """Rows of two lines may arrive out of order; the table is sorted by time."""
    rows = [row(second, "pump", name, second) for name in ("b", "a") for second in (3.0, 1.0, 2.0)]
    table = pa.table(from_rows(rows).wide())
    assert table.column("pump.a").to_pylist() == table.column("pump.b").to_pylist() == [1.0, 2.0, 3.0]
    assert table.column("monotonic_ns").to_pylist() == [SECOND, 2 * SECOND, 3 * SECOND]


def test_only_rows_with_equal_times_are_joined() -> None:
    early = row(1.0, "pump", "a", 1.0)
    rows = [
        early,
        early._replace(register="b", time_ns=early.time_ns + 1, monotonic_ns=early.monotonic_ns + 1),
    ]
    rows.append(rows[1]._replace(drive="fan"))  # a row of another line, at the same time to the nanosecond
    table = pa.table(from_rows(rows).wide())
    assert table.column("pump.a").to_pylist() == [1.0, None]
    assert table.column("pump.b").to_pylist() == table.column("fan.b").to_pylist() == [None, 1.0]


def test_rows_with_equal_utc_but_different_monotonic_times_are_not_joined() -> None:
    """If UTC repeats, the monotonic time still distinguishes the rows."""

    first = row(1.0, "pump", "a", 1.0)
    table = pa.table(from_rows([first._replace(monotonic_ns=2 * SECOND, value=2.0), first]).wide())
    assert table.column("pump.a").to_pylist() == [1.0, 2.0]


def test_a_miss_is_null_and_does_not_replace_a_sample() -> None:
    columns = Columns(4)
    assert add_rows(columns, block(0, 0), completion(SECOND, first_ns=SECOND, words=(100,)), UTC_0)
    assert add_miss(columns, block(0, 0), Status.NOT_ASKED, SECOND, UTC_0)
    assert add_miss(columns, block(0, 0), Status.NO_REPLY, 2 * SECOND, UTC_0)
    table = pa.table(Batch(columns, Names(["p"]), Names(["r"])).wide())
    assert table.column("p.r").to_pylist() == [1.0, None]


def test_an_empty_batch_has_an_empty_wide_form() -> None:
    wide = Batch(Columns(4), Names(["p"]), Names(["r"])).wide()
    assert (len(wide), wide.columns) == (0, ["time", "monotonic_ns"])
    assert pa.table(wide).num_rows == 0
    assert pa.table(Batch(Columns(4), Names(["p"]), Names(["r"])).wide("p.r")).num_rows == 0


def test_equal_column_names_of_two_drives_raise_value_error() -> None:
    rows = from_rows([row(1.0, "a.b", "c", 1.0), row(1.0, "a", "b.c", 2.0)])
    with pytest.raises(ValueError, match=r"'a\.b' and 'a' both have a column that is called 'a\.b\.c'"):
        rows.wide()


@pytest.mark.slow
def test_the_wide_form_equals_the_pivot_of_pandas() -> None:
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    rows = [
        row(second / 7, f"pump-{second % 3}", name, float(second), "ok")
        for second in range(2000)
        for name in ("a", "b")
        if second % 5 or name == "a"
    ]
    frame = from_rows(rows).to_pandas()
    frame["column"] = frame["drive"] + "." + frame["register"]
    theirs = frame.pivot(index="time", columns="column", values="value")
    ours = from_rows(rows).wide().to_pandas().set_index("time").drop(columns="monotonic_ns")
    pandas.testing.assert_frame_equal(
        ours[sorted(ours.columns)], theirs, check_names=False, check_index_type=False
    )
