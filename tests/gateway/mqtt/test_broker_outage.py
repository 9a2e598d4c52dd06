"""A broker that is frozen or gone changes nothing of the polling; what it did not get is counted.

`BROKER_OUT_S=60 pytest -n 0 tests/gateway/mqtt/test_broker_outage.py` lets it be away for a minute.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import NamedTuple

import pytest
from brokers import Broker, Listener, mosquitto
from examples import usually
from gateways import Served, plant_text, running, tokens
from lines import HOST_LATE, until
from peers import require_module

from multidrop import Batch, InvtCHE, Plant
from multidrop.gateway.gateway import Gateway
from multidrop.gateway.settings import read_settings
from multidrop.sim import Simulator, Wire, simulated

OUT_S = float(os.environ.get("BROKER_OUT_S", "1.5"))
PERIOD_S = 0.25  # of each drive
DRIVES = ("pump-1", "pump-2", "fan-1")
SECOND_NS = 1_000_000_000
SERVE = '[serve.may]\nstop = "anyone"\n[serve.mqtt]\nbroker = "{}"\nevery = "0.1 s"\nsparkplug = "works"\n'


class Slot(NamedTuple):
    at_ns: int  # by the monotonic clock
    status: str
    late_s: float  # until it was handed out


class Slots:
    """A part that notes every slot of each drive, and how late it is told of it."""

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
def gateway_of(folder: Path, broker: Broker) -> Iterator[tuple[Served, Slots]]:
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
    """Return the slots of so many seconds from now on."""
    begin = time.monotonic_ns()
    end = begin + int(OUT_S * SECOND_NS)
    until(lambda: slots.seen_until() > end, patience=OUT_S + 120)
    return slots.between(begin, end)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("kind", usually("gone", "frozen"))
def test_polling_is_unchanged_and_dropped_messages_are_counted(tmp_path: Path, kind: str) -> None:
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
            until(lambda: figures(gateway)["dropped_total"] >= lost + 2 * len(DRIVES))  # each turn
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
