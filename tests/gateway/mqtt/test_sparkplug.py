"""A Sparkplug edge node through a real broker: births, data, deaths and rebirths, as a host sees them."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from batches import add_rows, new_completion
from brokers import (
    FAN,
    ROOT,
    WITH_NATS,
    Broker,
    Host,
    Running,
    command,
    inside,
    sparkplug_messages,
    without_fan,
)
from hypothesis import given
from hypothesis import strategies as st
from lines import until
from peers import require_installed, require_module
from profile_families import VfdEl
from tables import table

from multidrop import DelixiModbus, Drive, InvtCHE
from multidrop.core import Columns, Field, Names, NumberFormat, RowLayout
from multidrop.gateway.mqtt.broker import Outbox, Publication
from multidrop.gateway.mqtt.part import build
from multidrop.gateway.mqtt.settings import MqttSettings
from multidrop.gateway.mqtt.sparkplug import STOP, SparkplugNode
from multidrop.gateway.mqtt.sparkplug_payload import (
    DataType,
    Metric,
    ReceivedMetric,
    payload,
    read_command,
)
from multidrop.polling.batch import Batch


@pytest.fixture
def node(broker: Broker, host: Host, fan: Drive, tmp_path: Path) -> Iterator[tuple[Any, Running]]:
    require_module("paho.mqtt.client")
    known = inside(tmp_path, fan)
    settings = MqttSettings(broker.address, sparkplug="works", node="line", commands=True)
    running = Running(build(settings, known))
    yield known, running
    running.close()


@WITH_NATS
def test_a_sparkplug_node_publishes_births_deaths_and_changed_values(
    host: Host, node: tuple[Any, Running], fan: Drive
) -> None:
    known, running = node
    birth = host.values(host.wait_for("NBIRTH"))
    assert birth == {"bdSeq": 0, "Node Control/Rebirth": False}
    assert host.values(host.wait_for("DBIRTH", "pump-1")) == {
        "state": "runs",
        "fault": None,
        "output_frequency": 49.5,
        "status": "FORWARD",
        "setpoint": None,
        "Device Control/Stop": False,
    }
    host.wait_for("DBIRTH", fan.name)
    known.hub.values[("pump-1", "output_frequency")] = 50.0
    running.step()
    assert host.values(host.wait_for("DDATA", "pump-1")) == {"output_frequency": 50.0}
    known.hub.states[fan.name] = "silent"
    running.step()
    host.wait_for("DDEATH", fan.name)
    known.hub.states[fan.name] = "fault"
    known.hub.faults[fan.name] = "перегрев"
    running.step()
    born = host.values(host.wait_for("DBIRTH", fan.name))
    assert (born["state"], born["fault"]) == ("fault", "перегрев")


def test_the_fault_text_is_published_if_the_fault_register_is_not_polled(tmp_path: Path) -> None:
    """The register `fault` of this drive is not polled, and its values have no names."""
    known = inside(tmp_path, VfdEl(2, name="mill"))
    known.hub.states["mill"], known.hub.faults["mill"] = "fault", "it shows a fault"
    node = SparkplugNode(MqttSettings(sparkplug="works", node="line"), known, lambda: 7)
    (birth,) = [given for given in read_command(node._device_birth("mill"))[1] if given.name == "fault"]
    assert birth.value == "it shows a fault"


@pytest.mark.parametrize("family", [VfdEl, InvtCHE, DelixiModbus])
def test_a_register_named_fault_does_not_hide_the_fault_metric(tmp_path: Path, family: type[Drive]) -> None:
    """The metric `fault` is the text of a fault. The register's metric has the type of the register."""
    known = inside(tmp_path, family(2, name="mill"))
    known.hub.states["mill"], known.hub.faults["mill"] = "fault", "it shows a fault"
    register = family.registers["fault"]
    known.hub.polled = lambda drive: (register,) if drive == "mill" else ()
    known.hub.values["mill", "fault"] = 3.0
    node = SparkplugNode(MqttSettings(sparkplug="works", node="line"), known, lambda: 7)
    birth = sparkplug_messages().Payload.FromString(node._device_birth("mill"))
    kinds = {metric.name: metric.datatype for metric in birth.metrics}
    own = DataType.DOUBLE if register.values is None else DataType.STRING
    assert kinds == {"state": DataType.STRING, "fault": DataType.STRING, "registers/fault": own}
    assert {metric.name: metric.string_value for metric in birth.metrics}["fault"] == "it shows a fault"
    assert len({metric.alias for metric in birth.metrics}) == 3


def test_a_birth_certificate_has_the_units_of_metrics(host: Host, node: tuple[Any, Running]) -> None:
    birth = host.wait_for("DBIRTH", "pump-1")
    units = {
        metric.name: dict(
            zip(metric.properties.keys, (one.string_value for one in metric.properties.values), strict=True)
        )
        for metric in birth.metrics
    }
    assert {name: said for name, said in units.items() if said} == {
        "output_frequency": {"engUnit": "Hz"},
        "setpoint": {"engUnit": "%"},
    }
    known, running = node
    known.hub.values[("pump-1", "output_frequency")] = 50.0
    running.step()
    assert not host.wait_for("DDATA", "pump-1").metrics[0].HasField("properties")


def test_unchanged_values_are_not_sent_again(host: Host, node: tuple[Any, Running]) -> None:
    known, running = node
    host.wait_for("DBIRTH", FAN.name)
    for _ in range(5):
        running.step()
    known.hub.states[FAN.name] = "stands"
    running.step()
    host.wait_for("DDATA", FAN.name)
    assert host.kinds.count("DDATA") == 1


@pytest.mark.long
def test_sequence_numbers_of_messages_restart_at_0_after_255(host: Host, node: tuple[Any, Running]) -> None:
    known, running = node
    host.wait_for("DBIRTH", FAN.name)
    for value in range(300):
        known.hub.values[("pump-1", "output_frequency")] = float(value)
        running.step()
        host.wait_for("DDATA", "pump-1")
    assert host.seq is not None
    assert host.seq < 256


@WITH_NATS
def test_a_rebirth_command_repeats_all_birth_certificates(
    broker: Broker, host: Host, node: tuple[Any, Running], fan: Drive
) -> None:
    host.wait_for("DBIRTH", fan.name)
    command(broker, ROOT.format("NCMD"), name="Node Control/Rebirth", boolean_value=True, datatype=11)
    assert host.values(host.wait_for("NBIRTH"))["bdSeq"] == 0
    host.wait_for("DBIRTH", "pump-1")
    host.wait_for("DBIRTH", fan.name)


@pytest.mark.slow
@WITH_NATS
def test_each_sparkplug_connection_has_the_next_bdseq_number(
    host: Host, node: tuple[Any, Running], fan: Drive
) -> None:
    host.wait_for("DBIRTH", fan.name)
    node[1].cut(1)
    assert host.values(host.wait_for("NDEATH")) == {"bdSeq": 0}
    assert host.values(host.wait_for("NBIRTH"))["bdSeq"] == 1
    host.wait_for("DBIRTH", "pump-1")


def test_only_the_newest_pending_certificate_of_a_drive_is_sent(tmp_path: Path) -> None:
    """In Sparkplug, a birth or death certificate says whether a drive is online."""
    known, sent, is_open = inside(tmp_path), [], [True]

    def send(message: Publication) -> int | None:
        if not is_open[0]:
            return None
        sent.append((message.topic.split("/")[2], message.make()))
        return len(sent)

    node = SparkplugNode(MqttSettings(sparkplug="works", node="line"), known, lambda: 7)
    # the test sends fewer messages than MOST_UNDER_WAY, so none waits for acknowledgements
    node.outbox = outbox = Outbox(send)
    node.will()
    node.connected()
    assert [kind for kind, _ in sent] == ["NBIRTH", "DBIRTH", "DBIRTH"]
    is_open[0] = False
    for state in ("silent", "runs", "fault", "silent"):
        known.hub.states["pump-1"] = state
        node.publish()
    is_open[0] = True
    outbox.flush()
    assert [kind for kind, _ in sent[3:]] == ["DDEATH"]
    is_open[0] = False
    for state in ("runs", "silent", "runs", "fault"):
        known.hub.states["pump-1"] = state
        node.publish()
    is_open[0] = True
    outbox.flush()
    assert [kind for kind, _ in sent[4:]] == ["DBIRTH", "DDATA"]


def test_closing_the_gateway_sends_a_death_certificate(broker: Broker, host: Host, tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    settings = MqttSettings(broker.address, sparkplug="works", node="line")
    running = Running(build(settings, inside(tmp_path)))
    host.wait_for("DBIRTH", FAN.name)
    running.close()
    assert host.values(host.wait_for("NDEATH")) == {"bdSeq": 0}


@WITH_NATS
def test_an_old_sparkplug_write_is_not_sent_but_an_old_stop_is(
    broker: Broker, host: Host, node: tuple[Any, Running], fan: Drive
) -> None:
    known, _ = node
    host.wait_for("DBIRTH", "pump-1")
    alias = {name: number for number, name in host.aliases.items()}["setpoint"]
    host.wait_for("DBIRTH", fan.name)
    topic = ROOT.format("DCMD") + "/pump-1"
    old_ms = time.time_ns() // 1_000_000 - 60_000
    command(broker, topic, name="setpoint", double_value=10.0, datatype=10, time_ms=old_ms)
    command(broker, topic, name="status", double_value=1.0, datatype=10)
    command(broker, topic, alias=alias, double_value=25.0, datatype=10)
    command(broker, topic, name="Device Control/Stop", boolean_value=True, datatype=11, time_ms=old_ms)
    ends = time.monotonic() + 30
    while len(known.commands.noted) < 2 and time.monotonic() < ends:
        time.sleep(0.01)
    assert known.commands.noted == [("write", "pump-1", "setpoint", 25.0), ("stop", ["pump-1"])]


@pytest.mark.parametrize("damage", [b"\x0b", b"\x12\x04\x0a\x02\xff\xfe", b"\x12\x7f"])
@pytest.mark.parametrize(
    ("name", "noted"), [(b"Device Control/Stop", [("stop", ["pump-1"])]), (b"setpoint", [])]
)
async def test_a_stop_in_an_invalid_payload_is_carried_out(
    tmp_path: Path, damage: bytes, name: bytes, noted: list[object]
) -> None:
    """A metric is followed by an invalid field, by a name that is not UTF-8, or by a truncated metric."""
    known = inside(tmp_path)
    node = SparkplugNode(MqttSettings(sparkplug="works", node="line", commands=True), known, lambda: 7)
    metric = b"\x0a" + bytes([len(name)]) + name + b"\x70\x01"
    payload = b"\x12" + bytes([len(metric)]) + metric + damage
    node.received(ROOT.format("DCMD") + "/pump-1", payload, is_retained=False)
    await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
    assert known.commands.noted == noted


@pytest.mark.parametrize("is_retained", [False, True])
async def test_a_retained_sparkplug_message_can_stop_but_not_write(
    tmp_path: Path, *, is_retained: bool
) -> None:
    """A broker sends a retained write at each connection, so even a recent one is refused."""
    known = inside(tmp_path)
    node = SparkplugNode(MqttSettings(sparkplug="works", node="line", commands=True), known, lambda: 1_000)
    given = [Metric(DataType.DOUBLE, 25.0, 1_000, "setpoint"), Metric(DataType.BOOLEAN, 1, 1_000, STOP)]
    topic = ROOT.format("DCMD") + "/pump-1"
    node.received(topic, payload(1_000, given, None), is_retained=is_retained)
    await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
    written = [] if is_retained else [("write", "pump-1", "setpoint", 25.0)]
    assert known.commands.noted == [*written, ("stop", ["pump-1"])]


def test_a_reload_publishes_death_and_birth_certificates_of_drives(
    broker: Broker, host: Host, node: tuple[Any, Running]
) -> None:
    known, running = node
    host.wait_for("DBIRTH", FAN.name)
    running.adopt(without_fan(known))
    host.wait_for("DDEATH", FAN.name)
    host.wait_for("NBIRTH")
    host.wait_for("DBIRTH", "pump-1")
    born = len(host.kinds)
    command(broker, ROOT.format("DCMD") + f"/{FAN.name}", name="setpoint", double_value=1.0, datatype=10)
    known.hub.values[("pump-1", "output_frequency")] = 50.0
    running.step()
    assert host.values(host.wait_for("DDATA", "pump-1")) == {"output_frequency": 50.0}
    assert host.kinds[born:] == ["DDATA"]
    assert known.commands.noted == []


# ---- Sparkplug's payloads, against Eclipse's own message definitions and Google's protobuf ----


SPANS: dict[DataType, st.SearchStrategy[Any]] = {
    DataType.INT64: st.integers(-(2**63), 2**63 - 1),
    DataType.DOUBLE: st.floats(),
    DataType.BOOLEAN: st.booleans(),
    DataType.STRING: st.text(),
}
metrics = st.sampled_from(DataType).flatmap(
    lambda kind: st.builds(
        Metric,
        st.just(kind),
        st.none() | SPANS[kind],
        st.integers(0, 2**63),
        st.text(),
        st.none() | st.integers(0, 2**63),
    )
)


def value_of(metric: Any) -> object:
    """Return the value that a Sparkplug host reads from a metric."""
    if metric.is_null:
        return None
    value = getattr(metric, metric.WhichOneof("value"))
    return value - 2**64 if metric.datatype == DataType.INT64 and value >= 2**63 else value


@pytest.mark.long
@given(st.integers(0, 2**63), st.lists(metrics, max_size=5), st.none() | st.integers(0, 255))
def test_a_sparkplug_host_can_decode_all_payloads(time_ms: int, said: list[Metric], seq: int | None) -> None:
    received = sparkplug_messages().Payload.FromString(payload(time_ms, said, seq))
    assert received.timestamp == time_ms
    assert (received.seq if received.HasField("seq") else None) == seq
    for one, metric in zip(received.metrics, said, strict=True):
        assert (one.name, one.timestamp, one.datatype) == (metric.name, metric.time_ms, metric.datatype)
        assert (one.alias if one.HasField("alias") else None) == metric.alias
        found = value_of(one)
        if isinstance(metric.value, float) and math.isnan(metric.value):
            assert isinstance(found, float)
            assert math.isnan(found)
        else:
            assert found == metric.value


@table(
    ("field", "value"),
    [
        ("int_value", 7),
        ("long_value", 7),
        ("double_value", 7.5),
        ("float_value", 0.5),
        ("boolean_value", True),
        ("string_value", "жар"),
    ],
)
def test_a_command_of_a_sparkplug_host_is_decoded(field: str, value: object) -> None:
    messages = sparkplug_messages()
    sent = messages.Payload(timestamp=1234, seq=3)
    sent.metrics.add(name="setpoint", alias=9, datatype=10, timestamp=5, **{field: value})
    sent.metrics.add(name="nothing", is_null=True)
    setpoint = ReceivedMetric("setpoint", 9, value)  # type: ignore[arg-type]
    assert read_command(sent.SerializeToString()) == (1234, [setpoint, ReceivedMetric("nothing", None, None)])


@table(
    ("data", "sentence"),
    [
        (bytes(65_537), "the payload has 65537 bytes; the limit is 65536"),
        (b"\x12\x05\x62\x03abc", "a float has 3 bytes; it must have 4 or 8"),
        (b"\x08" + b"\xff" * 10, "a varint has no last byte"),
    ],
)
def test_an_invalid_payload_of_a_sparkplug_host_is_refused(data: bytes, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        read_command(data)


@given(st.binary(max_size=300))
def test_decoding_random_bytes_raises_only_value_error(data: bytes) -> None:
    try:
        time_ms, found = read_command(data)
    except ValueError:
        return
    assert time_ms >= 0
    assert len(found) <= len(data)


@given(st.data())
def test_a_damaged_command_is_decoded_or_raises_value_error(data: st.DataObject) -> None:
    whole = bytearray(payload(5, [Metric(DataType.DOUBLE, 2.5, 5, "setpoint", 3)], 1))
    whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    del whole[data.draw(st.integers(0, len(whole))) :]
    decoded = test_decoding_random_bytes_raises_only_value_error
    decoded.hypothesis.inner_test(bytes(whole))  # type: ignore[attr-defined]


# ---- all rows over MQTT: JSON on a topic of each drive, and historical values of a Sparkplug node ----


require_installed("pyarrow")
NOON_MS = 1_795_262_400_000
DRIVES, REGISTERS = Names(["pump-1", FAN.name, "gone"]), Names(["output_frequency", "status", "gone"])


def batch(*given: tuple[int, int, int, int]) -> Batch:
    """Return a batch of rows. Each is given as (ms after noon, drive code, register code, value)."""
    columns = Columns(len(given))
    for ms, drive, register, value in given:
        found = new_completion(result=7, sent_ns=ms * 1_000_000, first_ns=ms * 1_000_000 + 1)
        found.reply.data_len = 2
        found.reply.data[0:2] = list(value.to_bytes(2, "big"))
        layout = RowLayout(drive, [Field(0, NumberFormat.U16, register, 1.0, 1.0)])
        assert add_rows(columns, layout, found, NOON_MS * 1_000_000)
    return Batch(columns, DRIVES, REGISTERS)


@pytest.fixture
def row_node(broker: Broker, host: Host, tmp_path: Path) -> Iterator[tuple[Any, Any, Running]]:
    """A node that sends all rows: its context, the MQTT part, and the running part."""
    known = inside(tmp_path)
    part = build(MqttSettings(broker.address, sparkplug="works", node="line", rows=True), known)
    running = Running(part)
    yield known, part, running
    running.close()


def history(host: Host, kind: str, drive: str) -> list[tuple[str, int, Any]]:
    """Wait for a message, and return (name, ms after noon, value) of its historical metrics."""
    found = host.wait_for(kind, drive)
    values = host.values(found)
    return [
        (name, metric.timestamp - NOON_MS, values[name])
        for metric in found.metrics
        if metric.is_historical and (name := host.aliases[metric.alias])
    ]


def test_no_file_stays_open_if_mqtt_cannot_start(tmp_path: Path) -> None:
    settings = MqttSettings("mqtt://127.0.0.1:9", sparkplug="works", node="line", rows=True)
    other = tmp_path / settings.spool / "sparkplug" / "rows.csv"
    other.parent.mkdir(parents=True)
    other.touch()
    for _ in range(2):
        with pytest.raises(ValueError, match="sparkplug is not a spool"):
            build(settings, inside(tmp_path))
    full = RuntimeError("can't start new thread")
    with patch("multidrop.gateway.mqtt.rows.sparkplug_rows", side_effect=full):
        for _ in range(2):
            with pytest.raises(RuntimeError, match="can't start new thread"):
                build(settings, inside(tmp_path))


@pytest.mark.slow
def test_late_rows_are_published_as_historical_values(
    broker: Broker, host: Host, row_node: tuple[Any, Any, Running]
) -> None:
    _, part, _ = row_node
    host.wait_for("DBIRTH", FAN.name)
    for one in part._brokers:
        one._client.reconnect_delay_set(3, 3)  # delays the reconnection until the second host listens
    broker.kill()
    until(lambda: "no connection" in part.health())
    part.take(batch((1, 0, 0, 40), (2, 1, 0, 41), (3, 2, 0, 42), (4, 0, 2, 43), (5, 0, 1, 1)))
    assert all(one._spool.sync(30.0) for one in part._forwarded)
    broker.start()
    again = Host(broker)
    again.wait_for("NBIRTH")
    assert history(again, "DDATA", "pump-1") == [("output_frequency", 1, 40.0), ("status", 5, "FORWARD")]
    assert history(again, "DDATA", FAN.name) == [("output_frequency", 2, 41.0)]
    until(lambda: part.health() == "")
    again.close()
    assert [one._forwarder.rows for one in part._forwarded] == [5, 5]


@pytest.mark.slow
def test_a_birth_certificate_is_published_before_historical_values(
    host: Host, row_node: tuple[Any, Any, Running]
) -> None:
    known, part, running = row_node
    host.wait_for("DBIRTH", FAN.name)
    known.hub.states["pump-1"] = "silent"
    running.step()
    host.wait_for("DDEATH", "pump-1")
    part.take(batch((7, 0, 0, 44)))
    assert part._forwarded[1]._spool.sync(30.0)
    host.wait_for("DBIRTH", "pump-1")
    assert history(host, "DDATA", "pump-1") == [("output_frequency", 7, 44.0)]
    until(lambda: part._forwarded[1]._forwarder.rows == 1)
    running.step()
    host.wait_for("DDEATH", "pump-1")


def test_live_values_have_the_time_of_their_poll(host: Host, row_node: tuple[Any, Any, Running]) -> None:
    known, _, running = row_node
    host.wait_for("DBIRTH", FAN.name)
    known.hub.values["pump-1", "output_frequency"] = 48.0
    running.step()
    [metric] = host.wait_for("DDATA", "pump-1").metrics
    assert (metric.timestamp, metric.is_historical) == (7, False)


def test_a_reload_without_a_connection_prepares_new_birth_certificates(tmp_path: Path) -> None:
    """Messages are made without a connection too. The outbox keeps the newest one of each topic."""
    known = inside(tmp_path)
    node = SparkplugNode(MqttSettings(sparkplug="works", node="line"), known, lambda: 7)
    node.outbox = Outbox(lambda message: None)
    node.publish()
    more = known.hub.polled("pump-1")
    known.hub.polled = lambda drive: (*more, InvtCHE.output_current) if drive == "pump-1" else ()
    known.hub.values["pump-1", "output_current"] = 3.0
    node.adopt(known.plant)
    node.publish()
    assert node._sent["pump-1"]["output_current"] == 3.0
