"""`multidrop plan` and its output for a plant file, without a port."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import TOY, Run

from multidrop.cli.support.values import columns_of

LINE = '[[line]]\nname = "{}"\nport = "/dev/there-is-no-such-port-{}"\n'
DRIVE = '[[line.drive]]\nname = "{}"\nmodel = "{}"\naddress = {}\n'


@pytest.fixture
def fitting(tmp_path: Path) -> Path:
    """Return a plant file with two drives that are polled at low rates."""
    path = tmp_path / "fitting.toml"
    path.write_text(
        LINE.format("hall-1", 1)
        + DRIVE.format("pump-1", TOY, 1)
        + 'every = "1 s"\n'
        + DRIVE.format("pump-2", TOY, 2)
        + 'poll = ["output_current", { register = "output_frequency", every = "500 ms" }]\n'
    )
    return path


@pytest.fixture
def crowded(tmp_path: Path) -> Path:
    """Return a plant file whose second line has four drives at 9600 bit/s, each polled 50 times a second."""
    path = tmp_path / "crowded.toml"
    path.write_text(
        LINE.format("hall-1", 1)
        + DRIVE.format("fan", TOY, 1)
        + LINE.format("hall-2", 2)
        + "".join(DRIVE.format(f"pump-{n}", TOY, n) + 'every = "20 ms"\n' for n in range(1, 5))
    )
    return path


def test_the_plan_command_returns_0_if_the_line_reaches_all_rates(run: Run, fitting: Path) -> None:
    status, out, err = run("plan", fitting)
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].startswith("hall-1: utilisation 100.0%, bus cycle ")
    assert lines[1].split() == ["DRIVE", "REQUESTS", "REGISTERS", "EVERY", "ASKED", "REACHED"]
    assert lines[2].split() == ["pump-1", "1", "5", "1", "s", "1/s", "1/s"]
    assert lines[3].split()[:5] == ["pump-2", "1", "1", "-", "-"]
    assert lines[4].split() == ["pump-2", "1", "1", "500", "ms", "2/s", "2/s"]
    assert len(lines) == 5


def test_the_plan_command_shortens_long_names_and_aligns_its_columns(run: Run, tmp_path: Path) -> None:
    """Names may differ only at their ends, and Chinese characters are two columns wide."""
    path = tmp_path / "named.toml"
    names = [
        "conveyor-of-the-bottling-hall-1",
        "conveyor-of-the-bottling-hall-2",
        "主泵电机三号线北侧冷却水循环",
    ]
    path.write_text(
        LINE.format("hall-1", 1) + "".join(DRIVE.format(n, TOY, at + 1) for at, n in enumerate(names))
    )
    _, out, _ = run("plan", path)
    head, first, second, chinese = out.splitlines()[1:5]
    assert [row.split()[0] for row in (first, second)] == [
        "conveyor-of-...ng-hall-1",
        "conveyor-of-...ng-hall-2",
    ]
    assert chinese.split()[0] == "主泵电机三号...却水循环"
    assert {columns_of(row) for row in (first, second, chinese)} == {columns_of(head)}


def test_the_plan_command_prints_the_same_figures_as_json(run: Run, fitting: Path) -> None:
    status, out, _ = run("plan", fitting, "--json")
    line = json.loads(out)["lines"]["hall-1"]
    assert (status, line["fits"], line["misfits"], line["remedies"], line["warnings"]) == (
        0,
        True,
        [],
        None,
        [],
    )
    # One request reads five registers, and two requests read one each, at 8N1. Each request adds 5 ms of
    # response delay, a silence of 3.5 characters and one bit, and 0.1 ms in this computer.
    characters = (8 + 15) + 2 * (8 + 7)
    assert line["cycle_ms"] == pytest.approx(characters * 10 / 9.6 + 3 * (5 + 36 / 9.6 + 0.1), abs=0.001)
    (pump,) = line["drives"]["pump-1"]
    assert pump == {
        "registers": ["output_frequency", "output_current", "mystery", "fault", "status"],
        "requests": 1,
        "every_ms": 1000.0,
        "asked_per_second": 1.0,
        "reached_per_second": 1.0,
        "fits": True,
    }


@pytest.mark.slow
def test_the_plan_command_suggests_changes_if_the_line_is_too_slow(run: Run, crowded: Path) -> None:
    status, out, err = run("plan", crowded)
    assert (status, err) == (1, "")
    assert max(map(len, out.splitlines())) <= 80
    told = " ".join(out.split())
    first = "output_frequency, output_current, mystery and 2 more do not fit"
    for drive in ("pump-1", "pump-2", "pump-3", "pump-4"):
        assert f"! {drive}: {first}: " in told
    assert " of 50 times per second" in told
    assert '! it would fit with every = "' in told
    assert "fan:" not in told
    *_, second = json.loads(run("plan", crowded, "--json")[1])["lines"].items()
    assert (second[0], second[1]["fits"]) == ("hall-2", False)
    (suggestion,) = second[1]["remedies"]["every_ms"]
    assert suggestion["asked"] == 20
    again = crowded.read_text().replace("20 ms", f"{suggestion['fits']:g} ms")
    crowded.write_text(again)
    assert run("plan", crowded)[0] == 0


def test_the_plan_polls_a_drive_without_a_rate_on_an_overloaded_line(run: Run, crowded: Path) -> None:
    crowded.write_text(crowded.read_text() + DRIVE.format("eager", TOY, 9) + 'poll = ["fault"]\n')
    status, out, _ = run("plan", crowded)
    assert status == 1
    assert "! eager" not in out
    (row,) = (line for line in out.splitlines() if line.startswith("  eager"))
    assert 0 < float(row.split()[-1].removesuffix("/s")) < 10


@pytest.mark.parametrize("model", ["yd1000", "delixi-modbus"])
def test_the_plan_command_warns_if_polling_all_readings_takes_too_long(
    run: Run, tmp_path: Path, model: str
) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(LINE.format("hall-1", 1) + DRIVE.format("p", model, 1) + DRIVE.format("q", model, 2))
    status, out, _ = run("plan", path)
    assert status == 0
    told = " ".join(out.split())
    assert "? a bus cycle takes longer than 1 s; all readings are polled of p (" in told
    assert "name the registers you need, such as poll" in told
    path.write_text(path.read_text().replace("address = 1\n", 'address = 1\npoll = ["output_current"]\n'))
    path.write_text(path.read_text().replace("address = 2\n", 'address = 2\npoll = ["output_current"]\n'))
    assert "?" not in run("plan", path)[1]


def test_the_plan_command_includes_the_time_to_switch_between_line_settings(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(
        LINE.format("hall-1", 1) + DRIVE.format("p", "yd1000", 1) + 'poll = ["output_current"]\n'
        "" + DRIVE.format("q", "erman-er-g-220", 2) + 'poll = ["output_current"]\n'
    )
    free = json.loads(run("plan", path, "--json")[1])["lines"]["hall-1"]
    assert (free["switches"], free["switching_ms"]) == (2, 0)
    told = " ".join(run("plan", path)[1].split())
    assert "the line changes its settings 2 times in a bus cycle; `multidrop poll` measures how long" in told
    path.write_text(path.read_text().replace("port =", 'switching = "3 ms"\nport ='))
    dear = json.loads(run("plan", path, "--json")[1])["lines"]["hall-1"]
    assert dear["cycle_ms"] - free["cycle_ms"] == pytest.approx(6)
    assert "the line changes its settings 2 times in a bus cycle, 3 ms each" in " ".join(
        run("plan", path)[1].split()
    )


def test_the_plan_command_prints_long_names_within_80_columns(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    name = "the pump behind the second door on the left of the hall with the blue floor"
    path.write_text(LINE.format(name, 1) + DRIVE.format(name, TOY, 1) + 'every = "1 ms"\n')
    status, out, _ = run("plan", path)
    assert status == 1
    assert max(map(len, out.splitlines())) <= 80


def test_the_plan_command_prints_all_mistakes_in_a_plant_file_and_returns_2(run: Run, fitting: Path) -> None:
    text = fitting.read_text().replace("port =", "prot =").replace('"1 s"', '"soon"')
    fitting.write_text(text)
    status, out, err = run("plan", fitting)
    assert (status, out) == (2, "")
    assert [line.removeprefix(f"multidrop: {fitting}:") for line in err.splitlines()] == [
        "3: line \"hall-1\": unknown key 'prot'; did you mean port?",
        '8: line "hall-1", drive "pump-1": every = \'soon\' is not a duration from 100 us to 24 h, '
        'such as "50 ms", "2 s" or "1 min"',
    ]


def test_the_plan_command_returns_2_for_a_missing_file(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    sentence = f"multidrop: {path}: the plant file cannot be read: No such file or directory\n"
    assert run("plan", path) == (2, "", sentence)
