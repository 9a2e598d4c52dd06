"""The forwarder of rows: the newest rows are sent first. A failure neither loses nor doubles a row."""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Iterator
from math import inf
from pathlib import Path

import pytest
from forwarded import Recorded, store
from lines import until
from spooled import exchanges_in, numbered, rows_of
from tables import table

from multidrop.gateway.forward import forwarder as forwarder_module
from multidrop.gateway.forward.forwarder import MOST_GAPS, RowForwarder, SpoolPosition
from multidrop.gateway.sending import Refused
from multidrop.samples import Spool


class Clocked:
    """A forwarder under test: its spool, a simulated clock `now_s`, and a receiver that records messages."""

    def __init__(self, folder: Path, receiver: Recorded | None = None, most: int = 10**9) -> None:
        self.now_s = 0.0
        self.spool = Spool(folder, "serve", most=most, keep_sent=False)
        self.receiver = receiver or Recorded()
        self.forwarder = RowForwarder(
            "the receiver", self.spool, self.receiver.at(folder), lambda: self.now_s
        )

    def send_all(self) -> float:
        """Send all messages that can be sent now; return the seconds until the next attempt."""
        while (pause_s := self.forwarder.step()) < 0.5:
            pass
        return pause_s

    def exchanges(self) -> list[int]:
        """Return the numbers of the exchanges received, in this order. Fails if an exchange lacks a row."""
        return [n for one in self.receiver.messages for n in exchanges_in(rows_of(one.rows))]


@pytest.fixture
def clocked(tmp_path: Path) -> Iterator[Clocked]:
    made = Clocked(tmp_path / "spool")
    yield made
    made.spool.close()


def test_the_newest_message_is_sent_before_the_backlog() -> None:
    position, sent = SpoolPosition(3), []
    for newest in (9, 9, 9, *[12] * 6):
        sequence = position.next(newest)
        assert sequence is not None
        sent.append(sequence)
        position = position.after(sequence, sequence)
    assert sent == [9, 4, 5, 12, 6, 7, 8, 10, 11]


def test_each_message_is_sent_once_although_the_receiver_fails_at_random() -> None:
    dice = random.Random(43)
    for _ in range(200):
        position, sent, newest = SpoolPosition(), list[int](), 0
        while newest < 300 or position.behind(newest):
            newest = min(300, newest + dice.choice((0, 0, 1, 7)))
            for _ in range(dice.choice((0, 1, 4))):
                if (sequence := position.next(newest)) is not None:
                    sent.append(sequence)
                    position = position.after(sequence, sequence)
            assert len(position.gaps) <= MOST_GAPS
        assert sorted(sent) == list(range(1, 301))
        assert position == SpoolPosition(300)


@pytest.mark.slow
def test_each_row_is_sent_once_after_two_hours_without_a_receiver(clocked: Clocked) -> None:
    messages, period_s = 240, 30.0  # two hours
    clocked.receiver.failure = ConnectionRefusedError("Connection refused")
    due_s = 0.0
    for number in range(messages):
        store(clocked.spool, number * 5, 5)
        clocked.now_s += period_s
        if clocked.now_s >= due_s:
            pause_s = clocked.send_all()
            assert pause_s <= RowForwarder.most_pause_s
            due_s = clocked.now_s + pause_s
    assert clocked.forwarder.problem == "the receiver takes no rows: Connection refused"
    assert clocked.forwarder.behind == messages
    clocked.receiver.failure = None
    for _ in range(10):
        assert clocked.forwarder.step() == 0
    store(clocked.spool, messages * 5, 5)
    assert clocked.send_all() == inf
    assert clocked.receiver.sequences == [240, *range(1, 10), 241, *range(10, 240)]
    assert sorted(clocked.exchanges()) == list(range((messages + 1) * 5))
    historical = [one.is_historical for one in clocked.receiver.messages]
    assert historical == [False, *[True] * 9, False, *[True] * 230]
    assert (clocked.forwarder.problem, clocked.spool.state().lost) == ("", 0)


def test_sent_messages_are_deleted_from_the_disk(clocked: Clocked) -> None:
    for number in range(5):
        store(clocked.spool, number * 5, 5)
        clocked.send_all()
    store(clocked.spool, 25, 5)
    until(lambda: clocked.spool.state().oldest == 6)


def test_the_oldest_unsent_rows_are_deleted_at_the_size_limit(tmp_path: Path) -> None:
    first = Clocked(tmp_path / "one")
    store(first.spool, 0, 5)
    first.spool.close()
    size = first.spool.state().stored
    full = Clocked(tmp_path / "spool", most=10 * size)
    full.receiver.failure = OSError("away")
    for number in range(30):
        store(full.spool, number * 5, 5)
        full.forwarder.step()
    until(lambda: full.spool.state().stored <= 10 * size)
    lost = full.spool.state().lost
    assert lost >= 20 * 50
    full.receiver.failure = None
    full.send_all()
    assert sorted(full.exchanges()) == list(range(lost // 10, 150))
    assert full.spool.state().lost == lost
    full.spool.close()


def test_sent_rows_do_not_count_as_lost_when_deleted(tmp_path: Path) -> None:
    """The full spool deletes messages 1 to 3. Message 3 had been sent, so only the rows of two are lost."""
    clocked = Clocked(tmp_path / "spool", most=1)
    clocked.spool.acknowledge(3, [(1, 2)])
    for number in range(4):
        store(clocked.spool, number * 5, 5)
    until(lambda: clocked.spool.state().oldest == 4)
    assert clocked.spool.state().lost == 100
    clocked.spool.close()


def test_a_restarted_forwarder_continues_after_the_last_sent_message(tmp_path: Path) -> None:
    first = Clocked(tmp_path / "spool")
    for number in range(3):
        store(first.spool, number * 5, 5)
        first.send_all()
    store(first.spool, 15, 5)
    first.spool.close()
    second = Clocked(tmp_path / "spool", first.receiver)
    store(second.spool, 20, 5)
    second.send_all()
    second.spool.close()
    assert second.receiver.sequences == [1, 2, 3, 5, 4]
    assert [one.is_historical for one in second.receiver.messages[3:]] == [False, True]


def test_a_message_keeps_its_id_when_sent_again_after_a_restart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = Clocked(tmp_path / "spool")
    store(first.spool, 0, 5)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError("killed")))
        first.send_all()
    first.spool.close()
    second = Clocked(tmp_path / "spool", first.receiver)
    second.send_all()
    second.spool.close()
    before, after = second.receiver.messages
    assert before.id == after.id
    assert before.rows == after.rows


@pytest.mark.parametrize("text", ["", "{}", '{"newest": "x", "gaps": []}', '{"newest": 2, "gaps": [1]}'])
def test_all_messages_are_sent_again_if_the_position_file_is_damaged(tmp_path: Path, text: str) -> None:
    first = Clocked(tmp_path / "spool")
    first.receiver.failure = OSError("away")
    for number in range(2):
        store(first.spool, number * 5, 5)
    first.spool.close()
    (tmp_path / "spool" / "position.json").write_text(text)
    second = Clocked(tmp_path / "spool")
    second.send_all()
    second.spool.close()
    assert second.receiver.sequences == [2, 1]


def test_a_too_large_number_in_the_position_file_is_reported(tmp_path: Path) -> None:
    clocked = Clocked(tmp_path / "spool")
    (tmp_path / "spool" / "position.json").write_text('{"newest": 7, "gaps": []}')
    store(clocked.spool, 0, 5)
    clocked.send_all()
    clocked.spool.close()
    assert "which ends at message 1: the folder was copied or set back" in clocked.forwarder.problem
    assert clocked.receiver.messages == []


def test_a_refused_message_is_skipped_if_the_next_one_is_accepted(clocked: Clocked) -> None:
    clocked.receiver.failure = Refused("HTTP Error 400: field type conflict")
    store(clocked.spool, 0, 5)
    assert clocked.send_all() > 0
    clocked.receiver.failure = None
    store(clocked.spool, 5, 5)
    assert clocked.forwarder.step() == 0
    clocked.receiver.failure = Refused("HTTP Error 400: field type conflict")
    assert clocked.send_all() == inf
    assert (clocked.receiver.sequences, clocked.forwarder.refused) == ([2], 50)


def test_a_message_damaged_on_the_disk_is_skipped_and_counted(clocked: Clocked) -> None:
    for number in range(3):
        store(clocked.spool, number * 5, 5)
    damaged = clocked.spool.following(1)
    assert damaged is not None
    damaged.path.write_bytes(b"no rows")
    assert clocked.send_all() == inf
    assert (clocked.receiver.sequences, clocked.forwarder.refused) == ([3, 1], 50)


def test_no_message_is_lost_while_the_receiver_refuses_all_messages(clocked: Clocked) -> None:
    clocked.receiver.failure = Refused("HTTP Error 400: database is required")
    for number in range(5):
        store(clocked.spool, number * 5, 5)
        clocked.send_all()
    assert "database is required" in clocked.forwarder.problem
    clocked.receiver.failure = None
    clocked.send_all()
    assert sorted(clocked.receiver.sequences) == [1, 2, 3, 4, 5]
    assert clocked.forwarder.refused == 0


def test_only_the_newest_refusals_are_kept_in_memory(
    clocked: Clocked, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forwarder_module, "MOST_REFUSALS", 2)
    test_no_message_is_lost_while_the_receiver_refuses_all_messages(clocked)
    assert [*clocked.forwarder._refusals] == [4, 5]


def test_a_hanging_receiver_is_reported(clocked: Clocked) -> None:
    found = []

    def hang() -> None:
        clocked.now_s += clocked.forwarder.slow_s + 1
        found.append(clocked.forwarder.problem)

    clocked.receiver.on_call = hang
    store(clocked.spool, 0, 5)
    clocked.send_all()
    assert found == ["the receiver has not answered for 40 s"]
    assert clocked.forwarder.problem == ""


@table("failure", [OSError("away"), KeyError("bug"), MemoryError()])
def test_unsent_rows_are_kept_after_any_failure_of_the_receiver(tmp_path: Path, failure: Exception) -> None:
    clocked = Clocked(tmp_path / "spool")
    clocked.receiver.failure = failure
    store(clocked.spool, 0, 5)
    pauses = [clocked.forwarder.step() for _ in range(7)]
    assert pauses == [1, 2, 4, 8, 16, 30, 30]
    clocked.receiver.failure = None
    clocked.send_all()
    clocked.spool.close()
    assert clocked.exchanges() == list(range(5))


def test_the_forwarder_thread_sends_new_rows(clocked: Clocked) -> None:
    thread = threading.Thread(target=clocked.forwarder.run)
    thread.start()
    clocked.spool.append(numbered(0, 5))
    clocked.spool.sync(30.0)
    until(lambda: clocked.receiver.sequences == [1])
    clocked.forwarder.close()
    thread.join()
