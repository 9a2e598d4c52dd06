"""A gateway with users of all kinds at once: its answers are right, and all drives can be stopped."""

from __future__ import annotations

import http.client
import json
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
from brokers import mosquitto
from free_ports import free_ports
from gateway_users import gateway_users, place_of, serve_tables
from gateways import get, serving
from lines import PATIENCE, until
from peers import require_module
from simulated_pumps import simulated_pumps, write_plant

LINES = (8, 8, 8, 7)  # number of drives on each line
LEAST = {"frames": 100, "scrapes": 5, "queries": 5, "messages": 200, "reads": 100, "reads of others": 100}


@pytest.mark.long
def test_a_gateway_stays_healthy_while_users_of_all_kinds_are_connected(tmp_path: Path) -> None:
    """Five viewers, ten clients that read no answers, Prometheus, history, MQTT, and two Modbus masters."""
    require_module("paho.mqtt.client")
    with ExitStack() as stack:
        broker = stack.enter_context(mosquitto(tmp_path))
        place = place_of(sum(LINES), *free_ports(2), broker.port)
        plant = write_plant(tmp_path, LINES, serve_tables(place, "5 s"))
        pumps = stack.enter_context(simulated_pumps(plant))
        stack.enter_context(serving(plant))
        users = stack.enter_context(gateway_users(place))

        def ask(path: str, body: str | None = None) -> Any:
            with closing(http.client.HTTPConnection("127.0.0.1", place.http, timeout=PATIENCE)) as connection:
                if body is None:
                    return json.loads(get(connection, path))
                connection.request("POST", path, body, {"content-type": "application/json"})
                return json.loads(connection.getresponse().read())

        def all_are(state: str) -> bool:
            return {drive["state"] for drive in ask("/api/frame")["drives"].values()} == {state}

        def have_got(more: dict[str, float]) -> bool:
            counts, _ = users.counts()
            return all(counts.get(what, 0) >= more.get(what, 0) + least for what, least in LEAST.items())

        pumps.run()
        until(lambda: all_are("runs") and have_got({}))
        told = ask("/api/stop", "{}")
        assert len(told) == sum(LINES)
        assert [one["text"] for one in told.values() if not one["done"]] == []
        stops = pumps.stops()
        assert [name for name, (at, turns) in stops.items() if at is None or turns] == []
        before = dict(users.counts()[0])
        until(lambda: all_are("stands") and have_got(before))
        assert users.counts()[1] == {}
        frame = ask("/api/frame")
        assert {line["lost"] for line in frame["lines"].values()} == {None}
        health = ask("/health")
        assert (health["lines"], health["parts"]) == (
            {f"line-{number}": "ok" for number in range(1, len(LINES) + 1)},
            dict.fromkeys(("history", "modbus", "mqtt"), "ok"),
        )
        assert set(health["failures"].values()) <= {0}
