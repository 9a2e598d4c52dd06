"""MQTT through the listener of nats-server: retained state, the last will, commands, and Sparkplug."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import pytest
from brokers import (
    PLAIN_FAN,
    ROOT,
    Broker,
    Host,
    Listener,
    Running,
    command,
    has,
    nats,
    publish,
)
from lines import until
from nats_clusters import old_server_program, server_program

Start = Callable[..., tuple[Any, Running]]


def nats_of(program: Callable[[], str]) -> Any:
    """Return a test parameter that makes the broker a nats-server."""
    return pytest.mark.parametrize("broker", [lambda folder: nats(folder, program())], indirect=True)


on_nats = nats_of(server_program)


def now_ms() -> int:
    return time.time_ns() // 1_000_000


@pytest.mark.slow
@on_nats
def test_state_is_retained_and_the_will_reports_a_lost_gateway(
    broker: Broker, listener: Listener, start: Start
) -> None:
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


@pytest.mark.slow
@on_nats
def test_delayed_and_repeated_commands_are_refused_and_stops_are_not(
    broker: Broker, listener: Listener, start: Start
) -> None:
    def told() -> Any:
        return json.loads(listener.wait_for(has("multidrop/pump-1/told")).payload)

    def write(value: float, time_ms: int, *options: str) -> None:
        body = json.dumps({"value": value, "time": time_ms}).encode()
        publish(broker, "multidrop/pump-1/set/setpoint", body, *options)

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


@pytest.mark.slow
@on_nats
def test_retained_command_is_refused(broker: Broker, listener: Listener, start: Start) -> None:
    body = json.dumps({"value": 25.0, "time": now_ms() + 1000}).encode()
    publish(broker, "multidrop/pump-1/set/setpoint", body, "-r")
    known, _ = start(commands=True)
    said = listener.wait_for(has("multidrop/pump-1/told"))
    assert json.loads(said.payload)["text"].startswith("not sent: it was retained")
    assert known.commands.noted == []


@pytest.mark.slow
@nats_of(old_server_program)
def test_rejected_topics_do_not_delay_others(broker: Broker, listener: Listener, start: Start) -> None:
    """Sparkplug's namespace has a dot, for which nats-server before 2.10 closes the connection."""
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


@pytest.mark.slow
@on_nats
def test_sparkplug_births_data_deaths_and_commands(broker: Broker, host: Host, start: Start) -> None:
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
