"""Messages that have arrived, and what paho's thread tells the loop of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from peers import require_module

from multidrop.gateway.mqtt.broker import Broker, Login, Publication, parse_broker


class Silent:
    """A speaker that says nothing."""

    def will(self) -> Publication:
        return Publication("gone", bytes)

    def topics(self) -> list[tuple[str, int]]:
        return []

    def connected(self) -> None: ...

    def received(self, topic: str, payload: bytes, *, is_retained: bool) -> None: ...

    def pass_over(self) -> int:
        return 0


class Loop:
    """An event loop that carries out what it is called for when the test says so."""

    def __init__(self) -> None:
        self.calls: list[Callable[[], None]] = []

    def is_closed(self) -> bool:
        return False

    def call_soon_threadsafe(self, what: Callable[..., None], *given: Any) -> None:
        self.calls.append(lambda: what(*given))

    def step(self) -> None:
        self.calls.pop(0)()


def test_the_loop_is_woken_once_for_messages_that_arrive_together(monkeypatch: pytest.MonkeyPatch) -> None:
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
