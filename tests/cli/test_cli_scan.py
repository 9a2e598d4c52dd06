"""`multidrop scan` on a simulated line: its output, its plant file and its exit status."""

from __future__ import annotations

import json
import os
import re
import socket
from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path

import pytest
from commands import TOY, Run, running
from interruptions import read_only_directory
from tables import table
from terminals import on_terminal
from toy import Toy

import multidrop.cli.scan
import multidrop.scan.scanner
from multidrop.cli import main
from multidrop.cli.scan import sentence
from multidrop.core import RS485, Framing
from multidrop.drive.line_settings import Settings
from multidrop.families import ErmanERG220
from multidrop.families.delixi import DelixiModbus
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.families.registry import find_model
from multidrop.plant.loader import load_plant
from multidrop.scan import Crowd, Finding, Found, Noise, Untried, plant_text
from multidrop.scan.findings import Progress
from multidrop.scan.sweep import Sweep
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated
from multidrop.transport import port_identity
from multidrop.transport.port_identity import USBAdapter

USUAL = Settings(9600, "8N1")
# few settings and addresses, because each request waits longer on a busy machine
PATIENTLY = ("--baudrates", "9600", "--formats", "8N1", "--addresses", "1-3")
TWO_MODELS = ("--model", "invt-che", "--model", "innovert-ibd")


@pytest.fixture(autouse=True)
def _slow_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use a longer minimum timeout, because a busy computer may delay the replies of a fast drive."""
    monkeypatch.setattr(multidrop.scan.scanner, "LEAST_TIMEOUT", 0.1)


@pytest.fixture
def port(request: pytest.FixtureRequest) -> Iterator[str]:
    drives = [simulated(InvtCHE(1)), simulated(InnovertIBD(2, framing="ascii")), SimulatedDrive(Toy(3))]
    with Simulator([Wire(drives, unpaced=True, port=getattr(request, "param", "pty"))]) as sim:
        yield sim.wires[0].path


@pytest.mark.slow
def test_the_scan_command_prints_each_finding(run: Run, port: str) -> None:
    status, out, err = run("scan", port, *PATIENTLY, *TWO_MODELS)
    assert status == 0
    *told, summary = out.splitlines()
    told.sort()  # sorted: on a busy machine, a drive may be found only in the second pass
    assert told[0].startswith("address 1: invt-che at 9600 8N1 rtu, ")
    assert told[1].startswith("address 2: innovert-ibd at 9600 8N1 ascii, ")
    assert told[2].startswith("address 3: an unknown Modbus device at 9600 8N1 rtu, ")
    assert summary.startswith("3 drives found in ")
    assert "9600 8N1 rtu; " in err
    assert " s left" in err


@pytest.mark.slow
def test_the_scan_command_prints_one_json_object(run: Run, port: str) -> None:
    status, out, _ = run("scan", port, *PATIENTLY, "--model", "invt-che", "--json")
    told = json.loads(out)
    assert status == 0
    assert told["finished"]
    assert [(record["address"], record["models"], record["framing"]) for record in told["drives"]] == [
        (1, ["invt-che"], "rtu"),
        (3, [], "rtu"),
    ]


@pytest.mark.slow
def test_the_plant_file_of_a_scan_can_be_polled_unchanged(run: Run, port: str, tmp_path: Path) -> None:
    out = tmp_path / "found.toml"
    words = (*PATIENTLY, *TWO_MODELS, "--model", TOY.replace(":Toy", ":Unsure"), "--out", out)
    assert run("scan", port, *words)[0] == 0
    (line,) = load_plant(out).lines
    assert line.port == port
    assert [(polled.drive.address, polled.drive.model) for polled in line.drives] == [
        (1, "invt-che"),
        (2, "innovert-ibd"),
        (3, "toy"),
    ]
    status, told, _ = run("poll", out, "--seconds", 0.4, "--json")
    assert status == 0
    polled = json.loads(told)["lines"]["line-1"]["drives"]
    assert set(polled) == {"invt-che-1", "innovert-ibd-2", "toy-3"}
    assert all(each["samples"] for each in polled.values())
    status, _, err = run("scan", port, *words)
    assert status == 2
    assert "exists already" in err


def test_a_scan_without_findings_returns_1_and_writes_no_file(run: Run, port: str, tmp_path: Path) -> None:
    out = tmp_path / "none.toml"
    words = ("--baudrates", "19200", "--formats", "8O2", "--addresses", "9", "--quick", "--out", out)
    status, text, _ = run("scan", port, *words)
    assert status == 1
    assert text.startswith("no drives found in ")
    assert "run `multidrop doctor` on the port" in text
    assert not out.exists()


@pytest.mark.long
@pytest.mark.parametrize("port", ["socket://127.0.0.1:0"], indirect=True)
def test_a_scan_over_a_serial_server_needs_the_baud_rate(run: Run, port: str) -> None:
    status, _, err = run("scan", port, "--quick")
    assert status == 2
    assert "Give the server's rate, such as --baudrates 9600" in err
    status, out, _ = run("scan", port, "--baudrates", "9600", "--addresses", "1-2", *TWO_MODELS)
    assert status == 0
    assert "address 1: invt-che" in out
    assert "address 2: innovert-ibd" in out


def test_a_scan_over_tcp_finds_the_unit_ids_0_and_255(run: Run, tmp_path: Path) -> None:
    model = tmp_path / "meter.toml"
    model.write_text(
        '[family]\ntitle = "T"\nmanual = "M"\ncounts_from = 0\naddresses = [0, 255]\n'
        "[reading]\nlevel = { at = 1 }\n"
    )
    meter = find_model(str(model))
    drives = [simulated(meter(unit, framing=Framing.TCP)) for unit in (0, 255)]
    with Simulator([Wire(drives, port="tcp://127.0.0.1:0", unpaced=True)]) as line:
        status, out, _ = run(
            "scan", line.wires[0].path, "--model", str(model), "--addresses", "0,255", "--quick"
        )
    assert status == 0
    assert all(f"address {unit}: " in out for unit in (0, 255))


@pytest.mark.long
def test_an_unknown_device_on_modbus_tcp_is_listed_once_without_a_baud_rate(run: Run, tmp_path: Path) -> None:
    """The scan for all families has several TCP requests, whose families have different baud rates."""
    model = tmp_path / "meter.toml"
    model.write_text(
        '[family]\ntitle = "T"\nmanual = "M"\ncounts_from = 0\n'
        '[reading]\nlevel = { at = 1 }\nheat = { at = 1, table = "input" }\n'
    )
    meter = SimulatedDrive(find_model(str(model))(7, framing=Framing.TCP))
    with Simulator([Wire([meter], port="tcp://127.0.0.1:0", unpaced=True)]) as line:
        scan = ("scan", line.wires[0].path, "--addresses", "7")
        status, out, _ = run(*scan)
        _, as_json, _ = run(*scan, "--json")
    assert status == 0
    assert out.count("address 7: an unknown Modbus device at Modbus TCP") == 1
    (device,) = json.loads(as_json)["drives"]
    assert (device["baudrate"], device["format"], device["framing"]) == (None, None, "tcp")


@table(
    ("words", "sentence"),
    [
        (
            ("--addresses", "0-5"),
            "--addresses: 0 is only valid on tcp:// ports; on /dev/nowhere use 1 to 247",
        ),
        (("--addresses", "1-256"), "invalid addresses '1-256': write 1 to 247 (0 to 255 on a tcp:// port)"),
        (("--addresses", "1-" + "9" * 400), "write 1 to 247"),
        (("--addresses", "1-99999999999"), "invalid addresses '1-99999999999': write 1 to 247"),
        (("--addresses", "one"), "invalid addresses 'one': write 1 to 247"),
        (("--baudrates", "fast"), "invalid baud rates 'fast': write numbers, such as 9600,19200"),
        (("--baudrates", "300"), "none of these families allows baud rate 300"),
        (("--formats", "9N1"), "none of these families allows format 9N1"),
        (("--model", "inovert-ibd"), "did you mean innovert-ibd"),
    ],
)
def test_an_invalid_scan_argument_is_named_in_the_error(
    run: Run, words: tuple[str, ...], sentence: str
) -> None:
    status, out, err = run("scan", "/dev/nowhere", *words)
    assert (status, out) == (2, "")
    assert sentence in err
    assert len(err.splitlines()) == 1


def test_a_scan_into_an_unwritable_file_fails_before_the_port_opens(run: Run, tmp_path: Path) -> None:
    for out, status, reason in (
        (tmp_path / "none" / "found.toml", 2, "No such file or directory"),
        (tmp_path, 2, "Is a directory"),
    ):
        assert run("scan", "/dev/nowhere", "--out", out) == (status, "", f"multidrop: {out}: {reason}\n")
    with read_only_directory() as directory:
        status, _, err = run("scan", "/dev/nowhere", "--out", directory / "found.toml")
    assert (status, err) == (1, f"multidrop: {directory}/found.toml: Permission denied\n")


def test_a_failed_scan_leaves_no_plant_file(run: Run, tmp_path: Path) -> None:
    sentence = "multidrop: /dev/nowhere: there is no such port\n"
    assert run("scan", "/dev/nowhere", "--out", tmp_path / "found.toml") == (1, "", sentence)
    assert list(tmp_path.iterdir()) == []


def test_every_kind_of_scan_result_is_printed_as_a_sentence() -> None:
    found = Found(5, USUAL, Framing.RTU, ("yd1000", "delixi-modbus"), 0.0051, "1 of 9 replies were damaged")
    assert sentence(found) == (
        "address 5: yd1000 or delixi-modbus at 9600 8N1 rtu, response delay 5.1 ms "
        "(1 of 9 replies were damaged)"
    )
    assert "several drives may have this address" in sentence(Crowd(5, USUAL, Framing.RTU))
    whole = Crowd(5, USUAL, Framing.RTU, "reply from another address (received 63 03 02 00 00)")
    assert sentence(whole).endswith("do not match the request: " + whole.reply)
    assert "at 30 of 31 addresses" in sentence(Noise(USUAL, Framing.RTU, 30, 31))
    assert sentence(Untried(USUAL, Framing.RTU, "no parity")) == "not asked at 9600 8N1 rtu: no parity"


def test_each_doubt_about_a_found_drive_is_a_comment_in_the_plant_file(tmp_path: Path) -> None:
    families = {each.model: each for each in (InvtCHE, InnovertIBD, DelixiModbus)}
    found = [
        Found(4, USUAL, Framing.RTU, (), 0.005),
        Found(2, Settings(9600, "8N2"), Framing.RTU, ("invt-che", "delixi-modbus"), 0.005, "damaged"),
        Found(2, Settings(19200, "8N1"), Framing.ASCII, ("innovert-ibd",), 0.005),
    ]
    path = tmp_path / "found.toml"
    path.write_text(plant_text('/dev/tty"S0', found, families, RS485.RTS_UP))
    (line,) = load_plant(path).lines
    assert line.rs485 is RS485.RTS_UP
    assert line.port == '/dev/tty"S0'
    (polled,) = line.drives
    assert (polled.drive.address, polled.drive.model, str(polled.drive.settings)) == (
        2,
        "invt-che",
        "9600 8N2",
    )
    comments = [each for each in path.read_text().splitlines() if each.startswith("#")]
    assert comments[:2] == ["# damaged", "# it may as well be delixi-modbus"]
    assert "# invt-che-2 has this address too" in comments[2]
    assert 'name = "innovert-ibd-2"' in comments[4]
    assert comments[-1] == "# address 4: an unknown Modbus device at 9600 8N1 rtu"


def test_no_plant_file_is_written_if_a_scan_identifies_no_drive() -> None:
    with pytest.raises(ValueError, match="so no plant file can be written"):
        plant_text("port", [Found(4, USUAL, Framing.RTU, (), 0.005)], {})


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_an_interrupted_scan_keeps_its_findings(
    run: Run, port: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    def interrupted(*_: object) -> Iterator[Finding]:
        yield Found(1, USUAL, Framing.RTU, ("invt-che",), 0.005)
        raise KeyboardInterrupt

    monkeypatch.setattr(multidrop.cli.scan, "scan", interrupted)
    plant = tmp_path / "found.toml"
    status, out, err = run("scan", port, *PATIENTLY, "--out", plant, *words)
    assert (status, err) == (130, "multidrop: interrupted\n")
    assert [polled.drive.address for polled in load_plant(plant).lines[0].drives] == [1]
    assert json.loads(out)["finished"] is False if words else "1 drive found" in out


def test_a_scan_writes_the_port_name_with_the_adapters_serial_number(
    run: Run, port: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_id = tmp_path / "usb-FTDI_A50285BI-if00-port0"
    by_id.symlink_to(port)
    monkeypatch.setattr(port_identity, "BY_ID", tmp_path)
    monkeypatch.setattr(port_identity, "adapter_of", lambda name: USBAdapter("1-4:1.0.0", "A50285BI:1.0.0"))
    monkeypatch.setattr(
        multidrop.cli.scan, "scan", lambda *_: iter([Found(1, USUAL, Framing.RTU, ("invt-che",), 0.005)])
    )
    plant = tmp_path / "found.toml"
    assert run("scan", port, *PATIENTLY, "--out", plant)[0] == 0
    assert load_plant(plant).lines[0].port == str(by_id)


def test_an_interrupted_scan_gives_no_advice(run: Run, port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> Iterator[Finding]:
        raise KeyboardInterrupt

    monkeypatch.setattr(multidrop.cli.scan, "scan", interrupted)
    status, out, _ = run("scan", port, *PATIENTLY)
    assert status == 130
    assert re.fullmatch(r"no drives found in \d+ s\n", out)


def test_a_quick_scan_has_no_second_pass(run: Run, port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    planned: list[list[Sweep]] = []

    def noted(_: object, sweeps: Sequence[Sweep], *__: object) -> Iterator[Finding]:
        planned.append([*sweeps])
        yield Found(1, USUAL, Framing.RTU, ("invt-che",), 0.005)

    monkeypatch.setattr(multidrop.cli.scan, "scan", noted)
    for words in ((), ("--quick",)):
        assert run("scan", port, *PATIENTLY, *words)[0] == 0
    patiently, quickly = planned
    assert quickly == patiently[: len(quickly)]
    again = patiently[len(quickly) :]
    assert [sweep.request for sweep in again] == [sweep.request for sweep in quickly]
    assert all(late.patience > usual.patience for late, usual in zip(again, quickly, strict=True))


@pytest.mark.long
def test_the_scan_progress_is_one_line_on_a_terminal(port: str) -> None:
    with on_terminal("scan", port, *PATIENTLY, *TWO_MODELS) as terminal:
        terminal.wait_for("address 2; ")
        terminal.wait_for("3 drives found in ")
        assert terminal.process.wait(timeout=60) == 0
        lines = terminal.text.splitlines()
    assert next(line for line in lines if "innovert-ibd" in line).startswith("address 2: ")
    assert terminal.written.count(b"\r\x1b[K") > 3


class TerminalText(StringIO):
    """Text output that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


def test_an_interrupted_scan_clears_its_progress_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted() -> Iterator[Finding]:
        yield Progress(USUAL, Framing.RTU, 3, 12.0)
        raise KeyboardInterrupt

    terminal = TerminalText()
    monkeypatch.setattr(multidrop.cli.scan.sys, "stderr", terminal)  # type: ignore[attr-defined]
    with pytest.raises(KeyboardInterrupt):
        list(multidrop.cli.scan._shown(interrupted(), silent=True))
    assert terminal.getvalue() == "\r\x1b[K9600 8N1 rtu, address 3; 12 s left\r\x1b[K"


# ---- `multidrop ports`: the list of serial ports and the advice on permissions, with a simulated /sys ----


@pytest.fixture
def devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the /dev of a simulated computer with an FTDI adapter and an entry for an absent UART."""
    usb = tmp_path / "sys/devices/usb1/1-4"
    for name, text in (
        ("idVendor", "0403"),
        ("idProduct", "6001"),
        ("manufacturer", "FTDI"),
        ("product", "R"),
    ):
        (usb / name).parent.mkdir(parents=True, exist_ok=True)
        (usb / name).write_text(text)
    (tmp_path / "sys/drivers/ftdi_sio").mkdir(parents=True)
    (usb / "tty0").mkdir()
    (usb / "tty0/driver").symlink_to(tmp_path / "sys/drivers/ftdi_sio")
    for name, kind in (("ttyUSB0", None), ("ttyS7", "0\n")):
        tty = tmp_path / "sys/class/tty" / name
        tty.mkdir(parents=True)
        (tty / "device").symlink_to(usb / "tty0")
        if kind:
            (tty / "type").write_text(kind)
        (tmp_path / "dev").mkdir(exist_ok=True)
        (tmp_path / "dev" / name).touch(mode=0o660)
    found = list(multidrop.cli.scan._linux_ports(tmp_path / "sys", tmp_path / "dev"))
    monkeypatch.setattr(multidrop.cli.scan, "_linux_ports", lambda: found)
    monkeypatch.setattr("sys.platform", "linux")
    return tmp_path / "dev"


def test_the_ports_command_prints_the_adapter_and_driver_of_a_port(
    devices: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ports"]) == 0
    assert capsys.readouterr().out == (
        f"{devices}/ttyUSB0\n  FTDI R (0403:6001); driver ftdi_sio\n  you may open it\n"
    )


def test_the_ports_command_advises_to_plug_in_an_adapter_if_there_is_no_port(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(multidrop.cli.scan, "_linux_ports", lambda: iter(()))
    monkeypatch.setattr(multidrop.cli.scan, "_other_ports", lambda: iter(()))
    assert main(["ports"]) == 1
    assert capsys.readouterr().out.startswith("no serial port found; plug the adapter in")


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of POSIX")
def test_the_ports_command_prints_the_group_that_may_open_a_port(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import grp
    import pwd

    port = tmp_path / "ttyUSB0"
    port.touch(mode=0o600)
    assert "a udev rule" in multidrop.cli.scan._permission_advice(port)
    group = next(one for one in grp.getgrall() if one.gr_gid)
    os.chown(port, -1, group.gr_gid) if os.getuid() == 0 else pytest.skip("only root may give a file away")
    port.chmod(0o660)
    user = pwd.getpwuid(os.getuid()).pw_name
    assert multidrop.cli.scan._permission_advice(port).startswith(f"sudo usermod -aG {group.gr_name} {user}")


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of POSIX")
def test_permission_advice_works_for_a_user_id_without_an_account(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch(mode=0o660)
    monkeypatch.setattr(os, "getuid", lambda: 4_123_456)
    assert f"in group {port.stat().st_gid}" in multidrop.cli.scan._permission_advice(port)


# ---- commands on tcp:// ports: simulate serves such a line, scan finds its drives, and poll reads them ----


PLANT = """
[[line]]
name = "net"
port = "{port}"

[[line.drive]]
name = "pump"
model = "innovert-ibd"
address = 1
poll = ["output_current"]
"""


@pytest.mark.long
def test_the_simulate_command_serves_a_line_of_a_plant_over_modbus_tcp(tmp_path: Path, run: Run) -> None:
    plant = tmp_path / "plant.toml"
    plant.write_text(PLANT.format(port="tcp://10.0.0.7"))
    with running("simulate", plant, "--ports", tmp_path / "ports", "--unpaced") as (_, said):
        ready, name, port = said.readline().split()
        assert (ready, name) == ("ready", "net")
        assert port.startswith("tcp://127.0.0.1:")
        status, shown, _ = run("read", port, "innovert-ibd", "1", "output_current")
        assert status == 0
        assert "output_current" in shown


@pytest.mark.long
def test_the_simulate_command_listens_on_a_local_port_of_the_plant_file(tmp_path: Path, run: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    plant = tmp_path / "plant.toml"
    plant.write_text(PLANT.format(port=port))
    with running("simulate", plant, "--unpaced") as (_, said):
        assert said.readline() == f"ready net {port}\n"
        assert "output_current" in run("read", plant, "pump", "output_current")[1]


def test_the_simulate_command_needs_a_ports_directory_for_a_serial_line(tmp_path: Path, run: Run) -> None:
    plant = tmp_path / "plant.toml"
    plant.write_text(PLANT.format(port="/dev/ttyUSB0"))
    assert run("simulate", plant)[::2] == (
        2,
        "multidrop: line net needs a pseudo-terminal: add --ports DIR\n",
    )


@pytest.mark.long
def test_the_scan_command_finds_drives_behind_a_gateway(tmp_path: Path, run: Run) -> None:
    sims = [simulated(drive) for drive in (InnovertIBD(1), InvtCHE(2), ErmanERG220(3))]
    out = tmp_path / "found.toml"
    with Simulator([Wire(sims, port="tcp://127.0.0.1:0", unpaced=True)]) as line:
        port = line.wires[0].path
        models = [word for sim in sims for word in ("--model", sim.drive.model)]
        status, _, complaint = run("scan", port, "--addresses", "1-3", *models, "--out", out)
        assert status == 0, complaint
        (found,) = load_plant(out).lines
        assert found.port == port
        assert {polled.drive.address: polled.drive.model for polled in found.drives} == {
            1: "innovert-ibd",
            2: "invt-che",
            3: "erman-er-g-220",
        }
        status, _, _ = run("poll", str(out), "--seconds", "0.4", "--out", str(tmp_path / "run.csv"))
        assert status == 0
    assert "ok" in (tmp_path / "run.csv").read_text()
