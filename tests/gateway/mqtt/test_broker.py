"""The gateway's connection to an MQTT broker: outbox, acknowledgements, frozen and lost brokers."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from brokers import Broker as BrokerProcess
from brokers import Broker as RunningBroker
from brokers import Listener, Start, has, mosquitto, nats
from gateways import Served, gateway_of, plant_text, running, tokens
from lines import HOST_LATE, until
from nats_clusters import old_server_program
from peers import require_module
from tables import usually

from multidrop import Batch, InvtCHE
from multidrop.control import CommandOutcome, CommandResult
from multidrop.gateway.commands import Admit
from multidrop.gateway.http.rights import Caller, Right
from multidrop.gateway.mqtt import broker_commands
from multidrop.gateway.mqtt.broker import (
    MOST_RECEIVED,
    MOST_UNDER_WAY,
    MOST_WAITING,
    Broker,
    Login,
    Outbox,
    Publication,
    parse_broker,
)
from multidrop.gateway.mqtt.broker_commands import MOST_COMMANDS, BrokerCommands
from multidrop.sim import Simulator, Wire, simulated


class BreakableConnection:
    """A connection that a test can break and restore."""

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


def test_only_the_newest_message_of_a_topic_waits_for_acknowledgements() -> None:
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


def test_the_payload_of_an_mqtt_message_is_made_just_before_sending() -> None:
    wire, now = BreakableConnection(), [b"old"]
    outbox = Outbox(wire.send)
    wire.is_open = False
    outbox.put(Publication("state", lambda: now[0]))
    now[0], wire.is_open = b"new", True
    outbox.flush()
    assert wire.sent == [("state", b"new")]


def test_the_next_message_is_sent_if_a_payload_cannot_be_made() -> None:
    wire = BreakableConnection()
    outbox = Outbox(wire.send)
    outbox.put(Publication("told", "\ud800".encode))
    outbox.put(said("state"))
    assert wire.sent == [("state", b"")]
    assert outbox.dropped == 1
    outbox.acknowledge([1])
    assert outbox.is_idle


def test_a_lost_connection_drops_and_counts_pending_messages() -> None:
    wire = BreakableConnection()
    outbox = Outbox(wire.send)
    for topic in range(MOST_UNDER_WAY + 3):
        outbox.put(said(f"{topic}"))
    outbox.forget()
    assert (outbox.dropped, outbox.is_idle) == (MOST_UNDER_WAY + 3, True)
    outbox.put(said("next"))
    assert wire.sent[-1] == ("next", b"")


def test_waiting_messages_are_sent_as_soon_as_others_are_acknowledged() -> None:
    wire = BreakableConnection()
    outbox = Outbox(wire.send)
    for topic in range(3 * MOST_UNDER_WAY):
        outbox.put(said(f"{topic}"))
    outbox.acknowledge(range(1, MOST_UNDER_WAY + 1))
    assert len(wire.sent) == 2 * MOST_UNDER_WAY
    # numbers of messages that were sent on an earlier connection
    outbox.acknowledge([1, 2, 3 * MOST_UNDER_WAY])
    assert len(wire.sent) == 2 * MOST_UNDER_WAY


def test_waiting_mqtt_messages_beyond_a_limit_are_dropped_and_counted() -> None:
    """Commands can choose a new topic for each answer, so a broker could otherwise fill the memory."""
    wire = BreakableConnection()
    outbox = Outbox(wire.send)
    wire.is_open = False
    for at in range(MOST_WAITING + 10):
        outbox.put(said(f"{at}"))
    assert outbox.dropped == 10
    outbox.put(said("0", b"newer"))  # replaces the pending message of the same topic
    assert outbox.dropped == 11
    wire.is_open = True
    outbox.flush()
    for number in range(1, MOST_WAITING + 1):
        outbox.acknowledge([number])
    assert [topic for topic, _ in wire.sent] == [f"{at}" for at in range(MOST_WAITING)]
    assert wire.sent[0] == ("0", b"newer")


class Silent:
    """A publisher that has no messages."""

    def will(self) -> Publication:
        return Publication("gone", bytes)

    def topics(self) -> list[tuple[str, int]]:
        return []

    def connected(self) -> None: ...

    def received(self, topic: str, payload: bytes, *, is_retained: bool) -> None: ...


class Loop:
    """A fake event loop. It runs its scheduled calls when the test calls `step`."""

    def __init__(self) -> None:
        self.calls: list[Callable[[], None]] = []

    def is_closed(self) -> bool:
        return False

    def call_soon_threadsafe(self, what: Callable[..., None], *given: Any) -> None:
        self.calls.append(lambda: what(*given))

    def step(self) -> None:
        self.calls.pop(0)()


def test_a_burst_of_acknowledgements_wakes_the_event_loop_once(monkeypatch: pytest.MonkeyPatch) -> None:
    require_module("paho.mqtt.client")
    broker, loop, told = Broker(parse_broker("mqtt://localhost"), Login(), "a", Silent()), Loop(), list[int]()
    monkeypatch.setattr(broker, "loop", loop)
    monkeypatch.setattr(broker.outbox, "acknowledge", told.extend)
    for number in range(20):
        broker._client.on_publish(broker._client, None, number, 0, None)
    assert (len(loop.calls), told) == (1, [])
    loop.step()
    assert told == list(range(20))
    broker._client.on_publish(broker._client, None, 20, 0, None)
    loop.step()
    assert told[20:] == [20]


def test_the_number_of_unprocessed_received_messages_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    require_module("paho.mqtt.client")
    broker, loop, handled = (
        Broker(parse_broker("mqtt://localhost"), Login(), "a", Silent()),
        Loop(),
        list[int](),
    )
    monkeypatch.setattr(broker, "loop", loop)
    monkeypatch.setattr(
        broker._messages, "received", lambda topic, payload, **more: handled.append(payload[0])
    )

    def receive() -> None:
        for number in range(20):
            message = SimpleNamespace(topic="stop", payload=bytes([number]), retain=False)
            broker._client.on_message(broker._client, None, message)

    thread = threading.Thread(target=receive, daemon=True)
    thread.start()
    while len(handled) < 20:
        due = min(MOST_RECEIVED, 20 - len(handled))
        until(lambda wanted=due: len(loop.calls) == wanted)
        loop.step()
    thread.join()
    assert handled == [*range(20)]


OUT_S = float(os.environ.get("BROKER_OUT_S", "1.5"))
PERIOD_S = 0.25  # polling period of each drive
DRIVES = ("pump-1", "pump-2", "fan-1")
SECOND_NS = 1_000_000_000
SERVE = '[serve.may]\nstop = "anyone"\n[serve.mqtt]\nbroker = "{}"\nevery = "0.1 s"\nsparkplug = "works"\n'


class Slot(NamedTuple):
    at_ns: int  # time of the poll (CLOCK_MONOTONIC)
    status: str


class Slots:
    """A gateway part that records each poll of each drive."""

    def __init__(self) -> None:
        self._found: dict[str, list[Slot]] = defaultdict(list)

    def take(self, batch: Batch) -> None:
        for row in batch:
            if row.register == "output_frequency":
                self._found[row.drive].append(Slot(row.monotonic_ns, str(row.status)))

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
def with_slots(folder: Path, broker: BrokerProcess) -> Iterator[tuple[Served, Slots]]:
    sims = {name: simulated(InvtCHE(n, name=name, baudrate=38400)) for n, name in enumerate(DRIVES, 1)}
    with Simulator([Wire(list(sims.values()), unpaced=True)]) as simulator:
        text = plant_text(simulator.wires[0].path, DRIVES, SERVE.format(broker.address))
        path = folder / "plant.toml"
        path.write_text(text.replace('every = "100 ms"', f'every = "{PERIOD_S * 1000:g} ms"'))
        gateway, slots = gateway_of(path), Slots()
        gateway.feeds["slots"] = slots
        with running(gateway):
            yield Served(gateway, sims, tokens()[0]), slots


def figures(gateway: Served) -> dict[str, float]:
    lines = gateway.get("/metrics").body.decode().splitlines()
    found = [line.split() for line in lines if line.startswith("multidrop_mqtt_")]
    return {name.removeprefix("multidrop_mqtt_"): float(value) for name, value in found}


def skipped(gateway: Served) -> int:
    """Return the number of polls that were not due any more at their turn, as on a busy computer."""
    assert gateway.gateway.poller is not None
    return sum(line["overrun_slots"] for line in gateway.gateway.poller.summary()["lines"].values())


def watched(slots: Slots) -> dict[str, list[Slot]]:
    """Wait until rows that were polled OUT_S seconds later have arrived; return the polls before them."""
    begin = time.monotonic_ns()
    end = begin + int(OUT_S * SECOND_NS)
    until(lambda: slots.seen_until() > end, patience=OUT_S + 120)
    return slots.between(begin, end)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("kind", usually("gone", "frozen"))
def test_polling_is_unchanged_while_the_mqtt_broker_is_frozen_or_gone(tmp_path: Path, kind: str) -> None:
    require_module("paho.mqtt.client")
    with mosquitto(tmp_path) as broker, with_slots(tmp_path, broker) as (gateway, slots):
        until(lambda: figures(gateway)["connected"] == 2.0)
        until(lambda: len(slots.between(0, time.monotonic_ns())) == len(DRIVES))
        assert gateway.get("/health").json["parts"]["mqtt"] == "ok"
        skipped_before = skipped(gateway)
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

            until(lambda: figures(gateway)["dropped_total"] >= lost + 2 * len(DRIVES))
        stopped = gateway.post("/api/stop").json
        assert {name: one["done"] for name, one in stopped.items()} == dict.fromkeys(DRIVES, True)

        came_back_ms = time.time_ns() // 1_000_000
        broker.signal(signal.SIGCONT) if kind == "frozen" else broker.start()
        phases["after"] = watched(slots)
        heard = Listener(broker, "multidrop/#")
        for name in DRIVES:
            heard.wait_for(
                lambda one, topic=f"multidrop/{name}": one.topic == topic and one.json["time"] > came_back_ms
            )
        heard.close()
        until(lambda: gateway.get("/health").json["parts"]["mqtt"] == "ok")
        has_skipped = skipped(gateway) > skipped_before

    wanted = OUT_S / PERIOD_S
    for phase, found in phases.items():
        for name in DRIVES:
            statuses = {one.status for one in found[name]}
            assert (1 if has_skipped else wanted - 1) <= len(found[name]) <= wanted + 1, (phase, name)
            assert statuses <= {"ok", *HOST_LATE}, (phase, name)


# ---- BrokerCommands: the limit of concurrent commands from a broker, which does not apply to stops ----


CALLER = Caller("anyone", "mqtt", "broker", Right.WRITE)
NOW_MS = 1_000_000


class HeldCommands:
    """Commands that wait until the test sets `go_on`. Stops do not wait."""

    plant_ns = None

    def __init__(self) -> None:
        self.go_on = asyncio.Event()
        self.begun: list[float] = []
        self.deadlines: list[float] = []  # CLOCK_BOOTTIME, ns
        self.stopped: list[Sequence[str] | None] = []

    def stopped_ns(self, drive: str) -> None:
        return None

    async def write(
        self, drive: str, register: str, value: float, caller: Caller, admit: Admit
    ) -> CommandResult:
        self.begun.append(value)
        self.deadlines.append(admit(register))
        await self.go_on.wait()
        return CommandResult(CommandOutcome.DONE, "done")

    async def stop(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, CommandResult]:
        self.stopped.append(drives)
        return {"pump-1": CommandResult(CommandOutcome.DONE, "stopped")}


async def test_a_stop_is_sent_when_too_many_broker_commands_are_in_progress() -> None:
    told: list[tuple[str, str]] = []
    commands: Any = HeldCommands()
    orders = BrokerCommands(
        commands, CALLER, lambda: NOW_MS, lambda drive, what, end, _: told.append((what, end.text))
    )
    for value in range(MOST_COMMANDS + 2):
        orders.write("pump-1", "setpoint", value, NOW_MS)
    await asyncio.sleep(0)  # starts the commands
    assert commands.begun == [*range(MOST_COMMANDS)]
    refused = f"not sent: {MOST_COMMANDS} other commands are under way"
    assert told == [(f"setpoint = {MOST_COMMANDS + at}", refused) for at in range(2)]
    for _ in range(3):
        orders.stop(["pump-1"])
    await asyncio.sleep(0)
    assert commands.stopped == [["pump-1"]] * 3
    commands.go_on.set()
    await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
    orders.write("pump-1", "setpoint", 99.0, NOW_MS)
    await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
    assert commands.begun[-1] == 99.0


def suspended(monkeypatch: pytest.MonkeyPatch, pause_ns: int) -> Callable[[], int]:
    """Suspend the process for `pause_ns` after each read of a clock; return the clock of UTC in ms.

    CLOCK_BOOTTIME begins at 100 s, and UTC at NOW_MS.
    """
    times_ns = count(100 * 10**9, pause_ns)
    monkeypatch.setattr(broker_commands, "boottime_ns", lambda: next(times_ns))
    return lambda: NOW_MS + next(times_ns) // 10**6 - 100_000


@pytest.mark.parametrize("pause_ns", [0, 10**9])
async def test_a_command_is_not_sent_after_its_age_limit(
    monkeypatch: pytest.MonkeyPatch, pause_ns: int
) -> None:
    """The process may be suspended while the command's age is checked, or afterwards."""
    commands: Any = HeldCommands()
    orders = BrokerCommands(commands, CALLER, suspended(monkeypatch, pause_ns), lambda *given: None)
    orders.write("pump-1", "setpoint", 1.0, NOW_MS - 3_000)
    commands.go_on.set()
    await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
    assert commands.deadlines == [102 * 10**9 - pause_ns]


@pytest.mark.parametrize("pause_ns", [0, 3 * 10**9])
async def test_a_command_sent_before_a_stop_is_refused_after_a_pause(
    monkeypatch: pytest.MonkeyPatch, pause_ns: int
) -> None:
    told: list[str] = []
    commands: Any = HeldCommands()
    commands.stopped_ns = lambda drive: 100 * 10**9
    orders = BrokerCommands(
        commands, CALLER, suspended(monkeypatch, pause_ns), lambda drive, what, end, _: told.append(end.text)
    )
    orders.write("pump-1", "setpoint", 1.0, NOW_MS - 100)
    await asyncio.sleep(0)
    assert commands.begun == []
    assert told == ["not sent: the command may have been sent before the latest stop: send it again"]


@pytest.mark.slow
@pytest.mark.parametrize("broker", [lambda folder: nats(folder, old_server_program())], indirect=True)
def test_json_topics_are_published_although_the_broker_rejects_sparkplug(
    broker: RunningBroker, listener: Listener, start: Start
) -> None:
    """Sparkplug's topics contain a dot, for which nats-server before 2.10 closes the connection."""
    known, running = start(sparkplug="works", node="line")
    listener.wait_for(has("multidrop/pump-1"))
    until(lambda: running._part.health().startswith(f"no connection to 127.0.0.1:{broker.port}"))
    known.hub.values[("pump-1", "output_frequency")] = 50.0
    running.step()
    listener.wait_for(
        lambda heard: heard.topic == "multidrop/pump-1" and heard.json["values"]["output_frequency"] == 50.0
    )
    assert "multidrop/gateway" not in [h.topic for h in listener.all if h.payload == b"offline"]
