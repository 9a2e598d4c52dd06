"""Plant files: valid contents are loaded, and every mistake gives one sentence."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tables import table

from multidrop.channels import Channel
from multidrop.core import Echo
from multidrop.drive import Framing
from multidrop.drive.line_settings import Settings
from multidrop.families.files.sections import NOT_OPTIONS
from multidrop.families.yd1000 import YD1000
from multidrop.plant import RESERVED_NAMES, check_drive_name, drive_meant
from multidrop.plant.loader import DRIVE_KEYS, PlantError, load_plant
from multidrop.plant.model import Plant, Polled, PolledDrive
from multidrop.toml_check import parse_duration

FAMILY = """\
from multidrop.drive.family import Drive, Framing
from multidrop.drive.register import Option
from multidrop.drive.register import command, reading, setting

class Toy(Drive):
    model = "toy"
    title = "TOY T1"
    framings = (Framing.RTU, Framing.ASCII)
    formats = {Framing.RTU: ("8N1", "8E1"), Framing.ASCII: ("7E1",)}
    baudrates = (9600, 19200)
    addresses = range(1, 32)
    options = {"rated_frequency": Option("Hz", (10, 400), "rated frequency of the motor")}

    output_frequency = reading(1, "Hz", step=0.1)
    output_current = reading(2, "A", step=0.1)
    acceleration_time = setting(10, "s", step=0.1)
    control = command(20)

class Fixed(Drive):
    model = "fixed"
    title = "FIXED F1"
    baudrates = (38400,)
    formats = {Framing.RTU: ("8N1",)}
    output_voltage = reading(5, "V")

class Mute(Drive):
    model = "mute"
    title = "MUTE M1"
    control = command(1)
"""

GOOD = """\
[[line]]
name = "hall-1"
port = "/dev/ttyUSB0"
baudrate = 19200
format = "8E1"

[[line.drive]]
name = "pump-1"
model = "family.py:Toy"
address = 1
every = "50 ms"
poll = ["output_current", { register = "output_frequency", every = "20 ms" }, "acceleration_time"]

[[line.drive]]
name = "fan-1"
model = "family.py:Fixed"
address = 2
baudrate = 38400
format = "8N1"

[[line]]
name = "hall-2"
port = "socket://10.0.0.9:4001"

[[line.drive]]
name = "pump-2"
model = "family.py:Toy"
address = 1
framing = "ascii"
rated_frequency = 60
"""

HEAD = '[[line]]\nname = "L"\nport = "/dev/a"\n'
TOY = '[[line.drive]]\nname = "D"\nmodel = "family.py:Toy"\naddress = 1\n'
POLL = 'poll = ["output_current"]\n'
FIXED = '[[line.drive]]\nname = "F"\nmodel = "family.py:Fixed"\naddress = 2\n'

Load = Callable[[str], Plant]
Mistakes = Callable[[str], list[str]]


@pytest.fixture
def load(tmp_path: Path) -> Load:
    (tmp_path / "family.py").write_text(FAMILY)

    def load(text: str) -> Plant:
        path = tmp_path / "plant.toml"
        path.write_text(text, "utf-8")
        return load_plant(path)

    return load


@pytest.fixture
def mistakes(load: Load, tmp_path: Path) -> Mistakes:
    """Return a function that loads a plant file and returns its mistakes, without path and line number."""

    def mistakes(text: str) -> list[str]:
        with pytest.raises(PlantError) as refusal:
            load(text)
        start = re.compile(re.escape(str(tmp_path / "plant.toml")) + r"(:\d+)?: ")
        assert all(start.match(sentence) for sentence in refusal.value.mistakes)
        assert str(refusal.value) == "\n".join(refusal.value.mistakes)
        return [start.sub("", sentence, count=1) for sentence in refusal.value.mistakes]

    return mistakes


def test_the_lines_drives_and_polls_are_read_from_a_plant_file(load: Load) -> None:
    plant = load(GOOD)
    hall_1, hall_2 = plant.lines
    assert (hall_1.name, hall_1.port, hall_1.baudrate, hall_1.format) == (
        "hall-1",
        "/dev/ttyUSB0",
        19200,
        "8E1",
    )
    assert (hall_2.name, hall_2.baudrate, hall_2.format) == ("hall-2", None, None)
    pump_1, fan_1 = hall_1.drives
    assert (pump_1.drive.name, pump_1.drive.address) == ("pump-1", 1)
    assert pump_1.drive.settings == Settings(19200, "8E1")
    assert [(poll.register.name, poll.every) for poll in pump_1.polls] == [
        ("output_current", 0.05),
        ("output_frequency", 0.02),
        ("acceleration_time", 0.05),
    ]
    assert fan_1.drive.settings == Settings(38400, "8N1")


SILENT = """\
[[line]]
name = "hall-1"
port = "/dev/ttyUSB0"
baudrate = 38400
format = "8N1"
silence = "500 us"

[[line.drive]]
name = "quick"
model = "erman-er-g-220"
address = 1

[[line.drive]]
name = "slow"
model = "innovert-ibd"
address = 2

[[line.drive]]
name = "text"
model = "delixi-modbus"
framing = "ascii"
format = "7N2"
address = 3
"""


def test_the_silence_setting_of_a_line_keeps_a_familys_required_silence(load: Load) -> None:
    (line,) = load(SILENT).lines
    assert [polled.drive.needed_silence() for polled in line.drives] == pytest.approx([500e-6, 10e-3, 0])
    assert line.switching == 0
    (line,) = load(SILENT.replace('silence = "500 us"\n', 'switching = "2 ms"\n')).lines
    assert line.switching == 2e-3
    (line,) = load(SILENT.replace('silence = "500 us"\n', 'settle = "1.5 s"\n')).lines
    assert (line.settle, line.at("socket://127.0.0.1:1").settle) == (1.5, 1.5)
    assert [polled.drive.needed_silence() for polled in line.drives] == pytest.approx([1.75e-3, 10e-3, 0])


def test_the_echo_setting_of_a_line_is_automatic_by_default(load: Load) -> None:
    assert load(SILENT).lines[0].echo is Echo.AUTO
    assert load(SILENT.replace('silence = "500 us"', 'echo = "off"')).lines[0].echo is Echo.OFF


def test_the_key_realtime_applies_to_all_lines_of_a_plant_file(load: Load, mistakes: Mistakes) -> None:
    assert load(GOOD).realtime is False
    assert load("realtime = true\n" + GOOD).realtime is True
    assert mistakes("realtime = 1\n" + GOOD) == ["realtime = 1 is not right; write realtime = true"]


def test_a_drive_without_a_poll_list_polls_all_readings_continuously(load: Load) -> None:
    (pump,) = load(GOOD).lines[1].drives
    assert [(poll.register.name, poll.every) for poll in pump.polls] == [
        ("output_frequency", None),
        ("output_current", None),
    ]


def test_the_byte_order_mark_of_a_plant_file_is_skipped(load: Load) -> None:
    assert load("\ufeff" + SILENT).metadata() == load(SILENT).metadata()


def test_framing_and_options_in_a_plant_file_reach_the_drive(load: Load) -> None:
    (pump,) = load(GOOD).lines[1].drives
    assert pump.drive.framing is Framing.ASCII
    assert pump.drive.settings == Settings(9600, "7E1")
    assert pump.drive.option == {"rated_frequency": 60}


def test_an_error_names_the_line_number_of_the_wrong_key_or_table(load: Load) -> None:
    text = (
        GOOD.replace('port = "/dev/ttyUSB0"', 'prot = "/dev/ttyUSB0"')
        .replace('"output_current",', '"output_curent",')
        .replace("address = 2", "address = 1")
    )
    with pytest.raises(PlantError) as refusal:
        load(text)
    numbers = [int(sentence.split(":")[1]) for sentence in refusal.value.mistakes]
    rows = text.splitlines()
    starts = ("prot =", "poll =", "address =")
    assert all(rows[number - 1].startswith(start) for number, start in zip(numbers, starts, strict=True))


def test_the_same_mistake_in_many_drives_is_reported_once_with_a_count(load: Load) -> None:
    drives = (
        TOY.replace('"D"', f'"D{address}"').replace("address = 1", f"address = {address}")
        + 'poll = ["output_curent"]\n'
        for address in range(1, 32)
    )
    with pytest.raises(PlantError) as refusal:
        load(HEAD + "".join(drives))
    (sentence,) = refusal.value.mistakes
    assert '"D1"' in sentence
    assert sentence.endswith("; the same in 30 more places")


def test_all_mistakes_in_a_plant_file_are_reported_together(mistakes: Mistakes) -> None:
    text = (
        GOOD.replace('port = "/dev/ttyUSB0"', 'prot = "/dev/ttyUSB0"')
        .replace('"output_current",', '"output_curent",')
        .replace('every = "50 ms"', 'every = "50"')
        .replace("address = 2", "address = 1")
        .replace("rated_frequency = 60", "rated_frequency = 600")
    )
    assert mistakes(text) == [
        "line \"hall-1\": unknown key 'prot'; did you mean port?",
        'line "hall-1", drive "pump-1": every = \'50\' is not a duration from 100 us to 24 h, '
        'such as "50 ms", "2 s" or "1 min"',
        'line "hall-1", drive "pump-1", poll number 1: '
        "TOY T1 has no register 'output_curent'; did you mean output_current or output_frequency?",
        'line "hall-1", drive "fan-1": '
        'address 1 is already used by line "hall-1", drive "pump-1"; give each drive its own',
        'line "hall-2", drive "pump-2": rated_frequency = 600 is outside 10 to 400 Hz',
    ]


@table(
    ("text", "sentence"),
    [
        ("", "'line' is missing; add [[line]], in two brackets, with its name, port and drives"),
        ("[line]", "line = {} is not right; write [[line]], in two brackets, with its name, port and drives"),
        (
            "line = [3]",
            "line number 1: 3 is not a table with name, port, baudrate, format, silence, switching, echo, "
            "rs485, settle, transaction, drive",
        ),
        (
            HEAD,
            "line \"L\": 'drive' is missing; add [[line.drive]], in two brackets, "
            "with its name, model and address",
        ),
        (
            HEAD + 'silence = "0 us"\n' + TOY,
            "line \"L\": silence = '0 us' is not a duration from 100 us to 24 h, "
            'such as "50 ms", "2 s" or "1 min"',
        ),
        (
            HEAD + "silence = 0.0005\n" + TOY,
            'line "L": silence = 0.0005 is not right; write silence = "500 us"',
        ),
        (
            HEAD + 'silence = "500 us"\n' + TOY,
            'line "L", drive "D": silence 500 us is too short at 9600 8N1: write 1563 us or more, '
            "because a frame may contain pauses of 1.5 characters",
        ),
        (HEAD + 'silence = "2 s"\n' + TOY, 'line "L", drive "D": silence 2.0 is not a time from 0 to 1 s'),
        (HEAD + 'echo = "loud"\n' + TOY, 'line "L": echo \'loud\' is none of "auto", "on" and "off"'),
        (HEAD + "baudrate = 7\n" + TOY, 'line "L": baud rate 7 is outside 50 to 4000000'),
        (
            HEAD + 'format = "8X1"\n' + TOY,
            "line \"L\": format '8X1' is not data bits, parity and stop bits, such as 8N1, 8E1 or 7N2",
        ),
        (
            HEAD + 'baudrate = "19200"\n' + TOY,
            "line \"L\": baudrate = '19200' is not right; write baudrate = 19200, without quotes",
        ),
        (HEAD + 'parity = "N"\n' + TOY, "line \"L\": unknown key 'parity'; did you mean format?"),
        (
            (HEAD + TOY).replace("= 1", "= true"),
            'line "L", drive "D": address = True is not right; write address = 1',
        ),
        (
            (HEAD + TOY).replace('"D"', '""'),
            'line "L", drive number 1: name = \'\' is not right; write name = "pump-1"',
        ),
        (
            (HEAD + TOY).replace("= 1", "= 32"),
            'line "L", drive "D": address 32 is not supported by TOY T1; choose 1 to 31',
        ),
        (
            HEAD + TOY + "baudrate = 38400",
            'line "L", drive "D": baud rate 38400 is not supported by TOY T1; choose 9600, 19200',
        ),
        (
            HEAD + TOY + "baudrate = 0",
            'line "L", drive "D": baud rate 0 is not supported by TOY T1; choose 9600, 19200',
        ),
        (
            HEAD + TOY + 'format = "8O1"',
            'line "L", drive "D": format \'8O1\' is not supported by TOY T1; choose 8N1, 8E1',
        ),
        (
            HEAD + TOY + 'framing = "udp"',
            'line "L", drive "D": framing \'udp\' is not supported by TOY T1, which has rtu, ascii',
        ),
        (
            HEAD + TOY + 'framing = "tcp"',
            'line "L", drive "D": framing tcp is for tcp:// ports, such as tcp://10.0.0.7:502, '
            "not for /dev/a",
        ),
        (
            HEAD + "baudrate = 9600\n" + FIXED,
            'line "L", drive "F": baud rate 9600 is not supported by FIXED F1; choose 38400'
            "; 9600 is the value of the line, so add baudrate = 38400 to this drive",
        ),
        (
            HEAD + 'format = "8N1"\n' + TOY + 'framing = "ascii"',
            'line "L", drive "D": format \'8N1\' is not supported by TOY T1; choose 7E1'
            '; 8N1 is the value of the line, so add format = "7E1" to this drive',
        ),
        (
            (HEAD + TOY).replace("family.py:Toy", "innovert-ibt"),
            'line "L", drive "D": there is no model \'innovert-ibt\'; '
            "did you mean innovert-ibd? (or write path/to/file.toml or file.py:Class)",
        ),
        (
            HEAD + TOY + 'poll = ["control"]',
            'line "L", drive "D", poll number 1: '
            "control can only be written, not polled; see `multidrop models toy`",
        ),
        (
            HEAD + TOY + "poll = []",
            'line "L", drive "D": poll = [] is not right; '
            'write poll = ["output_current"], or leave it out to poll all readings',
        ),
        (
            HEAD + TOY + "poll = [7]",
            'line "L", drive "D", poll number 1: 7 is not right; '
            'write "output_current" or { register = "output_current" }',
        ),
        (
            HEAD + TOY + 'poll = ["output_current", { register = "output_current" }]',
            'line "L", drive "D": output_current of D is in poll twice; remove one',
        ),
        (
            HEAD + TOY + 'poll = ["*", "*"]',
            'line "L", drive "D": * of D is in poll twice; remove one',
        ),
        (
            HEAD + TOY + 'poll = [{ register = "output_current", evry = "1 s" }]',
            'line "L", drive "D", poll number 1: unknown key \'evry\'; did you mean every?',
        ),
        (HEAD + TOY + "every = 5", 'line "L", drive "D": every = 5 is not right; write every = "50 ms"'),
        (
            HEAD + TOY + 'every = "0 ms"',
            'line "L", drive "D": every = \'0 ms\' is not a duration from 100 us to 24 h, '
            'such as "50 ms", "2 s" or "1 min"',
        ),
        (HEAD + 'settle = "11 s"\n' + TOY, 'line "L": settle = 11.0 is not a number of seconds from 0 to 10'),
        (
            HEAD + 'switching = "now"\n' + TOY,
            "line \"L\": switching = 'now' is not a duration from 100 us to 24 h, "
            'such as "50 ms", "2 s" or "1 min"',
        ),
        (
            HEAD + TOY + 'poll = [{ register = "output_current", every = "often" }]',
            'line "L", drive "D", poll number 1: every = \'often\' is not a duration from 100 us to 24 h, '
            'such as "50 ms", "2 s" or "1 min"',
        ),
        (
            HEAD + '[[line.drive]]\nname = "I"\nmodel = "innovert-ibd"\naddress = 1\nforward_bit = 2.5',
            'line "L", drive "I": forward_bit = 2.5 is not a whole number from 2 to 3',
        ),
        (
            HEAD + TOY + "rated_frequency = true",
            'line "L", drive "D": rated_frequency = True is not right; write rated_frequency = 400',
        ),
        (
            HEAD + FIXED + "rated_frequency = 50",
            'line "L", drive "F": unknown key \'rated_frequency\'; '
            "the keys here are name, model, address, framing, baudrate, format, ram, every, poll, channel",
        ),
        (
            HEAD + '[[line.drive]]\nname = "M"\nmodel = "family.py:Mute"\naddress = 1',
            'line "L", drive "M": MUTE M1 has no readings; add poll = [...] with registers',
        ),
        (
            HEAD + TOY + HEAD.replace("/dev/a", "/dev/b") + FIXED,
            'line "L": another line already has this name; each line needs its own',
        ),
        (
            HEAD + TOY + HEAD.replace('"L"', '"M"') + FIXED,
            'line "M": port /dev/a is already used by line "L"; make them one line',
        ),
        (
            HEAD + TOY + '[[line]]\nname = "M"\nport = "/dev/b"\n' + TOY,
            'line "M", drive "D": another drive already has this name; each drive needs its own',
        ),
        (
            HEAD + TOY + POLL + TOY.replace("= 1", "= 2") + POLL,
            'line "L", drive "D": another drive already has this name; each drive needs its own',
        ),
        ('[[line]]\nname = "L"\n' + TOY, 'line "L": \'port\' is missing; add port = "/dev/ttyUSB0"'),
        (
            HEAD.replace("/dev/a", "socket://10.0.0.9:40O1") + TOY,
            "line \"L\": socket://10.0.0.9:40O1: Port could not be cast to integer value as '40O1'",
        ),
        (
            HEAD.replace("/dev/a", "socket://10.0.0.9") + TOY,
            'line "L": socket://10.0.0.9: the URL needs a host and a port number, '
            "such as socket://10.0.0.7:4001",
        ),
    ],
)
def test_each_plant_file_mistake_gives_one_sentence(mistakes: Mistakes, text: str, sentence: str) -> None:
    assert mistakes(text) == [sentence]


def test_each_drive_key_that_the_family_refuses_is_reported(mistakes: Mistakes) -> None:
    text = (
        HEAD + TOY.replace("= 1", "= 99") + 'baudrate = 1\nformat = "8N2"\nframing = "x"\nrated_frequency = 1'
    )
    assert [sentence.split(": ")[1].split(" is ")[0] for sentence in mistakes(text)] == [
        "framing 'x'",
        "address 99",
        "baud rate 1",
        "format '8N2'",
        "rated_frequency = 1",
    ]


def test_a_plant_file_path_that_is_too_long_is_reported() -> None:
    with pytest.raises(PlantError, match="the plant file cannot be read: File name too long"):
        load_plant("x" * 5000)


def test_an_unreadable_plant_file_is_reported_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(
        PlantError, match=r"none.toml: the plant file cannot be read: No such file or directory"
    ):
        load_plant(tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b'name = "S\xfcd"')
    with pytest.raises(
        PlantError, match=r"latin.toml:1: the file is not text in UTF-8, from byte 9 on \(0xFC\); save"
    ):
        load_plant(tmp_path / "latin.toml")


SCANNED = "is a port, not a plant file; `multidrop scan {} --out plant.toml` writes one"


@table(
    ("name", "expected"),
    [
        ("http://10.0.0.7:8750", "open a gateway's page in a browser"),
        ("HTTPS://plant.example/", "open a gateway's page in a browser"),
        ("nats://10.0.0.7:4222", "name a file such as plant.toml"),
        ("tcp://10.0.0.7", SCANNED.format("tcp://10.0.0.7")),
        ("/dev/ttyUSB0", SCANNED.format("/dev/ttyUSB0")),
    ],
)
def test_a_url_or_port_name_instead_of_a_plant_file_is_reported(name: str, expected: str) -> None:
    for given in (name, Path(name)):  # Path reduces two slashes to one, so both types are tried
        with pytest.raises(PlantError) as raised:
            load_plant(given)
        assert str(raised.value).lower().startswith(name.lower().rstrip("/"))
        assert expected in str(raised.value)


def test_a_family_file_given_as_plant_file_is_reported_in_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "meter.toml"
    path.write_text('[family]\ntitle = "Meter"\n\n[reading]\nvoltage = { at = "30001" }\n')
    with pytest.raises(PlantError) as raised:
        load_plant(path)
    (sentence,) = raised.value.mistakes
    assert sentence.startswith(f"{path}: this is a family file, not a plant file")


def test_a_device_path_given_as_plant_file_is_not_read() -> None:
    """Reading a serial port would block, and take bytes from its line."""
    with pytest.raises(PlantError, match=r": the path is a device, not a plant file$"):
        load_plant(os.devnull)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a = " + "[" * 5000 + "]" * 5000, "is nested too deeply"),
        ("a." * 300 + "b = 1", "is not TOML: a key or a text has more than 100 dots"),
        ("a." * 100_000 + "b = 1", "is not TOML: a key or a text has more than 100 dots"),
        ("address = " + "9" * 5000, "is not TOML: Exceeds the limit"),
        ("address = 0x" + "f" * 5000, "is not TOML: a number does not fit into 64 bits"),
    ],
    ids=["nested", "dotted", "long dotted", "decimal", "hexadecimal"],
)
def test_a_plant_file_that_tomllib_rejects_is_reported(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(PlantError, match=sentence) as found:
        load_plant(tmp_path / "a.toml")
    assert len(found.value.mistakes) == 1


def test_control_characters_in_names_are_escaped_in_errors(mistakes: Mistakes) -> None:
    name, address = mistakes(HEAD + TOY.replace('"D"', r'"D\n\u001B[2J"').replace("= 1", "= 99"))
    assert name.startswith(r'line "L", drive "D\n\x1b[2J": name = ')
    assert name.endswith("has unprintable characters; remove them")
    assert address.startswith(r'line "L", drive "D\n\x1b[2J": address 99')


UNDOCUMENTED = ("spy:///dev/null?file={}", "SPY://x?file={}", "alt://x?class={}", "loop://")


@pytest.mark.parametrize("port", UNDOCUMENTED)
def test_a_port_url_with_an_undocumented_scheme_is_refused(mistakes: Mistakes, port: str) -> None:
    """For example, pyserial's spy:// would overwrite the file that the URL names."""
    (sentence,) = mistakes((HEAD + TOY).replace('port = "/dev/a"', f'port = "{port}"'))
    scheme = port.partition(":")[0]
    assert sentence.endswith(
        f"the scheme {scheme}:// is not supported; write a URL such as tcp://10.0.0.7, "
        "socket://10.0.0.7:4001 or rfc2217://10.0.0.7:4001"
    )


def test_a_port_url_with_a_user_is_refused_without_showing_the_password(mistakes: Mistakes) -> None:
    (sentence,) = mistakes((HEAD + TOY).replace('port = "/dev/a"', 'port = "tcp://bob:S3C@ET@10.0.0.7"'))
    assert "tcp://10.0.0.7: a port takes no user name and no password" in sentence
    assert "S3C" not in sentence


def test_reserved_names_of_lines_and_drives_are_refused(mistakes: Mistakes) -> None:
    line, drive = mistakes((HEAD + TOY).replace('"L"', '".."').replace('"D"', '"stop"'))
    assert line.startswith('line "..": name ".." is reserved for the folder above')
    assert drive.startswith('line "..", drive "stop": name "stop" is reserved for the MQTT topic PREFIX/stop')


def test_a_family_file_name_that_is_too_long_is_reported(mistakes: Mistakes) -> None:
    (sentence,) = mistakes(HEAD + TOY.replace("family.py:Toy", "a" * 300 + ".py"))
    # Windows has the second text
    assert sentence.endswith((".py cannot be read: File name too long", ".py does not exist"))


@table(
    ("text", "expected"), [("500 us", 500e-6), ("50ms", 0.05), ("2 s", 2), ("1.5 min", 90), (" 1 h ", 3600)]
)
def test_a_text_such_as_100ms_is_read_as_a_duration(text: str, expected: float) -> None:
    assert parse_duration(text) == pytest.approx(expected)


@table(
    "text",
    [
        "",
        "50",
        "ms",
        "-5 ms",
        "0 s",
        "5 sec",
        "1e3 s",
        "nan s",
        "5 ms 3",
        "1 us",
        "25 h",
        "9" * 400 + " h",
        5,
        None,
        b"5 s",
    ],
)
def test_invalid_durations_in_a_plant_file_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"is not a duration from 100 us to 24 h, such as"):
        parse_duration(text)


def test_the_options_of_a_drive_are_read_from_the_plant_file(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(
        """
        [[line]]
        name = "hall-1"
        port = "/dev/ttyUSB0"
        [[line.drive]]
        name = "pump-1"
        model = "innovert-ibd"
        address = 1
        confirmed = 1
        ram = ["acceleration_time"]
        """
    )
    (drive,) = (each.drive for each in load_plant(path).lines[0].drives)
    assert (drive.ram, drive.option) == ({"acceleration_time"}, {"confirmed": 1})
    path.write_text(path.read_text().replace("acceleration_time", "acceleration"))
    with pytest.raises(PlantError, match="did you mean acceleration_time"):
        load_plant(path)
    path.write_text(path.read_text().replace('["acceleration"]', "[3]"))
    with pytest.raises(PlantError, match="the argument ram must hold register names, not 3"):
        load_plant(path)


def two_lines(directory: Path) -> Path:
    path = directory / "plant.toml"
    line = '[[line]]\nname = "{0}"\nport = "/dev/{0}"\n[[line.drive]]\nname = "pump-{1}"\n'
    rest = 'model = "yd1000"\naddress = 1\n'
    path.write_text(line.format("hall", 1) + rest + line.format("roof", 2) + rest)
    return path


def test_replacing_ports_changes_nothing_else_in_a_plant(tmp_path: Path) -> None:
    plant = load_plant(two_lines(tmp_path))
    changed = plant.with_ports({"roof": "ports/roof"})
    assert [line.port for line in changed.lines] == ["/dev/hall", "ports/roof"]
    assert changed.lines[1].drives == plant.lines[1].drives
    assert [line.port for line in plant.lines] == ["/dev/hall", "/dev/roof"]
    assert plant.with_ports({"roof": "/dev/hall", "hall": "/dev/roof"}).lines[0].port == "/dev/roof"


def test_replacing_ports_refuses_unknown_lines_and_duplicate_ports(tmp_path: Path) -> None:
    plant = load_plant(two_lines(tmp_path))
    with pytest.raises(ValueError, match=r"plant\.toml has no line 'rof'; did you mean roof\?"):
        plant.with_ports({"rof": "x"})
    with pytest.raises(ValueError, match="lines hall and roof would both use /dev/hall"):
        plant.with_ports({"roof": "/dev/hall"})


def test_a_plant_finds_lines_and_drives_by_name(tmp_path: Path) -> None:
    plant = load_plant(two_lines(tmp_path))
    assert plant.find_line("roof") is plant.lines[1]
    line, drive = plant.find_drive("pump-2")
    assert (line.name, drive.name) == ("roof", "pump-2")
    with pytest.raises(ValueError, match=r"has no drive 'fan'; there are pump-1, pump-2"):
        plant.find_drive("fan")


@table("every", [0, 0.0, -1.0, 0.00009, 86401.0, float("nan"), float("inf"), True, "1 s"])
def test_a_polling_period_outside_the_limits_is_refused(every: Any) -> None:
    """A period of 0 s would make the polling of the whole line fail."""

    register = YD1000.register("status")
    with pytest.raises(ValueError, match=rf"^every = {every!r} is not a number of seconds from 0\.0001 to "):
        Polled(register, every)
    assert Polled(register, None).every is None


def test_a_star_in_the_poll_list_means_all_readings(load: Load) -> None:
    def polls(entries: str) -> dict[str, float | None]:
        (line,) = load(HEAD + TOY + f'every = "1 s"\npoll = {entries}').lines
        return {poll.register.name: poll.every for poll in line.drives[0].polls}

    assert polls('["*"]') == {"output_frequency": 1.0, "output_current": 1.0}
    assert polls('["*", { register = "output_current", every = "10 s" }, "acceleration_time"]') == {
        "output_frequency": 1.0,
        "output_current": 10.0,
        "acceleration_time": 1.0,
    }
    assert polls('[{ register = "*", every = "2 s" }, "output_current"]') == {
        "output_frequency": 2.0,
        "output_current": 1.0,
    }


@table("twice", [["status", "status"], ["*", "*"], [YD1000.register("status"), Polled("status", 1.0)]])
def test_a_drive_in_python_refuses_a_register_that_is_polled_twice(twice: list[Any]) -> None:
    with pytest.raises(ValueError, match=r"^(status|\*) of yd1000@1 is in poll twice; remove one$"):
        PolledDrive(YD1000(1), twice)


def test_a_text_register_in_a_poll_list_is_a_mistake(mistakes: Mistakes, tmp_path: Path) -> None:
    (tmp_path / "meter.toml").write_text(
        '[family]\ntitle = "Meter"\nmanual = "M"\ncounts_from = 0\n'
        "[reading]\npower = { at = 1 }\n[text]\nmark = { at = 9, length = 4 }\n"
    )
    (sentence,) = mistakes(HEAD + TOY.replace("family.py:Toy", "meter.toml") + 'poll = ["mark"]')
    assert sentence.endswith("'mark' of Meter is a text, which can be read, but not polled or written")


# Letters with a composed and a decomposed Unicode encoding, from the code charts.
COMPOSED, APART = "L\u00fcfter", "Lu\u0308fter"
SHORT, LONG = "\u0439", "\u0438\u0306"


@table(
    ("given", "names", "meant"),
    [
        (APART, [COMPOSED, "pump"], COMPOSED),
        (COMPOSED, ["pump", APART], APART),
        (LONG, [SHORT], SHORT),
        (APART, [COMPOSED, APART], APART),  # an exact match takes precedence
        ("pump", ["pump", "pump-1"], "pump"),
        ("Pump", ["pump"], "Pump"),  # case is significant
        # ambiguous: both names have the same Unicode normal form
        ("\u212b", ["A\u030a", "\u00c5"], "\u212b"),
        ("Lufter", [COMPOSED], "Lufter"),
        ("\ufb01", ["fi"], "\ufb01"),  # the ligature of f and i does not match the two letters
        ("\ud800", [COMPOSED], "\ud800"),
        ("", [], ""),
    ],
)
def test_a_drive_name_is_found_by_its_unicode_normal_form(given: str, names: list[str], meant: str) -> None:
    assert drive_meant(given, names) == meant


@table("name", [*RESERVED_NAMES, "--all", "-"])
def test_reserved_drive_names_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="give it another name"):
        check_drive_name(name)


@table("name", ["stop-1", "Stop", "gateways", "...", "a-", "__proto"])
def test_drive_names_similar_to_reserved_ones_are_allowed(name: str) -> None:
    assert check_drive_name(name)


def test_a_family_option_cannot_have_the_name_of_a_plant_file_key() -> None:
    assert set(DRIVE_KEYS) <= NOT_OPTIONS


FILE = """\
totals = "kept.json"
[[line]]
name = "hall"
port = "/dev/ttyUSB0"
[[line.drive]]
name = "pump-1"
model = "yaskawa-v1000"
address = 1
poll = ["output_power", "output_frequency"]
[[line.drive.channel]]
name = "energy"
value = "integral(output_power)"
unit = "kWh"
[[line.drive]]
name = "pump-2"
model = "yaskawa-v1000"
address = 2
poll = ["output_power"]
[[line.drive.channel]]
name = "both"
value = "pump-1.output_power + output_power"
unit = "W"
"""


def loaded(folder: Path, text: str = FILE) -> tuple[tuple[Channel, ...], ...]:
    path = folder / "plant.toml"
    path.write_text(text)
    plant = load_plant(path)
    assert plant.totals == folder / "kept.json"
    return tuple(polled.channels for polled in plant.lines[0].drives)


def test_computed_channels_in_a_plant_file_belong_to_their_drive(tmp_path: Path) -> None:
    first, second = loaded(tmp_path)
    assert first == (Channel("energy", "integral(output_power)", "kWh"),)
    assert second == (Channel("both", "pump-1.output_power + output_power", "W"),)


WRONG_CHANNELS = (
    (
        "pump-1.output_power +",
        "pump-1.output_frequency +",
        21,
        "column 25: kW cannot be combined with Hz; both",
    ),
    ('"kWh"', '"kW"', 12, "column 1: the value is in kW*s, which cannot be converted to kW"),
    ("integral(", "integrall(", 12, "column 1: there is no function 'integrall'; did you mean integral?"),
    (
        '"energy"',
        '"output_power"',
        12,
        "pump-1 already has a register or channel 'output_power'; give the channel another name",
    ),
    ("+ output_power", "+ output_current", 21, "column 23: pump-2.output_current is not polled; add"),
    ('\nunit = "kWh"', "\nunits = 3", 13, "unknown key 'units'; did you mean unit?"),
    ('"both"', '"energy"\n[[line.drive.channel]]', 19, "'value' is missing; add"),
)


@pytest.mark.parametrize(("right", "wrong", "line", "sentence"), WRONG_CHANNELS)
def test_a_mistake_in_a_computed_channel_is_reported_with_file_and_line(
    tmp_path: Path, right: str, wrong: str, line: int, sentence: str
) -> None:
    assert right in FILE
    with pytest.raises(PlantError) as mistake:
        loaded(tmp_path, FILE.replace(right, wrong))
    first = mistake.value.mistakes[0]
    assert first.startswith(f"{tmp_path}/plant.toml:{line}: ")
    assert sentence in first


def test_a_drive_with_a_mistake_in_its_channel_can_still_be_stopped(tmp_path: Path) -> None:
    with pytest.raises(PlantError) as mistake:
        loaded(tmp_path, FILE.replace("integral(", "integrall("))
    assert mistake.value.right is not None
    assert [polled.drive.name for polled in mistake.value.right.lines[0].drives] == ["pump-1", "pump-2"]
