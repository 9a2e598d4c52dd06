"""mbpoll, libmodbus and pyModbusTCP read and write the words of drives through the gateway."""

from __future__ import annotations

import asyncio
import random
import struct
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Any, NamedTuple, Protocol

import pytest
from examples import usually
from lines import until
from modbus_gateway import in_thread
from modbus_tools import Libmodbus, Mbpoll
from peers import require_module

from multidrop import Batch, Bus, BusError, Plant, Poller
from multidrop.drive import Carrier
from multidrop.gateway.commands import Commands
from multidrop.gateway.http.rights import May
from multidrop.gateway.live.hub import Hub
from multidrop.gateway.modbus_server.server import ModbusServer
from multidrop.gateway.modbus_server.settings import MAIN, ModbusSettings
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated


class Master(Protocol):
    """A Modbus master connected to the gateway."""

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        """Return the words or bits at these addresses, or an exception code."""

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        """Write one value; return 0 or an exception code."""


class PyModbusTcp:
    """A master that uses the client of pyModbusTCP."""

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
    """Yield the master of this name, connected to this port. Skips the test if it is not installed."""
    masters: dict[str, Callable[[], Any]] = {
        "mbpoll": lambda: Mbpoll("127.0.0.1", "-m", "tcp", "-p", str(port)),
        "libmodbus": lambda: Libmodbus(port, built),
        "pyModbusTCP": lambda: PyModbusTcp(port),
    }
    with closing(masters[name]()) as master:
        yield master


MASTERS = ["pyModbusTCP", "mbpoll", "libmodbus"]
METER = Path(__file__).parents[2] / "data" / "families" / "sdm630.toml"
MODELS = ["innovert-ibd", "invt-che", "delixi-modbus", "yd1000", "erman-er-g-220", str(METER)]
COMMANDED = 7  # unit id of the drive that the tests write to
# addresses of two registers, and the value that means stop (CHE100 manual v1.4, p. 117)
SETPOINT, CONTROL, STOP = 0x2000, 0x1000, 5
PATIENCE = 60.0  # s


class Lines(NamedTuple):
    """Adapts a poller to PolledLines, the protocol that Commands needs."""

    plant: Plant
    poller: Poller
    asked: list[tuple[str, int, int, int]]  # reads that the gateway passed on to a drive

    def bus(self, line: str) -> Bus:
        return self.poller.bus(line)

    @property
    def plant_now(self) -> Plant:
        return self.plant

    @property
    def plant_coming(self) -> None:
        return None  # no reload in progress

    async def ask(self, drive: str, function: int, start: int, count: int, expiry: float) -> list[int]:
        self.asked.append((drive, function, start, count))
        _, known = self.plant.find_drive(drive)
        data = await asyncio.to_thread(known.read_raw, function, start, count, expiry=expiry)
        if function < 3:
            return [data[bit // 8] >> bit % 8 & 1 for bit in range(count)]
        return list(struct.unpack(f">{count}H", data))


class Rig(NamedTuple):
    """The gateway's Modbus server, the simulated drives by unit id, and the poller."""

    server: ModbusServer
    drives: dict[int, SimulatedDrive]
    lines: Lines

    @property
    def port(self) -> int:
        return self.server.ports[MAIN]


def plant_text(ports: list[str]) -> str:
    """Return a plant file with half of the drives on each of two lines; some registers are not polled."""
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
            lines = Lines(plant, poller, [])
            commands = Commands(lines, May(write=frozenset({f"drive-{COMMANDED}.setpoint"})))
            settings = ModbusSettings(listen="127.0.0.1:0", may="write")

            def make() -> ModbusServer:
                loop = asyncio.get_running_loop()

                def feed(batch: Batch) -> None:
                    with suppress(RuntimeError):  # raised when a batch arrives after the loop was closed
                        loop.call_soon_threadsafe(hub.take, batch)

                poller.on_batch(feed, every=0.02)
                return ModbusServer(plant, hub, commands, settings, lines.ask)

            with in_thread(make) as server:
                yield Rig(server, drives, lines)


def fill(drive: SimulatedDrive, chance: random.Random) -> None:
    """Set each register to random words, often small numbers, or to a value that its manual lists."""
    for register in drive.drive.registers.values():
        for cell in drive.memory.of(register):
            top = 1 if register.table.carrier is Carrier.BIT else 0xFFFF
            cell.raw = min(chance.choice([chance.randint(0, top), chance.randint(1, 20)]), top)
    for register, (least, _) in drive.drive.known_counts().items():
        (cell,) = drive.memory.of(register)
        cell.raw = least


class Chunk(NamedTuple):
    """Adjacent readable addresses of a unit id, and the words there."""

    unit: int
    function: int
    start: int
    words: list[int]

    @property
    def next_place(self) -> tuple[int, int, int]:
        return self.unit, self.function, self.start + len(self.words)


def chunks(rig: Rig) -> list[Chunk]:
    """Return all declared readable addresses as chunks, with the words of the simulated memory."""
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
    """Repeat a call while it returns 6 (line time used up) or 11 (reply lost on a busy machine)."""
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
def test_a_master_reads_the_words_that_each_drive_stores(rig: Rig, master: Master) -> None:
    asked, before = chunks(rig), len(rig.lines.asked)
    assert len(asked) > 40
    wrong = [
        (chunk, found)
        for chunk in asked
        if (found := patiently(master.read, chunk.unit, chunk.function, chunk.start, len(chunk.words)))
        != chunk.words
    ]
    assert wrong == []
    passed = {(drive, function, start) for drive, function, start, _ in rig.lines.asked[before:]}
    assert 10 < len(passed) < len(asked) - 10


@pytest.mark.long
@pytest.mark.slow
def test_words_computed_from_polled_rows_equal_those_read_from_the_drive(rig: Rig, master: Master) -> None:
    """Reads of whole polled registers need no request on the line."""
    frequency = rig.drives[2].drive.register("output_frequency").address  # polled

    def is_cached() -> bool:
        before = len(rig.lines.asked)
        return bool(patiently(master.read, 2, 3, frequency, 1)) and len(rig.lines.asked) == before

    until(is_cached)
    asked, before = 0, len(rig.lines.asked)
    for unit, drive in rig.drives.items():
        polled = [register for register in drive.drive.readings() if not register.commands]
        for register in polled[:6]:
            direct = direct_words(rig.lines.bus(f"line-{unit % 2}"), drive, register)
            found = patiently(master.read, unit, register.table.read, register.address, register.words)
            assert found == direct, (unit, register.name)
            asked += 1
    assert len({*rig.lines.asked[before:]}) < asked / 2


def direct_words(bus: Bus, drive: SimulatedDrive, register: Any) -> list[int]:
    """Read the words of a register directly from the drive. Retries if a busy machine loses the reply."""
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
def test_a_master_can_write_a_setpoint(rig: Rig, master: Master, request: pytest.FixtureRequest) -> None:
    value = 3000 + 100 * MASTERS.index(request.node.callspec.params["master"])
    assert patiently(master.write, COMMANDED, 6, SETPOINT, value) == 0
    drive = rig.drives[COMMANDED]
    assert [one.raw for one in drive.counters.writes if one.name == "setpoint"][-1] == value
    assert patiently(master.read, COMMANDED, 3, SETPOINT, 1) == [value]


def test_a_master_gets_the_exception_codes_of_refused_writes(rig: Rig, master: Master) -> None:
    writes = len(rig.drives[COMMANDED].counters.writes)
    assert patiently(master.write, COMMANDED, 6, SETPOINT, 60000) == 3  # above the register's range
    assert patiently(master.write, COMMANDED, 6, CONTROL, 1) == 3  # FORWARD
    assert patiently(master.write, 1, 6, 0x0002, 1) == 2  # the register is read-only
    assert patiently(master.write, 4, 6, 0x2000, 1) == 2
    assert master.read(99, 3, 0, 1) == 10
    assert len(rig.drives[COMMANDED].counters.writes) == writes


def test_a_master_stops_a_motor_by_its_own_or_the_common_register(rig: Rig, master: Master) -> None:
    drive = rig.drives[COMMANDED]
    for address, value in ((CONTROL, STOP), (0xF00A, 1)):
        drive.counters.writes.clear()
        # 0: confirmed, 5: acknowledged and still in progress
        assert master.write(COMMANDED, 6, address, value) in (0, 5)
        until(lambda: drive.counters.writes)
        assert [(one.name, one.raw) for one in drive.counters.writes][-1] == ("control", STOP)


def test_each_master_reads_the_common_register_block(rig: Rig, master: Master) -> None:
    for unit in rig.drives:
        found = patiently(master.read, unit, 3, 0xF000, 11)
        assert isinstance(found, list)
        assert found[0] in range(5)
        assert found[10] == 0
