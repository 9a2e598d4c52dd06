"""An edge node through a real broker: births, data, deaths and rebirth, as a host sees them."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from brokers import (
    FAN,
    ROOT,
    Broker,
    Host,
    Running,
    command,
    inside,
    sparkplug_messages,
    without_fan,
)
from peers import require_module
from profile_families import VfdEl

from multidrop import DelixiModbus, Drive, InvtCHE
from multidrop.gateway.mqtt.broker import Outbox, Publication
from multidrop.gateway.mqtt.part import build
from multidrop.gateway.mqtt.settings import MqttSettings
from multidrop.gateway.mqtt.sparkplug import DataType, Metric, payload, read_command
from multidrop.gateway.mqtt.sparkplug_node import STOP, SparkplugNode


@pytest.fixture
def node(broker: Broker, host: Host, tmp_path: Path) -> Iterator[tuple[Any, Running]]:
    require_module("paho.mqtt.client")
    known = inside(tmp_path)
    settings = MqttSettings(broker.address, sparkplug="works", node="line", commands=True)
    running = Running(build(settings, known))
    yield known, running
    running.close()


def test_node_sends_births_data_and_deaths(host: Host, node: tuple[Any, Running]) -> None:
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
    host.wait_for("DBIRTH", FAN.name)
    known.hub.values[("pump-1", "output_frequency")] = 50.0
    running.step()
    assert host.values(host.wait_for("DDATA", "pump-1")) == {"output_frequency": 50.0}
    known.hub.states[FAN.name] = "silent"
    running.step()
    host.wait_for("DDEATH", FAN.name)
    known.hub.states[FAN.name] = "fault"
    known.hub.faults[FAN.name] = "перегрев"
    running.step()
    born = host.values(host.wait_for("DBIRTH", FAN.name))
    assert (born["state"], born["fault"]) == ("fault", "перегрев")


def test_fault_text_is_published_without_a_polled_fault_register(tmp_path: Path) -> None:
    """This drive's register `fault` is a number without names, and is not polled."""
    known = inside(tmp_path, VfdEl(2, name="mill"))
    known.hub.states["mill"], known.hub.faults["mill"] = "fault", "it shows a fault"
    node = SparkplugNode(MqttSettings(sparkplug="works", node="line"), known, lambda: 7)
    (birth,) = [given for given in read_command(node._device_birth("mill"))[1] if given.name == "fault"]
    assert birth.value == "it shows a fault"


@pytest.mark.parametrize("family", [VfdEl, InvtCHE, DelixiModbus])
def test_register_named_fault_gets_its_own_metric(tmp_path: Path, family: type[Drive]) -> None:
    """The metric `fault` is a text for every family; the register's own metric has its own type."""
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


def test_birth_has_the_units_of_metrics(host: Host, node: tuple[Any, Running]) -> None:
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


def test_unchanged_values_are_not_sent(host: Host, node: tuple[Any, Running]) -> None:
    known, running = node
    host.wait_for("DBIRTH", FAN.name)
    for _ in range(5):
        running.step()
    known.hub.states[FAN.name] = "stands"
    running.step()
    host.wait_for("DDATA", FAN.name)
    assert host.kinds.count("DDATA") == 1


@pytest.mark.long
def test_sequence_numbers_restart_at_0_after_255(host: Host, node: tuple[Any, Running]) -> None:
    known, running = node
    host.wait_for("DBIRTH", FAN.name)
    for value in range(300):
        known.hub.values[("pump-1", "output_frequency")] = float(value)
        running.step()
        host.wait_for("DDATA", "pump-1")
    assert host.seq is not None
    assert host.seq < 256


def test_rebirth_command_sends_all_births_again(
    broker: Broker, host: Host, node: tuple[Any, Running]
) -> None:
    host.wait_for("DBIRTH", FAN.name)
    command(broker, ROOT.format("NCMD"), name="Node Control/Rebirth", boolean_value=True, datatype=11)
    assert host.values(host.wait_for("NBIRTH"))["bdSeq"] == 0
    host.wait_for("DBIRTH", "pump-1")
    host.wait_for("DBIRTH", FAN.name)


@pytest.mark.slow
def test_lost_connection_sends_a_death_and_a_birth_with_the_next_bdseq(
    host: Host, node: tuple[Any, Running]
) -> None:
    host.wait_for("DBIRTH", FAN.name)
    node[1].cut(1)
    assert host.values(host.wait_for("NDEATH")) == {"bdSeq": 0}
    assert host.values(host.wait_for("NBIRTH"))["bdSeq"] == 1
    host.wait_for("DBIRTH", "pump-1")


def test_only_the_final_birth_or_death_of_pending_messages_is_sent(tmp_path: Path) -> None:
    known, sent, is_open = inside(tmp_path), [], [True]

    def send(message: Publication) -> int | None:
        if not is_open[0]:
            return None
        sent.append((message.topic.split("/")[2], message.make()))
        return len(sent)

    node = SparkplugNode(MqttSettings(sparkplug="works", node="line"), known, lambda: 7)
    node.outbox = outbox = Outbox(send)  # the test sends fewer messages than MOST_UNDER_WAY
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


def test_closing_sends_a_death(broker: Broker, host: Host, tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    settings = MqttSettings(broker.address, sparkplug="works", node="line")
    running = Running(build(settings, inside(tmp_path)))
    host.wait_for("DBIRTH", FAN.name)
    running.close()
    assert host.values(host.wait_for("NDEATH")) == {"bdSeq": 0}


def test_fresh_write_and_any_stop_of_a_host_are_carried_out(
    broker: Broker, host: Host, node: tuple[Any, Running]
) -> None:
    known, _ = node
    host.wait_for("DBIRTH", "pump-1")
    alias = {name: number for number, name in host.aliases.items()}["setpoint"]
    host.wait_for("DBIRTH", FAN.name)
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
async def test_stop_in_an_invalid_payload_is_sent(
    tmp_path: Path, damage: bytes, name: bytes, noted: list[object]
) -> None:
    """A boolean metric is followed by an invalid field, a name that is not UTF-8, or a truncated metric."""
    known = inside(tmp_path)
    node = SparkplugNode(MqttSettings(sparkplug="works", node="line", commands=True), known, lambda: 7)
    metric = b"\x0a" + bytes([len(name)]) + name + b"\x70\x01"
    payload = b"\x12" + bytes([len(metric)]) + metric + damage
    node.received(ROOT.format("DCMD") + "/pump-1", payload, is_retained=False)
    await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
    assert known.commands.noted == noted


@pytest.mark.parametrize("is_retained", [False, True])
async def test_retained_write_is_refused_and_retained_stop_is_sent(
    tmp_path: Path, *, is_retained: bool
) -> None:
    """A retained write is delivered on every connection, and may be recent on the first."""
    known = inside(tmp_path)
    node = SparkplugNode(MqttSettings(sparkplug="works", node="line", commands=True), known, lambda: 1_000)
    given = [Metric(DataType.DOUBLE, 25.0, 1_000, "setpoint"), Metric(DataType.BOOLEAN, 1, 1_000, STOP)]
    topic = ROOT.format("DCMD") + "/pump-1"
    node.received(topic, payload(1_000, given, None), is_retained=is_retained)
    await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
    written = [] if is_retained else [("write", "pump-1", "setpoint", 25.0)]
    assert known.commands.noted == [*written, ("stop", ["pump-1"])]


def test_reload_sends_deaths_of_removed_drives_and_births_of_others(
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
