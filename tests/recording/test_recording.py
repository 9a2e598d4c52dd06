"""Recordings: the library and other programs read all written rows, also after a conversion."""

from __future__ import annotations

import csv
import json
import math
import struct
import sys
from collections.abc import Iterator
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import Any, cast

import pyarrow as pa
import pyarrow.parquet
import pytest
from batches import EXAMPLE, METADATA, add_miss, add_rows, block, completion, counting, example
from hypothesis import example as with_example
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import FILE_SCHEMA, SCHEMA, is_kept, record_as_before, rows_of
from tables import examples, table

from multidrop.core import Columns, Names, Status
from multidrop.plant.model import Plant
from multidrop.polling.batch import Batch, Row, Rows
from multidrop.recording import (
    FORMATS,
    Metadata,
    RecordingError,
    RecordingReader,
    RecordingWriter,
    convert,
    open_recording,
    open_writer,
    parquet,
    repair,
)
from multidrop.recording.rows import from_rows

every_format = pytest.mark.parametrize("suffix", FORMATS)


def record(path: Path, metadata: Metadata = METADATA) -> Path:
    """Record the example and 2500 more rows in three batches; return the path."""
    with open_writer(path, metadata) as writer:
        for batch in (example(), counting(2000), counting(500, 2000)):
            writer.write(batch)
        assert writer.rows == 2505
    return path


RECORDED = [*EXAMPLE, *counting(2000), *counting(500, 2000)]


def rows(reader: RecordingReader) -> list[Row]:
    return [row for batch in reader for row in batch]


@every_format
def test_a_recording_is_read_back_with_the_written_rows(tmp_path: Path, suffix: str) -> None:
    reader = open_recording(record(tmp_path / f"a{suffix}"))
    assert reader.metadata == METADATA
    assert reader.truncated == 0
    assert rows(reader) == RECORDED
    assert rows(reader) == RECORDED  # a second iteration gives the same rows
    with reader as same:  # as users of other files write it
        assert rows(same) == RECORDED
    # no variable refers to a batch while its rows are read, so the batch must keep its memory alive itself
    assert [*chain.from_iterable(reader)] == RECORDED


@every_format
def test_an_empty_recording_is_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    open_writer(path, {}).close()
    assert rows(open_recording(path)) == []
    path = tmp_path / f"b{suffix}"
    with open_writer(path, {}) as writer:
        writer.write(counting(0))
    assert rows(open_recording(path)) == []


@every_format
def test_batches_from_a_reader_can_be_passed_to_arrow(tmp_path: Path, suffix: str) -> None:
    found = [pa.record_batch(batch) for batch in open_recording(record(tmp_path / f"a{suffix}"))]
    for batch in found:
        batch.validate(full=True)
        assert batch.schema.equals(SCHEMA)
    assert [row for batch in found for row in rows_of(batch)] == RECORDED


@pytest.mark.slow
@every_format
def test_a_recording_never_replaces_another_recording(tmp_path: Path, suffix: str) -> None:
    path = record(tmp_path / f"a{suffix}")
    sentence = rf"a{suffix} exists already: name another file, or remove it first$"
    with pytest.raises(ValueError, match=sentence):
        open_writer(path, {"second": True})
    other = record(tmp_path / "b.csv")
    with pytest.raises(ValueError, match=sentence):
        convert(other, path)
    reader = open_recording(path)
    assert (rows(reader), reader.metadata) == (RECORDED, METADATA)


@pytest.mark.parametrize("suffix", [".arrows", ".csv"])
def test_every_batch_can_be_read_before_the_recording_is_closed(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with open_writer(path, METADATA) as writer:
        assert rows(open_recording(path)) == []
        for at in range(3):
            writer.write(counting(10, 10 * at))
            assert rows(open_recording(path)) == list(counting(10 * at + 10))


@pytest.mark.parametrize("suffix", [".arrows", ".csv"])
def test_recording_reader_stops_at_the_end_seen_at_opening(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with open_writer(path, METADATA) as writer:
        writer.write(counting(10))
        reader = open_recording(path)
        writer.write(counting(10, 10))
        assert rows(reader) == list(counting(10))


def test_pyarrow_opens_an_arrows_file(tmp_path: Path) -> None:
    with pa.ipc.open_stream(record(tmp_path / "a.arrows").read_bytes()) as stream:
        table = stream.read_all()
    table.validate(full=True)
    assert table.schema.equals(FILE_SCHEMA)
    assert json.loads(table.schema.metadata[b"multidrop"]) == METADATA
    assert rows_of(table) == RECORDED


@pytest.mark.slow
def test_polars_opens_every_format(tmp_path: Path) -> None:
    polars = pytest.importorskip("polars", reason="needs polars")
    physical = polars.col("time").to_physical()
    arrows = polars.read_ipc_stream(record(tmp_path / "a.arrows")).with_columns(physical)
    parquet = polars.read_parquet(record(tmp_path / "a.parquet")).with_columns(physical)
    text = polars.read_csv(record(tmp_path / "a.csv"))
    assert [Row(*row) for row in arrows.iter_rows()] == RECORDED
    assert [Row(*row) for row in parquet.iter_rows()] == RECORDED
    assert text.drop("time").rows() == [row[1:] for row in RECORDED]
    times = text["time"].str.to_datetime("%Y-%m-%dT%H:%M:%S%.9fZ", time_unit="ns").to_physical()
    assert times.to_list() == [row.time_ns for row in RECORDED]


@pytest.mark.slow
def test_pandas_opens_parquet_and_csv(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    for frame in (
        pandas.read_parquet(record(tmp_path / "a.parquet")),
        pandas.read_csv(record(tmp_path / "a.csv"), parse_dates=["time"]),
    ):
        assert [time.value for time in frame["time"]] == [row.time_ns for row in RECORDED]
        assert list(frame["value"].isna()) == [row.value is None for row in RECORDED]
        assert list(frame["value"].dropna()) == [row.value for row in RECORDED if row.value is not None]
        assert list(frame["status"]) == [row.status for row in RECORDED]


@pytest.mark.slow
def test_duckdb_opens_parquet_and_csv(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb", reason="needs duckdb")
    columns = "epoch_ns(time), monotonic_ns, uncertainty_ns, drive, register, value, status"
    parquet = duckdb.sql(f"select {columns} from '{record(tmp_path / 'a.parquet')}'").fetchall()
    assert [Row(*row) for row in parquet] == RECORDED
    text = duckdb.sql(f"select * exclude (time) from '{record(tmp_path / 'a.csv')}'").fetchall()
    assert text == [row[1:] for row in RECORDED]


@pytest.mark.parametrize("is_before", [False, True])
def test_name_cut_within_a_utf_8_character_is_reported_as_damage(tmp_path: Path, is_before: bool) -> None:
    path = tmp_path / "a.arrows"
    some = from_rows([Row(0, 0, None, name, "r", None, "no reply") for name in ("h\u00e9", "x")])
    if is_before:
        record_as_before(path, some)
    else:
        with open_writer(path, METADATA) as writer:
            writer.write(some)
    content, whole, cut = path.read_bytes(), struct.pack("<3i", 0, 3, 4), struct.pack("<3i", 0, 2, 4)
    assert content.count(whole) == 1
    path.write_bytes(content.replace(whole, cut))
    with pytest.raises(ValueError, match="is damaged after row 0: a text is not UTF-8"):
        list(open_recording(path))


@pytest.mark.parametrize("name", ["monotonic_ns", "drive", "status"])
@pytest.mark.parametrize("suffix", [".arrows", ".parquet"])
def test_a_null_in_a_required_column_is_reported_as_damage(tmp_path: Path, suffix: str, name: str) -> None:
    whole, path = record(tmp_path / f"whole{suffix}"), tmp_path / f"a{suffix}"
    is_parquet = suffix == ".parquet"
    with whole.open("rb") as file:
        table = pa.parquet.ParquetFile(file).read() if is_parquet else pa.ipc.open_stream(file).read_all()
    at = table.schema.names.index(name)
    lacking = pa.array([None, *table[name].to_pylist()[1:]], table.schema.field(at).type)
    table = table.set_column(at, table.schema.field(at).with_nullable(True), lacking)
    if is_parquet:
        pa.parquet.write_table(table, path)
    else:
        with pa.ipc.new_stream(path, table.schema) as stream:
            stream.write_table(table)
    with pytest.raises(ValueError, match=f"is damaged after row 0: a row has no value in the column {name}"):
        list(open_recording(path))


def test_a_long_parquet_file_has_its_rows_in_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet, "GROUP_ROWS", 8192)
    batch, times = counting(1024), 9
    with open_writer(tmp_path / "a.parquet", METADATA) as writer:
        for _ in range(times):
            writer.write(batch)
    about = pa.parquet.read_metadata(tmp_path / "a.parquet")
    assert [about.row_group(at).num_rows for at in range(about.num_row_groups)] == [8192, 1024]
    assert [row for rows in open_recording(tmp_path / "a.parquet") for row in rows] == [*batch] * times


def test_the_names_in_a_parquet_file_are_dictionary_encoded(tmp_path: Path) -> None:
    group = pa.parquet.read_metadata(record(tmp_path / "a.parquet")).row_group(0)
    encodings = {group.column(at).path_in_schema: group.column(at).encodings for at in range(7)}
    assert all("RLE_DICTIONARY" in encodings[name] for name in ("drive", "register", "status"))


def test_a_csv_file_has_the_documented_text(tmp_path: Path) -> None:
    with open_writer(tmp_path / "a.csv", METADATA) as writer:
        writer.write(example())
    assert (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines() == [
        "time,monotonic_ns,uncertainty_ns,drive,register,value,status",
        "2026-11-21T09:30:00.123456789Z,1000000000,7,pump-1,output_frequency,49.99,ok",
        "2026-11-21T09:30:00.123456789Z,1000000000,7,pump-1,motor_speed,0.3,ok",
        '2026-11-21T09:30:01.123456789Z,2000000000,,"fan, the ""old"" one",output_frequency,,exception 12',
        "2026-11-21T09:30:02.123456789Z,3000000000,,насос,motor_speed,,no reply",
        '2026-11-21T09:30:03.123456789Z,4000000000,,"fan, the ""old"" one",motor_speed,,'
        "not asked: drive is silent",
    ]
    assert json.loads((tmp_path / "a.csv.json").read_text(encoding="utf-8")) == METADATA


def test_a_csv_file_without_metadata_is_read(tmp_path: Path) -> None:
    path = record(tmp_path / "a.csv")
    (tmp_path / "a.csv.json").unlink()
    reader = open_recording(path)
    assert (reader.metadata, rows(reader)) == ({}, RECORDED)


INT64 = st.integers(-(2**63), 2**63 - 1)
ANY = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
NAME = ANY | st.text("'=+-@\t\r\nx", max_size=4)  # text that a spreadsheet may evaluate
SAMPLE = st.builds(Row, INT64, INT64, INT64, NAME, NAME, st.floats(allow_nan=False), st.just("ok"))
NO_NUMBER = st.builds(Row, INT64, INT64, INT64, NAME, NAME, st.just(math.nan), st.just("ok"))
MISS = st.builds(Row, INT64, INT64, st.none(), NAME, NAME, st.none(), NAME)


@every_format
@pytest.mark.parametrize("target", FORMATS)
@with_example(batches=[RECORDED])
@settings(max_examples=examples(20), deadline=None)
@given(batches=st.lists(st.lists(st.one_of(SAMPLE, NO_NUMBER, MISS), max_size=9), max_size=5))
def test_converting_keeps_rows_and_metadata(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, target: str, batches: list[list[Row]]
) -> None:
    """Values may be NaN, which does not equal itself, so the test compares texts."""
    folder = tmp_path_factory.mktemp("any")
    with open_writer(folder / f"a{suffix}", METADATA) as writer:
        for some in filter(None, batches):
            writer.write(from_rows(some))
    written = [row for some in batches for row in some]
    assert convert(folder / f"a{suffix}", folder / f"b{target}") == len(written)
    reader = open_recording(folder / f"b{target}")
    found = rows(reader)
    assert (reader.metadata, len(found)) == (METADATA, len(written))
    is_rounded = ".arrows" in (suffix, target)
    assert repr(found) == repr(written) or (is_rounded and all(map(is_kept, found, written)))


def as_text(name: str) -> str:
    """Return a name as in a .csv: with an apostrophe in front if a spreadsheet would evaluate the name."""
    return f"'{name}" if name.lstrip("'")[:1] in tuple("=+-@\t\r\n") else name


@settings(max_examples=examples(60), deadline=None)
@given(some=st.lists(st.one_of(SAMPLE, MISS), min_size=1, max_size=20))
def test_pythons_csv_module_reads_the_same_rows_from_any_recording(
    tmp_path_factory: pytest.TempPathFactory, some: list[Row]
) -> None:
    path = tmp_path_factory.mktemp("any") / "a.csv"
    with open_writer(path, {}) as writer:
        writer.write(from_rows(some))
    with path.open(encoding="utf-8", newline="") as file:
        found = list(csv.DictReader(file))
    assert [(row["drive"], row["register"], row["status"]) for row in found] == [
        tuple(map(as_text, (row.drive, row.register, row.status))) for row in some
    ]
    for row, expected in zip(found, some, strict=True):
        second = datetime.fromisoformat(row["time"][:19] + "+00:00")
        assert int(second.timestamp()) * 10**9 + int(row["time"][20:29]) == expected.time_ns
        assert (float(row["value"]) if row["value"] else None) == expected.value


FORMULAS = ("=1+1", "+cmd|' /C calc'!A0", "-2", "@SUM(A1)", "\t=1", "\r=1", "'=1", "''-", "'old'", "a=b", "")


def test_csv_texts_that_look_like_formulas_are_escaped(tmp_path: Path) -> None:
    some = [Row(1, 1, None, name, name, None, name) for name in FORMULAS]
    with open_writer(tmp_path / "a.csv", {}) as writer:
        writer.write(from_rows(some))
    with (tmp_path / "a.csv").open(encoding="utf-8", newline="") as file:
        found = [tuple(row[name] for name in ("drive", "register", "status")) for row in csv.DictReader(file)]
    cells = [drive for drive, _, _ in found]
    assert found == [(cell, cell, cell) for cell in cells]
    assert not [cell for cell in cells if cell.startswith(("=", "+", "-", "@", "\t", "\r"))]
    assert cells[6:] == ["''=1", "'" + "''-", "'old'", "a=b", ""]
    assert rows(open_recording(tmp_path / "a.csv")) == some


@pytest.mark.uncounted
@pytest.mark.slow
@pytest.mark.long
def test_conversion_keeps_only_a_few_batches_in_memory(tmp_path: Path) -> None:
    """Converting a recording of 13 MB uses at most 6.5 MB of memory."""
    tracemalloc = pytest.importorskip("tracemalloc")
    with open_writer(tmp_path / "a.arrows", {}) as writer:
        batch = counting(16384)
        for _ in range(24):
            writer.write(batch)
    size = (tmp_path / "a.arrows").stat().st_size
    tracemalloc.start()
    convert(tmp_path / "a.arrows", tmp_path / "b.arrows")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert size > 12e6
    assert peak < size / 2


def test_a_recording_is_not_converted_into_itself(tmp_path: Path) -> None:
    path = record(tmp_path / "a.arrows")
    (tmp_path / "link.arrows").symlink_to(path)
    for target in (path, tmp_path / "link.arrows"):
        with pytest.raises(ValueError, match=r"a\.arrows cannot be converted into itself"):
            convert(path, target)
    assert rows(open_recording(path)) == RECORDED


def test_a_failed_conversion_leaves_the_target_unchanged(tmp_path: Path) -> None:
    target = record(tmp_path / "b.arrows")
    (tmp_path / "a.csv").write_text("time,value\n")
    with pytest.raises(ValueError, match=r"a\.csv is not a recording"):
        convert(tmp_path / "a.csv", target)
    with pytest.raises(FileNotFoundError):
        convert(tmp_path / "c.csv", target)
    assert rows(open_recording(target)) == RECORDED


DAMAGED_AT = {".arrows": struct.pack("<6H", *(0, 1, 2) * 2), ".csv": b",ok", ".parquet": b"PAR1"}  # damaged


@every_format
@pytest.mark.parametrize("target", FORMATS)
def test_a_failed_conversion_leaves_no_file(tmp_path: Path, suffix: str, target: str) -> None:
    """The error's message names the recording, and does not quote the library that read it."""
    path = record(tmp_path / f"a{suffix}")
    content = path.read_bytes()
    at = content.index(DAMAGED_AT[suffix], 0 if suffix == ".parquet" else len(content) // 2) + 4
    path.write_bytes(content[:at] + b"\xff" * 64 + content[at + 64 :])
    before = set(tmp_path.iterdir())
    damage = rf"a{suffix}(, line \d+: not a row of a recording| is damaged after row \d+)"
    with pytest.raises(ValueError, match=damage) as failure:
        convert(path, tmp_path / f"b{target}")
    assert set(tmp_path.iterdir()) == before
    for foreign in ("codec", "Arrow", "thrift", "ZSTD", "isoformat", "literal", "\n"):
        assert foreign not in str(failure.value)


@every_format
def test_a_conversion_interrupted_by_ctrl_c_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    path = record(tmp_path / "a.csv")
    before = set(tmp_path.iterdir())

    def interrupted(reader: object) -> Iterator[Rows]:
        yield counting(10)
        raise KeyboardInterrupt

    monkeypatch.setattr("multidrop.recording.csv.CsvReader.__iter__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        convert(path, tmp_path / f"b{suffix}")
    assert set(tmp_path.iterdir()) == before


@table("act", [lambda path: open_writer(path, {}), open_recording, repair])
@table("name", ["a.xlsx", "a", "arrows", "a.arrow"])
def test_a_recording_with_an_unknown_suffix_is_refused(tmp_path: Path, act: object, name: str) -> None:
    assert callable(act)
    with pytest.raises(ValueError, match=rf"{name}: a recording's name must end in \.arrows, \.csv"):
        act(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@every_format
def test_metadata_that_json_cannot_hold_raises_type_error(tmp_path: Path, suffix: str) -> None:
    path = record(tmp_path / f"a{suffix}")
    with pytest.raises(TypeError, match="not JSON serializable"):
        open_writer(path, {"drives": object()})
    with pytest.raises(TypeError, match=r"takes metadata as a dict, such as plant.metadata\(\), not <Plant "):
        open_writer(path, cast(Any, Plant([])))
    assert rows(open_recording(path)) == RECORDED


@every_format
def test_closed_writer_refuses_later_writes(tmp_path: Path, suffix: str) -> None:
    writer: RecordingWriter = open_writer(tmp_path / f"a{suffix}", {})
    writer.write(example())
    writer.close()
    writer.close()
    with pytest.raises(ValueError, match=r"closed|released"):
        writer.write(example())
    assert rows(open_recording(tmp_path / f"a{suffix}")) == EXAMPLE


@pytest.mark.parametrize("act", [lambda path: open_writer(path, {}), open_recording])
def test_the_error_for_parquet_without_pyarrow_names_the_extra_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, act: object
) -> None:
    assert callable(act)
    path = record(tmp_path / "a.parquet")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(RecordingError, match=r"Parquet needs pyarrow: pip install 'pyarrow>"):
        act(path)


@pytest.mark.parametrize("suffix", [".arrows", ".csv"])
def test_arrows_and_csv_files_are_written_and_read_without_pyarrow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    for name in ("pyarrow", "numpy", "pandas", "polars"):
        monkeypatch.setitem(sys.modules, name, None)
    assert rows(open_recording(record(tmp_path / f"a{suffix}"))) == RECORDED


def test_recordings_of_earlier_versions_are_read(tmp_path: Path) -> None:
    batches = (example(), counting(2000), counting(500, 2000))
    path = record_as_before(tmp_path / "a.arrows", *batches, metadata=json.dumps(METADATA).encode())
    reader = open_recording(path)
    assert (reader.metadata, reader.truncated, rows(reader)) == (METADATA, 0, RECORDED)
    assert convert(path, tmp_path / "b.arrows") == 2505
    assert rows(open_recording(tmp_path / "b.arrows")) == RECORDED
    assert (tmp_path / "b.arrows").stat().st_size < path.stat().st_size * 0.6


@pytest.mark.slow
def test_pandas_and_duckdb_read_arrow_recordings_through_pyarrow(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    duckdb = pytest.importorskip("duckdb", reason="needs duckdb")
    table = pa.ipc.open_stream(record(tmp_path / "a.arrows").read_bytes()).read_all()
    frame = table.to_pandas()
    assert isinstance(frame["drive"].dtype, pandas.CategoricalDtype)
    assert list(frame["drive"]) == [row.drive for row in RECORDED]
    columns = "epoch_ns(time), monotonic_ns, uncertainty_ns, drive, register, value, status"
    for taken in (table, open_recording(tmp_path / "a.arrows")):
        found = duckdb.from_arrow(taken).query("taken", f"select {columns} from taken").fetchall()
        assert [Row(*row) for row in found] == RECORDED


class Grown:
    """Makes batches like a poller to which one drive is added before each batch."""

    def __init__(self) -> None:
        self.names = Names(["pump-0"])
        self.rows: list[Row] = []

    def batch(self) -> Batch:
        columns = Columns(len(self.names))
        for drive in range(len(self.names)):
            assert add_rows(columns, block(drive, 0), completion(1, first_ns=2, words=(100 * drive,)), 0)
        batch = Batch(columns, self.names, Names(["speed"]))
        self.rows += batch
        self.names.number(f"pump-{len(self.names)}")
        return batch


@pytest.mark.long
def test_every_reader_gets_the_names_of_drives_that_were_added_later(tmp_path: Path) -> None:
    """polars and nanoarrow cannot read deltas, so each changed dictionary is written again as a whole."""
    polars = pytest.importorskip("polars", reason="needs polars")
    nanoarrow = pytest.importorskip("nanoarrow")
    path, grown = tmp_path / "a.arrows", Grown()
    with open_writer(path, {}) as writer:
        for _ in range(150):
            writer.write(grown.batch())
    names = [row.drive for row in grown.rows]
    assert [row.drive for row in rows(open_recording(path))] == names
    assert pa.ipc.open_stream(path.read_bytes()).read_all().column("drive").to_pylist() == names
    assert polars.read_ipc_stream(path)["drive"].to_list() == names
    with path.open("rb") as file:
        stream = nanoarrow.ArrayStream.from_readable(file)
        assert [name for part in stream for name in part.child(3).iter_py()] == names


def test_a_stream_rewritten_by_another_program_is_read(tmp_path: Path) -> None:
    """In the rewritten stream, dictionaries have other ids, and some are deltas."""
    path, grown = record(tmp_path / "a.arrows"), Grown()
    table = pa.ipc.open_stream(path.read_bytes()).read_all()
    with pa.ipc.new_stream(tmp_path / "b.arrows", table.schema) as stream:
        stream.write_table(table)
    reader = open_recording(tmp_path / "b.arrows")
    assert (reader.metadata, rows(reader)) == (METADATA, RECORDED)
    options = pa.ipc.IpcWriteOptions(emit_dictionary_deltas=True)
    with pa.ipc.new_stream(tmp_path / "c.arrows", FILE_SCHEMA, options=options) as stream:
        for _ in range(5):
            stream.write_batch(pa.record_batch(grown.batch()).cast(FILE_SCHEMA))
    assert rows(open_recording(tmp_path / "c.arrows")) == grown.rows


@pytest.mark.parametrize("count", [255, 256, 257, 1000])
def test_up_to_1000_different_statuses_are_recorded(tmp_path: Path, count: int) -> None:
    some = [Row(at, at, None, "a", "b", None, f"status {at % count}") for at in range(2500)]
    path = tmp_path / "a.arrows"
    with open_writer(path, {}) as writer:
        writer.write(from_rows(some))
    assert rows(open_recording(path)) == some
    assert rows_of(pa.ipc.open_stream(path.read_bytes()).read_all()) == some


def test_all_exception_codes_are_recorded_in_one_batch(tmp_path: Path) -> None:
    """One batch has rows for all 255 exception codes, with good replies in between."""
    columns = Columns(1024)
    for code in range(512):
        reply = completion(code + 1, first_ns=code + 2, words=(7,), exception=code % 256)
        assert add_rows(columns, block(0, 0), reply, 0)
    for status in list(Status)[1:]:
        assert add_miss(columns, block(0, 0), status, 1000, 0)
    batch = Batch(columns, Names(["a"]), Names(["b"]))
    assert len({row.status for row in batch}) > 256
    path = tmp_path / "a.arrows"
    with open_writer(path, {}) as writer:
        writer.write(batch)
        writer.write(batch)
        assert writer.rows == 2 * len(batch)
    assert rows(open_recording(path)) == [*batch, *batch]
    assert rows_of(pa.ipc.open_stream(path.read_bytes()).read_all()) == [*batch, *batch]


def test_a_row_in_an_arrows_file_takes_at_most_35_bytes(tmp_path: Path) -> None:
    """The rows are those of 31 drives with 10 values at 10 Hz; some have no value."""
    drives = Names([f"pump-{number}" for number in range(31)])
    registers = Names([f"some_register_{number}" for number in range(10)])
    with open_writer(tmp_path / "a.arrows", METADATA) as writer:
        for _ in range(100):
            columns = Columns(310)
            for drive in range(31):
                layout = block(drive, *range(10))
                if drive == 7:
                    assert add_miss(columns, layout, Status.NO_REPLY, 1, 0)
                else:
                    assert add_rows(columns, layout, completion(1, first_ns=2, words=(1,) * 10), 0)
            writer.write(Batch(columns, drives, registers))
    assert (tmp_path / "a.arrows").stat().st_size <= 35 * writer.rows
