"""Outbox: the topics that are still to be sent, and a bounded number of messages under way.

A broker that stands still holds up nothing and costs no memory: each topic waits once, and what it says is
made when it is sent. Pure: `send` does the sending.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import NamedTuple

MOST_UNDER_WAY = 64  # messages that were sent, and not acknowledged: two lines' drives go at once
MOST_WAITING = 4096  # topics; more than any plant has

_log = logging.getLogger("multidrop.gateway.mqtt.part")


class Publication(NamedTuple):
    """A topic, and a function that makes its message when it is sent."""

    topic: str
    make: Callable[[], bytes]
    qos: int = 1
    is_retained: bool = False


class Outbox:
    """Messages that wait, one of each topic.

    `send` takes a message and returns its number, or None where it cannot be sent now.
    """

    def __init__(self, send: Callable[[Publication], int | None]) -> None:
        self._send = send
        self._waiting: dict[str, Publication] = {}
        self._under_way: set[int] = set()
        self.sent = 0
        self.dropped = 0  # replaced by a newer one, or lost with the connection

    def put(self, message: Publication) -> None:
        """Send the message as soon as there is room, in the place of an older one of its topic."""
        if message.topic in self._waiting or len(self._waiting) >= MOST_WAITING:
            self.dropped += 1
        if message.topic in self._waiting or len(self._waiting) < MOST_WAITING:
            self._waiting[message.topic] = message
        self.flush()

    def withdraw(self, topic: str) -> None:
        """Drop what waits of a topic, if anything does: something else was said since."""
        self.dropped += self._waiting.pop(topic, None) is not None

    def flush(self) -> None:
        """Send what waits, as far as there is room."""
        while self._waiting and len(self._under_way) < MOST_UNDER_WAY:
            topic = next(iter(self._waiting))
            try:
                number = self._send(self._waiting[topic])
            except Exception as failure:  # no broker takes this one; all others are sent
                del self._waiting[topic]
                self.dropped += 1
                _log.warning("what was to be said on %.100r cannot be sent: %r", topic, failure)
                continue
            if number is None:
                return
            del self._waiting[topic]
            self._under_way.add(number)
            self.sent += 1

    def acknowledge(self, numbers: Iterable[int]) -> None:
        """Note that messages have arrived."""
        self._under_way.difference_update(numbers)
        self.flush()

    def forget(self) -> None:
        """Drop all that waits: the connection is gone, and what comes next begins anew."""
        self.dropped += len(self._waiting) + len(self._under_way)
        self._waiting.clear()
        self._under_way.clear()

    @property
    def is_idle(self) -> bool:
        return not self._waiting and not self._under_way
