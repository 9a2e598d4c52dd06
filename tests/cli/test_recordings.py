"""`plot`, `report` and `convert`: mistakes are reported in one sentence, and no file is replaced."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import Run
from peers import require_installed
from recordings import record, row

import multidrop.cli.support.files
from multidrop.recording import open_writer

require_installed("matplotlib")

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def ramp(tmp_path: Path) -> Path:
    rows = [row(at, "pump", name, at) for at in range(9) for name in ("output_frequency", "fault")]
    rows += [row(at, "fan", "output_current", at) for at in range(9)]
    return record(tmp_path / "ramp.arrows", rows)


@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_the_commands_plot_and_report_need_only_the_recording(run: Run, ramp: Path, tmp_path: Path) -> None:
    here = tmp_path / "ramp.arrows"
    here.write_bytes(ramp.read_bytes())
    assert run("plot", here) == (0, f"{tmp_path}/ramp.png\n", "")
    assert (tmp_path / "ramp.png").read_bytes().startswith(PNG)
    assert run("report", here) == (0, f"{tmp_path}/ramp.html\n", "")
    assert "Report on ramp.arrows" in (tmp_path / "ramp.html").read_text()
    status, _, err = run("plot", here)
    assert status == 2
    assert "exists already" in err
    assert run("plot", here, "--drive", "fan", "--out", tmp_path / "fan.html")[0] == 0
    assert "data:image/png" in (tmp_path / "fan.html").read_text()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--drive", "punp"), "the recording has no drive 'punp'; it has pump, fan"),
        (("--register", "speed"), "the recording has no register 'speed'; it has output_frequency, "),
        (("--drive", "fan", "--register", "fault"), "has no register 'fault'; it has output_current"),
        (("--out", "picture.jpg"), "picture.jpg: a plot's name must end in .png or .html"),
    ],
)
def test_wrong_plot_options_are_reported_in_one_sentence(
    run: Run, ramp: Path, tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    out = () if "--out" in words else ("--out", tmp_path / "it.png")
    status, text, err = run("plot", ramp, *words, *out)
    assert (status, text) == (2, "")
    assert sentence in err
    assert len(err.splitlines()) == 1


@pytest.mark.usefixtures("_unpainted")
def test_series_without_values_are_not_plotted(run: Run, tmp_path: Path) -> None:
    rows = [row(at, "pump", "output_frequency", None, "no reply") for at in range(3)]
    rows += [row(at, "fan", "output_frequency", 5.0) for at in range(3)]
    path = record(tmp_path / "it.arrows", rows)
    assert run("plot", path, "--drive", "pump") == (
        2,
        "",
        "multidrop: there is no value to draw, only failed reads: no reply 3; "
        "`multidrop report` shows more\n",
    )
    assert run("plot", path)[0] == 0


@pytest.mark.parametrize("command", ["plot", "report", "convert"])
def test_a_history_folder_as_argument_prints_one_sentence(run: Run, tmp_path: Path, command: str) -> None:
    out = () if command != "convert" else (tmp_path / "all.csv",)
    folder = f"multidrop: {tmp_path} is the folder of a history: name one of its files, such as"
    by_program = "or read it from Python with `multidrop.History`\n"
    (tmp_path / "rows").mkdir()
    for name in ("rows.00000003.arrows", "rows/00000001.parquet", "rows/00000002.parquet"):
        (tmp_path / name).touch()
    assert run(command, tmp_path, *out) == (2, "", f"{folder} {tmp_path}/rows.00000003.arrows, {by_program}")
    (tmp_path / "rows.00000003.arrows").unlink()
    assert run(command, tmp_path, *out) == (2, "", f"{folder} {tmp_path}/rows/00000002.parquet, {by_program}")


@pytest.mark.parametrize("command", ["plot", "report"])
def test_a_file_without_a_recording_prints_one_sentence(run: Run, tmp_path: Path, command: str) -> None:
    assert run(command, ".")[::2] == (2, "multidrop: . is a folder: name the recording in it\n")
    text = tmp_path / "letter.arrows"
    text.write_text("Dear Sir")
    assert "is not a recording" in run(command, text)[2]
    empty = tmp_path / "empty.arrows"
    with open_writer(empty, {}):
        pass
    status, _, err = run(command, empty)
    assert status == 2
    assert "holds no rows: nothing was polled" in err
    with empty.open("ab") as file:
        file.write(b"\xff\xff\xff\xff\x10")
    assert "holds no rows: it ends within the first one" in run(command, empty)[2]


@pytest.mark.parametrize("time", [-(2**63), -1, 2**63 - 1])
def test_a_time_outside_the_calendar_prints_one_sentence(run: Run, tmp_path: Path, time: int) -> None:
    rows = [
        row(0, "pump", "output_frequency", 1.0),
        row(1, "pump", "output_frequency", 1.0)._replace(time_ns=time),
    ]
    path = record(tmp_path / "it.arrows", rows)
    for command in ("plot", "report"):
        assert run(command, path) == (
            2,
            "",
            f"multidrop: {path} cannot be drawn: it has rows from before 1970 or after 2200\n",
        )


def test_recordings_with_deeply_nested_metadata_print_one_sentence(run: Run, tmp_path: Path) -> None:
    path = record(tmp_path / "it.csv", [row(0, "pump", "output_frequency", 1.0)])
    (tmp_path / "it.csv.json").write_text("[" * 100_000)
    for command in ("plot", "report"):
        status, out, err = run(command, path)
        assert (status, out) == (2, "")
        assert "is not a recording: its metadata is nested too deeply" in err


@pytest.mark.parametrize("command", ["plot", "report"])
def test_a_missing_library_is_named_with_the_command_that_installs_it(
    run: Run, ramp: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(multidrop.cli.support.files.importlib.util, "find_spec", lambda name: None)
    status, _, err = run(command, ramp)
    assert status == 2
    assert "pip install 'matplotlib>" in err
