"""The connection to a broker: outbox, acknowledgements, and brokers that freeze or disappear."""

from __future__ import annotations

import json
import os
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import pytest
from brokers import Broker as BrokerProcess
from brokers import Listener, mosquitto
from examples import usually
from gateways import Served, plant_text, running, tokens
from lines import HOST_LATE, until
from peers import require_module

from multidrop import Batch, InvtCHE, Plant
from multidrop.gateway.gateway import Gateway
from multidrop.gateway.mqtt.broker import (
    MOST_UNDER_WAY,
    MOST_WAITING,
    Broker,
    Login,
    Outbox,
    Publication,
    parse_broker,
)
from multidrop.gateway.settings import read_settings
from multidrop.sim import Simulator, Wire, simulated


class BreakableConnection:
    """A connection that a test can break."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, bytes]] = []
        self.is_open = True

    def send(self, message: Publication) -> int | None:
        if not self.is_open:
            return None
        self.sent.append((message.topic, message.make()))
        return len(self.sent)


def said(topic: str, text: bytes = b"") -> Publication:
    return Publication(topic, lambda: text)


def test_unacknowledged_messages_are_limited_and_only_the_newest_is_sent() -> None:
    wire = BreakableConnection()
    outbox = Outbox(wire.send)
    for round in range(100):
        for topic in range(50):
            outbox.put(said(f"{topic}", b"%d" % round))
    assert len(wire.sent) == MOST_UNDER_WAY
    assert outbox.dropped == 100 * 50 - MOST_UNDER_WAY - 50
    number = 0
    while number < len(wire.sent):
        number += 1
        outbox.acknowledge([number])
    assert wire.sent[MOST_UNDER_WAY:] == [
        (f"{at % 50}", b"99") for at in range(MOST_UNDER_WAY, MOST_UNDER_WAY + 50)
    ]
    assert outbox.is_idle


def test_payload_of_a_pending_message_is_made_when_it_is_sent() -> None:
    wire, now = BreakableConnection(), [b"old"]
    outbox = Outbox(wire.send)
    wire.is_open = False
    outbox.put(Publication("state", lambda: now[0]))
    now[0], wire.is_open = b"new", True
    outbox.flush()
    assert wire.sent == [("state", b"new")]


def test_message_whose_payload_fails_is_dropped_and_others_are_sent() -> None:
    wire = BreakableConnection()
    outbox = Outbox(wire.send)
    outbox.put(Publication("told", "\ud800".encode))
    outbox.put(said("state"))
    assert wire.sent == [("state", b"")]
    assert outbox.dropped == 1
    outbox.acknowledge([1])
    assert outbox.is_idle


def test_lost_connection_drops_and_counts_pending_messages() -> None:
    wire = BreakableConnection()
    outbox = Outbox(wire.send)
    for topic in range(MOST_UNDER_WAY + 3):
        outbox.put(said(f"{topic}"))
    outbox.forget()
    assert (outbox.dropped, outbox.is_idle) == (MOST_UNDER_WAY + 3, True)
    outbox.put(said("next"))
    assert wire.sent[-1] == ("next", b"")


def test_acknowledged_messages_make_room_immediately() -> None:
    wire = BreakableConnection()
    outbox = Outbox(wire.send)
    for topic in range(3 * MOST_UNDER_WAY):
        outbox.put(said(f"{topic}"))
    outbox.acknowledge(range(1, MOST_UNDER_WAY + 1))
    assert len(wire.sent) == 2 * MOST_UNDER_WAY
    outbox.acknowledge([1, 2, 3 * MOST_UNDER_WAY])  # numbers of an earlier connection
    assert len(wire.sent) == 2 * MOST_UNDER_WAY


def test_messages_beyond_the_limit_are_dropped_and_counted() -> None:
    """The limit is needed because senders of commands can choose the topics of answers."""
    wire = BreakableConnection()
    outbox = Outbox(wire.send)
    wire.is_open = False
    for at in range(MOST_WAITING + 10):
        outbox.put(said(f"{at}"))
    assert outbox.dropped == 10
    outbox.put(said("0", b"newer"))  # replaces the pending message of this topic
    assert outbox.dropped == 11
    wire.is_open = True
    outbox.flush()
    for number in range(1, MOST_WAITING + 1):
        outbox.acknowledge([number])
    assert [topic for topic, _ in wire.sent] == [f"{at}" for at in range(MOST_WAITING)]
    assert wire.sent[0] == ("0", b"newer")


class Silent:
    """A publisher without messages."""

    def will(self) -> Publication:
        return Publication("gone", bytes)

    def topics(self) -> list[tuple[str, int]]:
        return []

    def connected(self) -> None: ...

    def received(self, topic: str, payload: bytes, *, is_retained: bool) -> None: ...


class Loop:
    """An event loop that runs its scheduled calls when the test requests it."""

    def __init__(self) -> None:
        self.calls: list[Callable[[], None]] = []

    def is_closed(self) -> bool:
        return False

    def call_soon_threadsafe(self, what: Callable[..., None], *given: Any) -> None:
        self.calls.append(lambda: what(*given))

    def step(self) -> None:
        self.calls.pop(0)()


def test_event_loop_is_woken_once_for_a_burst_of_acknowledgements(monkeypatch: pytest.MonkeyPatch) -> None:
    require_module("paho.mqtt.client")
    broker, loop, told = Broker(parse_broker("mqtt://localhost"), Login(), "a", Silent()), Loop(), list[int]()
    monkeypatch.setattr(broker, "_loop", loop)
    monkeypatch.setattr(broker.outbox, "acknowledge", told.extend)
    for number in range(20):
        broker._client.on_publish(broker._client, None, number, 0, None)
    assert (len(loop.calls), told) == (1, [])
    loop.step()
    assert told == list(range(20))
    broker._client.on_publish(broker._client, None, 20, 0, None)
    loop.step()
    assert told[20:] == [20]


OUT_S = float(os.environ.get("BROKER_OUT_S", "1.5"))
PERIOD_S = 0.25  # polling period of each drive
DRIVES = ("pump-1", "pump-2", "fan-1")
SECOND_NS = 1_000_000_000
SERVE = '[serve.may]\nstop = "anyone"\n[serve.mqtt]\nbroker = "{}"\nevery = "0.1 s"\nsparkplug = "works"\n'


class Slot(NamedTuple):
    at_ns: int  # time of the request (CLOCK_MONOTONIC)
    status: str
    late_s: float  # delay from the request until the part received the row


class Slots:
    """A part that records every polling slot of each drive, and how late the part receives the row."""

    def __init__(self) -> None:
        self._found: dict[str, list[Slot]] = defaultdict(list)

    def take(self, batch: Batch) -> None:
        now = time.monotonic_ns()
        for row in batch:
            if row.register == "output_frequency":
                late = (now - row.monotonic_ns) / SECOND_NS
                self._found[row.drive].append(Slot(row.monotonic_ns, str(row.status), late))

    def between(self, begin_ns: int, end_ns: int) -> dict[str, list[Slot]]:
        return {
            name: [one for one in slots if begin_ns <= one.at_ns < end_ns]
            for name, slots in self._found.items()
        }

    def seen_until(self) -> int:
        return min(slots[-1].at_ns for slots in self._found.values())

    async def run(self) -> None: ...

    async def close(self) -> None: ...


@contextmanager
def gateway_of(folder: Path, broker: BrokerProcess) -> Iterator[tuple[Served, Slots]]:
    sims = {name: simulated(InvtCHE(n, name=name, baudrate=38400)) for n, name in enumerate(DRIVES, 1)}
    with Simulator([Wire(list(sims.values()), unpaced=True)]) as simulator:
        text = plant_text(simulator.wires[0].path, DRIVES, SERVE.format(broker.address))
        path = folder / "plant.toml"
        path.write_text(text.replace('every = "100 ms"', f'every = "{PERIOD_S * 1000:g} ms"'))
        plant = Plant.load(path)
        gateway, slots = Gateway(plant, replace(read_settings(plant, {}), port=0)), Slots()
        gateway.feeds["slots"] = slots
        with running(gateway):
            yield Served(gateway, sims, tokens()[0]), slots


def figures(gateway: Served) -> dict[str, float]:
    lines = gateway.get("/metrics").body.decode().splitlines()
    found = [line.split() for line in lines if line.startswith("multidrop_mqtt_")]
    return {name.removeprefix("multidrop_mqtt_"): float(value) for name, value in found}


def watched(slots: Slots) -> dict[str, list[Slot]]:
    """Wait for OUT_S seconds, and return the slots of that time."""
    begin = time.monotonic_ns()
    end = begin + int(OUT_S * SECOND_NS)
    until(lambda: slots.seen_until() > end, patience=OUT_S + 120)
    return slots.between(begin, end)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("kind", usually("gone", "frozen"))
def test_polling_is_unchanged_while_the_broker_is_frozen_or_gone(tmp_path: Path, kind: str) -> None:
    require_module("paho.mqtt.client")
    with mosquitto(tmp_path) as broker, gateway_of(tmp_path, broker) as (gateway, slots):
        until(lambda: figures(gateway)["connected"] == 2.0)
        until(lambda: len(slots.between(0, time.monotonic_ns())) == len(DRIVES))
        assert gateway.get("/health").json["parts"]["mqtt"] == "ok"
        phases = {"before": watched(slots)}
        dropped = figures(gateway)["dropped_total"]

        broker.signal(signal.SIGSTOP) if kind == "frozen" else broker.kill()
        phases["while"] = watched(slots)
        until(lambda: figures(gateway)["dropped_total"] > dropped)
        if kind == "gone":
            until(lambda: gateway.get("/health").json["status"] == "degraded")
            told = gateway.get("/health").json["parts"]["mqtt"]
            assert told.startswith(f"no connection to 127.0.0.1:{broker.port}")
            lost = figures(gateway)["dropped_total"]
            until(lambda: figures(gateway)["dropped_total"] >= lost + 2 * len(DRIVES))  # in each period
        stopped = gateway.post("/api/stop").json
        assert {name: one["done"] for name, one in stopped.items()} == dict.fromkeys(DRIVES, True)

        came_back_ms = time.time_ns() // 1_000_000
        broker.signal(signal.SIGCONT) if kind == "frozen" else broker.start()
        phases["after"] = watched(slots)
        heard = Listener(broker, "multidrop/#")
        for name in DRIVES:
            heard.wait_for(
                lambda one, topic=f"multidrop/{name}": (
                    one.topic == topic and json.loads(one.payload)["time"] > came_back_ms
                )
            )
        heard.close()
        until(lambda: gateway.get("/health").json["parts"]["mqtt"] == "ok")

    wanted = OUT_S / PERIOD_S
    for phase, found in phases.items():
        for name in DRIVES:
            statuses = {one.status for one in found[name]}
            assert abs(len(found[name]) - wanted) <= 1, (phase, name)  # no slot is missing
            assert statuses <= {"ok", *HOST_LATE}, (phase, name)
            assert median(one.late_s for one in found[name]) < PERIOD_S, (phase, name)
