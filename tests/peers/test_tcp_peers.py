"""Modbus TCP with programs by other authors: servers that we use, and a client of our drives."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from kills import BoundProcess
from lines import HOST_LATE, patient, rows_of, until
from peers import build_with_libmodbus, require_module, require_program

from multidrop.bus import Bus
from multidrop.cli import main
from multidrop.errors import DriveException, NoReply
from multidrop.families import InnovertIBD, InvtCHE
from multidrop.families.registry import find_model
from multidrop.plant.loader import load_plant
from multidrop.poller import Poller
from multidrop.sim import Simulator, Wire, simulated

SERVERS = Path(__file__).parents[1] / "support" / "servers"
DEVICE = f"{Path(__file__).parents[1] / 'support' / 'drives' / 'own_drives.py'}:Device"
Device = find_model(DEVICE)
ADDRESS = 7
HELD = {
    "current": 101.0,  # input register 10 holds 1010
    "voltage": 1011,
    "temperature": 1012,
    "frequency": 10.2,  # holding register 20 holds 1020
    "energy": (1022 << 16 | 1023) / 100,
    "relay": 1,  # coil 5
    "door": 1,
}


def pymodbus(_: Path) -> list[str]:
    require_module("pymodbus")
    return [sys.executable, str(SERVERS / "modbus_tcp_server.py"), str(ADDRESS)]


def libmodbus(built: Path) -> list[str]:
    return [str(build_with_libmodbus(SERVERS / "libmodbus_tcp_server.c", built))]


@pytest.fixture(params=[pymodbus, libmodbus], ids=lambda made: made.__name__)
def server(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """Give the URL of the server's port."""
    made: Callable[[Path], list[str]] = request.param
    with BoundProcess(made(tmp_path), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        ready, number = process.stdout.readline().split()
        assert ready == "ready"
        yield f"tcp://127.0.0.1:{number}"
        process.kill()


@pytest.mark.slow
@patient
def test_registers_and_coils_are_read(server: str) -> None:
    with Bus(server) as bus:
        device = bus.attach(Device, ADDRESS)
        assert device.read_many(Device.registers.values()) == HELD


@pytest.mark.slow
@patient
def test_written_values_are_read_back(server: str) -> None:
    with Bus(server) as bus:
        device = bus.attach(Device, ADDRESS)
        for name, value in (("frequency", 28.5), ("energy", 1234567.89), ("relay", 0), ("relay", 1)):
            assert device.write(device.register(name), value) == value


@pytest.mark.slow
@patient
def test_exception_code_raises_drive_exception(server: str) -> None:
    with Bus(server) as bus:
        device = bus.attach(find_model(DEVICE.replace("Device", "Mistaken")), ADDRESS)
        with pytest.raises(DriveException, match="illegal address") as refusal:
            device.read(device.register("absent"))
        assert refusal.value.code == 2


@pytest.mark.slow
def test_poll_reads_all_values_of_the_server(server: str, tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(
        f'[[line]]\nname = "net"\nport = "{server}"\n'
        f'[[line.drive]]\nname = "meter"\nmodel = "{DEVICE}"\naddress = {ADDRESS}\n'
        f"poll = {list(HELD)}\n"
    )
    rows = []
    with Poller(load_plant(path)) as poller:
        until(lambda: rows.extend(rows_of(poller)) or len(rows) > 500)
    assert {row.status for row in rows} <= {"ok"} | HOST_LATE
    assert {(row.register, row.value) for row in rows if row.value is not None} == set(HELD.items())


@pytest.mark.slow
@patient
def test_command_line_reads_and_writes(server: str, capsys: pytest.CaptureFixture[str]) -> None:
    where = [server, DEVICE, str(ADDRESS)]
    assert main(["write", *where, "frequency", "31.4", "--yes"]) == 0
    assert main(["read", *where, "frequency", "current"]) == 0
    shown = capsys.readouterr().out
    assert ["frequency", "31.40", "Hz"] in map(str.split, shown.splitlines())
    assert ["current", "101.0", "A"] in map(str.split, shown.splitlines())


@pytest.mark.slow
def test_another_unit_of_pymodbus_times_out(tmp_path: Path) -> None:
    with BoundProcess(pymodbus(tmp_path), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = f"tcp://127.0.0.1:{process.stdout.readline().split()[1]}"
        with Bus(port) as bus, pytest.raises(NoReply, match=r"name the port socket://127\.0\.0\.1:\d+"):
            bus.attach(Device, ADDRESS + 1).read(Device.registers["current"])
        process.kill()


# ---- a client that we did not write reads simulated drives ----


def mbpoll(port: str, address: int, options: str, *values: int) -> subprocess.CompletedProcess[str]:
    place = urlsplit(port)
    command = [require_program("mbpoll"), "-q", "-m", "tcp", "-p", str(place.port), "-o", "5", "-0"]
    command += ["-a", str(address), *options.split(), str(place.hostname), *map(str, values)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def test_mbpoll_reads_and_writes_a_simulated_family_over_tcp() -> None:
    pump, fan = simulated(InnovertIBD(1)), simulated(InvtCHE(247))
    pump["output_current"], fan["output_voltage"] = 2.5, 231
    with Simulator([Wire([pump, fan], port="tcp://127.0.0.1:0", unpaced=True)]) as line:
        port = line.wires[0].path
        read = mbpoll(port, 1, "-r 3 -c 1 -t 4 -1")
        assert ("[3]:", "25") in [tuple(row.split()) for row in read.stdout.splitlines()], read.stderr
        read = mbpoll(port, 247, "-r 12291 -c 1 -t 4 -1")
        assert ("[12291]:", "231") in [tuple(row.split()) for row in read.stdout.splitlines()], read.stderr
        refused = mbpoll(port, 247, "-r 32779 -c 1 -t 4 -1")
        assert "Illegal data address" in refused.stderr
        assert mbpoll(port, 1, "-r 107 -t 4", 200).returncode == 0
    assert pump["acceleration_time"] == 20
