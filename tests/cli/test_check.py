"""`multidrop check`, and other commands that are given a family file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from commands import Run
from profile_families import write_meter

FAN = """\
[family]
title = "Fan FC-2"
manual = "FC-2, section 4"
counts_from = 1
[reading]
speed = { at = 0x0010, unit = "rpm" }
scale = { at = 0x0011, step = "unknown", place = "P0" }
[setting]
frequency = { at = 0x0020, unit = "Hz", step = 0.1 }
ramp = { at = 0x0021, unit = "s", kept = "eeprom", while_running = false, span = [0, 10], place = "P1" }
locked = { at = 0x0022, never = "it changes the motor", place = "P2", span = [0, 1], kept = "ram" }
[command]
run = { at = 0x0030, values = { off = 0, on = 1 }, harmless = [0], place = "P3" }
"""


def words(text: str) -> str:
    return re.sub(r"\s+", " ", text)


@pytest.fixture
def fan(tmp_path: Path) -> Path:
    path = tmp_path / "fan.toml"
    path.write_text(FAN)
    return path


def test_the_check_command_lists_unknown_facts_and_forbidden_writes(run: Run, fan: Path) -> None:
    status, out, err = run("check", fan)
    shown = words(out)
    assert (status, err) == (0, "")
    assert "000FH speed reading 1 rpm" in shown  # 000FH is the address on the wire; the manual counts from 1
    assert "declared by its file, untested" in shown
    unknown, refused = shown.partition(" not known ")[2].split(" will be refused ")
    for told in (
        "frequency whether it is stored in EEPROM: each write counts as wear",
        "frequency its span: every value that fits is written; span = [0, 50]",
        "frequency its place in the manual",
        "scale its scale: raw counts are shown",
        "place the manual's place of speed",
        "identify how to recognise this device",
        "watchdog whether the motor stops when polling stops",
    ):
        assert told in unknown
    for told in (
        "ramp every write: it is unknown whether the motor has stopped",
        "ramp more than one write in 60 s, or 1000 a year: it is stored in EEPROM",
        "locked every write: it changes the motor",
        "run every write except by verbs, and of 0000H",
        "confirmed every write, until the drive has confirmed = 1",
        "It can move a motor and is untested",
    ):
        assert told in refused


def test_a_web_address_is_refused_as_a_plant_file(run: Run) -> None:
    told = "http://10.0.0.7:8750 is a web address, not a plant file; open a gateway's page in a "
    for command in ("check", "plan", "poll", "simulate"):
        assert run(command, "http://10.0.0.7:8750") == (2, "", f"multidrop: {told}browser\n")


def test_the_check_command_accepts_the_name_of_a_shipped_family_file(run: Run) -> None:
    status, out, _ = run("check", "abb-acs355")
    assert status == 0
    assert "No mistake found in abb-acs355" in words(out)
    assert max(map(len, out.splitlines())) <= 80


def test_the_check_command_suggests_the_right_name_or_command(run: Run, tmp_path: Path) -> None:
    assert "see `multidrop models innovert-ibd`" in run("check", "innovert-ibd")[2]
    assert "did you mean abb-acs355" in run("check", "abb-acs35")[2]
    (tmp_path / "plant.toml").write_text('[[line]]\nname = "L"\n')
    mistakes = run("check", tmp_path / "plant.toml")[2].splitlines()
    assert [mistake.partition('"L": ')[2].partition(";")[0] for mistake in mistakes] == [
        "'port' is missing",
        "'drive' is missing",
    ]


def test_family_sheets_show_bit_numbers_and_hex_addresses(run: Run, tmp_path: Path) -> None:
    """Bits have numbers, and registers have hex addresses. Only a family with verbs has a watchdog."""
    _, out, _ = run("check", "abb-acs355")
    assert "bit 0 READY_TO_SWITCH_ON, bit 1 READY_TO_OPERATE" in words(out)
    assert "only verbs write it, except 047EH, 047CH, 0476H" in words(out)
    assert "watchdog" in run("models", "abb-acs355")[1]
    path = write_meter(tmp_path)
    assert "watchdog" not in run("models", path)[1]
    with path.open("a") as file:
        file.write("[text]\nserial_number = { at = '30500', length = 4 }\n")
    assert "01F3H serial_number input register 8 characters" in words(run("models", path)[1])


def test_the_check_command_prints_a_family_as_json(run: Run, fan: Path) -> None:
    status, out, _ = run("check", fan, "--json")
    found = json.loads(out)
    assert (status, found["model"], found["declared_in"], found["mistakes"]) == (
        0,
        "fan.toml",
        "fan.toml",
        [],
    )
    assert ["identify", "how to recognise this device; read its name plate"] in found["not_known"]


def test_the_check_command_prints_all_mistakes_and_returns_1(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "fan.toml"
    path.write_text(FAN.replace("0x0010", '"8192"').replace("0x0020", "-1"))
    status, out, err = run("check", path)
    assert (status, out) == (1, "")
    assert [line.partition(": [")[2] for line in err.splitlines()] == [
        'reading] speed: at: "8192" may be decimal or hex; write 8192, or "8192H"',
        "setting] frequency: at: -1 is outside 1 to 10000H",
    ]
    status, out, _ = run("check", path, "--json")
    assert (status, len(json.loads(out)["mistakes"])) == (1, 2)


def test_the_models_command_warns_that_a_family_file_is_not_tested(run: Run, tmp_path: Path) -> None:
    path = write_meter(tmp_path)
    status, out, _ = run("models", path)
    assert status == 0
    assert "declared by its file, untested" in words(out)
    assert json.loads(run("models", path, "--json")[1])["declared_in"] == "meter.toml"


def test_the_models_command_returns_2_for_an_invalid_family_file(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "fan.toml"
    path.write_text("[family]\n")
    status, _, err = run("models", path)
    assert status == 2
    assert "'title' is missing" in err
    assert "'manual' is missing" in err


def test_the_check_command_warns_of_a_line_with_too_many_drives(run: Run, tmp_path: Path) -> None:
    """The manual of ERMAN, section 1, allows at most 31 devices, including the drive itself."""
    plant = tmp_path / "plant.toml"

    def check(drives: int, *options: str) -> tuple[int, str, str]:
        text = '[[line]]\nname = "L"\nport = "/dev/ttyUSB0"\nbaudrate = 38400\nformat = "8N1"\n'
        for number in range(1, drives + 1):
            model = "erman-er-g-220" if number == 1 else "invt-che"
            text += f'[[line.drive]]\nname = "d{number}"\nmodel = "{model}"\naddress = {number}\n'
            text += 'poll = [{ register = "output_frequency" }]\n'
        plant.write_text(text)
        return run("check", plant, *options)

    assert check(31)[2] == ""
    status, out, err = check(32)
    assert status == 0
    assert (
        "line L: it has 32 drives; the manual of ERMAN ER-G-220-01(02) allows 31 devices: split the line"
        in err
    )
    assert out.startswith("No mistake found")
    remarks = json.loads(check(32, "--json")[1])["remarks"]
    assert [name for name, _ in remarks] == ["line L"]


def test_mistakes_of_a_family_file_are_reported_once_for_all_drives(run: Run, tmp_path: Path) -> None:
    (tmp_path / "fan.toml").write_text(FAN.replace("0x0010", '"8192"').replace("0x0020", "-1"))
    drives = "".join(f'[[line.drive]]\nname = "f{at}"\nmodel = "fan.toml"\naddress = {at}\n' for at in (1, 2))
    (tmp_path / "plant.toml").write_text(f'[[line]]\nname = "L"\nport = "/dev/null"\n{drives}')
    status, _, err = run("plan", tmp_path / "plant.toml")
    assert status == 2
    reported = [line for line in err.splitlines() if "fan.toml" in line]
    assert len(reported) == 2
    assert all('plant.toml:6: line "L", drive "f1": ' in line for line in reported)


def test_the_check_command_does_not_ask_for_the_value_range_of_a_coil(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "io.toml"
    path.write_text(
        '[family]\ntitle = "IO"\nmanual = "v1"\n[setting]\nlamp = { at = "00001", place = "1" }\n'
    )
    status, out, _ = run("check", path)
    assert status == 0
    assert "lamp  setting  0 or 1" in out
    assert "its span" not in out
    assert "together = { coil = 20 }" in " ".join(out.split())


def test_the_scan_command_refuses_two_family_files_of_the_same_model(run: Run, tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_meter(tmp_path / folder)
    found = [tmp_path / folder / "meter.toml" for folder in ("a", "b")]
    status, _, err = run("scan", "/dev/null", "--model", found[0], "--model", found[1])
    assert status == 2
    assert "two family files declare the model meter.toml: name only one of them" in err
