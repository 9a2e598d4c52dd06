"""The library reads other authors' servers on serial lines and Modbus TCP; mbpoll reads simulated drives."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import pytest
from commands import BoundProcess
from lines import HOST_LATE, patient, rows_of, until
from modbus_tools import Mbpoll
from own_drives import ADDRESSES
from peers import build_with_libmodbus, require_module
from ptys import linked_ptys

from multidrop.bus import Bus
from multidrop.cli import main
from multidrop.errors import DriveException, NoReply
from multidrop.families import InnovertIBD, InvtCHE
from multidrop.families.files.loader import load_family
from multidrop.families.registry import find_model
from multidrop.plant.loader import load_plant
from multidrop.poller import Poller
from multidrop.polling.batch import Row
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


class Server(NamedTuple):
    """A running server: its port, and, on a serial line, its framing."""

    port: str
    framing: str | None = None

    def attach(self, bus: Bus, *, family: str = "Device", address: int = ADDRESS) -> Any:
        framing = {} if self.framing is None else {"framing": self.framing}
        return bus.attach(find_model(DEVICE.replace("Device", family)), address, **framing)

    @property
    def words(self) -> list[str]:
        """Return the command-line arguments that name this server."""
        framing = [] if self.framing is None else ["--framing", self.framing]
        return [self.port, DEVICE, str(ADDRESS), *framing]


def libmodbus(built: Path, *words: str) -> list[str]:
    return [str(build_with_libmodbus(SERVERS / "libmodbus_server.c", built)), *words]


def pymodbus(*words: str, address: int = ADDRESS) -> list[str]:
    require_module("pymodbus")
    return [sys.executable, str(SERVERS / "pymodbus_server.py"), str(address), *words]


COMMANDS: dict[str, Callable[[Path], list[str]]] = {
    "libmodbus rtu": lambda built: libmodbus(built, "PORT", str(ADDRESS)),
    "pymodbus rtu": lambda _: pymodbus("rtu", "PORT"),
    "pymodbus ascii": lambda _: pymodbus("ascii", "PORT"),
    "libmodbus tcp": lambda built: libmodbus(built),
    "pymodbus tcp": lambda _: pymodbus("tcp"),
}


@contextmanager
def running(name: str, folder: Path) -> Iterator[Server]:
    command, framing = COMMANDS[name](folder), name.split()[1]
    with ExitStack() as stack:
        ours = ""
        if framing != "tcp":
            theirs, ours = stack.enter_context(linked_ptys())
            command = [theirs if word == "PORT" else word for word in command]
        process = stack.enter_context(BoundProcess(command, stdout=subprocess.PIPE, text=True))
        assert process.stdout is not None
        ready, *number = process.stdout.readline().split()
        assert ready == "ready"
        yield Server(ours, framing) if ours else Server(f"tcp://127.0.0.1:{number[0]}")
        process.kill()


@pytest.fixture(params=COMMANDS)
def server(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Server]:
    with running(request.param, tmp_path) as made:
        yield made


@pytest.mark.slow
@patient
def test_registers_and_coils_of_other_servers_are_read(server: Server) -> None:
    with Bus(server.port) as bus:
        assert server.attach(bus).read_many(Device.registers.values()) == HELD


@pytest.mark.slow
@patient
def test_undeclared_registers_of_pymodbus_and_libmodbus_can_be_read(server: Server) -> None:
    """Check that undeclared registers and coils have the values that the server's source defines."""
    with Bus(server.port) as bus:
        device = server.attach(bus)
        for function in (3, 4):
            assert device.read_raw(function, 50, 3) == struct.pack(">3H", 1050, 1051, 1052)
        for function in (1, 2):
            assert device.read_raw(function, 1, 10) == bytes([0b01010101, 0b01])
        with pytest.raises(DriveException) as refusal:
            device.read_raw(3, 40000, 1)
        assert refusal.value.code == 2


@pytest.mark.slow
@patient
def test_the_identity_of_a_server_can_be_read(server: Server) -> None:
    """pymodbus reports its name by functions 11H and 2BH; libmodbus answers 11H only."""
    with Bus(server.port) as bus:
        device = server.attach(bus)
        name = device.read_raw(0x11, 0, 0)
        assert len(name) > 2
        if b"LMB" not in name:  # libmodbus does not answer function 2BH
            identity = device.read_raw(0x2B, 0x0100, 0)
            assert identity[:2] == b"\x0e\x01"
            assert b"pymodbus" in identity


@pytest.mark.slow
@patient
def test_a_value_written_to_a_foreign_modbus_server_is_read_back(server: Server) -> None:
    with Bus(server.port) as bus:
        device = server.attach(bus)
        for name, value in (("frequency", 28.5), ("energy", 1234567.89), ("relay", 0), ("relay", 1)):
            assert device.write(device.register(name), value) == value


@pytest.mark.slow
@patient
def test_an_exception_code_raises_drive_exception(server: Server) -> None:
    with Bus(server.port) as bus:
        device = server.attach(bus, family="Mistaken")
        with pytest.raises(DriveException, match="illegal address") as refusal:
            device.read(device.register("absent"))
        assert refusal.value.code == 2


@pytest.mark.long
# libmodbus answers requests to any unit id over TCP
@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "libmodbus tcp"])
def test_a_read_from_an_address_without_a_device_times_out(name: str, tmp_path: Path) -> None:
    advice = r"name the port socket://127\.0\.0\.1:\d+" if "tcp" in name else "does not answer"
    with running(name, tmp_path) as server, Bus(server.port) as bus:
        device = server.attach(bus, address=ADDRESS + 1)
        with pytest.raises(NoReply, match=advice):
            device.read(device.register("current"))


@pytest.mark.slow
@patient
def test_the_read_and_write_commands_work_with_other_servers(
    server: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["write", *server.words, "frequency", "31.4", "--yes"]) == 0
    assert main(["read", *server.words, "frequency", "current"]) == 0
    shown = capsys.readouterr().out
    assert "frequency = 31.40 Hz" in shown
    assert ["frequency", "31.40", "Hz"] in map(str.split, shown.splitlines())
    assert ["current", "101.0", "A"] in map(str.split, shown.splitlines())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["libmodbus tcp", "pymodbus tcp"])
def test_a_poller_reads_all_values_from_other_libraries_servers(name: str, tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    with running(name, tmp_path) as server:
        path.write_text(
            f'[[line]]\nname = "net"\nport = "{server.port}"\n'
            f'[[line.drive]]\nname = "meter"\nmodel = "{DEVICE}"\naddress = {ADDRESS}\n'
            f"poll = {list(HELD)}\n"
        )
        rows = []
        with Poller(load_plant(path)) as poller:
            until(lambda: rows.extend(rows_of(poller)) or len(rows) > 500)
    assert {row.status for row in rows} <= {"ok"} | HOST_LATE
    assert {(row.register, row.value) for row in rows if row.value is not None} == set(HELD.items())


def test_mbpoll_reads_and_writes_a_simulated_family_over_tcp() -> None:
    pump, fan = simulated(InnovertIBD(1)), simulated(InvtCHE(247))
    pump["output_current"], fan["output_voltage"] = 2.5, 231
    with Simulator([Wire([pump, fan], port="tcp://127.0.0.1:0", unpaced=True)]) as line:
        place = urlsplit(line.wires[0].path)
        mbpoll = Mbpoll(str(place.hostname), "-m", "tcp", "-p", str(place.port))
        assert mbpoll.read(1, 3, 3, 1) == [25]
        assert mbpoll.read(247, 3, 12291, 1) == [231]
        assert mbpoll.read(247, 3, 32779, 1) == 2  # "illegal data address"
        assert mbpoll.write(1, 6, 107, 200) == 0
    assert pump["acceleration_time"] == 20


FAMILY = Path(__file__).parents[1] / "data" / "families" / "sdm630.toml"
PAGE = Path(__file__).parents[2] / "docs" / "howto" / "family-file.md"
STATED = ("together", "gaps")
UNIT = 5
SERIAL_NUMBER = 0x01020304
FLOATS = {name: (-1) ** at * (at * 37.11 + 0.25) for at, name in enumerate(ADDRESSES)}
METER_HOLDS = {
    **{name: struct.unpack(">f", struct.pack(">f", value))[0] for name, value in FLOATS.items()},
    "serial_number": SERIAL_NUMBER,
}


def family_file(folder: Path, *, stated: bool) -> Path:
    """Write the meter's family file. With `stated`, it declares the meter's read limits and gaps."""
    lines = FAMILY.read_text("utf-8").splitlines(keepends=True)
    path = folder / ("meter.toml" if stated else "unstated.toml")
    path.write_text("".join(line for line in lines if stated or not line.startswith(STATED)), "utf-8")
    return path


@contextmanager
def served(folder: Path, *options: str) -> Iterator[str]:
    """Yield the port of a meter that pymodbus simulates."""
    values = folder / "values.json"
    floats = {ADDRESSES[name]: value for name, value in FLOATS.items()}
    values.write_text(json.dumps({"floats": floats, "serial_number": SERIAL_NUMBER}))
    with linked_ptys() as (theirs, ours):
        command = pymodbus("meter", theirs, str(values), *options, address=UNIT)
        with BoundProcess(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield ours
            process.kill()


def plant_file(folder: Path, port: str, family: Path, *polled: str) -> Path:
    path = folder / "plant.toml"
    path.write_text(
        f'[[line]]\nname = "house"\nport = "{port}"\n'
        f'[[line.drive]]\nname = "meter"\nmodel = "{family.name}"\naddress = {UNIT}\n'
        + (f"poll = {list(polled)}\n" if polled else "")
    )
    return path


@pytest.mark.long
@pytest.mark.parametrize("stated", [True, False], ids=["gaps stated", "nothing stated"])
def test_the_poller_reads_all_40_values_of_the_server(tmp_path: Path, stated: bool) -> None:
    """The server rejects reads of undeclared registers."""
    assert len(METER_HOLDS) == 40
    family = family_file(tmp_path, stated=stated)
    rows: list[Row] = []
    with served(tmp_path, *([] if stated else ["refusing"])) as port:
        plant = load_plant(plant_file(tmp_path, port, family))
        with Poller(plant) as poller:
            until(lambda: rows.extend(rows_of(poller)) or len(rows) > 400)
    assert {row.status for row in rows} <= {"ok"} | HOST_LATE
    assert {(row.register, row.value) for row in rows if row.value is not None} == set(METER_HOLDS.items())


@pytest.mark.slow
def test_one_call_reads_all_40_values_of_the_server(tmp_path: Path) -> None:
    meter = load_family(FAMILY)
    with served(tmp_path) as port, Bus(port) as bus:
        assert bus.attach(meter, UNIT).read_many(meter.registers.values()) == METER_HOLDS


@pytest.mark.parametrize(("stated", "requests"), [(True, 4), (False, 8)])
def test_the_plan_of_39_floats_prints_the_documented_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], stated: bool, requests: int
) -> None:
    """Check the plan in the documentation; 5 ms is the default response delay."""
    family = family_file(tmp_path, stated=stated)
    assert load_family(family).response_delay == 0.005
    assert main(["plan", str(plant_file(tmp_path, "/dev/null", family, *ADDRESSES))]) == 0
    shown = capsys.readouterr().out
    assert shown.splitlines()[2].split()[:3] == ["meter", str(requests), "39"]
    assert shown in PAGE.read_text("utf-8")


@pytest.mark.parametrize(
    ("stated", "most"), [(True, "at most 80"), (False, "at most 125, the standard's limit")]
)
def test_the_read_limit_of_a_family_file_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], stated: bool, most: str
) -> None:
    assert main(["models", str(family_file(tmp_path, stated=stated))]) == 0
    assert f"input registers (read 04H, {most}" in capsys.readouterr().out
