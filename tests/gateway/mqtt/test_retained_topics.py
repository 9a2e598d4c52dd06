"""Retained messages of removed drives are deleted. Commands that a frozen broker delays are refused."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from brokers import FAN, Broker, Listener, Running, inside, mosquitto, publish, without_fan
from gateways import served
from lines import until
from peers import require_module, require_program
from tables import table

from multidrop.control import CommandOutcome, CommandResult
from multidrop.gateway.mqtt.home_assistant import discovery_topic
from multidrop.gateway.mqtt.json_topics import (
    MOST_DISCOVERY,
    MOST_KEPT,
    JsonTopics,
    RetainedTopics,
    _read_write,
)
from multidrop.gateway.mqtt.part import build
from multidrop.gateway.mqtt.settings import MqttSettings

GATEWAY = "works/gateway", b"offline"
THERE = {"pump-1"}


def heard(*messages: tuple[str, bytes], prefix: str = "works") -> list[str]:
    """Return the topics that a gateway with one pump deletes when it receives these retained messages."""
    left_behind = RetainedTopics(prefix, home_assistant=True)
    return [topic for message in messages for topic in left_behind.hear(*message, THERE)]


def configuration(state_topic: object) -> bytes:
    return json.dumps({"state_topic": state_topic}).encode()


def test_topics_of_a_removed_drive_are_deleted_in_any_message_order() -> None:
    messages = [
        ("works/old fan/available", b"online"),
        ("homeassistant/device/works-old_20_fan/config", configuration("works/old fan")),
    ]
    expected = ["works/old fan", *(topic for topic, _ in messages)]
    assert heard(GATEWAY, *messages) == expected
    assert heard(*messages, GATEWAY) == expected


def test_retained_messages_of_present_drives_are_kept() -> None:
    mine = [
        ("works/pump-1/available", b"online"),
        ("homeassistant/device/works-pump-1/config", configuration("works/pump-1")),
    ]
    assert heard(GATEWAY, *mine) == []
    back = RetainedTopics("works", home_assistant=True)
    assert back.hear("works/old/available", b"offline", THERE) == []
    assert back.hear(*GATEWAY, {*THERE, "old"}) == []  # meanwhile, a reload has added the drive "old"


def test_no_topic_is_deleted_while_another_gateway_uses_the_prefix() -> None:
    old = ("works/old/available", b"online")
    assert heard(("works/gateway", b"online"), old) == []
    assert heard(old) == []


@table(
    ("topic", "payload"),
    [
        ("works/available", b"online"),
        ("works//available", b"online"),
        ("works/a/b/available", b"online"),
        ("workshop/old/available", b"online"),
        ("elsewhere/old/available", b"online"),
        # values of a drive named "available", from a gateway with the prefix works/old
        ("works/old/available", b'{"state": "runs"}'),
        ("works/old/available", b""),
        ("works/old", b"online"),
        ("available", b"online"),
        ("", b"offline"),
        ("homeassistant/device/works-old/config", b"online"),
        ("homeassistant/device/works-old/config", configuration("other/old")),
        # from a gateway with the prefix works-hall
        ("homeassistant/device/works-hall-fan/config", configuration("works-hall/fan")),
        ("homeassistant/device/works-old/config", configuration("works/new")),
        ("homeassistant/device/works-old/config", configuration(["works/old"])),
        ("homeassistant/device/works-old/config", b"[" * 100_000),
        ("homeassistant/device/works-old/config", configuration("works/old") + b" " * MOST_DISCOVERY),
        ("homeassistant/device/works-old/other", configuration("works/old")),
        ("homeassistant/sensor/works-old/config", configuration("works/old")),
    ],
)
def test_topics_of_other_gateways_and_unknown_topics_are_kept(topic: str, payload: bytes) -> None:
    assert heard(GATEWAY, (topic, payload)) == []


def test_the_number_of_examined_retained_messages_is_limited() -> None:
    drives = [(f"works/{number}/available", b"online") for number in range(10 * MOST_KEPT)]
    assert len(heard(GATEWAY, *drives)) == 2 * MOST_KEPT
    left_behind = RetainedTopics("works", home_assistant=True)
    for topic, payload in [*drives, *drives]:
        left_behind.hear(topic, payload, THERE)
    assert len(left_behind.hear(*GATEWAY, THERE)) == 2 * MOST_KEPT
    left_behind.begin()
    assert len([*left_behind.hear(*GATEWAY, THERE), *left_behind.hear(*drives[-1], THERE)]) == 2


def kept_at(broker: Broker) -> set[str]:
    """Return the topics for which the broker has a retained message."""
    listener = Listener(broker)
    publish(broker, "the/end", b"x", "-q", "1")
    listener.wait_for(lambda received: received.topic == "the/end")
    listener.close()
    return {received.topic for received in listener.all if received.is_retained}


def live_and_die(broker: Broker, folder: Path, listener: Listener) -> None:
    """Let a gateway with two drives publish all its messages, then cut its connection for good."""
    part: Any = build(MqttSettings(broker.address, home_assistant=True), inside(folder))
    with closing(Running(part)) as running:
        listener.wait_for(lambda one: one.topic == "multidrop/pump-1/available")
        listener.wait_for(lambda one: one.topic == f"multidrop/{FAN.name}/available")
        part._brokers[0]._client.reconnect_delay_set(3600, 3600)
        running.cut(0)
        listener.wait_for(lambda one: (one.topic, one.payload) == ("multidrop/gateway", b"offline"))


def test_retained_messages_of_a_killed_gateway_are_deleted(broker: Broker, tmp_path: Path) -> None:
    for topic in ("elsewhere/old/available", "multidrop/hall/old/available"):
        publish(broker, topic, b"online", "-r")
    foreign = discovery_topic("multidrop", "old")
    publish(broker, foreign, configuration("elsewhere/old"), "-r")
    with closing(Listener(broker)) as listener:
        live_and_die(broker, tmp_path, listener)
        fan = f"multidrop/{FAN.name}"
        topics = {fan, f"{fan}/available", discovery_topic("multidrop", FAN.name)}
        assert topics < kept_at(broker)
        known: Any = inside(tmp_path)
        less = without_fan(known)
        part = build(MqttSettings(broker.address, home_assistant=True), known._replace(plant=less))
        with closing(Running(part)):
            waited = set(topics)
            while waited:
                waited.discard(listener.wait_for(lambda one: one.topic in waited and not one.payload).topic)
            assert kept_at(broker) == {
                *("elsewhere/old/available", "multidrop/hall/old/available", foreign),
                *("multidrop/gateway", "multidrop/alarms", "multidrop/pump-1", "multidrop/pump-1/available"),
                discovery_topic("multidrop", "pump-1"),
            }


SERVE = """[serve.may]
stop = "anyone"
write = ["pump-1.setpoint"]
verbs = ["pump-1.start"]
[serve.mqtt]
broker = "{}"
commands = true
"""


@pytest.mark.long
def test_a_delayed_start_from_the_broker_is_refused_after_a_stop(tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    with mosquitto(tmp_path) as broker, served(tmp_path, SERVE.format(broker.address)) as gateway:
        listener = Listener(broker, "multidrop/#")
        options = ["-p", str(broker.port), "-t", "multidrop/pump-1/act", "-l"]
        program = require_program("mosquitto_pub")
        publisher = subprocess.Popen([program, *options], stdin=subprocess.PIPE, text=True)
        assert publisher.stdin

        def start() -> None:
            assert publisher.stdin
            sent = {"verb": "start", "drive": "pump-1", "time": time.time_ns() // 1_000_000}
            publisher.stdin.write(json.dumps(sent) + "\n")
            publisher.stdin.flush()

        def told() -> str:
            found = listener.wait_for(lambda one: one.topic == "multidrop/pump-1/told")
            return str(found.json["text"])

        motor = gateway.sims["pump-1"].motor  # type: ignore[attr-defined]
        try:
            listener.wait_for(lambda one: one.topic == "multidrop/gateway" and one.payload == b"online")
            assert gateway.write("pump-1", "setpoint", 50.0)["done"] is True
            start()
            assert told() == "pump-1: start is done"
            until(lambda: motor.goal)

            broker.signal(signal.SIGSTOP)
            start()
            assert gateway.post("/api/stop").json["pump-1"]["done"] is True
            broker.signal(signal.SIGCONT)
            assert told().startswith("not sent: the command ")
            assert not motor.goal
        finally:
            broker.signal(signal.SIGCONT)
            publisher.stdin.close()
            publisher.wait()
            listener.close()


CHANNEL = """
[[line.drive.channel]]
name = "half"
value = "output_frequency / 2 + 25"
unit = "Hz"
[[serve.limit]]
drive = "pump-2"
register = "half"
above = 10
[serve.mqtt]
broker = "{}"
rows = true
"""


@pytest.mark.long
def test_values_and_alarms_of_a_computed_channel_are_published(tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    with (
        mosquitto(tmp_path) as broker,
        served(tmp_path, CHANNEL.format(broker.address)),
        closing(Listener(broker, "multidrop/#")) as listener,
    ):
        listener.wait_for(
            lambda one: one.topic == "multidrop/pump-2" and one.json["values"].get("half") == 25.0
        )
        found = listener.wait_for(lambda one: one.topic.endswith("/rows") and b'"half"' in one.payload)
        row = next(row for row in found.json["rows"] if row["register"] == "half")
        assert (row["drive"], row["value"], row["unit"], row["status"]) == ("pump-2", 25.0, "Hz", "ok")
        with closing(Listener(broker, "multidrop/#")) as later:
            found = later.wait_for(lambda one: one.topic == "multidrop/alarms" and one.payload != b"[]")
        [alarm] = found.json
        assert (alarm["drive"], alarm["kind"]) == ("pump-2", "limit")
        assert "half above 10 Hz" in alarm["text"]


# ---- the Node-RED flow in the documentation uses only topics of the gateway ----


PAGES = Path(__file__).parents[3] / "docs" / "gateway"
FLOW: list[dict[str, Any]] = json.loads((PAGES / "node-red-flow.json").read_text("utf-8"))


def topics_of(kind: str) -> list[str]:
    return [node["topic"] for node in FLOW if node["type"] == kind]


def test_the_gateway_uses_each_topic_of_the_node_red_flow(tmp_path: Path) -> None:
    matches = require_module("paho.mqtt.client").topic_matches_sub
    topics = JsonTopics(MqttSettings(commands=True), inside(tmp_path), lambda: 7)
    put_in: list[Any] = []
    topics.outbox = SimpleNamespace(put=put_in.append)
    topics.connected()
    topics._report("pump-1", "stop", CommandResult(CommandOutcome.DONE, "stopped"), "id")
    published = [
        *(one.topic for one in put_in),
        "multidrop/pump-1/rows",
    ]  # test_sparkplug.py tests the topic of rows
    taken = [topic for topic, _ in topics.topics()]
    assert len(topics_of("mqtt in")) == 4
    for topic in topics_of("mqtt in"):
        assert any(matches(topic, one) for one in published), topic
    assert len(topics_of("mqtt out")) == 2
    for topic in topics_of("mqtt out"):
        assert any(matches(one, topic) for one in taken), topic


def test_the_command_of_the_node_red_flow_is_a_valid_write() -> None:
    [rule] = next(node["rules"] for node in FLOW if node["type"] == "change")
    given = json.loads(rule["to"].replace("$millis()", "1795262400000"))
    assert _read_write(given) == (25, 1_795_262_400_000)


def test_the_node_red_flow_is_complete_and_its_page_lists_the_topics() -> None:
    ids = {node["id"] for node in FLOW}
    assert {to for node in FLOW for wire in node.get("wires", []) for to in wire} <= ids
    assert {
        node[key] for node in FLOW for key in ("z", "broker") if node["type"] != "mqtt-broker" and key in node
    } <= ids
    page = (PAGES / "node-red.md").read_text("utf-8")
    assert all(f"| `{topic}` |" in page for topic in topics_of("mqtt in") + topics_of("mqtt out"))
