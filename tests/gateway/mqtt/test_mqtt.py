"""MQTT through a real broker: mosquitto's own clients receive values and send commands."""

from __future__ import annotations

import asyncio
import json
import signal
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from brokers import FAN, WITH_NATS, Broker, Listener, Running, Start, has, inside, publish, without_fan
from free_ports import free_port
from gateways import certificate, served
from lines import until
from peers import require_module
from tables import in_turn

from multidrop import Drive, InvtCHE, PolledDrive
from multidrop.control import CommandOutcome, CommandResult
from multidrop.core import boottime_ns
from multidrop.gateway.http.rights import COMMAND_ID
from multidrop.gateway.mqtt.broker import MOST_UNDER_WAY
from multidrop.gateway.mqtt.home_assistant import discovery_topic
from multidrop.gateway.mqtt.json_topics import JsonTopics
from multidrop.gateway.mqtt.part import build
from multidrop.gateway.mqtt.settings import MqttSettings
from multidrop.plant import RESERVED_NAMES

STOPS = ["coast", "emergency_stop", "stop"]


def now_ms() -> int:
    return time.time_ns() // 1_000_000


def now_on_both_clocks() -> tuple[int, int]:
    """Return UTC in ms and CLOCK_BOOTTIME in ns, read within 10 ms of each other."""
    while True:
        boot_ns, utc_ms = boottime_ns(), now_ms()
        if boottime_ns() - boot_ns < 10_000_000:
            return utc_ms, boot_ns


@WITH_NATS
def test_the_mqtt_broker_retains_the_newest_values(
    broker: Broker, listener: Listener, start: Start, fan: Drive
) -> None:
    start()
    listener.wait_for(has("multidrop/gateway", b"online"))
    listener.wait_for(has(f"multidrop/{fan.name}/available", b"online"))
    with closing(Listener(broker)) as later:
        said = later.wait_for(has("multidrop/pump-1"))
    assert said.is_retained
    assert said.json == {
        "time": 7,
        "state": "runs",
        "fault": None,
        "values": {"output_frequency": 49.5, "status": "FORWARD"},
    }


def test_mqtt_shows_stale_values_as_null_and_silent_drives_as_offline(
    listener: Listener, start: Start
) -> None:
    known, running = start()
    listener.wait_for(has("multidrop/pump-1/available", b"online"))
    known.hub.values[("pump-1", "output_frequency")] = None
    known.hub.states["pump-1"] = "silent"
    running.step()
    listener.wait_for(has("multidrop/pump-1/available", b"offline"))
    said = [received for received in listener.all if received.topic == "multidrop/pump-1"][-1]
    assert said.json["values"]["output_frequency"] is None


@WITH_NATS
def test_the_broker_retains_the_message_offline_after_a_lost_connection(
    broker: Broker, listener: Listener, start: Start
) -> None:
    _, running = start()
    listener.wait_for(has("multidrop/gateway", b"online"))
    running._part._brokers[0]._client.reconnect_delay_set(3600, 3600)
    running.cut(0)
    listener.wait_for(has("multidrop/gateway", b"offline"))
    with closing(Listener(broker)) as later:
        assert later.wait_for(has("multidrop/gateway")) == ("multidrop/gateway", True, b"offline")


def test_messages_without_a_connection_are_counted_as_dropped(tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    part: Any = build(MqttSettings(f"mqtt://127.0.0.1:{free_port()}", sparkplug="works"), inside(tmp_path))
    with closing(Running(part)) as running:
        of_json, of_sparkplug = (broker.outbox for broker in part._brokers)
        assert (of_json.dropped, of_sparkplug.dropped) == (0, 0)
        running.step()
        # JSON has one message for each of two drives; Sparkplug sends only changes
        assert (of_json.dropped, of_sparkplug.dropped) == (2, 0)
        for frequency in (1.0, 2.0):
            part._formats[0]._hub.values["pump-1", "output_frequency"] = frequency
            running.step()
        assert (of_json.dropped, of_sparkplug.dropped) == (6, 1)
        (dropped,) = (one for one in part.figures() if one.name == "multidrop_mqtt_dropped")
        assert [value for _, _, value in dropped.samples] == [7]


def test_closing_the_gateway_publishes_offline(broker: Broker, listener: Listener, tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    running = Running(build(MqttSettings(broker.address), inside(tmp_path)))
    listener.wait_for(has("multidrop/gateway", b"online"))
    running.close()
    listener.wait_for(has("multidrop/gateway", b"offline"))
    for drive in ("pump-1", FAN.name):  # each drive goes offline, because the next plant file may not have it
        listener.wait_for(has(f"multidrop/{drive}/available", b"offline"))


def test_a_stop_is_carried_out_while_publishing_fails(
    broker: Broker, listener: Listener, start: Start
) -> None:
    """Without "offline", the values that the broker retains would look current."""
    known, running = start(commands=True)
    listener.wait_for(has("multidrop/gateway", b"online"))
    state = known.hub.states.pop("pump-1")
    running.step()
    listener.wait_for(has("multidrop/gateway", b"offline"))
    assert running._part.health() == "publishing fails: KeyError: 'pump-1'"
    running.step()  # does not publish "offline" again
    publish(broker, "multidrop/pump-1/stop", b"now")
    listener.wait_for(has("multidrop/pump-1/told"))
    assert known.commands.noted == [("stop", ["pump-1"])]
    known.hub.states["pump-1"] = state
    running.step()
    listener.wait_for(has("multidrop/gateway", b"online"))
    listener.wait_for(has("multidrop/pump-1/available", b"online"))
    assert running._part.health() == ""
    said = [one.payload for one in listener.all if one.topic == "multidrop/gateway"]
    assert said == [b"online", b"offline", b"online"]


@pytest.mark.slow
def test_offline_is_published_if_publishing_fails_after_a_reconnection(
    listener: Listener, start: Start
) -> None:
    known, running = start()
    listener.wait_for(has("multidrop/gateway", b"online"))
    state = known.hub.states.pop("pump-1")
    running.cut(0)
    # the will message, the reconnection, the failed publication
    for said in (b"offline", b"online", b"offline"):
        listener.wait_for(has("multidrop/gateway", said))
    known.hub.states["pump-1"] = state
    running.step()
    listener.wait_for(has("multidrop/gateway", b"online"))
    listener.wait_for(has("multidrop/pump-1/available", b"online"))


@pytest.mark.slow
def test_publishing_never_waits_for_a_frozen_broker(broker: Broker, listener: Listener, start: Start) -> None:
    known, running = start()
    listener.wait_for(has(f"multidrop/{FAN.name}/available", b"online"))
    broker.signal(signal.SIGSTOP)
    [connection] = running._part._brokers
    for round in range(500):
        known.hub.values[("pump-1", "output_frequency")] = float(round)
        running.step()
    assert len(connection.outbox._under_way) <= MOST_UNDER_WAY
    assert len(connection.outbox._waiting) <= 4
    broker.signal(signal.SIGCONT)
    listener.wait_for(
        lambda received: (
            received.topic == "multidrop/pump-1" and received.json["values"]["output_frequency"] == 499.0
        )
    )
    figures = {family.name: list(family.samples) for family in running._part.figures()}
    assert figures["multidrop_mqtt_dropped"][0][2] > 0


@pytest.mark.slow
def test_messages_are_published_again_after_the_broker_restarts(
    broker: Broker, listener: Listener, start: Start
) -> None:
    start()
    listener.wait_for(has("multidrop/gateway", b"online"))
    broker.kill()
    broker.start()
    with closing(Listener(broker)) as again:
        again.wait_for(has("multidrop/gateway", b"online"))
        again.wait_for(has("multidrop/pump-1"))


@pytest.fixture
def commanded(listener: Listener, start: Start) -> Any:
    """The context of an MQTT part that is online and carries out commands."""
    known, _ = start(commands=True)
    listener.wait_for(has("multidrop/gateway", b"online"))
    return known


def told(listener: Listener, drive: str = "pump-1") -> Any:
    return listener.wait_for(has(f"multidrop/{drive}/told")).json


def write_of(value: object, time_ms: int, **more: object) -> bytes:
    return json.dumps({"value": value, "time": time_ms, **more}).encode()


@WITH_NATS
def test_a_repeated_mqtt_write_is_carried_out_once(
    broker: Broker, listener: Listener, commanded: Any
) -> None:
    fresh = write_of(25, now_ms(), id="order-7")
    publish(broker, "multidrop/pump-1/set/setpoint", fresh)
    assert told(listener) == {"what": "setpoint = 25", "done": True, "text": "done", "id": "order-7"}
    publish(broker, "multidrop/pump-1/set/setpoint", fresh)
    assert told(listener)["text"] == "not sent: the command is a copy of an earlier one"
    assert commanded.commands.noted == [("write", "pump-1", "setpoint", 25)]


@pytest.mark.parametrize("age_ms", [60_000, -60_000])
@WITH_NATS
def test_an_mqtt_command_is_refused_if_its_time_is_wrong_by_a_minute(
    broker: Broker, listener: Listener, commanded: Any, age_ms: int
) -> None:
    sent_ms = now_ms() - age_ms
    publish(broker, "multidrop/pump-1/set/setpoint", write_of(25, sent_ms))
    assert "s ago by the clocks of sender and gateway" in told(listener)["text"]
    act = json.dumps({"verb": "start", "drive": "pump-1", "time": sent_ms}).encode()
    publish(broker, "multidrop/pump-1/act", act)
    assert "s ago by the clocks of sender and gateway" in told(listener)["text"]
    assert commanded.commands.noted == []


@pytest.mark.parametrize("topic", ["multidrop/pump-1/set/setpoint", "multidrop/pump-1/act"])
@WITH_NATS
def test_a_retained_command_is_refused(broker: Broker, listener: Listener, start: Start, topic: str) -> None:
    sent = {"value": 25, "verb": "start", "drive": "pump-1", "time": now_ms() + 1000}
    publish(broker, topic, json.dumps(sent).encode(), "-r")
    known, _ = start(commands=True)
    assert told(listener)["text"].startswith("not sent: it was retained")
    assert known.commands.noted == []


@pytest.mark.slow
@WITH_NATS
def test_a_stop_is_carried_out_on_each_stop_topic(
    broker: Broker, listener: Listener, start: Start, fan: Drive
) -> None:
    publish(broker, "multidrop/pump-1/stop", b"stop", "-r")
    known, _ = start(commands=True)
    assert told(listener)["what"] == "stop"
    publish(broker, "multidrop/stop", b"whatever")
    assert told(listener)["what"] == "stop"
    publish(broker, f"multidrop/{fan.name}/stop", b"stop", "-q", "1")
    assert told(listener, fan.name)["what"] == "stop"
    assert known.commands.noted[-3:] == [("stop", ["pump-1"]), ("stop", None), ("stop", [fan.name])]


@pytest.mark.parametrize(
    ("topic", "payload", "stopped"),
    [
        ("pump-1/stop", b"x" * 70_000, ["pump-1"]),
        ("stop", b"\xff" * 70_000, None),
        ("pump-1/act", b'{"verb": "stop", "drive": "pump-1", "time": 17', ["pump-1"]),
        ("pump-1/act", b'{"verb": "coast", "note": "' + b"x" * 70_000 + b'"}', ["pump-1"]),
        ("pump-1/act", b'["emergency_stop", "\xff"]', ["pump-1"]),
    ],
    ids=range(5),
)
def test_a_stop_is_carried_out_whatever_its_payload(
    broker: Broker, listener: Listener, commanded: Any, topic: str, payload: bytes, stopped: list[str] | None
) -> None:
    """The payloads are too long, truncated, or not valid text."""
    publish(broker, f"multidrop/{topic}", payload)
    assert told(listener)["what"] == "stop"
    assert commanded.commands.noted == [("stop", stopped)]


@pytest.mark.parametrize(
    ("more", "verb"),
    in_turn(
        [
            {"time": 1},
            {"time": 10**15},
            {"time": "now"},
            {"drive": "pump-1"},
            {},
            {"options": None},
            {"options": [1]},
        ],
        STOPS,
    ),
)
def test_a_stop_verb_is_carried_out_whatever_its_time_and_options(
    broker: Broker, listener: Listener, commanded: Any, verb: str, more: dict[str, Any]
) -> None:
    commanded.commands.stopped_at["pump-1"] = commanded.commands.plant_ns = boottime_ns()
    for _ in range(2):
        publish(broker, "multidrop/pump-1/act", json.dumps({"verb": verb, "id": [], **more}).encode())
        answer = told(listener)
        assert COMMAND_ID.fullmatch(answer.pop("id"))  # the gateway replaced the invalid id by its own
        assert answer == {"what": verb, "done": True, "text": "done"}
    assert commanded.commands.noted == [("act", "pump-1", verb, {})] * 2


def test_a_retained_stop_verb_is_carried_out(broker: Broker, listener: Listener, start: Start) -> None:
    publish(broker, "multidrop/pump-1/act", b'{"verb": "coast", "drive": "pump-1", "time": 1}', "-r")
    known, _ = start(commands=True)
    assert told(listener)["done"]
    assert known.commands.noted == [("act", "pump-1", "coast", {})]


@pytest.mark.parametrize(
    ("named", "verb"),
    in_turn([FAN.name, "no-such-drive", "pump-1", 7, ["pump-1"], {}, None, "", "#", "pump-1/+"], STOPS),
)
def test_a_stop_verb_stops_the_drive_of_its_topic_and_the_drive_in_its_payload(
    broker: Broker, listener: Listener, commanded: Any, verb: str, named: object
) -> None:
    publish(broker, "multidrop/pump-1/act", json.dumps({"verb": verb, "drive": named, "time": 1}).encode())
    assert told(listener)["done"]
    others = [("act", FAN.name, verb, {})] if named == FAN.name else []
    if others:
        assert told(listener, FAN.name)["done"]
    assert commanded.commands.noted == [("act", "pump-1", verb, {}), *others]


@pytest.mark.parametrize(
    ("topic", "named", "stopped"),
    [
        ("pump-1", "Lu\u0308fter", ["pump-1", "L\u00fcfter"]),
        ("Lu\u0308fter", "L\u00fcfter", ["Lu\u0308fter"]),  # two Unicode spellings of the same name
        ("L\u00fcfter", "Lu\u0308fter", ["L\u00fcfter"]),
    ],
)
async def test_a_stop_verb_finds_drives_by_another_unicode_spelling(
    tmp_path: Path, topic: str, named: str, stopped: list[str]
) -> None:
    known = inside(tmp_path, InvtCHE(2, name="L\u00fcfter"))
    topics = JsonTopics(MqttSettings("mqtt://localhost", commands=True), known, now_ms)
    topics.outbox = SimpleNamespace(put=lambda publication: None)
    order = json.dumps({"verb": "coast", "drive": named}).encode()
    topics.received(f"multidrop/{topic}/act", order, is_retained=False)
    while len(known.commands.noted) < len(stopped):
        await asyncio.sleep(0)
    assert known.commands.noted == [("act", drive, "coast", {}) for drive in stopped]


def test_a_command_is_refused_if_its_verb_is_not_a_text(
    broker: Broker, listener: Listener, commanded: Any
) -> None:
    publish(broker, "multidrop/pump-1/act", b'{"verb": ["coast"], "drive": "pump-1", "time": 1}')
    assert not told(listener)["done"]
    assert commanded.commands.noted == []


def test_an_mqtt_command_sent_before_a_reload_is_refused(
    broker: Broker, listener: Listener, commanded: Any
) -> None:
    """After a reload, the drive's name may mean another drive."""
    for after_ms, text in (
        (1900, "not sent: the command may have been sent before the plant"),
        (2500, "done"),
    ):
        sent_ms, sent_ns = now_on_both_clocks()
        commanded.commands.plant_ns = sent_ns - after_ms * 1_000_000
        publish(broker, "multidrop/pump-1/set/setpoint", write_of(25, sent_ms))
        assert told(listener)["text"].startswith(text)


@pytest.mark.parametrize(("after_ms", "is_taken"), [(-3000, False), (0, False), (1900, False), (2500, True)])
def test_a_command_sent_before_a_stop_is_refused(
    broker: Broker, listener: Listener, commanded: Any, after_ms: int, is_taken: bool
) -> None:
    """A broker may deliver a delayed command after a stop. The sender's clock may be up to 2 s fast."""
    sent_ms, sent_ns = now_on_both_clocks()
    commanded.commands.stopped_at["pump-1"] = sent_ns - after_ms * 1_000_000
    for topic, payload in (
        ("act", {"verb": "start", "drive": "pump-1", "time": sent_ms}),
        ("set/setpoint", {"value": 25, "time": sent_ms}),
    ):
        publish(broker, f"multidrop/pump-1/{topic}", json.dumps(payload).encode())
        assert told(listener)["text"].startswith(
            "done" if is_taken else "not sent: the command may have been sent before"
        )
    act = {"verb": "emergency_stop", "drive": "pump-1", "time": sent_ms}
    publish(broker, "multidrop/pump-1/act", json.dumps(act).encode())
    assert told(listener)["text"] == "done"
    assert len(commanded.commands.noted) == (3 if is_taken else 1)


def test_a_command_is_refused_if_it_names_another_drive_or_its_options_are_a_list(
    broker: Broker, listener: Listener, commanded: Any
) -> None:
    act = {"verb": "start", "drive": "pump-1", "options": {"direction": "forward"}, "time": now_ms()}
    publish(broker, f"multidrop/{FAN.name}/act", json.dumps(act).encode())
    assert "the message names drive 'pump-1'" in told(listener, FAN.name)["text"]
    publish(broker, "multidrop/pump-1/act", json.dumps({**act, "options": ["forward"]}).encode())
    assert "key 'options' is not a JSON object" in told(listener)["text"]
    publish(broker, "multidrop/pump-1/act", json.dumps(act).encode())
    listener.wait_for(lambda one: one.topic == "multidrop/pump-1/told" and one.json["done"])
    assert commanded.commands.noted == [("act", "pump-1", "start", {"direction": "forward"})]


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (b"25", "the message is not a JSON object"),
        (b'{"value": 25}', "time is missing"),
        (b'{"time": 25}', "value is missing"),
        (b'{"value": "25", "time": 1}', "key 'value' is '25', not a number"),
        (b'{"value": true, "time": 1}', "key 'value' is True, not a number"),
        (b'{"value": 25, "time": "1"}', "key 'time' is not a whole number of ms"),
        (b"\xc3\x28", "codec"),
        (b"[" * 60_000, "nested too deeply"),
        (b'{"value": 25, "time": 1}' + b" " * 70_000, "the message has 70024 bytes"),
    ],
)
def test_invalid_commands_are_answered_with_the_reason(
    broker: Broker, listener: Listener, commanded: Any, payload: bytes, why: str
) -> None:
    publish(broker, "multidrop/pump-1/set/setpoint", payload)
    assert why in told(listener)["text"]
    assert commanded.commands.noted == []


@pytest.mark.parametrize(("drive", "verb"), [("pump-1", "\ud800"), ("x" * 65_521, "")])
def test_other_messages_are_sent_if_one_answer_cannot_be_sent(
    broker: Broker, listener: Listener, start: Start, drive: str, verb: str
) -> None:
    """One answer has a verb that is not UTF-8; the other has a topic of 65,536 bytes, too long for MQTT."""
    known, running = start(commands=True)
    listener.wait_for(has("multidrop/gateway", b"online"))
    outbox = running._part._brokers[0].outbox
    before = outbox.dropped
    command = {"verb": verb, "drive": "pump-1", "time": now_ms()}
    publish(broker, f"multidrop/{drive}/act", json.dumps(command).encode())
    until(lambda: outbox.dropped > before)
    known.hub.values[("pump-1", "output_frequency")] = 50.0
    running.step()
    listener.wait_for(
        lambda one: one.topic == "multidrop/pump-1" and one.json["values"]["output_frequency"] == 50.0
    )


def test_an_infinite_value_is_published_as_null(listener: Listener, start: Start) -> None:
    """JSON has no infinity, so a reader would have to reject the whole message."""
    known, running = start()
    listener.wait_for(has("multidrop/pump-1"))
    known.hub.values[("pump-1", "output_frequency")] = float("inf")
    running.step()
    said = listener.wait_for(lambda one: one.topic == "multidrop/pump-1" and b"49.5" not in one.payload)
    assert b'"output_frequency": null' in said.payload


def test_no_topic_of_drive_commands_is_subscribed_if_commands_are_disabled(tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    part: Any = build(MqttSettings(sparkplug="works", node="line"), inside(tmp_path))
    assert [messages.topics() for messages in part._formats] == [
        # for finding retained topics of removed drives
        [("multidrop/gateway", 0), ("multidrop/+/available", 0)],
        [("spBv1.0/works/NCMD/line", 1)],
    ]


@pytest.mark.parametrize("is_retained", [False, True])
async def test_mqtt_commands_are_ignored_if_commands_are_disabled(tmp_path: Path, is_retained: bool) -> None:
    """A broker may send messages of topics to which the gateway has not subscribed."""
    require_module("paho.mqtt.client")
    known = inside(tmp_path)
    part: Any = build(MqttSettings(sparkplug="works", node="line"), known)
    stop = {"verb": "stop", "time": now_ms()}
    for topic, payload in (
        ("multidrop/stop", b"stop"),
        ("multidrop/pump-1/stop", b"stop"),
        ("multidrop/pump-1/act", json.dumps(stop).encode()),
        ("multidrop/pump-1/set/setpoint", write_of(12.5, now_ms())),
        ("multidrop", b"stop"),
        ("elsewhere", b""),
    ):
        part._formats[0].received(topic, payload, is_retained=is_retained)
    for topic in ("spBv1.0/works/DCMD/line/pump-1", "spBv1.0", "multidrop/stop"):
        part._formats[1].received(topic, b"Device Control/Stop", is_retained=is_retained)
    await asyncio.sleep(0)
    assert known.commands.noted == []


def test_all_mistakes_in_the_mqtt_settings_are_reported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="broker = ") as told:
        MqttSettings("http://x", prefix="a/+", every="soon", sparkplug="a/b", node="#")
    sentences = str(told.value).splitlines()
    assert len(sentences) == 5
    assert sentences[0].startswith('broker = "http://x" is not a broker\'s URL; write one such as "mqtt://')


def test_invalid_certificate_authorities_are_reported_before_polling_starts(tmp_path: Path) -> None:
    certificate(tmp_path, "own")
    (tmp_path / "text.pem").write_text("no certificate\n", "ascii")
    plant = inside(tmp_path).plant
    for name, told in (
        ("own.pem", []),
        ("own.key", [f'authorities = "own.key": {tmp_path}/own.key has no certificates in PEM']),
        ("text.pem", [f'authorities = "text.pem": {tmp_path}/text.pem has no certificates in PEM']),
        ("none.pem", [f'authorities = "none.pem": there is no file {tmp_path}/none.pem']),
    ):
        settings = MqttSettings("mqtts://broker", authorities=name)
        assert [one for one in settings.check(plant) if "authorities" in one] == told


def test_a_drive_name_that_cannot_be_a_topic_is_reported(tmp_path: Path) -> None:
    plant = inside(tmp_path).plant
    odd = tuple(PolledDrive(InvtCHE(3, name=name), ()) for name in ("a/b", "fine", "gateway", "stop"))
    plant = replace(plant, lines=(replace(plant.lines[0], drives=odd),))
    assert [*MqttSettings(password="secret").check(plant)] == [
        f'password = "secret": there is no file {tmp_path}/secret',
        "drive 'a/b' cannot be a topic: choose a name without + # and /",
        *(
            f'drive {name!r}: name "{name}" is reserved for {RESERVED_NAMES[name]}; give it another name'
            for name in ("gateway", "stop")
        ),
    ]


@pytest.mark.parametrize(
    "topics", [{"prefix": "homeassistant/x"}, {"prefix": "spBv1.0"}, {"sparkplug": "STATE"}]
)
def test_reserved_topics_in_the_mqtt_settings_are_refused(topics: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=r"reserved topic|another group"):
        MqttSettings(**topics)


def test_a_plant_file_name_that_sparkplug_forbids_is_reported(tmp_path: Path) -> None:
    plant = replace(inside(tmp_path).plant, path=tmp_path / "a+b.toml")
    assert [*MqttSettings().check(plant)] == []
    assert [*MqttSettings(sparkplug="works", node="hall").check(plant)] == []
    (sentence,) = MqttSettings(sparkplug="works").check(plant)
    assert sentence == "the plant file's name 'a+b' cannot be an edge node; add node = \"hall-1\""


def test_words_of_mqtt_topics_are_not_allowed_as_drive_names(tmp_path: Path) -> None:
    topics = JsonTopics(MqttSettings(commands=True), inside(tmp_path), now_ms)
    put_in: list[Any] = []
    topics.outbox = SimpleNamespace(put=put_in.append)
    topics.connected()
    topics._report(FAN.name, "stop", CommandResult(CommandOutcome.DONE, "done"), "an-id")
    said = {message.topic for message in put_in} | {topic for topic, _ in topics.topics()}
    words = {word for topic in said for word in topic.removeprefix("multidrop/").split("/")}
    ours = words - {"+", FAN.name, "pump-1"}
    assert ours == {"gateway", "alarms", "stop", "act", "set", "available", "told"}
    assert ours <= RESERVED_NAMES.keys()


@pytest.mark.slow
def test_metrics_count_sent_mqtt_messages(broker: Broker, tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    with served(tmp_path, f'[serve.mqtt]\nbroker = "{broker.address}"\n') as gateway:

        def figures() -> dict[str, float]:
            lines = gateway.get("/metrics").body.decode().splitlines()
            found = [line.split() for line in lines if line.startswith("multidrop_mqtt_")]
            return {name.removeprefix("multidrop_mqtt_"): float(value) for name, value in found}

        until(lambda: figures().get("connected") == 1.0 and figures()["sent_total"] > 3)
        assert figures().keys() == {"sent_total", "dropped_total", "connected"}
        broker.kill()
        until(lambda: figures()["connected"] == 0.0)


def test_mqtt_metrics_have_help_texts(broker: Broker, tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    with served(tmp_path, f'[serve.history]\n[serve.mqtt]\nbroker = "{broker.address}"\n') as gateway:
        lines = gateway.get("/metrics").body.decode().splitlines()
        told = dict(
            line.removeprefix("# HELP multidrop_").split(" ", 1) for line in lines if "# HELP" in line
        )
        assert told["history_rows_total"] == "Rows written to the history."
        assert told["history_dropped_total"] == "Rows that the history could not take or write."
        assert told["mqtt_sent_total"] == "Messages handed to connections to the broker."
        for word in ("replaced", "no connection", "not acknowledged"):
            assert word in told["mqtt_dropped_total"]
        assert "one more for Sparkplug" in told["mqtt_connected"]


def emptied(put_in: Sequence[Any]) -> set[str]:
    """Return the topics whose retained messages are deleted by these messages."""
    return {one.topic for one in put_in if one.is_retained and one.make() == b""}


def test_topics_of_removed_drives_are_deleted_on_the_next_connection(tmp_path: Path) -> None:
    """A broken connection drops pending deletions, so they must be repeated on the next connection."""
    known = inside(tmp_path)
    whole = known.plant
    topics = JsonTopics(MqttSettings(home_assistant=True), known, now_ms)
    fan = f"multidrop/{FAN.name}"
    expected = {fan, f"{fan}/available", discovery_topic("multidrop", FAN.name)}
    put_in: list[Any] = []
    topics.outbox = SimpleNamespace(put=put_in.append)
    topics.adopt(without_fan(known))
    assert emptied(put_in) == expected
    put_in.clear()
    topics.connected()
    assert emptied(put_in) == expected
    known.hub.names.append(FAN.name)
    put_in.clear()
    topics.adopt(whole)
    topics.connected()
    assert emptied(put_in) == set()


@pytest.mark.parametrize("is_known", [True, False])
def test_no_topic_is_deleted_while_the_plant_has_no_lines(tmp_path: Path, is_known: bool) -> None:
    known = inside(tmp_path)
    plant = known.plant if is_known else replace(known.plant, lines=())
    topics = JsonTopics(MqttSettings(), known._replace(plant=plant), now_ms)
    put_in: list[Any] = []
    topics.outbox = SimpleNamespace(put=put_in.append)
    topics.received("multidrop/gateway", b"offline", is_retained=True)
    topics.received("multidrop/old/available", b"online", is_retained=True)
    assert bool(emptied(put_in)) is is_known


def test_topics_of_removed_drives_are_deleted(broker: Broker, listener: Listener, start: Start) -> None:
    known, running = start(home_assistant=True)
    fan = f"multidrop/{FAN.name}"
    topics = [fan, f"{fan}/available", discovery_topic("multidrop", FAN.name)]
    listener.wait_for(has(topics[1], b"online"))
    running.adopt(without_fan(known))
    for topic in topics:
        listener.wait_for(has(topic, b""))
    listener.wait_for(has(discovery_topic("multidrop", "pump-1")))
    listener.wait_for(has("multidrop/pump-1/available", b"online"))
    with closing(Listener(broker)) as later:
        later.wait_for(has("multidrop/pump-1"))
        running.step()
        told = later.wait_for(lambda received: received.topic in ("multidrop/pump-1", *topics))
        assert told.topic == "multidrop/pump-1"
