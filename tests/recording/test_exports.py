"""MDF4 and HDF5 exports of a recording, read with asammdf and h5py, have the same rows as the recording."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import count, product
from pathlib import Path
from threading import Semaphore, main_thread
from typing import Any

import pyarrow as pa
import pytest
from batches import SECOND, UTC_0
from lines import until
from peers import require_installed
from recordings import ABOUT, record, row

from multidrop.polling.batch import Row
from multidrop.recording import RecordingError, convert, open_recording
from multidrop.recording.rows import phase_row, with_phases

require_installed("asammdf")
require_installed("h5py")

TRIGGER = {"condition": "pump.output_current > 30", "time_ns": UTC_0 + 3 * SECOND}
METADATA = with_phases({**ABOUT, "multidrop": "0.1.0", "trigger": TRIGGER}, ["start", "stop"])
STATE = "fault"
COMMENT = Row(UTC_0 + SECOND // 2, SECOND // 2, None, "event", "comment", None, "подшипник changed")


def rows(number: int) -> list[Row]:
    """Return rows at irregular times of two drives and a test; a tenth has no value."""
    chance, found, at = random.Random(number), [*phase_row(0, UTC_0, 0), COMMENT], 0.0
    for _ in range(number):
        at += chance.uniform(0.0005, 0.003)
        for drive, register in (("pump", "output_frequency"), ("pump", STATE), ("fan", "output_current")):
            value = chance.choice([0.0, 8.0, 77.0]) if register == STATE else chance.gauss(20, 5)
            is_missed = chance.random() < 0.1
            status = chance.choice(["no reply", "bad checksum"]) if is_missed else "ok"
            found.append(row(at, drive, register, None if is_missed else value, status, chance.uniform(1, 9)))
    middle = round(at / 2 * SECOND)
    return [*found, *phase_row(1, UTC_0 + middle, middle)]


def exported(path: Path, suffix: str, number: int = 400) -> tuple[Path, pa.Table]:
    """Return an exported file, and the table of the exported recording."""
    source, target = record(path / "run.arrows", rows(number), METADATA), path / f"run{suffix}"
    assert convert(source, target) == 3 * number + 3
    return target, pa.table(open_recording(source))


@pytest.fixture(params=[1 << 18, 100], ids=["one piece", "many pieces"])
def _pieces(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run each test twice: the export is written in one piece, and in many."""
    monkeypatch.setattr("multidrop.recording.series.PIECE_ROWS", request.param)


def of(table: pa.Table, drive: str, register: str) -> dict[str, list[Any]]:
    """Return the columns of one register, sorted by time; times are in ns."""
    found = table.set_column(0, "time", table.column("time").cast(pa.int64())).to_pylist()
    own = [one for one in found if (one["drive"], one["register"]) == (drive, register)]
    own.sort(key=lambda one: one["time"])
    return {name: [one[name] for one in own] for name in table.column_names}


SERIES = [("pump", "output_frequency"), ("pump", STATE), ("fan", "output_current"), ("test", "phase")]


@pytest.mark.slow
@pytest.mark.usefixtures("_pieces")
def test_mdf4_has_the_rows_of_the_recording(tmp_path: Path) -> None:
    from asammdf import MDF

    path, table = exported(tmp_path, ".mf4")
    with MDF(path) as mdf:
        begin = mdf.header.abs_time
        assert (begin, mdf.start_time.isoformat()) == (UTC_0, "2026-11-21T09:29:59.123457+00:00")
        for drive, register in SERIES:
            name, expected = f"{drive}.{register}", of(table, drive, register)
            value = mdf.get(name, raw=True, ignore_invalidation_bits=True)
            assert [begin + round(at * 1e9) for at in value.timestamps.tolist()] == expected["time"]
            missed = (
                [False] * len(value) if value.invalidation_bits is None else list(value.invalidation_bits)
            )
            assert [
                None if miss else one for one, miss in zip(value.samples.tolist(), missed, strict=True)
            ] == (expected["value"])
            assert value.unit == {"output_frequency": "Hz", "output_current": "raw count"}.get(register, "")
            statuses = [text.decode() for text in mdf.get(f"{name}.status").samples.tolist()]
            assert statuses == expected["status"]
            uncertainty = mdf.get(f"{name}.uncertainty")  # the signal has no samples for rows without a value
            known = [one / 1e9 for one in expected["uncertainty_ns"] if one is not None]
            assert uncertainty.samples.tolist() == pytest.approx(known)
        texts = {str(one, "utf-8") for one in mdf.get(f"pump.{STATE}").samples.tolist()}
        assert texts == {"NONE", "OVERHEAT", "unnamed"}  # fault 77 has no name
        assert set(mdf.get("test.phase").samples.tolist()) == {b"start", b"stop"}
        events = {(one.name, one.comment, begin + round(one.value * 1e9)) for one in mdf.events}
        assert events == {
            ("comment", COMMENT.status, COMMENT.time_ns),
            ("trigger", TRIGGER["condition"], TRIGGER["time_ns"]),
        }
        assert json.loads(bytes(mdf.extract_attachment(0)[0])) == METADATA


@pytest.mark.usefixtures("_pieces")
def test_hdf5_has_the_rows_of_the_recording(tmp_path: Path) -> None:
    import h5py

    path, table = exported(tmp_path, ".h5")
    with h5py.File(path) as file:
        statuses = [text.decode() for text in file["statuses"][:].tolist()]
        for drive, register in SERIES:
            group, expected = file[f"drives/{drive}/{register}"], of(table, drive, register)
            assert (group.attrs["drive"], group.attrs["register"]) == (drive, register)
            assert group["time_ns"][:].tolist() == expected["time"]
            assert group["monotonic_ns"][:].tolist() == expected["monotonic_ns"]
            valid = group["valid"][:].tolist()
            for name in ("value", "uncertainty_ns"):
                found = zip(group[name][:].tolist(), valid, strict=True)
                assert [one if is_valid else None for one, is_valid in found] == expected[name]
            assert [statuses[code] for code in group["status"][:].tolist()] == expected["status"]
        assert file["drives/pump/output_frequency"].attrs["unit"] == "Hz"
        assert json.loads(file[f"drives/pump/{STATE}"].attrs["values"])["OVERHEAT"] == 8
        texts = [tuple(text.decode() for text in file["events"][name][:]) for name in ("kind", "text")]
        assert texts == [("comment", "trigger"), (COMMENT.status, TRIGGER["condition"])]
        assert file["events/time_ns"][:].tolist() == [COMMENT.time_ns, TRIGGER["time_ns"]]
        assert json.loads(file["metadata"][()]) == METADATA


def test_mdf4_times_never_decrease_if_the_clock_is_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from asammdf import MDF

    monkeypatch.setattr("multidrop.recording.series.PIECE_ROWS", 100)
    times = [at if at < 150 else at - 149 for at in range(300)]
    source = record(tmp_path / "a.arrows", [row(at, "pump", "speed", float(at)) for at in times], ABOUT)
    convert(source, tmp_path / "a.mf4")
    found: list[float] = []
    with MDF(tmp_path / "a.mf4") as mdf:
        for group in range(len(mdf.groups)):
            signal = mdf.get("pump.speed", group=group)
            assert sorted(signal.timestamps) == signal.samples.tolist() == signal.timestamps.tolist()
            assert set(mdf.get("pump.speed.status", group=group).samples) == {b"ok"}
            found += signal.samples.tolist()
    assert sorted(found) == sorted(times)


def test_export_includes_value_names_of_negative_numbers(tmp_path: Path) -> None:
    import h5py
    from asammdf import MDF

    names = {"REVERSE": -1, "REST": 0, "FORWARD": 1}
    about = {"drives": {"pump": {"registers": {"direction": {"unit": "", "values": names}}}}}
    source = record(tmp_path / "a.arrows", [row(at, "pump", "direction", at - 1.0) for at in range(3)], about)
    for suffix in (".mf4", ".h5"):
        convert(source, tmp_path / f"a{suffix}")
    with MDF(tmp_path / "a.mf4") as mdf:
        assert mdf.get("pump.direction").samples.tolist() == [name.encode() for name in names]
    with h5py.File(tmp_path / "a.h5") as file:
        assert json.loads(file["drives/pump/direction"].attrs["values"]) == names


def test_the_error_for_an_unknown_suffix_lists_the_suffixes_of_exports(tmp_path: Path) -> None:
    source = record(tmp_path / "run.arrows", rows(1), METADATA)
    with pytest.raises(ValueError, match=r"must end in \.arrows, \.csv, \.parquet, \.mf4, \.h5"):
        convert(source, tmp_path / "run.xls")


@pytest.mark.parametrize(
    ("suffix", "library", "extra"), [(".mf4", "asammdf", "mdf"), (".h5", "h5py", "hdf5")]
)
def test_the_error_for_a_missing_library_names_the_extra_to_install(
    suffix: str, library: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = record(tmp_path / "run.arrows", rows(1), METADATA)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(
        sys.modules, f"multidrop.recording.{'mdf4' if library == 'asammdf' else 'hdf5'}", False
    )
    with pytest.raises(
        RecordingError, match=rf"{suffix} needs {library}: pip install .*multidrop\[{extra}\]"
    ):
        convert(source, tmp_path / f"run{suffix}")
    assert not (tmp_path / f"run{suffix}").exists()


@pytest.mark.parametrize("suffix", [pytest.param(".mf4", marks=pytest.mark.slow), ".h5"])
@pytest.mark.parametrize("time_ns", [-1, (1 << 63) - 1])
def test_an_export_refuses_rows_before_1970_or_after_2200(time_ns: int, suffix: str, tmp_path: Path) -> None:
    wrong = rows(1)[-1]._replace(time_ns=time_ns)
    source, target = record(tmp_path / "run.arrows", [*rows(1), wrong], METADATA), tmp_path / f"run{suffix}"
    with pytest.raises(ValueError, match=rf"run{suffix}: rows from before 1970 or after 2200 do not fit"):
        convert(source, target)
    assert not target.exists()


@pytest.mark.parametrize("suffix", [pytest.param(".mf4", marks=pytest.mark.slow), ".h5"])
def test_an_export_keeps_an_existing_file_and_removes_an_incomplete_one(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = record(tmp_path / "run.arrows", rows(1), METADATA), tmp_path / f"run{suffix}"
    target.write_bytes(b"other")
    with pytest.raises(FileExistsError):
        convert(source, target)
    assert target.read_bytes() == b"other"
    target.unlink()

    def fail(*_: object) -> Callable[[], None]:
        raise ValueError("damaged")

    monkeypatch.setattr("multidrop.recording.series.codes_of", fail)
    with pytest.raises(ValueError, match="damaged"):
        convert(source, target)
    assert [path.name for path in tmp_path.iterdir()] == ["run.arrows"]


def test_drives_and_registers_with_similar_names_have_separate_groups_in_hdf5(tmp_path: Path) -> None:
    import h5py

    drives = ["hall/fan", "hall\N{DIVISION SLASH}fan"]
    registers = ["in/out", "in\N{DIVISION SLASH}out"]
    names = list(product(drives, registers))
    found = [row(at, *name, at) for at in (1.0, 2.0) for name in names]
    source = record(tmp_path / "run.arrows", found, METADATA)
    convert(source, tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5") as file:
        keys = product((drives[1], f"{drives[1]}_"), (registers[1], f"{registers[1]}_"))
        groups = [file[f"drives/{drive}/{register}"] for drive, register in keys]
        assert [(group.attrs["drive"], group.attrs["register"]) for group in groups] == names
        assert [group["value"][:].tolist() for group in groups] == [[1.0, 2.0]] * 4


def test_an_interrupted_hdf5_export_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from multidrop.recording.hdf5 import GuardedFile

    source, calls, write = record(tmp_path / "run.arrows", rows(100), METADATA), count(), GuardedFile.write

    def interrupted_write(file: GuardedFile, piece: Any) -> int:
        if next(calls) == 20:
            signal.raise_signal(signal.SIGINT)
        return write(file, piece)

    monkeypatch.setattr(GuardedFile, "write", interrupted_write)
    with pytest.raises(KeyboardInterrupt):
        convert(source, tmp_path / "run.h5")
    assert [path.name for path in tmp_path.iterdir()] == ["run.arrows"]


def interrupted_once(
    work: Callable[..., Any], interrupts: int, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    """Return a function that at its first call sends SIGINT to the main thread, and then does the work.

    The function catches all exceptions, as asammdf does. It sends the signal only when the main thread waits
    for the export's thread.
    """
    handled, steps, calls = Semaphore(0), Semaphore(0), count()
    submit = ThreadPoolExecutor.submit

    def counting_submit(*words: Any) -> Any:
        future = submit(*words)
        steps.release()
        return future

    def interrupt(*_: object) -> None:
        while steps.acquire(blocking=False):
            pass
        handled.release()
        raise KeyboardInterrupt

    def interrupted(*words: Any, **details: Any) -> Any:
        if next(calls) == 0:
            for _ in range(interrupts):
                with suppress(BaseException):
                    steps.acquire(timeout=5.0)
                    signal.pthread_kill(main_thread().ident or 0, signal.SIGINT)
                    handled.acquire(timeout=5.0)
        return work(*words, **details)

    monkeypatch.setattr(ThreadPoolExecutor, "submit", counting_submit)
    signal.signal(signal.SIGINT, interrupt)
    return interrupted


@pytest.fixture
def _usual_sigint() -> Iterator[None]:
    """Restore the handler of SIGINT after the test."""
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows interrupts no wait of the main thread")
@pytest.mark.usefixtures("_usual_sigint")
@pytest.mark.parametrize("interrupts", [1, 2])
@pytest.mark.parametrize("step", ["attach", "append", "extend", "save"])
def test_two_interrupts_during_a_step_of_an_mdf4_export_leave_no_file(
    step: str, interrupts: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second Ctrl-C interrupts the wait for the library's thread. That thread still removes the file."""
    from multidrop.recording.mdf4 import MDF

    source = record(tmp_path / "run.arrows", rows(400), METADATA)
    monkeypatch.setattr("multidrop.recording.series.PIECE_ROWS", 100)
    monkeypatch.setattr(MDF, step, interrupted_once(getattr(MDF, step), interrupts, monkeypatch))
    with pytest.raises(KeyboardInterrupt):
        convert(source, tmp_path / "run.mf4")
    until(lambda: [path.name for path in tmp_path.iterdir()] == ["run.arrows"])


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".mf4", ".h5"])
def test_an_interrupt_between_two_steps_of_an_export_leaves_no_file(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C comes when the main thread passes a step to the library's thread."""
    source, submit = record(tmp_path / "run.arrows", rows(400), METADATA), ThreadPoolExecutor.submit
    monkeypatch.setattr("multidrop.recording.series.PIECE_ROWS", 100)
    for last in count():
        calls = count()

        def interrupted_submit(*words: Any, calls: Iterator[int] = calls, last: int = last) -> Any:
            future = submit(*words)
            if next(calls) == last:
                raise KeyboardInterrupt
            return future

        monkeypatch.setattr(ThreadPoolExecutor, "submit", interrupted_submit)
        try:
            convert(source, tmp_path / f"run{suffix}")
        except KeyboardInterrupt:
            until(lambda: [path.name for path in tmp_path.iterdir()] == ["run.arrows"])
        else:
            break
    assert last > 4


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit for a file's size")
@pytest.mark.parametrize("suffix", [".mf4", ".h5"])
def test_a_full_disk_leaves_no_exported_file(suffix: str, tmp_path: Path) -> None:
    """HDF5 would crash the process if it noticed the failed write at 20,000 bytes."""
    import resource

    source = record(tmp_path / "run.arrows", rows(2000), METADATA)
    command = [sys.executable, "-m", "multidrop", "convert", str(source), str(tmp_path / f"run{suffix}")]
    full = subprocess.run(
        command,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
        check=False,
    )
    assert (full.returncode, "cannot be written: File too large" in full.stderr) == (1, True), full.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run.arrows"]
