"""Outbox: bounded, each topic once, and counted."""

from __future__ import annotations

from multidrop.gateway.mqtt.broker import MOST_UNDER_WAY, MOST_WAITING, Outbox, Publication


class Wire:
    """A connection that can be broken."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, bytes]] = []
        self.is_open = True

    def send(self, message: Publication) -> int | None:
        if not self.is_open:
            return None
        self.sent.append((message.topic, message.make()))
        return len(self.sent)


def said(topic: str, text: bytes = b"") -> Publication:
    return Publication(topic, lambda: text)


def test_no_more_than_the_bound_is_under_way_and_the_newest_of_a_topic_is_sent() -> None:
    wire = Wire()
    outbox = Outbox(wire.send)
    for round in range(100):
        for topic in range(50):
            outbox.put(said(f"{topic}", b"%d" % round))
    assert len(wire.sent) == MOST_UNDER_WAY
    assert outbox.dropped == 100 * 50 - MOST_UNDER_WAY - 50
    number = 0
    while number < len(wire.sent):
        number += 1
        outbox.acknowledge([number])
    assert wire.sent[MOST_UNDER_WAY:] == [
        (f"{at % 50}", b"99") for at in range(MOST_UNDER_WAY, MOST_UNDER_WAY + 50)
    ]
    assert outbox.is_idle


def test_pending_message_is_made_when_it_is_sent() -> None:
    wire, now = Wire(), [b"old"]
    outbox = Outbox(wire.send)
    wire.is_open = False
    outbox.put(Publication("state", lambda: now[0]))
    now[0], wire.is_open = b"new", True
    outbox.flush()
    assert wire.sent == [("state", b"new")]


def test_a_message_that_cannot_be_made_holds_up_no_other() -> None:
    wire = Wire()
    outbox = Outbox(wire.send)
    outbox.put(Publication("told", "\ud800".encode))
    outbox.put(said("state"))
    assert wire.sent == [("state", b"")]
    assert outbox.dropped == 1
    outbox.acknowledge([1])
    assert outbox.is_idle


def test_lost_connection_drops_and_counts_pending_messages() -> None:
    wire = Wire()
    outbox = Outbox(wire.send)
    for topic in range(MOST_UNDER_WAY + 3):
        outbox.put(said(f"{topic}"))
    outbox.forget()
    assert (outbox.dropped, outbox.is_idle) == (MOST_UNDER_WAY + 3, True)
    outbox.put(said("next"))
    assert wire.sent[-1] == ("next", b"")


def test_messages_that_arrive_together_make_room_at_once() -> None:
    wire = Wire()
    outbox = Outbox(wire.send)
    for topic in range(3 * MOST_UNDER_WAY):
        outbox.put(said(f"{topic}"))
    outbox.acknowledge(range(1, MOST_UNDER_WAY + 1))
    assert len(wire.sent) == 2 * MOST_UNDER_WAY
    outbox.acknowledge([1, 2, 3 * MOST_UNDER_WAY])  # of a connection before
    assert len(wire.sent) == 2 * MOST_UNDER_WAY


def test_no_more_topics_wait_than_the_bound_and_the_others_are_counted() -> None:
    """Whoever sends commands names the topics of their answers."""
    wire = Wire()
    outbox = Outbox(wire.send)
    wire.is_open = False
    for at in range(MOST_WAITING + 10):
        outbox.put(said(f"{at}"))
    assert outbox.dropped == 10
    outbox.put(said("0", b"newer"))  # a topic that waits already has its place
    assert outbox.dropped == 11
    wire.is_open = True
    outbox.flush()
    for number in range(1, MOST_WAITING + 1):
        outbox.acknowledge([number])
    assert [topic for topic, _ in wire.sent] == [f"{at}" for at in range(MOST_WAITING)]
    assert wire.sent[0] == ("0", b"newer")
