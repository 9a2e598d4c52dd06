"""Read and write drives through the gateway with mbpoll, libmodbus and pyModbusTCP: words equal the drives'
memory.
"""

from __future__ import annotations

import asyncio
import random
import re
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Any, NamedTuple, Protocol

import pytest
from examples import usually
from lines import until
from modbus_gateway import in_thread
from peers import build_with_libmodbus, require_module, require_program

from multidrop import Batch, Bus, BusError, Plant, Poller
from multidrop.drive import Carrier
from multidrop.gateway.commands import Commands
from multidrop.gateway.http.rights import May
from multidrop.gateway.live.hub import Hub
from multidrop.gateway.modbus_server.server import ModbusServer
from multidrop.gateway.modbus_server.settings import ModbusSettings
from multidrop.gateway.modbus_server.unit_ids import MAIN
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated

SOURCE = Path(__file__).parents[2] / "support" / "programs" / "libmodbus_tcp_client.c"
TYPES = {1: "0", 2: "1", 3: "4", 4: "3"}  # by function code: mbpoll's option -t
WRITTEN = {5: "0", 6: "4"}
MBPOLL_CODES = {  # libmodbus's texts for exceptions
    "Illegal function": 1,
    "Illegal data address": 2,
    "Illegal data value": 3,
    "Slave device or server failure": 4,
    "Acknowledge": 5,
    "Slave device or server is busy": 6,
    "Gateway path unavailable": 10,
    "Target device failed to respond": 11,
}


class Master(Protocol):
    """A Modbus master connected to the gateway."""

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        """Return the words or bits read, or an exception code."""

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        """Write a value; return an exception code, or 0."""


class Mbpoll:
    """The program mbpoll, started for each request."""

    def __init__(self, port: int) -> None:
        self._command = [require_program("mbpoll"), "-q", "-m", "tcp", "-p", str(port), "-o", "10", "-0"]

    def _run(self, *words: object) -> str:
        done = subprocess.run(
            [*self._command, *map(str, words)], capture_output=True, text=True, timeout=60, check=False
        )
        return done.stdout + done.stderr

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        shown = self._run("-a", unit, "-t", TYPES[function], "-r", start, "-c", count, "-1", "127.0.0.1")
        found = re.findall(r"^\[(\d+)\]:\s+(\d+)", shown, re.M)
        if code := _code(shown):
            return code
        assert [int(at) for at, _ in found] == list(range(start, start + count)), shown
        return [int(word) for _, word in found]

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        shown = self._run("-a", unit, "-t", WRITTEN[function], "-r", start, "127.0.0.1", value)
        assert "Written 1 references" in shown or _code(shown), shown
        return _code(shown)


def _code(shown: str) -> int:
    return next((code for words, code in MBPOLL_CODES.items() if words in shown), 0)


class Libmodbus:
    """The library libmodbus, in a C program of the tests."""

    def __init__(self, port: int, built: Path) -> None:
        self._process = subprocess.Popen(
            [build_with_libmodbus(SOURCE, built), str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def _ask(self, *numbers: int) -> list[str]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(*numbers, file=self._process.stdin, flush=True)
        return self._process.stdout.readline().split()

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        said, *words = self._ask(unit, function, start, count)
        return int(words[0]) if said == "error" else [int(word) for word in words]

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        said, *words = self._ask(unit, function, start, value)
        return int(words[0]) if said == "error" else 0

    def close(self) -> None:
        with self._process:
            self._process.kill()


class PyModbusTcp:
    """The client of pyModbusTCP."""

    def __init__(self, port: int) -> None:
        client = require_module("pyModbusTCP.client")
        self._client = client.ModbusClient("127.0.0.1", port, timeout=30.0, auto_open=True)

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        self._client.unit_id = unit
        ask = {
            1: self._client.read_coils,
            2: self._client.read_discrete_inputs,
            3: self._client.read_holding_registers,
            4: self._client.read_input_registers,
        }[function]
        found = ask(start, count)
        return int(self._client.last_except) if found is None else [int(word) for word in found]

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        self._client.unit_id = unit
        done = {
            5: lambda: self._client.write_single_coil(start, bool(value)),
            6: lambda: self._client.write_single_register(start, value),
            16: lambda: self._client.write_multiple_registers(start, [value]),
        }[function]()
        return 0 if done else int(self._client.last_except)

    def close(self) -> None:
        self._client.close()


@contextmanager
def master_of(name: str, port: int, built: Path) -> Iterator[Master]:
    """Yield the master of this name, connected to this port; skip the test if it is not installed."""
    if name == "mbpoll":
        yield Mbpoll(port)
        return
    master = Libmodbus(port, built) if name == "libmodbus" else PyModbusTcp(port)
    try:
        yield master
    finally:
        master.close()


MASTERS = ["pyModbusTCP", "mbpoll", "libmodbus"]
METER = Path(__file__).parents[2] / "data" / "families" / "sdm630.toml"
MODELS = ["innovert-ibd", "invt-che", "delixi-modbus", "yd1000", "erman-er-g-220", str(METER)]
COMMANDED = 7  # id of the unit that the tests write to
SETPOINT, CONTROL, STOP = 0x2000, 0x1000, 5  # two addresses and a value: CHE100 manual v1.4, p. 117
PATIENCE = 60.0  # s


class Lines(NamedTuple):
    """Adapts a poller to the protocol PolledLines of Commands."""

    plant: Plant
    poller: Poller

    def bus(self, line: str) -> Bus:
        return self.poller.bus(line)

    @property
    def plant_now(self) -> Plant:
        return self.plant

    @property
    def plant_coming(self) -> None:
        return None  # there are no reloads

    async def ask(self, drive: str, function: int, start: int, count: int, expiry: float) -> list[int]:
        _, known = self.plant.find_drive(drive)
        data = await asyncio.to_thread(known.read_raw, function, start, count, expiry=expiry)
        if function < 3:
            return [data[bit // 8] >> bit % 8 & 1 for bit in range(count)]
        return list(struct.unpack(f">{count}H", data))


class Rig(NamedTuple):
    """The gateway, its simulated drives by unit, and the poller."""

    server: ModbusServer
    drives: dict[int, SimulatedDrive]
    lines: Lines

    @property
    def port(self) -> int:
        return self.server.ports[MAIN]


def plant_text(ports: list[str]) -> str:
    """Return a plant file with half of the drives on each line, and some registers that are not polled."""
    models = [*MODELS, "invt-che"]
    text = ""
    for at, port in enumerate(ports):
        text += f'[[line]]\nname = "line-{at}"\nport = "{port}"\n'
        for unit, model in enumerate(models, 1):
            if unit % 2 == at:
                text += f'[[line.drive]]\nname = "drive-{unit}"\nmodel = "{model}"\naddress = {unit}\n'
                text += 'every = "200 ms"\n'
    return text


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory, _patient_module: None) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("rig")
    (folder / "plant.toml").write_text(plant_text(["/dev/ttyUSB0", "/dev/ttyUSB1"]))
    declared = Plant.load(folder / "plant.toml")
    known = {polled.drive.address: polled.drive for line in declared.lines for polled in line.drives}
    drives = {
        unit: simulated(drive) if unit == COMMANDED else SimulatedDrive(drive)
        for unit, drive in known.items()
    }
    chance = random.Random(20261122)
    for unit, drive in drives.items():
        if unit != COMMANDED:
            fill(drive, chance)
    wires = [Wire([drive for unit, drive in drives.items() if unit % 2 == at], unpaced=True) for at in (0, 1)]
    with Simulator(wires) as line:
        plant = declared.with_ports({f"line-{at}": wire.path for at, wire in enumerate(line.wires)})
        hub = Hub(plant)
        with Poller(plant) as poller:
            lines = Lines(plant, poller)
            commands = Commands(lines, May(write=frozenset({f"drive-{COMMANDED}.setpoint"})))
            settings = ModbusSettings(listen="127.0.0.1:0", may="write")

            def make() -> ModbusServer:
                loop = asyncio.get_running_loop()

                def feed(batch: Batch) -> None:
                    with suppress(RuntimeError):  # raised at the end of the tests, after the loop was closed
                        loop.call_soon_threadsafe(hub.take, batch)

                poller.on_batch(feed, every=0.02)
                return ModbusServer(plant, hub, commands, settings, lines.ask)

            with in_thread(make) as server:
                yield Rig(server, drives, lines)


def fill(drive: SimulatedDrive, chance: random.Random) -> None:
    """Set words to random bits, half of them small numbers, except those with documented values."""
    for register in drive.drive.registers.values():
        for cell in drive.memory.of(register):
            top = 1 if register.table.carrier is Carrier.BIT else 0xFFFF
            cell.raw = min(chance.choice([chance.randint(0, top), chance.randint(1, 20)]), top)
    for register, (least, _) in drive.drive.known_counts().items():
        (cell,) = drive.memory.of(register)
        cell.raw = least


class Chunk(NamedTuple):
    """Adjacent readable addresses of a unit, and their values."""

    unit: int
    function: int
    start: int
    words: list[int]

    @property
    def next_place(self) -> tuple[int, int, int]:
        return self.unit, self.function, self.start + len(self.words)


def chunks(rig: Rig) -> list[Chunk]:
    """Return all declared readable addresses in pieces, with the simulated memory's values."""
    found: list[Chunk] = []
    for unit, drive in rig.drives.items():
        readable: set[tuple[int, int]] = set()
        for register in drive.drive.registers.values():
            if register.readable and register.table.read is not None:
                readable |= {
                    (register.table.read, at)
                    for at in range(register.address, register.address + register.words)
                }
        for function, address in sorted(readable):
            cell = drive.memory.readable(function, address)
            assert cell is not None
            last = found[-1] if found else None
            place = unit, function, address
            if last and len(last.words) < drive.most.get(function, 1) and last.next_place == place:
                last.words.append(cell.raw)
            else:
                found.append(Chunk(*place, [cell.raw]))
    return [chunk for chunk in found if chunk.unit != COMMANDED]


def patiently(ask: Any, *numbers: int) -> Any:
    """Repeat a call if the clients' share of line time is used up or a busy machine lost a reply."""
    end = monotonic() + PATIENCE
    while (found := ask(*numbers)) in (6, 11) and monotonic() < end:
        sleep(0.1)
    return found


@pytest.fixture(params=usually(*MASTERS))
def master(request: pytest.FixtureRequest, rig: Rig, tmp_path: Path) -> Iterator[Master]:
    with master_of(request.param, rig.port, tmp_path) as found:
        yield found


@pytest.mark.slow
@pytest.mark.long
def test_all_words_equal_the_drives(rig: Rig, master: Master) -> None:
    before = rig.server.answered.copy()
    asked = chunks(rig)
    assert len(asked) > 40
    wrong = [
        (chunk, found)
        for chunk in asked
        if (found := patiently(master.read, chunk.unit, chunk.function, chunk.start, len(chunk.words)))
        != chunk.words
    ]
    assert wrong == []
    assert rig.server.answered["cached"] - before["cached"] > 10
    assert rig.server.answered["passed"] - before["passed"] > 10


@pytest.mark.long
@pytest.mark.slow
def test_cached_words_equal_the_words_of_the_line(rig: Rig, master: Master) -> None:
    """Check that a complete polled register is answered from the cache with the line's words."""
    before = rig.server.answered["cached"]
    asked = 0
    for unit, drive in rig.drives.items():
        polled = [register for register in drive.drive.readings() if not register.commands]
        for register in polled[:6]:
            direct = direct_words(rig.lines.bus(f"line-{unit % 2}"), drive, register)
            found = patiently(master.read, unit, register.table.read, register.address, register.words)
            assert found == direct, (unit, register.name)
            asked += 1
    frequency = rig.drives[2].drive.register("output_frequency").address  # polled, so answered from the cache
    until(
        lambda: (
            patiently(master.read, 2, 3, frequency, 1) and rig.server.answered["cached"] - before > asked / 2
        )
    )


def direct_words(bus: Bus, drive: SimulatedDrive, register: Any) -> list[int]:
    """Return the words read directly over the line; retry if a busy machine lost the reply."""
    end = monotonic() + PATIENCE
    data = b""
    while not data:
        try:
            data = drive.drive.read_raw(register.table.read, register.address, register.words, expiry=30)
        except BusError:
            assert monotonic() < end
    if register.table.carrier is Carrier.BIT:
        return [data[0] & 1]
    return list(struct.unpack(f">{register.words}H", data))


@pytest.mark.slow
def test_master_writes_and_reads_back_a_setpoint(
    rig: Rig, master: Master, request: pytest.FixtureRequest
) -> None:
    value = 3000 + 100 * MASTERS.index(request.node.callspec.params["master"])
    assert patiently(master.write, COMMANDED, 6, SETPOINT, value) == 0
    drive = rig.drives[COMMANDED]
    assert [one.raw for one in drive.counters.writes if one.name == "setpoint"][-1] == value
    assert patiently(master.read, COMMANDED, 3, SETPOINT, 1) == [value]


def test_master_gets_the_exception_codes_of_refused_writes(rig: Rig, master: Master) -> None:
    writes = len(rig.drives[COMMANDED].counters.writes)
    assert patiently(master.write, COMMANDED, 6, SETPOINT, 60000) == 3  # above its range
    assert patiently(master.write, COMMANDED, 6, CONTROL, 1) == 3  # FORWARD
    assert patiently(master.write, 1, 6, 0x0002, 1) == 2  # not a writable register
    assert patiently(master.write, 4, 6, 0x2000, 1) == 2
    assert master.read(99, 3, 0, 1) == 10
    assert len(rig.drives[COMMANDED].counters.writes) == writes


def test_master_stops_a_motor_by_control_register_and_common_block(rig: Rig, master: Master) -> None:
    drive = rig.drives[COMMANDED]
    for address, value in ((CONTROL, STOP), (0xF00A, 1)):
        drive.counters.writes.clear()
        assert master.write(COMMANDED, 6, address, value) in (0, 5)  # 0: done, 5: still in progress
        until(lambda: drive.counters.writes)
        assert [(one.name, one.raw) for one in drive.counters.writes][-1] == ("control", STOP)


def test_common_block_is_equal_for_all_masters(rig: Rig, master: Master) -> None:
    for unit in rig.drives:
        found = patiently(master.read, unit, 3, 0xF000, 11)
        assert isinstance(found, list)
        assert found[0] in range(5)
        assert found[10] == 0
