"""Publish all polled values over MQTT, as JSON and in Sparkplug.

Values polled while the broker was not connected are published later.
"""

from __future__ import annotations

import asyncio
import json
import time
from functools import cache
from math import isfinite
from typing import Any

from multidrop.gateway.forward.forwarder import (
    Forwarding,
    Outgoing,
    RepeatingReceiver,
    listed,
    pieces,
    row_objects,
)
from multidrop.gateway.live.hub import published_value
from multidrop.gateway.mqtt.broker import Address, Broker, Login, make_client
from multidrop.gateway.mqtt.settings import MqttSettings
from multidrop.gateway.mqtt.sparkplug import PastValue, SparkplugNode
from multidrop.gateway.parts import PartContext
from multidrop.samples import unit_of

ANSWER_S = 10.0  # time limit, in s, for an answer of the broker
KEEP_ALIVE_S = 60  # in s; longer than the time between two messages
LOOP_S = 0.1  # longest wait, in s, for one MQTT packet


def json_rows(settings: MqttSettings, context: PartContext, address: Address, login: Login) -> Forwarding:
    """Return the forwarder that publishes all polled values to the topics PREFIX/DRIVE/rows."""
    name = f"{settings.prefix}/{context.plant.path.stem}/rows"
    publisher = RowPublisher(settings.prefix, address, login, name)
    return _forwarding("mqtt", f"the broker {address.host}", settings, context, publisher.publish)


def sparkplug_rows(
    settings: MqttSettings, context: PartContext, broker: Broker, node: SparkplugNode
) -> Forwarding:
    """Return the forwarder that publishes all polled values as historical values of a Sparkplug node."""

    def deliver(message: Outgoing) -> None:
        if broker.loop is None or not broker.is_connected:
            raise ConnectionError("the connection to the broker is down")
        work = node.send_past(_past_values(message.rows, node), broker.confirm)
        asyncio.run_coroutine_threadsafe(work, broker.loop).result()

    return _forwarding("sparkplug", "the Sparkplug host's broker", settings, context, deliver)


def _forwarding(
    name: str, receiver: str, settings: MqttSettings, context: PartContext, deliver: Any
) -> Forwarding:
    folder = context.folder / settings.spool / name
    return Forwarding(
        name, receiver, folder, settings.most, context.plant, lambda at: RepeatingReceiver(at, deliver)
    )


def _past_values(rows: Any, node: SparkplugNode) -> list[PastValue]:
    """Return the values of the registers that the plant still has with the same unit.

    Failed reads are left out, because Sparkplug cannot represent them.
    """
    found = []
    find = cache(node.find)
    for time_ns, name, register, value, _, unit in listed(rows):
        drive, known = find(name, register)
        if value is not None and drive is not None and known is not None and unit_of(drive, known) == unit:
            published = published_value(known, value) if isfinite(value) else None
            found.append(PastValue(name, register, time_ns // 1_000_000, published))
    return found


class RowPublisher:
    """Publishes messages with QoS 1, and waits for their acknowledgements.

    It has its own connection, which only the forwarder's thread uses.
    """

    def __init__(self, prefix: str, address: Address, login: Login, name: str) -> None:
        self._prefix, self._address, self._login, self._name = prefix, address, login, name
        self._client: Any = None

    def publish(self, message: Outgoing) -> None:
        """Publish the rows of a message, as one MQTT message per drive. Raises OSError."""
        try:
            if self._client is None:
                self._connect()
            sent = [self._client.publish(*one, qos=1) for one in self._messages(message)]
            for one in sent:  # each MQTT message has its own time limit, because the network may be slow
                self._wait(one.is_published)
        except (OSError, ValueError, RuntimeError) as failure:
            self._client = None  # the forwarder sends unacknowledged messages again, with a new client
            raise ConnectionError(str(failure)) from failure

    def _messages(self, message: Outgoing) -> list[tuple[str, bytes]]:
        found = []
        for number, rows in enumerate(pieces(message.rows)):
            by_drive: dict[str, list[dict[str, Any]]] = {}
            for row in row_objects(rows):
                by_drive.setdefault(row["drive"], []).append(row)
            for drive, its in by_drive.items():
                content = {"id": f"{message.id}-{number}", "historical": message.is_historical, "rows": its}
                payload = json.dumps(content, ensure_ascii=False).encode()
                found.append((f"{self._prefix}/{drive}/rows", payload))
        return found

    def _connect(self) -> None:
        client = make_client(self._address, self._login, self._name)
        answers: list[Any] = []
        client.on_connect = lambda *given: answers.append(given[3])
        client.connect(self._address.host, self._address.port, KEEP_ALIVE_S)
        self._client = client
        self._wait(lambda: answers)
        if answers[0].is_failure:
            raise ConnectionError(f"the broker refuses the connection: {answers[0]}")

    def _wait(self, is_done: Any) -> None:
        """Handle packets from the broker until `is_done()` is true.

        Raises ConnectionError after ANSWER_S.
        """
        from paho.mqtt.client import MQTT_ERR_SUCCESS, error_string

        ends = time.monotonic() + ANSWER_S
        while not is_done():
            result = self._client.loop(LOOP_S)
            if result != MQTT_ERR_SUCCESS:
                raise ConnectionError(error_string(result))
            if time.monotonic() > ends:
                raise ConnectionError(f"the broker has not answered within {ANSWER_S:g} s")
