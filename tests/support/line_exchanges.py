"""Exchanges with one drive on a line whose clock the test sets."""

from __future__ import annotations

from typing import Any

import pytest
from frames import words
from line_driver import MS, LineDriver

from multidrop.core import (
    Exchange,
    Framing,
    Message,
    Peer,
    build_reply,
)

CHARACTER = 1 * MS
SILENCE = 4 * MS
LEAST, MOST = 20 * MS, 300 * MS
READ, OTHER, LONGER = Message(1, 3, 0, 1), Message(1, 3, 50, 1), Message(1, 3, 0, 2)
WRITE = Message(1, 6, 2, data=words(7))


@pytest.fixture
def line() -> LineDriver:
    return LineDriver()


@pytest.fixture
def drive() -> Peer:
    return Peer(least_timeout=LEAST / 1e9, most_timeout=MOST / 1e9)


def exchange(request: Message, drive: Peer, framing: Framing = Framing.RTU, **details: Any) -> Exchange:
    return Exchange(
        framing,
        request,
        drive,
        baudrate=9600,
        format="8N1",
        character=CHARACTER / 1e9,
        silence=SILENCE / 1e9,
        **details,
    )


def reply(value: int = 0) -> bytes:
    return build_reply(Framing.RTU, Message(1, 3, data=words(value)))


def ask(line: LineDriver, drive: Peer, request: Message = READ) -> int:
    """Send the request; return when its last bit has left."""
    line.begin(exchange(request, drive))
    line.wait_until_write()
    return line.now + 8 * CHARACTER


def answer(line: LineDriver, drive: Peer, delay: int) -> None:
    """Run a whole exchange; its reply arrives by character, the first after `delay`."""
    left = ask(line, drive)
    for at, character in enumerate(reply()):
        line.now = left + delay + (at + 1) * CHARACTER
        assert line.listens
        line.receive(bytes([character]))
    assert line.want == "done"
