"""The ledger of EEPROM writes identifies ports by their hardware, and does not count simulated drives."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from kills import BoundProcess
from lines import PATIENCE
from simulated_bus import SimulatedBus
from tables import table
from toy import Status, Toy

from multidrop.bus import Bus
from multidrop.control import records
from multidrop.control.records import Ledger, LedgerCell, default_ledger_path
from multidrop.drive import Drive
from multidrop.drive.register import COIL, Kept, setting
from multidrop.errors import WriteForbidden
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated
from multidrop.transport import port_identity
from multidrop.transport.line import Line
from multidrop.transport.port_identity import is_simulated


def toys(port: str = "pty") -> Simulator:
    toy = simulated(Toy(1))
    toy["status"] = Status(0)
    return Simulator([Wire([toy], unpaced=True, port=port)])


def write(port: str, seconds: float, ledger: Ledger | None = None) -> None:
    with Bus(port, ledger=ledger, expiry=60.0) as bus:
        toy = bus.attach(Toy, 1)
        toy.write(toy.acceleration_time, seconds)


@pytest.mark.slow
def test_all_paths_of_a_port_share_one_eeprom_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ledger = Ledger(tmp_path / "wear")
    (tmp_path / "ports").mkdir()
    with toys(str(tmp_path / "ports" / "hall-1")) as sim:
        device = os.path.realpath(sim.wires[0].path)
        (tmp_path / "again").symlink_to(tmp_path / "ports")
        write("ports/hall-1", 12.0, ledger)
        spellings = (
            device,
            f"{tmp_path}/ports/hall-1",
            "again/hall-1",
            "./ports/../again/hall-1",
            f"spy://{device}",
        )
        for at, port in enumerate(spellings):
            with pytest.raises(WriteForbidden, match="is written once in 60 s at most"):
                write(port, 13.0 + at, ledger)
        (wear,) = ledger.wear(0)
        assert (wear.cell.port, wear.writes) == (device, 1)


def test_all_names_of_a_host_share_one_eeprom_write_a_minute(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "wear")
    with toys("socket://127.0.0.1:0") as sim:
        path = sim.wires[0].path
        write(path, 12.0, ledger)
        with pytest.raises(WriteForbidden, match="is written once in 60 s at most"):
            write(path.replace("127.0.0.1", "localhost"), 13.0, ledger)
        assert [each.cell.port for each in ledger.wear(0)] == [path.removeprefix("socket://")]


def test_adapters_are_identified_by_serial_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_identity, "BY_ID", tmp_path / "by-id")
    (tmp_path / "by-id").mkdir()
    for name in ("ttyUSB0", "ttyUSB1"):
        (tmp_path / name).touch()
    link = tmp_path / "by-id" / "usb-FTDI_A1-port0"
    link.symlink_to("../ttyUSB0")
    assert port_identity.of_device(f"{tmp_path}/ttyUSB0") == str(link)
    assert port_identity.of_device(f"{tmp_path}/ttyUSB1") == f"{tmp_path}/ttyUSB1"
    ledger = Ledger(tmp_path / "wear")
    cell = LedgerCell(str(link), 1, "m", "r", f"{tmp_path}/ttyUSB0")
    assert ledger.enter(cell, 1000.0, 60.0) == ""
    link.unlink()
    link.symlink_to("../ttyUSB1")  # the adapter was plugged in again, under another device name
    moved = LedgerCell(port_identity.of_device(f"{tmp_path}/ttyUSB1"), 1, "m", "r", f"{tmp_path}/ttyUSB1")
    assert "was written 5 s ago" in ledger.enter(moved, 1005.0, 60.0)


@table(
    ("name", "identity"),
    [
        ("socket://10.0.0.7:4001", "10.0.0.7:4001"),
        ("rfc2217://10.0.0.7:4001?ign_set_control", "10.0.0.7:4001"),
        ("socket://Server:4001", "server:4001"),
        ("socket://[fe80::1]:4001", "[fe80::1]:4001"),
        ("10.0.0.7:4001", "10.0.0.7:4001"),
        ("socket://nowhere", "socket://nowhere"),
        ("socket://a:99999", "socket://a:99999"),
        ("loop://", "loop://"),
        ("/dev/../dev/null", "/dev/null"),
    ],
)
def test_a_port_name_is_resolved_to_its_device(name: str, identity: str) -> None:
    assert port_identity.of_name(name) == identity
    assert port_identity.of_name(identity) == identity


def test_a_port_without_a_device_is_identified_by_its_name() -> None:
    line = Line("loop://").open()
    assert line.identity == "loop://"
    line.close()


@table(
    ("old", "spelt"),
    [
        *((each, each) for each in ("link", "device", "socket://hall:1")),
        *((each, each) for each in ("socket://10.0.0.7:4001", "rfc2217://10.0.0.7:4001")),
        ("link", "device"),
        ("socket://10.0.0.7:4001", "rfc2217://10.0.0.7:4001"),
    ],
)
def test_ledger_entries_with_an_older_name_of_the_port_are_counted(old: str, spelt: str) -> None:
    with TemporaryDirectory() as folder:
        Path(folder, "device").touch()
        Path(folder, "link").symlink_to("device")
        entered, present = (each if "://" in each else f"{folder}/{each}" for each in (old, spelt))
        ledger = Ledger(Path(folder, "wear"), budget=3)
        for at in range(2):
            assert ledger.enter(LedgerCell(entered, 1, "m", "r"), 1000.0 + at, 0.0) == ""
        now = {"socket://hall:1": "10.0.0.9:1"}.get(old, port_identity.of_name(present))
        cell = LedgerCell(now, 1, "m", "r", present)
        assert ledger.enter(cell, 1002.0, 0.0) == ""
        assert "written 3 times in a year" in ledger.enter(cell, 1003.0, 0.0)
        if old != "socket://hall:1":
            assert [(each.cell.port, each.writes) for each in ledger.wear(1003.0)] == [(now, 3)]


def test_writes_to_registers_in_ram_are_not_in_the_ledger(tmp_path: Path) -> None:
    class Fan(Drive):
        """A user's own drive."""

        relay = setting(1, table=COIL)
        speed = setting(2, kept=Kept.RAM)
        known = setting(3)
        latch = setting(4, table=COIL, kept=Kept.EEPROM)

    ledger = Ledger(tmp_path / "wear")
    sim = SimulatedDrive(Fan(1))
    line = SimulatedBus(sim, ledger=ledger)
    fan = line.attach(Fan(1, ram=["known"]))
    for register in (fan.relay, fan.speed, fan.known):
        fan.write(register, 1)
    assert ledger.wear(0) == []
    fan.write(fan.latch, 1)
    assert [each.cell.register for each in ledger.wear(0)] == ["latch"]
    assert set(sim.counters.eeprom_writes) == {"known", "latch"}  # `ram` is unknown to the simulation


with_names = pytest.mark.skipif(sys.platform != "linux", reason="this system has no names for it")


def test_a_user_without_a_home_can_stop_drives_but_not_write_eeprom(monkeypatch: pytest.MonkeyPatch) -> None:
    """A container's user often has neither HOME nor an entry in /etc/passwd."""

    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", home)
    # root could create the default path
    monkeypatch.setattr(records, "NO_HOME", Path("/dev/null"), raising=False)
    toy = simulated(Toy(1))
    toy["status"] = Status(0)
    line = SimulatedBus(toy)
    drive = line.attach(Toy(1))
    drive.stop()
    with pytest.raises(OSError, match=r"EEPROM writes /dev/null/multidrop/wear\.sqlite cannot be kept"):
        drive.write(drive.acceleration_time, 12.0)
    assert toy.counters.eeprom_writes == {}


@with_names
@pytest.mark.parametrize("port", ["pty", "link", "socket://127.0.0.1:0", "socket://0.0.0.0:0"])
def test_writes_to_a_simulated_drive_are_not_in_the_user_s_ledger(tmp_path: Path, port: str) -> None:
    with toys(str(tmp_path / "link") if port == "link" else port) as sim:
        path = sim.wires[0].path.replace("0.0.0.0", "127.0.0.1")
        write(path, 12.0)
        # the ledger limits the writes to a simulated drive too, but in a file of its own
        with pytest.raises(WriteForbidden, match="is written once in 60 s at most"):
            write(path, 13.0)
    assert Ledger().wear(0) == []
    assert not list(default_ledger_path().parent.rglob("*.sqlite"))


@with_names
def test_a_ledger_passed_as_argument_counts_simulated_drives_too(tmp_path: Path) -> None:
    with toys() as sim:
        write(sim.wires[0].path, 12.0, Ledger(tmp_path / "wear"))
    assert len(Ledger(tmp_path / "wear").wear(0)) == 1


@pytest.mark.slow
@with_names
def test_a_port_counts_as_simulated_until_its_simulator_is_killed(tmp_path: Path) -> None:
    program = (
        "import time\nfrom multidrop.sim.port import PtyPort\n"
        "from multidrop.drive.line_settings import Settings\n"
        "port = PtyPort(Settings(9600, '8N1'), None)\nprint(port.path, flush=True)\ntime.sleep(3600)"
    )
    with BoundProcess([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        device = process.stdout.readline().strip()
        held = os.open(device, os.O_RDWR | os.O_NOCTTY)  # keeps the pty, so that no other test gets it
        try:
            assert is_simulated(device)
        finally:
            process.kill()
            process.wait(PATIENCE)
    assert not is_simulated(device)
    os.close(held)


def test_a_real_port_does_not_count_as_simulated() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        line = Line(f"socket://127.0.0.1:{listener.getsockname()[1]}").open()
        assert not is_simulated(line.identity)
        line.close()
    master, slave = os.openpty()
    assert not is_simulated(os.ttyname(slave))
    os.close(slave)
    os.close(master)


def test_a_system_that_cannot_mark_simulated_ports_counts_all_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_identity, "_HAS_NAMES", False)
    with toys() as sim:
        write(sim.wires[0].path, 12.0)
    assert len(Ledger().wear(0)) == 1
