"""Names from files and arguments: their characters cannot control a terminal or break a page."""

from __future__ import annotations

import ast
import logging
import math
import struct
import subprocess
import sys
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import Any

import pytest
from captures import write
from commands import Run
from frames import PRINTED
from peers import require_module
from recordings import record, row
from tables import table, usually
from terminals import MULTIDROP

import multidrop.cli
from multidrop.cli import main
from multidrop.cli.support.log_thread import logging_to_stderr
from multidrop.core import Framing, Message
from multidrop.families import InvtCHE
from multidrop.families.files import notation
from multidrop.gateway.http.messages import Denied, number_in
from multidrop.gateway.settings import read_plant
from multidrop.importers.parsing import count, number
from multidrop.plant.loader import PlantError, load_plant
from multidrop.printable import masked, plain_number, plain_whole, printable
from multidrop.recording.csv import _parse

# In this order: clear the screen, set the title, write the clipboard, reverse the text direction, start an
# escape with one byte, break the line, end a C string.
TRAPS = ("\x1b[2J", "\x1b]0;title\x07", "\x1b]52;c;cm0gLXJm\x07", "\u202egpj.exe", "\x9b2J", "a\r\nb", "\0")
TRAP = "".join(TRAPS)


def is_harmless(text: str) -> bool:
    return all(line.isprintable() for line in text.split("\n"))


def test_printable_text_stays_unchanged() -> None:
    assert printable("pump-1 насос 泵 é '\"\\") == "pump-1 насос 泵 é '\"\\"
    assert printable("\x1b[2J") == r"\x1b[2J"
    assert all(printable(trap).isprintable() for trap in TRAPS)


@pytest.mark.parametrize("form", ["text", "json"])
def test_the_gateway_log_escapes_control_characters_in_names(
    capfd: pytest.CaptureFixture[str], form: str
) -> None:
    """A caller's address may come from a proxy, and a drive's name may come from an MQTT topic."""
    with logging_to_stderr(form, {"multidrop": logging.INFO}):
        logging.getLogger("multidrop.gateway").warning("stop of %s, asked for by %s", TRAP, "anna")
    (line,) = capfd.readouterr().err.removesuffix("\n").split("\n")
    assert "asked for by anna" in line
    assert not set(line) & {"\x1b", "\r", "\0"}
    assert form == "json" or line.isprintable()


SECRET = "S3C@R:ET"  # some users write such passwords, although an @ should be escaped


def test_a_url_is_printed_without_user_and_password() -> None:
    given = f"no server at nats://bob:{SECRET}@a:4222, tls://{SECRET}@b, nats://c; by anna@hall"
    assert masked(given) == "no server at nats://a:4222, tls://b, nats://c; by anna@hall"


@pytest.mark.parametrize(
    ("words", "variables"),
    [
        (["fleet", "status", "--nats", "{}"], {}),
        (["fleet", "status", "--nats", "x{}"], {}),
        (["fleet", "status"], {"MULTIDROP_NATS": "{}"}),
        (["fleet", "stop", "pump-1", "--nats", "{}"], {}),
        (["fleet", "rights", "gw-1", "--nats", "{}00000"], {}),
        (["hub", "{}", "--parquet", "x", "--once"], {}),
        (["fleet", "status", "{}"], {}),
        (["serve", "{}"], {}),
        (["read", "{}", "invt-che", "1", "status"], {}),
    ],
)
def test_command_messages_contain_no_url_password(
    words: list[str],
    variables: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    require_module("nats")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    url = f"nats://bob:{SECRET}@127.0.0.1:1"
    for name, value in variables.items():
        monkeypatch.setenv(name, value.format(url))
    assert multidrop.cli.main([word.format(url) for word in words]) != 0
    said = "".join(capsys.readouterr())
    assert said
    assert "S3C" not in said
    assert "R:ET" not in said


def test_plant_file_errors_contain_no_url_password(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(
        '[[line]]\nname = "L"\nport = "/dev/a"\n'
        '[[line.drive]]\nname = "D"\nmodel = "invt-che"\naddress = 1\n'
        f'[serve.mqtt]\nbroker = "mqtt://bob:{SECRET}@broker:1883"\n'
        f'[serve.fleet]\nnats = ["x://bob:{SECRET}@host"]\n'
    )
    with pytest.raises(PlantError) as caught:
        read_plant(lambda: load_plant(tmp_path / "p.toml"), {})
    fleet, broker = caught.value.mistakes
    assert (
        'broker = "mqtt://broker:1883" contains a user or password; write user = "name" and '
        'password = "FILE" instead' in broker
    )
    assert "x://host" in fleet
    assert "S3C" not in str(caught.value)


@pytest.mark.parametrize("form", ["text", "json"])
def test_the_gateway_log_contains_no_url_password(capfd: pytest.CaptureFixture[str], form: str) -> None:
    with logging_to_stderr(form, {"multidrop": logging.INFO}):
        failure = OSError(f"nats://bob:{SECRET}@host is lost")
        logging.getLogger("multidrop.gateway").error("at %s", f"nats://{SECRET}@host", exc_info=failure)
    said = capfd.readouterr().err
    assert said.count("nats://host") == 2
    assert "S3C" not in said


@table("trap", TRAPS)
def test_unprintable_names_and_ports_are_refused(tmp_path: Path, trap: str) -> None:
    text = "".join(f"\\u{ord(character):04x}" for character in trap)
    path = tmp_path / "plant.toml"
    path.write_text(
        f'[[line]]\nname = "{text}"\nport = "{text}"\n'
        f'[[line.drive]]\nname = "{text}"\nmodel = "invt-che"\naddress = 1\n'
    )
    with pytest.raises(PlantError) as found:
        load_plant(path)
    assert len(found.value.mistakes) == 3
    assert all("has unprintable characters" in sentence for sentence in found.value.mistakes)
    assert is_harmless(str(found.value))


@pytest.mark.long
@table(
    "words",
    [
        ("doctor", TRAP),
        ("read", TRAP, "invt-che", 1),
        ("read", "/dev/nowhere", TRAP, 1),
        ("read", "/dev/nowhere", "invt-che", 1, TRAP),
        ("stop", TRAP, "invt-che", 1),
        ("write", TRAP, "invt-che", 1, TRAP, TRAP),
        ("set-frequency", TRAP, "invt-che", 1, 5, "--yes"),
        ("scan", TRAP),
        ("sniff", TRAP),
        ("sniff", f"socket://{TRAP}:1"),
        ("plan", TRAP),
        ("poll", TRAP),
        ("simulate", TRAP, "--ports", TRAP),
        ("models", TRAP),
        ("models", f"{TRAP}.py:Fan"),
        ("plot", TRAP),
        ("report", f"{TRAP}.arrows"),
        ("convert", f"{TRAP}.arrows", "b.csv"),
        ("decode", TRAP),
        (TRAP,),
        ("models", TRAP, TRAP),
    ],
)
def test_arguments_are_printed_without_control_characters(run: Run, words: tuple[object, ...]) -> None:
    status, out, err = run(*(str(word).replace("\0", "") for word in words))
    assert status in (1, 2)
    assert err.startswith("multidrop: ")
    assert is_harmless(out + err)


@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_the_names_in_a_recording_are_printed_without_control_characters(run: Run, tmp_path: Path) -> None:
    rows = [row(at, TRAP, f"{TRAP}{number}", at) for at in range(3) for number in range(4)]
    rows.append(row(3, TRAP, TRAP, None, TRAP))
    drive = dict.fromkeys(("line", "model", "settings", "address", "framing"), TRAP)
    names = {"unit": TRAP, "values": {TRAP: 1, "$x^{$": 2}, "bits": False}
    registers = {f"{TRAP}1": names, f"{TRAP}2": {**names, "bits": True}}
    about = {"plant": TRAP, "drives": {TRAP: {**drive, "registers": registers}}}
    path = record(tmp_path / "it.arrows", rows, about)
    for command, suffix in (("plot", ".html"), ("report", ".html")):
        status, out, err = run(command, path, "--out", tmp_path / f"{command}{suffix}")
        assert (status, err) == (0, "")
        assert is_harmless(out + err)
        page = (tmp_path / f"{command}{suffix}").read_text("utf-8")
        assert is_harmless(page.replace("\u202f", " "))
        assert r"\x1b[2J" in page or command == "plot"
    status, out, err = run("plot", path, "--drive", "x")
    assert status == 2
    assert is_harmless(out + err)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Glyph")
@pytest.mark.usefixtures("_laid_out")
def test_a_name_with_markup_is_plain_text_in_pictures_and_legends(tmp_path: Path) -> None:
    require_module("matplotlib")
    from multidrop.report import load, plot, plot_page, report_page

    # matplotlib hides a label that starts with _, and reads mathematics between two $
    name = rf"_$x^{{$\frac%s{{0}}{TRAP}"
    rows = [
        row(at, name, register, at) for at in range(3) for register in (name, "output_frequency", "fault")
    ]
    rows.append(row(3, name, name, None, name))
    look = load(record(tmp_path / "it.arrows", rows, {"drives": {name: {"line": name}}}))
    figure, _ = plot(look)
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 2
    assert report_page(look)
    assert plot_page(look, figure)


def test_the_texts_in_a_capture_are_printed_without_control_characters(run: Run, tmp_path: Path) -> None:
    exchanges = [each for each in PRINTED if each.framing is Framing.RTU and isinstance(each.says, Message)]
    path = write(
        tmp_path / "it.pcapng",
        [exchange for exchange in exchanges if exchange.request is not None][:3],
        line=TRAP,
    )
    comment = struct.pack("<HH4s", 1, 4, b"\x1b[2J")
    section = struct.pack("<III", 0x0A0D0D0A, 36, 0x1A2B3C4D) + struct.pack("<HHq", 1, 0, -1) + comment
    path.write_bytes(section + struct.pack("<I", 36) + path.read_bytes()[section_length(path) :])
    for words in (("decode", path), ("decode", path, "--json"), ("sniff", "--replay", path)):
        status, out, err = run(*words)
        assert status == 0
        assert "3 exchanges" in out or "--json" in words
        assert is_harmless(out + err)
    damaged = path.read_bytes()[:200].replace(struct.pack("<HHI", 252, 0, 0), struct.pack("<HHI", 1, 0, 0))
    path.write_bytes(damaged)
    status, out, err = run("decode", path)
    assert status == 2
    assert "is Ethernet" in err
    assert is_harmless(out + err)


def section_length(path: Path) -> int:
    return int(struct.unpack_from("<I", path.read_bytes(), 4)[0])


@pytest.mark.slow
def test_every_command_prints_through_the_escaping_function() -> None:
    """Commands call `print` only for help, drawings, schemas and questions. All other text is escaped."""
    printing = ("__init__", "support/output", "params", "poll", "scan", "completion")
    ours = {f"{name}.py" for name in printing}
    root = Path(multidrop.cli.__file__).parent
    found = {
        str(path.relative_to(root))
        for path in root.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    }
    assert found == ours


@pytest.mark.long
@pytest.mark.parametrize("command", usually("poll", "plan"))
def test_running_a_users_model_file_is_reported_once(tmp_path: Path, command: str) -> None:
    """The command runs in a new process, because each process reports this only once."""
    (tmp_path / "fan.py").write_text(
        "from pathlib import Path\nfrom multidrop import Drive, reading\n"
        f"Path({str(tmp_path / 'ran')!r}).touch()\n\n"
        "class Fan(Drive):\n    speed = reading(1, 'rpm')\n"
    )
    plant = tmp_path / "hall.toml"
    plant.write_text(
        '[[line]]\nname = "hall-1"\nport = "/dev/nowhere"\n'
        + "".join(f'[[line.drive]]\nname = "fan-{n}"\nmodel = "fan.py:Fan"\naddress = {n}\n' for n in (1, 2))
    )
    done = subprocess.run([*MULTIDROP, command, str(plant)], capture_output=True, text=True)
    assert (tmp_path / "ran").exists()
    told, *rest = done.stderr.splitlines()
    assert told == f"multidrop: {tmp_path}/fan.py is run as Python: a user's model is a program"
    assert not any("is run as Python" in line for line in rest)
    assert done.returncode == (0 if command == "plan" else 1)


# ---- output in an encoding that lacks some letters, such as that of a pipe on Windows ----


PLANT = """
[[line]]
name = "зал"
port = "/dev/ttyUSB0"
[[line.drive]]
name = "насос"
model = "innovert-ibd"
address = 1
"""


@pytest.mark.parametrize("words", [["plan"], ["plan", "--json"]])
def test_an_unencodable_letter_is_printed_as_an_escape(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    plant, out = tmp_path / "plant.toml", BytesIO()
    plant.write_text(PLANT, "utf-8")
    monkeypatch.setattr(sys, "stdout", TextIOWrapper(out, "cp1252"))
    assert main([*words, str(plant)]) == 0
    said = out.getvalue().decode("cp1252")
    assert r"\u0437\u0430\u043b" in said
    assert "зал" not in said


# ---- numbers in command arguments, requests and files: only ASCII decimal digits are accepted ----


# Fullwidth, Arabic-Indic, Devanagari and mathematical digits, and underscores as in Python.
ODD = ["1_0", "\uff11\uff12", "\u0663", "\u0967\u0968", "\U0001d7cf", "\u00bd", "12\u00a0", "1\u066b5"]


@table("text", [*ODD, "", "-", "0x10", "0b1", "1 2", "1,5"])
def test_text_other_than_plain_decimal_digits_is_not_parsed_as_a_number(text: str) -> None:
    for parse in (plain_number, plain_whole):
        with pytest.raises(ValueError, match="in decimal digits"):
            parse(text)


def test_a_number_of_thousands_of_digits_is_refused_in_one_sentence() -> None:
    with pytest.raises(ValueError, match="100 digits at most, and this one has 5000"):
        plain_whole("9" * 5000)


def test_numbers_in_ascii_digits_are_parsed() -> None:
    given = ("12", " 12 ", "+12", "-0", "12.", ".5", "1e1", "0012")
    assert [plain_number(text) for text in given] == [12, 12, 12, 0, 12, 0.5, 10, 12]
    assert [plain_whole(text) for text in ("12", " 12", "+12", "-3", "0012")] == [12, 12, 12, -3, 12]
    assert math.isnan(plain_number("nan"))


@table("text", [text for text in ODD if text.strip() == text])
def test_digits_other_than_ascii_are_refused_in_requests_and_files(text: str) -> None:
    row = ["2026-11-21T09:30:00.000000000Z", "1", "", "pump", "speed", text, "ok"]
    attempts: list[tuple[Any, Any]] = [
        (InvtCHE(1).setpoint.parse, text),
        (notation.number, text),
        (notation.whole, text),
        (count, text),
        (number, (text, 0)),
        (_parse, row),
        (number_in, (text, "count")),
    ]
    for parse, given in attempts:
        with pytest.raises((ValueError, Denied)):
            parse(*given) if isinstance(given, tuple) else parse(given)


@table("text", ODD[:2])
@table(
    "words",
    [
        ["set-frequency", "/dev/none", "invt-che", "3", "--yes", "{}"],
        ["set-frequency", "/dev/none", "invt-che", "{}", "--yes", "21"],
        ["simulate", "none.toml", "--speed", "{}"],
        ["start", "/dev/none", "invt-che", "3", "--yes", "--frequency", "{}"],
        ["write", "/dev/none", "invt-che", "3", "setpoint", "{}", "--yes"],
        ["state", "/dev/none", "invt-che", "3", "--option", "maximum_frequency={}"],
        ["state", "/dev/none", "invt-che", "3", "--baudrate", "{}"],
        ["scan", "/dev/none", "--addresses", "{}"],
        ["scan", "/dev/none", "--baudrates", "{}"],
        ["doctor", "/dev/none", "--address", "{}"],
    ],
)
def test_command_arguments_accept_only_ascii_digits(
    words: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([word.format(text) for word in words]) == 2
    assert "no such" not in capsys.readouterr().err.lower()  # neither a port nor a file was opened
