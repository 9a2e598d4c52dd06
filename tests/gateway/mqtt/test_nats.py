"""MQTT through the listener of nats-server: state that is kept, the last will, commands, and Sparkplug."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from brokers import (
    PLAIN_FAN,
    ROOT,
    Broker,
    Host,
    Listener,
    Published,
    Running,
    command,
    inside,
    nats,
    publish,
)
from lines import until
from nats_clusters import old_server_program, server_program
from peers import require_module

from multidrop.gateway.mqtt.part import build
from multidrop.gateway.mqtt.settings import MqttSettings

Start = Callable[..., tuple[Any, Running]]


@pytest.fixture
def broker(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Broker]:
    program = getattr(request, "param", server_program)
    with nats(tmp_path, program()) as broker:
        yield broker


@pytest.fixture
def start(broker: Broker, tmp_path: Path) -> Iterator[Start]:
    require_module("paho.mqtt.client")
    running: list[Running] = []

    def start(**settings: Any) -> tuple[Any, Running]:
        known = inside(tmp_path, PLAIN_FAN)
        running.append(Running(build(MqttSettings(broker.address, **settings), known)))
        return known, running[-1]

    yield start
    for one in running:
        one.close()


def has(topic: str, payload: bytes | None = None) -> Callable[[Published], bool]:
    return lambda heard: heard.topic == topic and payload in (None, heard.payload)


def now_ms() -> int:
    return time.time_ns() // 1_000_000


@pytest.mark.slow
def test_state_is_kept_and_the_broker_says_that_the_gateway_is_gone(broker: Broker, start: Start) -> None:
    listener = Listener(broker)
    try:
        _, running = start()
        listener.wait_for(has("multidrop/gateway", b"online"))
        listener.wait_for(has(f"multidrop/{PLAIN_FAN.name}/available", b"online"))
        later = Listener(broker)
        said = later.wait_for(has("multidrop/pump-1"))
        later.close()
        assert said.is_retained
        assert json.loads(said.payload)["values"] == {"output_frequency": 49.5, "status": "FORWARD"}
        running.cut(0)
        listener.wait_for(has("multidrop/gateway", b"offline"))
        listener.wait_for(has("multidrop/gateway", b"online"))
    finally:
        listener.close()


@pytest.mark.slow
def test_commands_go_through_the_rules(broker: Broker, start: Start) -> None:
    listener = Listener(broker)

    def told() -> Any:
        return json.loads(listener.wait_for(has("multidrop/pump-1/told")).payload)

    def write(value: float, time_ms: int, *options: str) -> None:
        body = json.dumps({"value": value, "time": time_ms}).encode()
        publish(broker, "multidrop/pump-1/set/setpoint", body, *options)

    try:
        known, _ = start(commands=True)
        listener.wait_for(has("multidrop/gateway", b"online"))
        sent_ms = now_ms()
        write(25.0, sent_ms)
        assert told()["done"] is True
        write(25.0, sent_ms)
        assert told()["text"] == "not sent: it came a second time"
        write(26.0, now_ms() - 60_000)
        assert "s ago by the clocks of sender and gateway" in told()["text"]
        publish(broker, "multidrop/pump-1/stop", b"stop", "-q", "1")
        assert told()["what"] == "stop"
        assert known.commands.noted == [("write", "pump-1", "setpoint", 25.0), ("stop", ["pump-1"])]
    finally:
        listener.close()


@pytest.mark.slow
def test_retained_command_is_refused(broker: Broker, start: Start) -> None:
    listener = Listener(broker)
    try:
        body = json.dumps({"value": 25.0, "time": now_ms() + 1000}).encode()
        publish(broker, "multidrop/pump-1/set/setpoint", body, "-r")
        known, _ = start(commands=True)
        said = listener.wait_for(has("multidrop/pump-1/told"))
        assert json.loads(said.payload)["text"].startswith("not sent: it was retained")
        assert known.commands.noted == []
    finally:
        listener.close()


@pytest.mark.slow
@pytest.mark.parametrize("broker", [old_server_program], indirect=True)
def test_a_topic_that_it_does_not_take_costs_the_others_nothing(broker: Broker, start: Start) -> None:
    """The namespace of Sparkplug has a dot, with which nats-server closes the connection before 2.10."""
    listener = Listener(broker)
    try:
        known, running = start(sparkplug="works", node="line")
        listener.wait_for(has("multidrop/pump-1"))
        until(lambda: running._part.health().startswith(f"no connection to 127.0.0.1:{broker.port}"))
        known.hub.values[("pump-1", "output_frequency")] = 50.0
        running.step()
        listener.wait_for(
            lambda heard: (
                heard.topic == "multidrop/pump-1"
                and json.loads(heard.payload)["values"]["output_frequency"] == 50.0
            )
        )
        assert "multidrop/gateway" not in [h.topic for h in listener.all if h.payload == b"offline"]
    finally:
        listener.close()


@pytest.mark.slow
def test_births_data_rebirth_death_and_commands_of_sparkplug(broker: Broker, start: Start) -> None:
    host = Host(broker)
    try:
        known, running = start(sparkplug="works", node="line", commands=True)
        assert host.values(host.wait_for("NBIRTH")) == {"bdSeq": 0, "Node Control/Rebirth": False}
        born = host.values(host.wait_for("DBIRTH", "pump-1"))
        assert (born["output_frequency"], born["status"]) == (49.5, "FORWARD")
        host.wait_for("DBIRTH", PLAIN_FAN.name)
        known.hub.values[("pump-1", "output_frequency")] = 50.0
        running.step()
        assert host.values(host.wait_for("DDATA", "pump-1")) == {"output_frequency": 50.0}
        command(broker, ROOT.format("NCMD"), name="Node Control/Rebirth", boolean_value=True, datatype=11)
        assert host.values(host.wait_for("NBIRTH"))["bdSeq"] == 0
        host.wait_for("DBIRTH", "pump-1")
        host.wait_for("DBIRTH", PLAIN_FAN.name)
        known.hub.states[PLAIN_FAN.name] = "silent"
        running.step()
        host.wait_for("DDEATH", PLAIN_FAN.name)
        topic = ROOT.format("DCMD") + "/pump-1"
        command(broker, topic, name="Device Control/Stop", boolean_value=True, datatype=11)
        until(lambda: known.commands.noted == [("stop", ["pump-1"])])
        running.cut(1)
        assert host.values(host.wait_for("NDEATH")) == {"bdSeq": 0}
        assert host.values(host.wait_for("NBIRTH"))["bdSeq"] == 1
    finally:
        host.close()
