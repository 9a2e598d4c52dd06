"""MQTT brokers, a listener and a Sparkplug host by other authors, and a fake hub with test values."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import queue
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import pytest
from free_ports import free_port
from peers import require_module, require_program

from multidrop import Drive, InvtCHE, Plant, PlantLine, Polled, PolledDrive
from multidrop.control import CommandOutcome, CommandResult
from multidrop.gateway.http.rights import Caller, May, Tokens
from multidrop.gateway.live.alarms import Alarms
from multidrop.gateway.live.hub import KeptRow, Known, Shown
from multidrop.gateway.parts import PartContext

PATIENCE_S = 30.0  # longest wait for an event that is immediate on an idle machine
TRIALS = 5


def end_paho_soon(patch: pytest.MonkeyPatch) -> None:
    """Let paho's thread end within 20 ms while it pauses between connections; its own limit is 1 s."""
    require_module("paho.mqtt.client")
    short = SimpleNamespace(**{**vars(time), "sleep": lambda seconds: time.sleep(min(seconds, 0.02))})
    patch.setattr("paho.mqtt.client.time", short)


class EndedAtOnce(Exception):
    """Raised if a broker's process ended before it accepted connections."""


class Broker:
    """An MQTT broker's process on a port of its own."""

    def __init__(self, command: Callable[[int], Sequence[str]]) -> None:
        self._command = command
        for _ in range(TRIALS):
            self.port = free_port()
            with suppress(EndedAtOnce):  # another program may have taken the free port
                self.start()
                return
        raise EndedAtOnce(f"the broker ended at once on {TRIALS} ports")

    @property
    def address(self) -> str:
        return f"mqtt://127.0.0.1:{self.port}"

    def start(self) -> None:
        self.process = subprocess.Popen(
            self._command(self.port), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        ends = time.monotonic() + PATIENCE_S
        while True:
            with closing(socket.socket()) as one:
                if one.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            if self.process.poll() is not None:
                raise EndedAtOnce("the broker ended at once")
            assert time.monotonic() < ends, "the broker does not listen"
            time.sleep(0.005)

    def signal(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@contextmanager
def mosquitto(folder: Path) -> Iterator[Broker]:
    program = require_program("mosquitto")

    def command(port: int) -> list[str]:
        (folder / "mosquitto.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
        return [program, "-c", str(folder / "mosquitto.conf")]

    yield from _running(Broker(command))


@contextmanager
def nats(folder: Path, program: str) -> Iterator[Broker]:
    def command(port: int) -> list[str]:
        (folder / "nats.conf").write_text(
            f'server_name: one\nport: -1\nhost: "127.0.0.1"\n'
            f'jetstream {{ store_dir: "{folder}/nats" }}\nmqtt {{ host: "127.0.0.1", port: {port} }}\n'
        )
        return [program, "-c", str(folder / "nats.conf")]

    yield from _running(Broker(command))


def new_nats(folder: Path) -> AbstractContextManager[Broker]:
    """Run nats-server in the version that a fleet needs."""
    from nats_clusters import server_program

    return nats(folder, server_program())


# Runs a test with both brokers; with nats-server, the test is slow.
WITH_NATS = pytest.mark.parametrize(
    "broker",
    [mosquitto, pytest.param(new_nats, marks=pytest.mark.slow)],
    indirect=True,
    ids=["mosquitto", "nats"],
)


def _running(broker: Broker) -> Iterator[Broker]:
    try:
        yield broker
    finally:
        broker.kill()


class Published(NamedTuple):
    topic: str
    is_retained: bool
    payload: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.payload)


def has(topic: str, payload: bytes | None = None) -> Callable[[Published], bool]:
    """Return a predicate for messages on this topic; `payload` None allows any payload."""
    return lambda received: received.topic == topic and payload in (None, received.payload)


class Listener:
    """A mosquitto_sub process that records retained and new messages."""

    def __init__(self, broker: Broker, topic: str = "#") -> None:
        program = require_program("mosquitto_sub")
        self._process = subprocess.Popen(
            [program, "-p", str(broker.port), "-t", topic, "-q", "1", "-F", "%t|%r|%x"],
            stdout=subprocess.PIPE,
            text=True,
        )
        self._received: queue.Queue[Published] = queue.Queue()
        self.all: list[Published] = []
        self._probe, self._hears = topic.replace("#", "probe"), threading.Event()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()
        while not self._hears.wait(0.01):  # wait until the broker has confirmed the subscription
            publish(broker, self._probe, b"probe")

    def _read(self) -> None:
        assert self._process.stdout
        with self._process.stdout:
            self._note(self._process.stdout)

    def _note(self, lines: Iterable[str]) -> None:
        for line in lines:
            topic, kept, payload = line.rstrip("\n").rsplit("|", 2)
            if topic == self._probe:
                self._hears.set()
            else:
                self._received.put(Published(topic, kept == "1", bytes.fromhex(payload)))

    def wait_for(self, wanted: Callable[[Published], object]) -> Published:
        """Return the next message that `wanted` accepts; every received message is kept in `all`."""
        ends = time.monotonic() + PATIENCE_S
        while True:
            received = self._received.get(timeout=max(0.0, ends - time.monotonic()))
            self.all.append(received)
            if wanted(received):
                return received

    def drain(self) -> None:
        """Move all messages received so far to `all`."""
        while not self._received.empty():
            self.all.append(self._received.get())

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._thread.join()


def publish(broker: Broker, topic: str, payload: bytes, *options: str) -> None:
    program = require_program("mosquitto_pub")
    command = [program, "-p", str(broker.port), "-t", topic, "-s", *options]
    subprocess.run(command, input=payload, check=True, timeout=PATIENCE_S)


def sparkplug_messages() -> ModuleType:
    """Import pysparkplug's message definitions only, because its client needs another version of paho."""
    require_module("google.protobuf")
    try:
        path = distribution("pysparkplug").locate_file("pysparkplug/_protobuf/sparkplug_b_pb2.py")
    except PackageNotFoundError:
        return require_module("pysparkplug")
    spec = importlib.util.spec_from_file_location("sparkplug_b_pb2", str(path))
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PUMP, FAN = InvtCHE(1, name="pump-1"), InvtCHE(2, name="вентилятор 2")
PLAIN_FAN = InvtCHE(2, name="вентилятор-2")  # for nats-server, which rejects topics with a space


class ScriptedHub:
    """A fake hub with values set by the test, by drive and register."""

    def __init__(self, fan: str) -> None:
        self.values: dict[tuple[str, str], float | None] = {
            ("pump-1", "output_frequency"): 49.5,
            ("pump-1", "status"): 1.0,
        }
        self.states = {PUMP.name: "runs", fan: "runs"}
        self.faults: dict[str, str | None] = {}
        self.names = [PUMP.name, fan]

    @property
    def drives(self) -> Iterator[str]:
        return iter(self.names)

    def polled(self, drive: str) -> tuple[Any, ...]:
        return (PUMP.output_frequency, PUMP.status)

    def known(self, drive: str) -> Iterator[Known]:
        for register in self.polled(drive):
            value = self.values.get((drive, register.name))
            row = None if value is None else (7_000_000, 7_000_000, value, 0)
            yield register, row, row, row is not None

    def last_answer(self, drive: str) -> KeptRow | None:
        return 7_000_000, 7_000_000, 0.0, 0

    def state(self, drive: str) -> str:
        return self.states[drive]

    def seen(self, drive: str) -> Shown:
        return Shown(self.state(drive), self.faults.get(drive))


class RecordedCommands:
    """Fake commands that record each call and succeed."""

    def __init__(self) -> None:
        self.may = May(write=frozenset({"pump-1.setpoint"}), verbs=frozenset({"pump-1.start"}))
        self.noted: list[tuple[Any, ...]] = []
        self.stopped_at: dict[str, int] = {}  # time of each drive's stop, in ns of CLOCK_MONOTONIC
        self.plant_ns: int | None = None

    async def stop(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, CommandResult]:
        self.noted.append(("stop", drives))
        return dict.fromkeys(drives or ["pump-1"], CommandResult(CommandOutcome.DONE, "stopped"))

    def stopped_ns(self, drive: str) -> int | None:
        return self.stopped_at.get(drive)

    async def write(self, drive: str, register: str, value: float, *_: object) -> CommandResult:
        self.noted.append(("write", drive, register, value))
        return CommandResult(CommandOutcome.DONE, "done")

    async def act(self, drive: str, verb: str, options: Mapping[str, object], *_: object) -> CommandResult:
        self.noted.append(("act", drive, verb, dict(options)))
        return CommandResult(CommandOutcome.DONE, "done")


def inside(folder: Path, fan: Drive = FAN) -> Any:
    """Return a PartContext for a gateway part: two drives, a fake hub and fake commands."""
    polls = tuple(Polled(register, 1.0) for register in (PUMP.output_frequency, PUMP.status))
    drives = tuple(PolledDrive(drive, polls) for drive in (PUMP, fan))
    plant = Plant((PlantLine("hall", "/dev/null", drives=drives),), folder / "plant.toml")
    hub: Any = ScriptedHub(fan.name)
    commands: Any = RecordedCommands()
    ask: Any = SimpleNamespace()
    return PartContext(plant, hub, commands, ask, folder, "0.2", Alarms(), Tokens())


def without_fan(known: Any) -> Plant:
    """Remove the fan from the context's hub; return the context's plant without the fan."""
    known.hub.names.remove(FAN.name)
    (line,) = known.plant.lines
    plant: Plant = replace(known.plant, lines=(replace(line, drives=line.drives[:1]),))
    return plant


class Running:
    """A gateway part that runs in a thread with its own event loop; `step()` waits for one publication."""

    def __init__(self, part: Any) -> None:
        self._part = part
        self._loop = asyncio.new_event_loop()
        self._step = asyncio.Event()
        self._published = threading.Semaphore(0)
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._live(),))
        self._thread.start()
        assert self._published.acquire(timeout=PATIENCE_S)

    def adopt(self, plant: Plant) -> None:
        """Pass a new plant to the part, in the part's event loop."""
        self._loop.call_soon_threadsafe(self._part.adopt, plant)

    async def _live(self) -> None:
        self._task = asyncio.ensure_future(self._part.run(self._sleep))
        try:
            await self._task
        except asyncio.CancelledError:
            await self._part.close()

    async def _sleep(self, seconds: float) -> None:
        self._published.release()
        await self._step.wait()
        self._step.clear()

    def step(self) -> None:
        self._loop.call_soon_threadsafe(self._step.set)
        assert self._published.acquire(timeout=PATIENCE_S)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join(PATIENCE_S)
        self._loop.close()

    def cut(self, connection: int) -> None:
        """Break a connection without an MQTT disconnect message, as a power failure does."""
        self._part._brokers[connection]._client.socket().shutdown(socket.SHUT_RDWR)


Start = Callable[..., tuple[Any, Running]]  # the fixture `start`


ROOT = "spBv1.0/works/{}/line"


class Host:
    """A Sparkplug host that checks that a node's sequence numbers increase by one."""

    def __init__(self, broker: Broker) -> None:
        self._listener = Listener(broker, "spBv1.0/#")
        self._messages = sparkplug_messages()
        self.seq: int | None = None
        self.aliases: dict[int, str] = {}
        self.kinds: list[str] = []

    def wait_for(self, kind: str, device: str = "") -> Any:
        wanted = ROOT.format(kind) + (f"/{device}" if device else "")
        return self._decoded(self._listener.wait_for(lambda received: self._take(received) == wanted))

    def _decoded(self, received: Published) -> Any:
        return self._messages.Payload.FromString(received.payload)

    def _take(self, received: Published) -> str:
        kind = received.topic.split("/")[2]
        if kind.endswith("CMD"):
            return received.topic
        self.kinds.append(kind)
        found = self._decoded(received)
        if kind == "NBIRTH":
            self.seq = 0
            assert found.seq == 0
        elif kind != "NDEATH":
            assert self.seq is not None
            self.seq = (self.seq + 1) % 256
            assert found.seq == self.seq
        if kind == "DBIRTH":
            self.aliases |= {metric.alias: metric.name for metric in found.metrics}
        return received.topic

    def values(self, found: Any) -> dict[str, Any]:
        return {
            metric.name or self.aliases[metric.alias]: None
            if metric.is_null
            else getattr(metric, metric.WhichOneof("value"))
            for metric in found.metrics
        }

    def close(self) -> None:
        self._listener.close()


def command(broker: Broker, topic: str, **metric: Any) -> None:
    sent = sparkplug_messages().Payload(timestamp=metric.pop("time_ms", time.time_ns() // 1_000_000))
    sent.metrics.add(**metric)
    publish(broker, topic, sent.SerializeToString())
