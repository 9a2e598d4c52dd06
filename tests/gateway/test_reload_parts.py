"""Gateway parts, such as MQTT or the history, that a reloaded plant file adds, changes or removes."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from brokers import Listener, mosquitto
from free_ports import free_port
from gateways import Served, served
from lines import PATIENCE, line, plant, polled, until
from modbus_gateway import RawClient
from peers import require_module

from multidrop import Drive, InvtCHE, Plant
from multidrop.gateway import parts as parts_module
from multidrop.gateway.commands import stop_meant
from multidrop.gateway.http.rights import Right

MODBUS = '[serve.modbus]\nlisten = "127.0.0.1:{}"\nunits = {{ pump-1 = {} }}\n'
STATUS = 0x1001  # address of the status register, which reads 3 in standby (CHE100 manual v1.4, p. 117)


@pytest.fixture
def gateway(tmp_path: Path) -> Iterator[Served]:
    with served(tmp_path) as gateway:
        gateway.await_state("pump-1", "stands")
        yield gateway


def parts(gateway: Served) -> dict[str, str]:
    found: dict[str, str] = gateway.get("/health").json["parts"]
    return found


def is_open(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


def status_of(port: int, unit: int) -> list[int]:
    with RawClient(port) as client:
        return list(client.ask(unit, 3, STATUS, 1).words)


IN_EFFECT = {"done": True, "text": "plant.toml is in effect", "mistakes": [], "restart": []}


def test_a_reload_can_start_change_or_end_the_modbus_server(gateway: Served) -> None:
    first, second = free_port(), free_port()
    assert gateway.reload(MODBUS.format(first, 21)) == IN_EFFECT
    until(lambda: status_of(first, 21) == [3])
    server = gateway.gateway.feeds["modbus"]
    assert gateway.reload(MODBUS.format(first, 21)) == IN_EFFECT
    # the table is unchanged, so the server and its clients stay
    assert gateway.gateway.feeds["modbus"] is server
    assert gateway.reload(MODBUS.format(second, 22)) == IN_EFFECT
    until(lambda: status_of(second, 22) == [3])
    until(lambda: not is_open(first))
    assert gateway.reload("") == IN_EFFECT
    until(lambda: not is_open(second))
    assert parts(gateway) == {}


def test_a_reload_changes_nothing_if_a_gateway_part_cannot_be_opened(gateway: Served) -> None:
    first = free_port()
    assert gateway.reload(MODBUS.format(first, 21))["done"] is True
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        path = gateway.gateway.plant.path
        path.write_text(path.read_text().replace('"pump-2"', '"fan-2"'))
        told = gateway.reload(MODBUS.format(number, 22) + '[serve.history]\nfolder = "h"\n')
    assert told["done"] is False
    assert told["text"] == "the previous plant stays in use: the file has mistakes"
    (mistake,) = told["mistakes"]
    assert mistake.startswith(f"[serve.modbus]: listen: 127.0.0.1:{number} cannot be opened")
    assert parts(gateway) == {"modbus": "ok"}
    until(lambda: status_of(first, 21) == [3])
    assert gateway.frame()["drives"].keys() == {"pump-1", "pump-2"}


@pytest.mark.slow
def test_a_reload_is_cancelled_if_a_server_of_the_gateway_cannot_start(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = free_port()
    assert gateway.reload(MODBUS.format(first, 21))["done"] is True
    build, failures = parts_module.build, [MemoryError("no memory")]

    def build_or_fail(*arguments: Any) -> Any:
        if failures:
            raise failures.pop()
        return build(*arguments)

    monkeypatch.setattr(parts_module, "build", build_or_fail)
    assert gateway.reload(MODBUS.format(free_port(), 22))["mistakes"] == ["no memory"]
    assert parts(gateway) == {"modbus": "ok"}
    until(lambda: status_of(first, 21) == [3])


@pytest.mark.slow
def test_a_modbus_port_lost_during_a_failed_reload_is_reported(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reload fails. Meanwhile, another program has opened the previous port of the Modbus server."""
    first = free_port()
    assert gateway.reload(MODBUS.format(first, 21))["done"] is True
    others = []

    def fail(plant: object) -> None:
        others.append(socket.create_server(("127.0.0.1", first)))
        raise RuntimeError("no memory")

    monkeypatch.setattr(gateway.gateway.poller, "adopt", fail)
    assert gateway.reload(MODBUS.format(free_port(), 22))["mistakes"] == ["no memory"]
    others[0].close()
    told = parts(gateway)["modbus"]
    assert told.startswith(f"[serve.modbus]: listen: 127.0.0.1:{first} cannot be opened")
    stopped = gateway.post("/api/stop", {}, **gateway.writer).json
    assert [one["done"] for one in stopped.values()] == [True, True]
    monkeypatch.undo()
    assert gateway.reload(MODBUS.format(first, 21)) == IN_EFFECT
    until(lambda: status_of(first, 21) == [3])
    assert parts(gateway) == {"modbus": "ok"}


@pytest.mark.slow
def test_a_stop_is_sent_while_a_reload_waits_for_the_history(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    opens, goes_on = threading.Event(), threading.Event()
    build = parts_module.build

    def slow(*given: Any) -> Any:
        opens.set()
        assert goes_on.wait(PATIENCE)
        return build(*given)

    monkeypatch.setattr(parts_module, "build", slow)
    told: list[Any] = []
    reloading = threading.Thread(target=lambda: told.append(gateway.reload("[serve.history]\n")))
    reloading.start()
    assert opens.wait(PATIENCE)
    stopped = gateway.post("/api/stop", authorization=gateway.bearer(Right.STOP)).json
    assert [one["done"] for one in stopped.values()] == [True, True]
    assert told == []
    goes_on.set()
    reloading.join(PATIENCE)
    assert told == [IN_EFFECT]


@pytest.mark.long
def test_a_reload_can_start_change_or_end_the_history(gateway: Served, tmp_path: Path) -> None:
    assert gateway.get("/api/export?from=0&to=1&series=pump-1.status").status == 404
    for folder in ("first", "second"):
        assert gateway.reload(f'[serve.history]\nfolder = "{folder}"\n') == IN_EFFECT
        until(lambda folder=folder: any((tmp_path / folder).glob("*.arrows")))
        history = gateway.gateway.feeds["history"]
        until(lambda history=history: history.state.rows > 0)
    assert gateway.reload("") == IN_EFFECT
    assert history.state.trouble is None
    assert gateway.get("/api/export?from=0&to=1&series=pump-1.status").status == 404


@pytest.mark.slow
def test_a_reload_can_start_change_or_end_mqtt(gateway: Served, tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    with mosquitto(tmp_path) as broker, closing(Listener(broker)) as heard:

        def says(topic: str, payload: bytes) -> None:
            heard.wait_for(lambda one: (one.topic, one.payload) == (topic, payload))

        table = f'[serve.mqtt]\nbroker = "{broker.address}"\nprefix = '
        assert gateway.reload(table + '"old"\n') == IN_EFFECT
        says("old/gateway", b"online")
        assert gateway.reload(table + '"new"\n') == IN_EFFECT
        says("old/gateway", b"offline")
        says("new/gateway", b"online")
        assert gateway.reload("") == IN_EFFECT
        says("new/gateway", b"offline")


# ---- stops during a reload that moves drives' names from one line to another ----


Names = dict[str, Drive]


@dataclass
class End:
    """The result of a stop, and the drive that was stopped."""

    drive: Drive | None
    ok: bool = True


@dataclass
class Lines:
    """Fake lines of a poller. The test can change them, and can delay the stop of a drive."""

    plant_now: Plant
    plant_coming: Plant | None = None
    # by drive address: event for which the drive's stop waits
    held: dict[int, asyncio.Event] = field(default_factory=dict)
    failing: set[int] = field(default_factory=set)
    begun: list[Drive | None] = field(default_factory=list)

    async def stop(self, now: Plant, names: list[str]) -> dict[str, End]:
        """Stop these drives. The stop of a drive in `held` waits for its event."""
        there = {polled.drive.name: polled.drive for line in now.lines for polled in line.drives}
        found = {name: there.get(name) for name in names}
        self.begun += found.values()
        for drive in found.values():
            if drive is not None and drive.address in self.held:
                await self.held[drive.address].wait()
        return {
            name: End(drive, drive is not None and drive.address not in self.failing)
            for name, drive in found.items()
        }


def plant_of(*drives: Drive) -> Plant:
    """Return a plant in which each drive has its own line."""
    return plant(
        *(
            line(f"/dev/tty{number}", polled(drive, []), name=f"hall-{number}")
            for number, drive in enumerate(drives)
        )
    )


async def until_met(met: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not met():
            await asyncio.sleep(0)


def told(ends: dict[str, End]) -> Names:
    return {name: end.drive for name, end in ends.items() if end.drive is not None}


FAN, PUMP = InvtCHE(1, name="fan"), InvtCHE(2, name="pump")
NEW_FAN = InvtCHE(2, name="fan")


@pytest.mark.parametrize("names", [["fan"], None])
async def test_a_new_drive_is_stopped_while_the_replaced_drive_is_being_stopped(
    names: list[str] | None,
) -> None:
    """The stop of the replaced drive may take half a minute, for example if that drive is silent."""
    silent = asyncio.Event()
    lines = Lines(plant_of(PUMP, FAN), held={FAN.address: silent})
    stopping = asyncio.create_task(stop_meant(lines, names, lines.stop))
    await until_met(lambda: FAN in lines.begun)
    lines.plant_coming = lines.plant_now = plant_of(NEW_FAN)
    await until_met(lambda: NEW_FAN in lines.begun)
    assert not stopping.done()
    lines.plant_coming = None
    silent.set()
    # the new drive's result, although that of the old drive came later
    assert (await stopping)["fan"].drive is NEW_FAN
    assert lines.begun.count(NEW_FAN) == 1


async def test_a_stop_is_sent_again_if_it_fails_during_a_reload() -> None:
    silent = asyncio.Event()
    lines = Lines(plant_of(PUMP, FAN), held={FAN.address: silent}, failing={FAN.address})
    stopping = asyncio.create_task(stop_meant(lines, ["fan"], lines.stop))
    await until_met(lambda: FAN in lines.begun)
    lines.plant_now = plant_of(PUMP, FAN, InvtCHE(3, name="mill"))
    silent.set()
    assert not (await stopping)["fan"].ok
    assert lines.begun == [FAN, FAN]


async def test_a_stop_reaches_a_drive_as_soon_as_a_reload_adds_it() -> None:
    """The name may have another Unicode spelling. Drives of the present plant are not stopped."""
    new = InvtCHE(2, name="L\u00fcfter")
    lines = Lines(plant_of(PUMP, FAN), plant_of(new, FAN))
    stopping = asyncio.create_task(stop_meant(lines, ["Lu\u0308fter"], lines.stop))
    await until_met(lambda: lines.begun)
    lines.plant_now, lines.plant_coming = plant_of(new, FAN), None
    assert told(await stopping) == {"Lu\u0308fter": new}
    assert lines.begun == [None, new]


async def test_a_stop_reaches_only_the_named_drives_while_no_reload_runs() -> None:
    lines = Lines(plant_of(PUMP, FAN))
    assert told(await stop_meant(lines, ["fan", "nobody"], lines.stop)) == {"fan": FAN}
    assert lines.begun == [FAN, None]
