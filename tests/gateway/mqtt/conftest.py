"""Fixtures: an MQTT broker, listeners on it, and the gateway's MQTT part connected to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from brokers import FAN, PLAIN_FAN, Broker, Host, Listener, Running, end_paho_soon, inside, mosquitto
from peers import require_module

from multidrop import Drive
from multidrop.gateway.mqtt.part import build
from multidrop.gateway.mqtt.settings import MqttSettings


@pytest.fixture(scope="module", autouse=True)
def _paho() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        end_paho_soon(patch)
        yield


@pytest.fixture
def broker(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Broker]:
    """A running broker: mosquitto, unless the test's parameter gives another."""
    require_module("paho.mqtt.client")
    with getattr(request, "param", mosquitto)(tmp_path) as broker:
        yield broker


@pytest.fixture
def listener(broker: Broker) -> Iterator[Listener]:
    listener = Listener(broker)
    yield listener
    listener.close()


@pytest.fixture
def host(broker: Broker) -> Iterator[Host]:
    """A Sparkplug host application."""
    host = Host(broker)
    yield host
    host.close()


@pytest.fixture
def fan(request: pytest.FixtureRequest) -> Drive:
    """The second drive of the plant; nats-server would refuse the space in the usual drive's name."""
    parameters = getattr(getattr(request.node, "callspec", None), "params", {})
    return FAN if parameters.get("broker", mosquitto) is mosquitto else PLAIN_FAN


@pytest.fixture
def start(broker: Broker, fan: Drive, tmp_path: Path) -> Iterator[Callable[..., tuple[Any, Running]]]:
    """Return a function that starts the MQTT part with settings, and returns its context and the part."""
    running: list[Running] = []

    def start(**settings: Any) -> tuple[Any, Running]:
        known = inside(tmp_path, fan)
        running.append(Running(build(MqttSettings(broker.address, **settings), known)))
        return known, running[-1]

    yield start
    for one in running:
        one.close()
