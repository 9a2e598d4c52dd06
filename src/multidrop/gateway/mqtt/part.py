"""The gateway's part `mqtt`: publishes values to a broker, and accepts the commands that the plant allows."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from multidrop import Batch, Plant
from multidrop.exposition import MetricFamily
from multidrop.gateway import utc_ms
from multidrop.gateway.live.alarms import Alarm, AlarmChange
from multidrop.gateway.metrics import counter
from multidrop.gateway.mqtt.broker import Broker, parse_broker
from multidrop.gateway.mqtt.json_topics import JsonTopics
from multidrop.gateway.mqtt.settings import MqttSettings
from multidrop.gateway.mqtt.sparkplug import SparkplugNode
from multidrop.gateway.parts import PartContext
from multidrop.supervisor import supervisor

if TYPE_CHECKING:
    from multidrop.gateway.forward.forwarder import Forwarding


def build(settings: MqttSettings, context: PartContext) -> Mqtt:
    """Return the MQTT interface. Raises ImportError without the library paho."""
    topics = JsonTopics(settings, context, utc_ms)
    formats: list[Any] = [topics]
    if settings.sparkplug:
        formats.append(SparkplugNode(settings, context, utc_ms))
    part = Mqtt(settings, context, topics, formats)
    if settings.rows:
        part.forward_rows(settings, context)
    return part


class Mqtt:
    """The gateway's MQTT interface.

    Each message format (`Messages`) has its own connection, because a connection can have only one last will.
    """

    def __init__(
        self, settings: MqttSettings, context: PartContext, topics: JsonTopics, formats: list[Any]
    ) -> None:
        address, login = parse_broker(settings.broker), settings.login(context.plant)
        self._every = settings.every_s
        self._topics = topics
        self._formats = formats
        self._brokers = []
        self._forwarded: list[Forwarding] = []
        for messages in formats:
            # the client id, which must differ from that of every other gateway at the broker
            name = f"{settings.prefix}/{context.plant.path.stem}/{messages.kind}"
            broker = Broker(address, login, name, messages)
            messages.outbox = broker.outbox
            self._brokers.append(broker)

    def forward_rows(self, settings: MqttSettings, context: PartContext) -> None:
        """Publish every polled value, in addition to each register's newest value.

        Values wait on the disk while the broker does not answer, in the folder `spool`. Raises ImportError
        without pyarrow, and ValueError for an invalid folder.
        """
        from multidrop.gateway.mqtt.rows import json_rows, sparkplug_rows

        address, login = parse_broker(settings.broker), settings.login(context.plant)
        self._forwarded.append(json_rows(settings, context, address, login))
        try:
            for broker, node in zip(self._brokers[1:], self._formats[1:], strict=True):
                self._forwarded.append(sparkplug_rows(settings, context, broker, node))
        except BaseException:
            for one in self._forwarded:
                one.abandon()
            raise

    def take(self, batch: Batch) -> None:
        """Store the batch for `forward_rows`, if that was called. The newest values come from the hub."""
        for one in self._forwarded:
            one.take(batch)

    def note_alarm(self, alarm: Alarm, change: AlarmChange) -> None:
        if self._brokers[0].is_connected:
            self._topics.publish_alarms()

    def adopt(self, plant: Plant) -> None:
        """Use another plant, and announce all its drives."""
        for broker, messages in zip(self._brokers, self._formats, strict=True):
            messages.adopt(plant)
            if broker.is_connected:
                broker.publish_all()
        for one in self._forwarded:
            one.adopt(plant)

    async def run(self, sleep: Callable[[float], Awaitable[object]] = asyncio.sleep) -> None:
        """Publish new values to the broker periodically, until cancelled."""
        for broker in self._brokers:
            broker.open()
        forwarding = [supervisor().start("mqtt rows", one.run()) for one in self._forwarded]
        try:
            while True:
                for broker in self._brokers:
                    broker.publish()
                for task in forwarding:
                    if task.done():
                        task.result()
                await sleep(self._every)
        finally:
            for task in forwarding:
                task.cancel()

    async def close(self) -> None:
        """Send the last messages, disconnect, and write unpublished values to the disk."""
        closing = [self._leave(), *(one.close() for one in self._forwarded)]
        for failure in await asyncio.gather(*closing, return_exceptions=True):
            if failure is not None:
                raise failure

    async def _leave(self) -> None:
        for broker, messages in zip(self._brokers, self._formats, strict=True):
            if broker.is_connected:
                messages.leave()
            await broker.close()

    def health(self) -> str:
        troubles = [broker.failure if broker.is_connected else broker.trouble for broker in self._brokers]
        troubles += [one.health() for one in self._forwarded]
        return next(filter(None, troubles), "")

    def figures(self) -> list[MetricFamily]:
        outboxes = [broker.outbox for broker in self._brokers]
        connected = sum(broker.is_connected for broker in self._brokers)
        return [
            counter(
                "multidrop_mqtt_sent",
                "Messages handed to connections to the broker.",
                sum(outbox.sent for outbox in outboxes),
            ),
            counter(
                "multidrop_mqtt_dropped",
                "Messages replaced by newer ones before they were sent, as while there is no connection, "
                "or not acknowledged when it broke.",
                sum(outbox.dropped for outbox in outboxes),
            ),
            MetricFamily(
                "multidrop_mqtt_connected",
                "gauge",
                "Connections to the broker that are up: one for JSON, and one more for Sparkplug.",
                [("", {}, connected)],
            ),
            *(family for one in self._forwarded for family in one.figures()),
        ]
