"""The Modbus server as a part of the gateway: from `[serve.modbus]` in a plant file to line and audit log."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from lines import until
from modbus_gateway import RawClient, RawReply, request
from peers import require_module

from multidrop import InvtCHE, Plant, PlantError
from multidrop.control import read_audit
from multidrop.gateway.settings import read_settings
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated

PLANT = """
[serve]
listen = "127.0.0.1:0"
audit = "audit.jsonl"
[serve.may]
write = ["mill.setpoint"]
[serve.modbus]
listen = "127.0.0.1:0"
may = "write"
units = {{ mill = 21 }}

[[line]]
name = "hall"
port = "{port}"
[[line.drive]]
name = "mill"
model = "invt-che"
address = 1
every = "50 ms"
poll = ["output_voltage", "status"]
"""
SETPOINT, CONTROL, OUTPUT_VOLTAGE, OUTPUT_CURRENT = (
    0x2000,
    0x1000,
    0x3003,
    0x3004,
)  # CHE100 manual v1.4, p. 117


@contextmanager
def gateway_of(path: Path) -> Iterator[Any]:
    """Run the gateway of a plant file in a thread until the `with` block is left."""
    require_module("uvicorn")
    from multidrop.gateway.gateway import Gateway

    ready = threading.Event()
    found: list[Any] = []
    failures: list[BaseException] = []
    loop = asyncio.new_event_loop()

    async def main() -> None:
        plant = Plant.load(path)
        gateway = Gateway(plant, read_settings(plant, {}))
        found.append(gateway)
        await gateway.run(ready.set)

    def run() -> None:
        try:
            loop.run_until_complete(main())
        except BaseException as failure:
            failures.append(failure)
        finally:
            ready.set()
            loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert ready.wait(60)
        if failures:
            raise failures[0]
        yield found[0]
    finally:
        if not loop.is_closed():
            loop.call_soon_threadsafe(found[0].end)
        thread.join()


@contextmanager
def simulated_plant(folder: Path) -> Iterator[tuple[SimulatedDrive, Path]]:
    drive = simulated(InvtCHE(1))
    with Simulator([Wire([drive], unpaced=True)]) as line:
        path = folder / "plant.toml"
        path.write_text(PLANT.format(port=line.wires[0].path))
        yield drive, path


def reply_to(client: RawClient, *words: int) -> RawReply:
    """Return the reply to a request, which is repeated if the line is busy or a reply was lost."""
    found: list[RawReply] = []

    def ask() -> bool:
        found.append(client.ask(21, *words))
        return found[-1].code not in (6, 11)

    until(ask)
    return found[-1]


@pytest.mark.slow
def test_drives_of_a_plant_file_are_read_written_and_stopped(tmp_path: Path) -> None:
    with simulated_plant(tmp_path) as (drive, path), gateway_of(path) as gateway:
        drive["output_voltage"] = 231
        server = gateway.feeds["modbus"]
        with RawClient(server.ports[""]) as client:
            until(lambda: reply_to(client, 3, OUTPUT_VOLTAGE, 1).words == [231] and server.answered["cached"])
            assert reply_to(client, 3, OUTPUT_CURRENT, 1).words == [0]  # not polled, so read from the drive
            assert server.answered["passed"] > 0
            assert reply_to(client, 6, SETPOINT, 5000).code is None
            assert reply_to(client, 3, SETPOINT, 1).words == [5000]
            assert reply_to(client, 6, CONTROL, 1).code == 3
            assert client.ask(21, 6, CONTROL, 5).code in (None, 5)
            until(lambda: ("control", 5) in [(one.name, one.raw) for one in drive.counters.writes])
            client.send(request(1, 0, 6, SETPOINT, 0))
            assert client.receive() is None
        sent = [(one.name, one.raw) for one in drive.counters.writes]
        assert ("setpoint", 5000) in sent
        assert {raw for name, raw in sent if name == "control"} == {5}
    audit = list(read_audit(tmp_path / "audit.jsonl"))
    assert any("modbus from 127.0.0.1" in str(entry) and "setpoint" in str(entry) for entry in audit)


def test_a_port_in_use_is_reported_before_polling(tmp_path: Path) -> None:
    with simulated_plant(tmp_path) as (drive, path), socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        path.write_text(path.read_text().replace(':0"\nmay', f':{number}"\nmay'))
        with pytest.raises(ValueError, match=f"127.0.0.1:{number} cannot be opened"), gateway_of(path):
            pass
        assert drive.counters.requests == 0


def test_mistakes_in_the_table_are_reported_with_their_place(tmp_path: Path) -> None:
    with simulated_plant(tmp_path) as (_, path):
        text = path.read_text()
        path.write_text(
            text.replace('may = "write"', 'may = "root"\npassing = 3').replace("mill = 21", "mil = 21")
        )
        with pytest.raises(PlantError) as mistakes:
            read_settings(Plant.load(path), {})
        shown = str(mistakes.value)
        assert "[serve.modbus]" in shown
        assert 'passing = 3 is not right; write passing = "declared"' in shown
        assert "may = 'root' is not one of look, stop, write" in shown
        path.write_text(text.replace("mill = 21", "mil = 21"))
        with pytest.raises(PlantError, match="units: there is no drive 'mil'; did you mean mill"):
            read_settings(Plant.load(path), {})
