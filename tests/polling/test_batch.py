"""Batches: read row by row, as columns, by Arrow libraries, and as a wide table."""

from __future__ import annotations

import asyncio
import builtins
import gc
import importlib
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import nanoarrow
import pyarrow as pa
import pytest
from batches import EXAMPLE, SECOND, UTC_0, add_miss, add_rows, block, completion, counting, example
from lines import line, plant, polled
from recordings import SCHEMA, row, rows_of
from tables import table
from toy import Toy

from multidrop.core import RS485, Columns, Echo, Names, RowQueue, Status, TransactionIds
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import ROW_COLUMNS, Batch, Row
from multidrop.printable import install_command
from multidrop.recording.rows import from_rows
from multidrop.sim import EncodedDrive, Simulator, Wire


def test_a_batch_yields_its_rows_repeatedly() -> None:
    batch = example()
    assert len(batch) == 5
    assert list(batch) == EXAMPLE
    assert list(batch) == EXAMPLE  # iterating again gives the same rows


def test_an_empty_batch_has_no_rows() -> None:
    batch = Batch(Columns(4), Names(["pump-1"]), Names())
    assert (len(batch), list(batch)) == (0, [])
    assert pa.record_batch(batch).num_rows == 0


@table("places", [[], [0], [4, 1], [0, 1, 2, 3, 4], [2, 2] * 9])
def test_the_method_at_returns_the_rows_at_the_given_indices(places: list[int]) -> None:
    wanted = [EXAMPLE[place] for place in places]
    found = example().at(places)
    assert list(found) == wanted
    assert rows_of(pa.record_batch(found)) == wanted


def test_a_list_of_wide_table_columns_raises_type_error() -> None:
    with pytest.raises(TypeError, match=r"wide takes column names as separate arguments, not \['"):
        example().wide(cast(Any, ["pump-1.speed"]))


@pytest.mark.parametrize("read", [pa.record_batch, pa.table])
def test_pyarrow_reads_the_rows_and_the_schema_of_a_batch(read: Callable[[Batch], Any]) -> None:
    found = read(example())
    found.validate(full=True)
    assert found.schema.equals(SCHEMA)
    assert rows_of(found) == EXAMPLE
    assert pa.schema(example()).equals(SCHEMA)


def test_arrow_data_stays_valid_after_the_batch_is_deleted() -> None:
    kept = [pa.record_batch(counting(100, start)) for start in range(0, 2000, 100)]
    values = [row.value for part in kept for row in rows_of(part)]
    assert values == [None if at % 10 == 9 else at for at in range(2000)]


@pytest.mark.parametrize("library", ["pandas", "numpy"])
def test_the_pandas_and_numpy_constructors_refuse_a_batch_with_advice(library: str) -> None:
    """The constructors of pandas and NumPy ignore Arrow's interface, and would read a batch row by row."""
    taker = pytest.importorskip(library, reason=f"needs {library}")
    take = taker.DataFrame if library == "pandas" else taker.asarray
    with pytest.raises(TypeError, match=r"Use batch\.to_pandas\(\)"):
        take(example())
    assert list(example()) == EXAMPLE


def test_duckdb_reads_a_batch() -> None:
    duckdb = pytest.importorskip("duckdb", reason="needs duckdb")
    batch = example()
    with duckdb.connect() as database:
        database.register("batch", batch)
        found = database.execute(
            "select epoch_ns(time), monotonic_ns, uncertainty_ns, drive, register, value, status from batch"
        ).fetchall()
    assert [Row(*row) for row in found] == EXAMPLE


def test_numpy_reads_missing_values_of_a_batch_as_nan() -> None:
    numpy = pytest.importorskip("numpy", reason="needs NumPy")
    taken = nanoarrow.Array(example())
    values = taken.child(5).to_pysequence(handle_nulls=nanoarrow.nulls_as_sentinel())
    numpy.testing.assert_array_equal(values, [49.99, 0.3, numpy.nan, numpy.nan, numpy.nan])
    monotonic = numpy.asarray(taken.child(1).to_pysequence())
    assert monotonic.dtype == numpy.int64
    assert list(monotonic) == [row.monotonic_ns for row in EXAMPLE]


def test_every_status_code_has_its_text() -> None:
    columns = Columns(300)
    for reason in Status:
        if reason is not Status.OK:
            assert add_miss(columns, block(0, 0), reason, SECOND, UTC_0)
    for code in range(1, 256):
        assert add_rows(columns, block(0, 0), completion(SECOND, exception=code), UTC_0)
    batch = Batch(columns, Names("a"), Names("b"))
    statuses = pa.record_batch(batch).column("status").to_pylist()
    reasons = [str(reason) for reason in Status if reason is not Status.OK]
    assert statuses == reasons + [f"exception {code:02X}" for code in range(1, 256)]
    assert [row.status for row in batch] == statuses
    assert all(statuses)


def test_the_columns_hold_all_rows_and_the_names_for_their_codes() -> None:
    columns = example().columns()
    drives, registers, statuses = columns.drives, columns.registers, columns.statuses
    rows = [
        Row(time, sent, near, drives[drive], registers[register], value, statuses[status])
        for time, sent, near, drive, register, value, status in zip(*columns[:7], strict=True)
    ]
    assert [row._replace(uncertainty_ns=None, value=None) for row in rows] == [
        row._replace(uncertainty_ns=None, value=None) for row in EXAMPLE
    ]
    samples = [at for at, status in enumerate(columns.status) if status == 0]
    assert [rows[at] for at in samples] == [row for row in EXAMPLE if row.status == "ok"]
    assert bytes(columns.valid) == bytes([sum(1 << at for at in samples)])


def test_the_columns_have_the_documented_types() -> None:
    columns = counting(20).columns()
    formats = {"time": "q", "monotonic_ns": "q", "uncertainty_ns": "q", "value": "d"}
    formats |= dict.fromkeys(("drive", "register", "status"), "H") | {"valid": "B"}
    for name, kind in formats.items():
        view = getattr(columns, name)
        assert (view.format, view.shape, view.readonly) == (kind, (3 if name == "valid" else 20,), True)
    numpy = pytest.importorskip("numpy")
    assert numpy.asarray(columns.value)[:9].tolist() == list(range(9))


def test_the_columns_stay_valid_after_their_batch_is_deleted() -> None:
    """The core's queue does not reuse a chunk of rows while a view of that chunk exists."""
    queue = RowQueue()
    names = Names(["a"])
    kept = []
    for at in range(200):
        queue.add_miss(block(0, 0), Status.NO_REPLY, at)
        taken = queue.take()
        assert taken is not None
        kept.append(Batch(taken, names, names).columns().monotonic_ns)
        del taken
    gc.collect()
    assert [list(view) for view in kept] == [[at] for at in range(200)]


def test_a_new_name_does_not_change_the_columns_of_earlier_batches() -> None:
    names = Names(["a"])
    first = Batch(Columns(1), names, names).columns()
    assert names.number("b") == 1
    assert (first.drives, Batch(Columns(1), names, names).columns().drives) == (("a",), ("a", "b"))


@pytest.fixture
def poller() -> Iterator[Poller]:
    with Simulator([Wire([EncodedDrive(Toy(1)), EncodedDrive(Toy(2))], unpaced=True)]) as simulator:
        toy = polled(Toy(1, name="pump-1"), [Toy.output_current])
        with Poller(plant(line(simulator.wires[0].path, toy))) as made:
            yield made


@pytest.mark.long
def test_a_for_loop_gets_batches_until_the_poller_is_closed(poller: Poller) -> None:
    rows = 0
    for batch in poller:
        rows += len(batch)
        if rows > 50:
            poller.close()
    assert rows > 50


async def test_an_async_loop_gets_every_row_after_another_loop_was_cancelled(poller: Poller) -> None:
    found: list[Row] = []

    async def collect() -> None:
        async for batch in poller:
            found.extend(batch)

    for least in (5, 10):
        collector = asyncio.create_task(collect())
        while len(found) < least:
            await asyncio.sleep(0.02)
        collector.cancel()
        with suppress(asyncio.CancelledError):
            await collector
    poller.close()
    for batch in poller:
        found.extend(batch)
    counted = poller.summary()
    assert len(found) == counted["samples"] + counted["misses"]
    assert found == sorted(found, key=lambda row: row.monotonic_ns)


def test_a_drive_is_found_by_its_name(poller: Poller) -> None:
    assert poller["pump-1"] is poller.bus("line").drives[0]
    with pytest.raises(KeyError, match="did you mean pump-1"):
        poller["pump-11"]
    assert "pump-1" in poller
    assert "pump-11" not in poller


def test_the_poll_list_of_an_added_drive_may_contain_names(poller: Poller) -> None:
    fan = poller.add("line", Toy(2, name="fan"), poll=["output_current", Polled(Toy.status)], every=0.05)
    assert poller["fan"] is fan
    (declared,) = (each for each in poller.plant.lines[0].drives if each.drive is fan)
    assert declared.polls == (Polled(Toy.output_current, 0.05), Polled(Toy.status, None))
    assert any(row.drive == "fan" for batch in poller.batches(0.5) for row in batch)


def test_a_plant_can_be_built_without_a_file() -> None:
    fan = Toy(2, name="fan")
    made = Plant([PlantLine("hall", "/dev/ttyUSB0", drives=[PolledDrive(fan, every=0.5)])])
    assert made == Plant(
        (PlantLine("hall", "/dev/ttyUSB0", drives=(PolledDrive(fan, made.lines[0].drives[0].polls),)),)
    )
    assert [poll.register for poll in made.lines[0].drives[0].polls] == list(fan.readings())


def test_a_star_in_python_polls_all_readings_that_have_no_other_entry() -> None:
    polled = PolledDrive(Toy(2), poll=["*", Polled("status", every=10.0)], every=0.5)
    others = [reading for reading in Toy.readings() if reading is not Toy.status]
    assert polled.polls == (*(Polled(one, 0.5) for one in others), Polled(Toy.status, 10.0))


def test_a_line_in_python_takes_the_values_of_a_plant_file_as_texts() -> None:
    line = PlantLine("hall", "/dev/ttyUSB0", echo="off", transaction="ignore", rs485="rts-up")
    assert (line.echo, line.transaction, line.rs485) == (Echo.OFF, TransactionIds.IGNORE, RS485.RTS_UP)
    with pytest.raises(ValueError, match=r'rs485 \'up\' is none of "off", "kernel", "rts-up" and "rts-down"'):
        PlantLine("hall", "/dev/ttyUSB0", rs485=cast(Any, "up"))


def test_a_line_in_python_gives_its_settings_to_drives_without_their_own() -> None:
    drives = [PolledDrive(Toy(2)), PolledDrive(Toy(3, baudrate=9600))]
    line = PlantLine("hall", "/dev/ttyUSB0", baudrate=19200, format="8E1", drives=drives)
    assert [str(polled.drive.settings) for polled in line.drives] == ["19200 8E1", "9600 8E1"]
    with pytest.raises(ValueError, match="baud rate 300 is not supported by TOY T1"):
        PlantLine("hall", "/dev/ttyUSB0", baudrate=300, drives=[PolledDrive(Toy(4))])


def test_the_repr_of_a_plant_shows_its_lines_and_the_number_of_drives() -> None:
    made = Plant([PlantLine("hall", "/dev/ttyUSB0", drives=[PolledDrive(Toy(2), ["status"])])])
    assert repr(made) == "<Plant plant; hall: 1 drives>"
    assert repr(Toy.status) == "<Register status: reading, holding register 5>"


def test_a_poller_can_be_created_from_a_plant_file(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    with Simulator([Wire([EncodedDrive(Toy(1))], unpaced=True)]) as simulator:
        path.write_text(
            f"""
            [[line]]
            name = "hall"
            port = "{simulator.wires[0].path}"

            [[line.drive]]
            name = "pump-1"
            model = "{Path(__file__).parents[1] / "support" / "drives" / "toy.py"}:Toy"
            address = 1
            """,
            encoding="utf-8",
        )
        with Poller(path) as poller:
            assert poller.plant.path == path
            assert next(iter(poller))


def test_the_time_of_a_row_is_a_datetime() -> None:
    row = Row(1_700_000_000_123_456_789, 1, None, "pump", "speed", None, "no reply")
    assert row.time == datetime(2023, 11, 14, 22, 13, 20, 123456, tzinfo=UTC)
    assert row.time_ns == 1_700_000_000_123_456_789


def polled_batches() -> list[Batch]:
    """Poll a drive that answers and one that does not; return batches with all their rows."""
    with Simulator([Wire([EncodedDrive(Toy(1))], unpaced=True)]) as simulator:
        drives = [polled(Toy(at, name=f"pump-{at}"), [Toy.output_current, Toy.fault]) for at in (1, 2)]
        found: list[Batch] = []
        seen: set[tuple[str, bool]] = set()
        with Poller(plant(line(simulator.wires[0].path, *drives))) as poller:
            for batch in poller:
                found.append(batch)
                seen |= {(row.drive, row.value is None) for row in batch}
                if seen >= {("pump-1", False), ("pump-2", True)}:
                    return found
    raise AssertionError("the poller has ended")


@pytest.mark.slow
def test_arrow_libraries_read_all_values_and_missing_values() -> None:
    polars = pytest.importorskip("polars", reason="needs polars")
    batches = polled_batches()
    rows = [row for batch in batches for row in batch]
    assert {row.status for row in rows if row.value is None} >= {"no reply"}
    found = [pa.record_batch(batch) for batch in batches]
    for one in found:
        one.validate(full=True)
    assert [row for one in found for row in rows_of(one)] == rows
    frame = polars.concat([polars.DataFrame(batch) for batch in batches])
    assert [Row(*row) for row in frame.with_columns(frame["time"].to_physical()).iter_rows()] == rows
    assert frame["value"].null_count() == sum(row.value is None for row in rows)


@pytest.mark.slow
def test_arrow_libraries_do_not_copy_numeric_columns() -> None:
    """No library copies the columns `value` and `monotonic_ns`. Only the names are created for Arrow."""

    def address(batch: Batch, name: str) -> int:
        return int(pa.py_buffer(getattr(batch.columns(), name)).address)

    pairs = [(batch, name) for batch in polled_batches() for name in ("value", "monotonic_ns")]
    for batch, name in pairs:
        assert pa.record_batch(batch).column(name).buffers()[1].address == address(batch, name)
    polars = pytest.importorskip("polars", reason="needs polars")
    for batch, name in pairs:
        assert polars.DataFrame(batch)[name].to_arrow().buffers()[1].address == address(batch, name)


PUMP = "pump-1.output_frequency"
SPEED = "pump-1.motor_speed"


@pytest.mark.slow
@pytest.mark.parametrize("by_method", [False, True])
def test_pandas_reads_a_batch_with_times_as_datetime64_in_utc(by_method: bool) -> None:
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    frame = example().to_pandas() if by_method else pandas.DataFrame.from_arrow(example())
    assert list(frame.columns) == list(ROW_COLUMNS)
    assert str(frame["time"].dtype) == "datetime64[ns, UTC]"
    assert [time.value for time in frame["time"]] == [row.time_ns for row in EXAMPLE]
    assert list(frame["drive"]) == [row.drive for row in EXAMPLE]
    assert list(frame["value"].isna()) == [row.value is None for row in EXAMPLE]
    assert list(frame["value"].dropna()) == [49.99, 0.3]
    assert list(frame["status"]) == [row.status for row in EXAMPLE]


@pytest.mark.slow
def test_polars_reads_a_batch_with_times_as_datetime_in_utc() -> None:
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
    for rows in (example(), example().wide()):
        with pytest.raises(ImportError, match=sentence):
            getattr(rows, method)()


def test_the_error_for_missing_extras_has_one_command_that_installs_them_all() -> None:
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
    # Most programs need neither the loader of family files nor the metadata of installed packages.
    late |= {"importlib.metadata", "multidrop.families.files.loader"}
    assert late.isdisjoint(told.stdout.split())


def test_registers_of_one_request_share_a_row_of_the_wide_table() -> None:
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


def test_pandas_and_polars_read_the_wide_table() -> None:
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


def test_the_wide_table_has_all_chosen_columns_in_the_chosen_order() -> None:
    """All batches then have the same columns, even if a batch has no row of a register."""

    never = "насос.output_frequency"
    wide = example().wide(never, SPEED, PUMP)
    assert wide.columns == ["time", "monotonic_ns", never, SPEED, PUMP]
    table = pa.table(wide)
    assert table.column(never).to_pylist() == [None]
    assert table.column(PUMP).to_pylist() == [49.99]


def test_an_unknown_column_of_the_wide_table_raises_value_error() -> None:
    with pytest.raises(ValueError, match=r"no column 'pump-1\.motor_sped'; did you mean pump-1\.motor_"):
        example().wide("pump-1.motor_sped")
    with pytest.raises(ValueError, match=r"there is no column 'x'; a column is DRIVE\.REGISTER"):
        example().wide("x")
    with pytest.raises(ValueError, match=f"column '{PUMP}' is chosen twice"):
        example().wide(PUMP, PUMP)


def test_the_rows_of_the_wide_table_are_sorted_by_time() -> None:
    """Rows of two lines may arrive out of order; the table is sorted by time."""
    rows = [row(second, "pump", name, second) for name in ("b", "a") for second in (3.0, 1.0, 2.0)]
    table = pa.table(from_rows(rows).wide())
    assert table.column("pump.a").to_pylist() == table.column("pump.b").to_pylist() == [1.0, 2.0, 3.0]
    assert table.column("monotonic_ns").to_pylist() == [SECOND, 2 * SECOND, 3 * SECOND]


def test_only_rows_with_equal_times_are_joined_in_the_wide_table() -> None:
    early = row(1.0, "pump", "a", 1.0)
    rows = [
        early,
        early._replace(register="b", time_ns=early.time_ns + 1, monotonic_ns=early.monotonic_ns + 1),
    ]
    rows.append(rows[1]._replace(drive="fan"))  # a row of another drive with equal times
    table = pa.table(from_rows(rows).wide())
    assert table.column("pump.a").to_pylist() == [1.0, None]
    assert table.column("pump.b").to_pylist() == table.column("fan.b").to_pylist() == [None, 1.0]


def test_rows_with_different_monotonic_times_are_not_joined_in_the_wide_table() -> None:
    """If UTC repeats, the monotonic time still distinguishes the rows."""

    first = row(1.0, "pump", "a", 1.0)
    table = pa.table(from_rows([first._replace(monotonic_ns=2 * SECOND, value=2.0), first]).wide())
    assert table.column("pump.a").to_pylist() == [1.0, 2.0]


def test_rows_after_a_restart_of_the_computer_are_last_in_the_wide_table() -> None:
    """A restart sets the monotonic clock to 0. Without a restart, a late row is sorted by its time."""
    hour = 3600.0
    before = [row(at, "pump", "a", at) for at in (hour, hour + 200, hour + 100)]
    after = [
        found._replace(time_ns=found.time_ns + 3 * 3600 * SECOND)
        for found in (row(at, "pump", "a", at) for at in (9.0, 7.0))
    ]
    table = pa.table(from_rows([*before, *after]).wide())
    assert table.column("pump.a").to_pylist() == [hour, hour + 100, hour + 200, 7.0, 9.0]


def test_a_missing_value_does_not_overwrite_a_value_in_the_wide_table() -> None:
    columns = Columns(4)
    assert add_rows(columns, block(0, 0), completion(SECOND, first_ns=SECOND, words=(100,)), UTC_0)
    assert add_miss(columns, block(0, 0), Status.NOT_ASKED, SECOND, UTC_0)
    assert add_miss(columns, block(0, 0), Status.NO_REPLY, 2 * SECOND, UTC_0)
    table = pa.table(Batch(columns, Names(["p"]), Names(["r"])).wide())
    assert table.column("p.r").to_pylist() == [1.0, None]


def test_an_empty_batch_has_an_empty_wide_table() -> None:
    wide = Batch(Columns(4), Names(["p"]), Names(["r"])).wide()
    assert (len(wide), wide.columns) == (0, ["time", "monotonic_ns"])
    assert pa.table(wide).num_rows == 0
    assert pa.table(Batch(Columns(4), Names(["p"]), Names(["r"])).wide("p.r")).num_rows == 0


def test_equal_column_names_of_two_drives_in_the_wide_table_raise_value_error() -> None:
    rows = from_rows([row(1.0, "a.b", "c", 1.0), row(1.0, "a", "b.c", 2.0)])
    with pytest.raises(ValueError, match=r"'a\.b' and 'a' both have a column that is called 'a\.b\.c'"):
        rows.wide()


@pytest.mark.slow
def test_the_wide_table_equals_the_pivot_table_of_pandas() -> None:
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
