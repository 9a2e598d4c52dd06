"""Read and write servers by other authors through a drive that a user declares."""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from kills import BoundProcess
from lines import patient
from peers import build_with_libmodbus, require_module
from ptys import linked_ptys

from multidrop.bus import Bus
from multidrop.cli import main
from multidrop.errors import DriveException, NoReply
from multidrop.families.registry import find_model

SERVERS = Path(__file__).parents[1] / "support" / "servers"
DEVICE = f"{Path(__file__).parents[1] / 'support' / 'drives' / 'own_drives.py'}:Device"
Device = find_model(DEVICE)
ADDRESS = 7


def libmodbus(built: Path) -> list[str]:
    return [str(build_with_libmodbus(SERVERS / "libmodbus_server.c", built)), "PORT", str(ADDRESS)]


def pymodbus(framing: str) -> list[str]:
    require_module("pymodbus")
    return [sys.executable, str(SERVERS / "pymodbus_server.py"), "PORT", str(ADDRESS), framing]


COMMANDS: dict[str, Callable[[Path], list[str]]] = {
    "libmodbus rtu": libmodbus,
    "pymodbus rtu": lambda _: pymodbus("rtu"),
    "pymodbus ascii": lambda _: pymodbus("ascii"),
}


@pytest.fixture(params=COMMANDS)
def server(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, str]]:
    """Give a port with a server behind it, and the server's framing."""
    command = COMMANDS[request.param](tmp_path)
    with linked_ptys() as (theirs, ours):
        started = [theirs if word == "PORT" else word for word in command]
        with BoundProcess(started, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield ours, request.param.split()[1]
            process.kill()


@pytest.mark.slow
@patient
def test_registers_and_coils_are_read(server: tuple[str, str]) -> None:
    port, framing = server
    with Bus(port) as bus:
        device = bus.attach(Device, ADDRESS, framing=framing)
        assert device.read_many(Device.registers.values()) == {
            "current": 101.0,  # input register 10 holds 1010
            "voltage": 1011,
            "temperature": 1012,
            "frequency": 10.2,  # holding register 20 holds 1020
            "energy": (1022 << 16 | 1023) / 100,
            "relay": 1,  # coil 5
            "door": 1,
        }


@pytest.mark.slow
@patient
def test_undeclared_addresses_can_be_read(server: tuple[str, str]) -> None:
    """Check that undeclared registers and coils have the values of the servers' sources."""
    port, framing = server
    with Bus(port) as bus:
        device = bus.attach(Device, ADDRESS, framing=framing)
        for function in (3, 4):
            assert device.read_raw(function, 50, 3) == struct.pack(">3H", 1050, 1051, 1052)
        for function in (1, 2):
            assert device.read_raw(function, 1, 10) == bytes([0b01010101, 0b01])
        with pytest.raises(DriveException) as refusal:
            device.read_raw(3, 40000, 1)
        assert refusal.value.code == 2


@pytest.mark.slow
@patient
def test_written_values_are_read_back(server: tuple[str, str]) -> None:
    port, framing = server
    with Bus(port) as bus:
        device = bus.attach(Device, ADDRESS, framing=framing)
        for name, value in (("frequency", 28.5), ("energy", 1234567.89), ("relay", 0), ("relay", 1)):
            assert device.write(device.register(name), value) == value


@pytest.mark.slow
@patient
def test_exception_code_raises_drive_exception(server: tuple[str, str]) -> None:
    port, framing = server
    with Bus(port) as bus:
        device = bus.attach(find_model(DEVICE.replace("Device", "Mistaken")), ADDRESS, framing=framing)
        with pytest.raises(DriveException, match="illegal address") as refusal:
            device.read(device.register("absent"))
        assert refusal.value.code == 2


@pytest.mark.long
def test_another_address_times_out(server: tuple[str, str]) -> None:
    port, framing = server
    with Bus(port) as bus:
        device = bus.attach(Device, ADDRESS + 1, framing=framing)
        with pytest.raises(NoReply):
            device.read(device.register("current"))


@pytest.mark.slow
@patient
def test_command_line_reads_and_writes(server: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    port, framing = server
    where = [port, DEVICE, str(ADDRESS), "--framing", framing]
    assert main(["write", *where, "frequency", "31.4", "--yes"]) == 0
    assert main(["read", *where, "frequency", "current"]) == 0
    shown = capsys.readouterr().out
    assert "frequency = 31.40 Hz" in shown
    assert ["frequency", "31.40", "Hz"] in map(str.split, shown.splitlines())
    assert ["current", "101.0", "A"] in map(str.split, shown.splitlines())
