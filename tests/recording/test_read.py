"""`multidrop.open_recording`: a recording of any format as a table, whole or damaged."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pyarrow as pa
import pyarrow.ipc
import pytest
from batches import EXAMPLE, METADATA, counting, example
from recordings import ABOUT, SCHEMA, record, recorded, row, rows_of
from toy import Toy

import multidrop
from multidrop import steps
from multidrop.drive.verbs import Read, Wait
from multidrop.polling.batch import Row
from multidrop.recording import FORMATS, open_writer

SUFFIXES = list(FORMATS)
PUMP = "pump.output_frequency"


@pytest.fixture(params=SUFFIXES)
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / f"run{request.param}"
    with open_writer(path, METADATA) as writer:
        writer.write(example())
        writer.write(counting(3000))
    return path


@pytest.mark.slow
def test_recordings_of_every_format_are_read_as_the_same_table(path: Path) -> None:
    found = multidrop.open_recording(path)
    assert found.metadata == METADATA
    table = pa.table(found)
    assert table.schema.equals(SCHEMA)
    assert rows_of(table) == [*EXAMPLE, *counting(3000)]
    assert [each for rows in multidrop.open_recording(str(path)) for each in rows] == rows_of(table)


@pytest.mark.slow
def test_pandas_and_polars_get_times_with_their_type(path: Path) -> None:
    pytest.importorskip("pandas", reason="needs pandas")
    polars = pytest.importorskip("polars", reason="needs polars")
    found = multidrop.open_recording(path)
    frame = found.to_pandas()
    assert str(frame["time"].dtype) == "datetime64[ns, UTC]"
    assert [time.value for time in frame["time"]] == [each.time_ns for each in recorded(path)]
    other = found.to_polars()
    assert other.schema["time"] == polars.Datetime("ns", "UTC")
    assert [Row(*each) for each in other.with_columns(other["time"].to_physical()).iter_rows()] == recorded(
        path
    )


@pytest.mark.slow
def test_the_wide_table_joins_rows_of_several_batches(path: Path) -> None:
    wide = multidrop.open_recording(path).wide("pump-1.output_frequency", "pump-1.motor_speed")
    table = pa.table(wide).drop(["time"]).to_pydict()
    expected = {
        (each.time_ns, each.register): each.value for each in recorded(path) if each.drive == "pump-1"
    }
    times = pa.table(wide).column("time").cast(pa.int64()).to_pylist()
    assert len(times) == len({time for time, _ in expected})
    for number, time in enumerate(times):
        for register in ("output_frequency", "motor_speed"):
            assert table[f"pump-1.{register}"][number] == expected.get((time, register))


def test_a_register_in_the_metadata_without_rows_is_an_empty_column(tmp_path: Path) -> None:
    path = record(tmp_path / "run.arrows", [row(1, "pump", "output_frequency", 50.0)], ABOUT)
    wide = multidrop.open_recording(path).wide("fan.output_current", PUMP)
    assert pa.table(wide).column("fan.output_current").to_pylist() == [None]
    with pytest.raises(ValueError, match=r"no column 'fan\.output_curent'; did you mean fan\.output_cu"):
        multidrop.open_recording(path).wide("fan.output_curent")


@pytest.mark.parametrize(
    "about", [{}, {"drives": 3}, {"drives": {"a": 3}}, {"drives": {"a": {"registers": 1}}}]
)
def test_a_recording_with_invalid_metadata_is_read(tmp_path: Path, about: dict[str, object]) -> None:
    path = record(tmp_path / "run.csv", [row(1, "pump", "output_frequency", 50.0)], about)
    assert pa.table(multidrop.open_recording(path).wide(PUMP)).column(PUMP).to_pylist() == [50.0]


def test_converting_a_damaged_recording_to_a_table_names_the_bad_line(tmp_path: Path) -> None:
    path = record(tmp_path / "run.csv", [row(at, "pump", "output_frequency", 50.0) for at in range(4)])
    path.write_text(path.read_text().replace("pump,", "pump;", 1))
    for take, library in (("to_pandas", "pandas"), ("to_polars", "polars"), ("wide", "json")):
        if find_spec(library) is None:
            continue
        with pytest.raises(ValueError, match=r"run\.csv, line 2: not a row of a recording"):
            getattr(multidrop.open_recording(path), take)()


def test_opening_a_recording_that_is_not_a_path_raises_type_error() -> None:
    with pytest.raises(TypeError, match=r"open_recording takes a file such as"):
        multidrop.open_recording(3)  # type: ignore[arg-type]


def test_the_steps_of_command_scripts_are_public_names() -> None:
    assert next(steps.read(Toy.output_current)) == Read(Toy.output_current)
    assert next(steps.wait(2.0)) == Wait(2.0)


def test_existing_recording_is_replaced_only_with_overwrite_true(path: Path) -> None:
    with pytest.raises(FileExistsError, match=r"exists already: name another file, or remove it first"):
        open_writer(path, METADATA)
    with open_writer(path, {"second": True}, overwrite=True):
        pass
    found = multidrop.open_recording(path)
    assert found.metadata == {"second": True}
    assert sum(map(len, found)) == 0


def test_the_repr_of_a_recording_shows_its_rows_drives_and_time_span(tmp_path: Path) -> None:
    about = r"^<recording .*run\.csv: 4 rows of 2 drives, 3\.000 s from .*>$"
    path = record(tmp_path / "run.csv", [row(at, f"pump-{at % 2}", "speed", 1.0) for at in range(4)])
    assert re.match(about, repr(multidrop.open_recording(path)))
    with open_writer(tmp_path / "new.csv", METADATA) as writer:
        assert repr(writer) == f"<CsvWriter {tmp_path}/new.csv: 0 rows>"


WITHOUT = "import sys; sys.modules['nanoarrow'] = None; from multidrop.cli import main; sys.exit(main())"


def without_nanoarrow(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITHOUT, *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.long
@pytest.mark.slow
def test_polling_and_recording_need_no_nanoarrow(tmp_path: Path) -> None:
    for name in ("run.arrows", "run.csv"):
        ran = without_nanoarrow("demo", "--seconds", "1", "--out", name, folder=tmp_path)
        assert ran.returncode == 0, ran.stderr
    assert pyarrow.ipc.open_stream(tmp_path / "run.arrows").read_all().num_rows > 5
    assert len((tmp_path / "run.csv").read_text().splitlines()) > 5


@pytest.mark.long
@pytest.mark.slow
def test_reading_without_nanoarrow_names_the_missing_library(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs matplotlib")  # for `report`
    record(tmp_path / "run.arrows", [row(1, "pump", "output_frequency", 50.0)])
    for words in (("report", "run.arrows"), ("convert", "run.arrows", "run.csv")):
        ran = without_nanoarrow(*words, folder=tmp_path)
        assert ran.returncode == 2
        assert ran.stderr.startswith("multidrop: rows in Arrow's layout")
        assert ran.stderr.count("\n") == 1
    assert not (tmp_path / "run.csv").exists()
