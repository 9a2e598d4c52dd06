"""A Sparkplug host that decodes a node's messages by their definitions, and sends it commands."""

from __future__ import annotations

import time
from typing import Any

from brokers import Broker, Listener, Published, publish, sparkplug_messages

ROOT = "spBv1.0/works/{}/line"


class Host:
    """A host that checks that a node's sequence numbers increase by one."""

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
