"""Parts that a reloaded plant file adds, changes or removes."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from brokers import Listener, free_port, mosquitto
from gateways import Served, served
from lines import PATIENCE, until
from modbus_gateway import RawClient
from peers import require_module

from multidrop.gateway import parts as parts_module
from multidrop.gateway.http.rights import Right

MODBUS = '[serve.modbus]\nlisten = "127.0.0.1:{}"\nunits = {{ pump-1 = {} }}\n'
STATUS = 0x1001  # CHE100 manual v1.4, p. 117: 3 is "standby"


@pytest.fixture
def gateway(tmp_path: Path) -> Iterator[Served]:
    with served(tmp_path) as gateway:
        gateway.await_state("pump-1", "stands")
        yield gateway


def reload(gateway: Served, serve: str) -> Any:
    """Reload the plant file with these tables of [serve]; return the gateway's answer."""
    path = gateway.gateway.plant.path
    path.write_text(path.read_text().partition("[serve")[0] + serve)
    answer = gateway.post("/api/reload", {"confirm": True}, authorization=gateway.bearer(Right.WRITE))
    assert answer.status == 200
    return answer.json


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


def test_reload_starts_changes_and_ends_the_modbus_server(gateway: Served) -> None:
    first, second = free_port(), free_port()
    assert reload(gateway, MODBUS.format(first, 21)) == IN_EFFECT
    until(lambda: status_of(first, 21) == [3])
    server = gateway.gateway.feeds["modbus"]
    assert reload(gateway, MODBUS.format(first, 21)) == IN_EFFECT
    assert gateway.gateway.feeds["modbus"] is server  # the table is unchanged, so clients stay connected
    assert reload(gateway, MODBUS.format(second, 22)) == IN_EFFECT
    until(lambda: status_of(second, 22) == [3])
    assert not is_open(first)
    assert reload(gateway, "") == IN_EFFECT
    assert not is_open(second)
    assert parts(gateway) == {}


def test_reload_with_a_part_that_cannot_be_opened_changes_nothing(gateway: Served) -> None:
    first = free_port()
    assert reload(gateway, MODBUS.format(first, 21))["done"] is True
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        path = gateway.gateway.plant.path
        path.write_text(path.read_text().replace('"pump-2"', '"fan-2"'))
        told = reload(gateway, MODBUS.format(number, 22) + '[serve.history]\nfolder = "h"\n')
    assert told["done"] is False
    assert told["text"] == "the previous plant stays in use: the file has mistakes"
    (mistake,) = told["mistakes"]
    assert mistake.startswith(f"[serve.modbus]: listen: 127.0.0.1:{number} cannot be opened")
    assert parts(gateway) == {"modbus": "ok"}
    until(lambda: status_of(first, 21) == [3])
    assert gateway.frame()["drives"].keys() == {"pump-1", "pump-2"}


@pytest.mark.slow
def test_reload_with_an_unexpected_failure_of_a_part_changes_nothing(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = free_port()
    assert reload(gateway, MODBUS.format(first, 21))["done"] is True
    build, failures = parts_module.build, [MemoryError("no memory")]

    def build_or_fail(*arguments: Any) -> Any:
        if failures:
            raise failures.pop()
        return build(*arguments)

    monkeypatch.setattr(parts_module, "build", build_or_fail)
    assert reload(gateway, MODBUS.format(free_port(), 22))["mistakes"] == ["no memory"]
    assert parts(gateway) == {"modbus": "ok"}
    until(lambda: status_of(first, 21) == [3])


@pytest.mark.slow
def test_part_that_loses_its_port_during_a_reload_is_reported(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reload fails, and meanwhile another program has opened the part's previous port."""
    first = free_port()
    assert reload(gateway, MODBUS.format(first, 21))["done"] is True
    others = []

    def fail(plant: object) -> None:
        others.append(socket.create_server(("127.0.0.1", first)))
        raise RuntimeError("no memory")

    monkeypatch.setattr(gateway.gateway.poller, "adopt", fail)
    assert reload(gateway, MODBUS.format(free_port(), 22))["mistakes"] == ["no memory"]
    others[0].close()
    told = parts(gateway)["modbus"]
    assert told.startswith(f"[serve.modbus]: listen: 127.0.0.1:{first} cannot be opened")
    assert [
        one["done"]
        for one in gateway.post("/api/stop", {}, authorization=gateway.bearer(Right.STOP)).json.values()
    ] == [
        True,
        True,
    ]
    monkeypatch.undo()
    assert reload(gateway, MODBUS.format(first, 21)) == IN_EFFECT
    until(lambda: status_of(first, 21) == [3])
    assert parts(gateway) == {"modbus": "ok"}


@pytest.mark.slow
def test_slow_part_delays_no_stop(gateway: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    opens, goes_on = threading.Event(), threading.Event()
    build = parts_module.build

    def slow(*given: Any) -> Any:
        opens.set()
        assert goes_on.wait(PATIENCE)
        return build(*given)

    monkeypatch.setattr(parts_module, "build", slow)
    told: list[Any] = []
    reloading = threading.Thread(target=lambda: told.append(reload(gateway, "[serve.history]\n")))
    reloading.start()
    assert opens.wait(PATIENCE)
    stopped = gateway.post("/api/stop", authorization=gateway.bearer(Right.STOP)).json
    assert [one["done"] for one in stopped.values()] == [True, True]
    assert told == []
    goes_on.set()
    reloading.join(PATIENCE)
    assert told == [IN_EFFECT]


@pytest.mark.long
def test_reload_starts_changes_and_ends_the_history(gateway: Served, tmp_path: Path) -> None:
    assert gateway.get("/api/export?from=0&to=1&series=pump-1.status").status == 404
    for folder in ("first", "second"):
        assert reload(gateway, f'[serve.history]\nfolder = "{folder}"\n') == IN_EFFECT
        until(lambda folder=folder: any((tmp_path / folder).glob("*.arrows")))
        history = gateway.gateway.feeds["history"]
        until(lambda history=history: history.state.rows > 0)
    assert reload(gateway, "") == IN_EFFECT
    assert history.state.trouble is None
    assert gateway.get("/api/export?from=0&to=1&series=pump-1.status").status == 404


@pytest.mark.slow
def test_reload_starts_changes_and_ends_mqtt(gateway: Served, tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    with mosquitto(tmp_path) as broker:
        heard = Listener(broker)

        def says(topic: str, payload: bytes) -> None:
            heard.wait_for(lambda one: (one.topic, one.payload) == (topic, payload))

        try:
            table = f'[serve.mqtt]\nbroker = "{broker.address}"\nprefix = '
            assert reload(gateway, table + '"old"\n') == IN_EFFECT
            says("old/gateway", b"online")
            assert reload(gateway, table + '"new"\n') == IN_EFFECT
            says("old/gateway", b"offline")
            says("new/gateway", b"online")
            assert reload(gateway, "") == IN_EFFECT
            says("new/gateway", b"offline")
        finally:
            heard.close()
