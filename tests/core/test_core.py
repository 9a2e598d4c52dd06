"""Exchanges on real file descriptors: queues, urgent exchanges, stops, failures and closing."""

from __future__ import annotations

import errno
import gc
import os
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import pairwise
from pathlib import Path

import pytest
from batches import pending, status_of
from frames import words
from lines import until
from multidrop._core import ffi
from tables import table

from multidrop.core import (
    EXCEPTION_STATUS,
    REFUSALS,
    STATUSES,
    Columns,
    Completion,
    Echo,
    Exchange,
    Extra,
    Failure,
    Field,
    Framing,
    Latch,
    Message,
    NumberFormat,
    Peer,
    Permit,
    Port,
    RowLayout,
    RowQueue,
    Status,
    boottime_ns,
    build_reply,
    now_ns,
    parse_request,
)

PARITY = next(bit for bit, name in REFUSALS.items() if name == "parity")
ANY_SETTINGS, NO_SETTINGS = 0, -1

ONE_VALUE = RowLayout(0, [Field(0, NumberFormat.U16, 0, 1, 1)])


def read(
    start: int,
    *,
    timeout: float = 5.0,
    format: str = "8N1",
    peer: Peer | None = None,
    period: float = 0.0,
    insists: bool = False,
    echo_probe: Exchange | None = None,
    values: RowLayout | None = None,
) -> Exchange:
    """Return a read of one register. The default `timeout` (s) is longer than any passing test."""
    return Exchange(
        Framing.RTU,
        Message(1, 0x03, start, 1),
        peer or Peer(least_timeout=timeout, most_timeout=timeout),
        baudrate=115_200,
        format=format,
        character=1e-6,
        silence=1e-4,
        turnaround=1e-4,
        period=period,
        insists=insists,
        block=ONE_VALUE,
        echo_probe=echo_probe,
        values=values,
    )


MINUTE_NS = 60_000_000_000  # no reply takes so long, even on a busy computer


def wait_until(look: Callable[[], bool]) -> None:
    while not look():
        time.sleep(0.001)


class Rows:
    """The rows of a port's exchanges, in the order of the exchanges."""

    def __init__(self, port: Port) -> None:
        self.row_queue = RowQueue()
        self._columns: list[Columns] = []
        port.report_to(self.row_queue, 0)

    def of(self, name: str, rows: int) -> list[int]:
        """Wait until there are `rows` rows; return their column `name`."""
        wait_until(lambda: self._taken() >= rows)
        return [each for columns in self._columns for each in columns.array(name)]

    def _taken(self) -> int:
        while columns := self.row_queue.take():
            self._columns.append(columns)
        return sum(map(len, self._columns))


def echo_start(request: Message) -> bytes:
    """Return the reply of a drive whose registers hold their own addresses."""
    data = words(request.start)
    return build_reply(Framing.RTU, Message(request.address, request.function, data=data))


def noting(
    requested: list[int], answer: Callable[[Message], bytes] = echo_start
) -> Callable[[Message], bytes]:
    """Return a function that replies like `answer`, and appends each requested address to `requested`."""

    def note_and_answer(request: Message) -> bytes:
        requested.append(request.start)
        return answer(request)

    return note_and_answer


@contextmanager
def opened(room: int = 256) -> Iterator[tuple[Port, socket.socket]]:
    """Yield a port and the far end of its line; both are closed at the end of the block."""
    near, far = socket.socketpair()
    near.setblocking(False)
    with near, far, closing(Port(near.fileno(), NO_SETTINGS, room=room)) as port:
        yield port, far


class Far:
    """The far end of a line: answers every request until the line is closed."""

    def __init__(self, fd: int, answer: Callable[[Message], bytes]) -> None:
        self.fd = fd
        self._answer = answer
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        received = b""
        while True:
            try:
                more = os.read(self.fd, 1024)
            except OSError:
                return
            if not more:
                return
            received += more
            used, request = parse_request(Framing.RTU, received)
            while request is not None:
                if answer := self._answer(request):
                    with suppress(OSError):  # the line is closed already
                        os.write(self.fd, answer)
                received = received[used:]
                used, request = parse_request(Framing.RTU, received)

    def join(self) -> None:
        self._thread.join()
        os.close(self.fd)


@pytest.fixture
def drive() -> Iterator[Callable[[Callable[[Message], bytes]], int]]:
    """Yield a function that makes a line with a drive at its far end, and returns the near descriptor."""
    lines: list[tuple[socket.socket, Far]] = []

    def make(answer: Callable[[Message], bytes]) -> int:
        near, far = socket.socketpair()
        near.setblocking(False)
        lines.append((near, Far(far.detach(), answer)))
        return near.fileno()

    yield make
    for near, far in lines:
        near.close()
        far.join()


Drive = Callable[[Callable[[Message], bytes]], int]


@pytest.fixture
def port(drive: Drive) -> Iterator[Port]:
    """Yield a port whose drive's registers hold their own addresses."""
    with closing(Port(drive(echo_start), NO_SETTINGS)) as port:
        yield port


@pytest.fixture
def rows(port: Port) -> Rows:
    return Rows(port)


def test_queued_exchanges_are_carried_out_in_order(drive: Drive) -> None:
    with closing(Port(drive(echo_start), NO_SETTINGS, room=128)) as port:
        rows = Rows(port)
        queued = [read(start) for start in range(100)]
        assert port.submit(queued, [0] * 100) == 100
        assert rows.of("value", 100) == list(range(100))
    assert rows.of("status", 100) == [0] * 100
    sent = rows.of("sent", 100)
    assert sent == sorted(sent)
    assert queued[0].peer.counters().values == 1


def test_a_full_queue_accepts_no_further_exchanges(drive: Drive) -> None:
    with closing(Port(drive(echo_start), NO_SETTINGS, room=4)) as port:
        later = [now_ns() + 60_000_000_000] * 6
        queued = [read(start) for start in range(6)]
        assert port.submit(queued, later) == 4
        assert port.submit(queued, later) == 0
        assert pending(port) == 4


def test_no_queued_request_is_sent_before_its_time(port: Port, rows: Rows) -> None:
    due = [now_ns() + 20_000_000, now_ns() + 40_000_000]
    queued = [read(0), read(1)]
    port.submit(queued, due)
    sent = rows.of("sent", 2)
    assert all(at >= wanted for at, wanted in zip(sent, due, strict=True))


def test_only_the_last_of_several_missed_polls_is_sent(drive: Drive) -> None:
    """The last poll that is due is sent, however late."""
    second = 1_000_000_000
    fast, slow, in_turn = read(1, period=1.0), read(2, period=30.0), read(3)
    with closing(Port(drive(echo_start), NO_SETTINGS)) as port:
        rows, now = Rows(port), now_ns()
        queued = [(fast, -50), (slow, -40), (fast, -30), (in_turn, -99), (fast, -20), (in_turn, 0)]
        port.submit([each for each, _ in queued], [now + at * second for _, at in queued])
        said = [STATUSES[each] for each in rows.of("status", len(queued))]
    over = "not sent: expired"
    assert said == [over, "ok", over, "ok", "ok", "ok"]
    assert fast.peer.counters().missed == {Status.EXPIRED: 2}


def test_late_poll_is_sent_if_the_next_poll_is_not_due_yet(port: Port) -> None:
    rows, now = Rows(port), now_ns()
    poll = read(1, period=1.0)
    port.submit([poll, poll], [now - 5_000_000_000, now + 60_000_000_000])
    assert rows.of("status", 1) == [0]


def test_repeated_exchanges_are_sent_until_they_are_replaced(port: Port, rows: Rows) -> None:
    port.repeat([read(0), read(1), read(2)])
    assert port.repeating
    assert rows.of("value", 30)[:30] == [0, 1, 2] * 10
    port.repeat([read(7)])
    so_far = len(rows.of("value", 30))
    assert rows.of("value", so_far + 10)[-1] == 7
    port.repeat([])
    assert not port.repeating
    assert status_of(port.carry_out(read(9))) == 0


def test_replacing_repeated_exchanges_returns_which_one_was_next(port: Port, rows: Rows) -> None:
    port.repeat([read(0), read(1), read(2)])
    rows.of("value", 20)
    following = port.repeat([])
    port.carry_out(read(9))  # carried out after the exchange in flight
    assert following == (rows.of("value", 20)[-1] + 1) % 3


def test_queued_exchanges_are_carried_out_between_repeated_exchanges(port: Port, rows: Rows) -> None:
    port.repeat([read(0)])
    rows.of("value", 1)
    queued, due_ns = [read(1), read(2)], now_ns() + 20_000_000
    port.submit(queued, [due_ns, due_ns])
    wait_until(lambda: not pending(port))
    port.stop()
    values, sent = rows.of("value", 3), rows.of("sent", 3)
    assert values[0] == 0  # repeated exchanges went on until the queued one was due
    at = values.index(1)
    assert values[at + 1] == 2
    assert sent[at] >= due_ns


def test_repeated_exchanges_end_if_one_cannot_be_sent(drive: Drive) -> None:
    slow = Peer(least_timeout=0.01, most_timeout=0.02)
    with closing(Port(drive(lambda _: b""), NO_SETTINGS)) as port:
        assert port.carry_out(read(1, peer=slow)).result == Failure.NO_REPLY
        slow.c.late_until_ns += MINUTE_NS
        rows = Rows(port)
        port.repeat([read(2, peer=slow), read(2, peer=slow)])
        wait_until(lambda: not port.repeating)
        assert rows.of("status", 1) == [Status.LATE_ANSWER_DUE]


def test_a_waiting_client_wakes_when_a_drive_fails_or_recovers(drive: Drive) -> None:
    silent = threading.Event()
    silent.set()
    peer = Peer(least_timeout=0.01, most_timeout=0.3)
    fd = drive(lambda request: b"" if silent.is_set() else echo_start(request))
    with closing(Port(fd, NO_SETTINGS)) as port:
        row_queue = RowQueue()
        port.report_to(row_queue, 17)
        asked = [read(0, peer=peer)]
        port.submit(asked, [0])
        assert row_queue.await_calls(60) == [17]
        assert peer.failures == 1
        silent.clear()
        wait_until(lambda: now_ns() > peer.late_until_ns)
        port.repeat(asked)
        # The first return may only report that no exchange is queued.
        while peer.failures:
            assert row_queue.await_calls(60) == [17]


def test_waiting_client_wakes_on_an_exception_reply_or_a_lost_port() -> None:
    with opened() as (port, far):
        row_queue = RowQueue()
        port.report_to(row_queue, 3)
        queued = [read(0), read(1), read(2)]
        port.submit(queued, [0, 0, now_ns() + 60_000_000_000])
        far.recv(1024)
        far.send(build_reply(Framing.RTU, Message(1, 0x03, exception=2)))
        assert row_queue.await_calls(60) == [3]
        far.close()
        wait_until(lambda: port.lost)
        assert row_queue.await_calls(60) == [3]


def test_rows_dropped_from_a_full_queue_are_counted(port: Port) -> None:
    row_queue = RowQueue(chunk_rows=10, most_chunks=2)
    port.report_to(row_queue, 0)
    queued = [read(start) for start in range(35)]
    port.submit(queued, [0] * 35)
    wait_until(lambda: not pending(port))
    assert (row_queue.chunks, row_queue.dropped) == (2, 20)
    kept = [columns for columns in (row_queue.take(), row_queue.take()) if columns]
    assert [each for columns in kept for each in columns.array("value")] == [*range(10), *range(30, 35)]


def test_memoryview_of_rows_stays_valid_after_its_columns_are_deleted(port: Port) -> None:
    row_queue = RowQueue()
    port.report_to(row_queue, 0)
    queued = [read(start) for start in range(100)]
    port.submit(queued, [0] * 100)
    wait_until(lambda: not pending(port))
    columns = row_queue.take()
    assert columns is not None
    values = columns.array("value")
    del columns, row_queue
    gc.collect()
    assert list(values) == list(range(100))


def test_columns_stay_valid_after_the_row_queue_is_freed(drive: Drive) -> None:
    with closing(Port(drive(echo_start), NO_SETTINGS)) as port:
        row_queue = RowQueue()
        port.report_to(row_queue, 0)
        queued = [read(7)]
        port.submit(queued, [0])
        wait_until(lambda: not pending(port))
        columns = row_queue.take()
    assert columns is not None
    ffi.release(row_queue.c)  # a garbage collector may free the queue before its columns
    assert list(columns.array("value")) == [7]
    del columns


def test_an_unreferenced_port_is_closed() -> None:
    near, far = socket.socketpair()
    near.setblocking(False)
    port = Port(near.fileno(), NO_SETTINGS)
    port.submit([read(0)], [now_ns() + 60_000_000_000])
    del port
    gc.collect()
    far.send(b"not for the core")
    assert near.recv(64) == b"not for the core"
    near.close()
    far.close()


@pytest.mark.parametrize("way", ["queued", "repeated", "urgent"])
def test_an_echo_probe_is_sent_first_if_the_adapter_may_echo(drive: Drive, way: str) -> None:
    requested: list[int] = []
    with closing(Port(drive(noting(requested)), NO_SETTINGS)) as port:
        rows, asked = Rows(port), [read(7, echo_probe=read(99))]
        if way == "urgent":
            assert [port.carry_out(asked[0]).reply.data for _ in range(2)] == [words(7)] * 2
        else:
            port.submit(asked * 2, [0, 0]) if way == "queued" else port.repeat(asked)
            assert rows.of("value", 2)[:2] == [7, 7]  # the echo probe has no row
        assert requested[:3] == [99, 7, 7]


def test_an_inconclusive_echo_probe_is_repeated(drive: Drive) -> None:
    requested: list[int] = []
    with closing(Port(drive(noting(requested, lambda _: b"")), NO_SETTINGS)) as port:
        nobody = Peer(least_timeout=0.001, most_timeout=0.001)
        asked = read(7, peer=nobody, echo_probe=read(99, peer=nobody))
        asked.c.insists = asked.echo_probe.c.insists = 1
        for _ in range(2):
            assert port.carry_out(asked).result == Failure.NO_REPLY
        until(lambda: requested == [99, 7, 99, 7])  # wait until the far end has seen the last request


@pytest.mark.parametrize("echo", [Echo.ON, Echo.OFF])
def test_no_echo_probe_is_sent_if_the_echo_option_is_set(drive: Drive, echo: Echo) -> None:
    requested: list[int] = []
    with closing(Port(drive(noting(requested)), NO_SETTINGS)) as port:
        port.set_echo(echo)
        assert port.carry_out(read(7, echo_probe=read(99))).result == 7
    assert requested == [7]


def test_an_urgent_exchange_is_sent_before_the_queue(port: Port) -> None:
    waiting = [read(0)]
    port.submit(waiting, [now_ns() + 60_000_000_000])
    found = port.carry_out(read(7))
    assert (found.result, found.reply.data) == (7, words(7))
    assert pending(port) == 1


def test_the_result_of_an_exchange_has_the_values_of_its_reply(drive: Drive) -> None:
    lacking = Extra(invalid=((0xFFFF, 8),))
    tenths, eight = (Field(0, NumberFormat.U16, 0, 1, 10, extra) for extra in (None, lacking))
    values = RowLayout(0, [tenths, eight])
    with closing(Port(drive(echo_start), NO_SETTINGS)) as port:
        first = port.carry_out(read(7, values=values))
        assert (first.count, first.numbers.tolist()) == (2, [0.7, 0.7])
        again = port.carry_out(read(8, values=values), into=first)
        assert again is first
        assert again.count == 1
        assert again.values_of(values) == [0.8, None]
        assert again.numbers[1] != again.numbers[1]


def test_result_memory_is_not_reused_if_too_small_for_the_values(port: Port) -> None:
    short = Completion()
    found = port.carry_out(read(7, values=ONE_VALUE), into=short)
    assert found is not short
    assert found.numbers.tolist() == [7]
    assert short.result == 0


def test_expired_urgent_exchange_is_not_sent(drive: Drive) -> None:
    requested: list[int] = []
    with closing(Port(drive(noting(requested)), NO_SETTINGS)) as port:
        found = port.carry_out(read(3), expires_ns=boottime_ns() - 1)
        assert (found.result, found.sent_ns) == (Failure.EXPIRED, 0)
        assert port.carry_out(read(4)).result == 7
    assert requested == [4]


def written(
    address: int, start: int, *, turnaround: float = 1e-4, insists: bool = False, permit: Permit | None = None
) -> Exchange:
    return Exchange(
        Framing.RTU,
        Message(address, 6, start, data=bytes(2)),
        Peer(least_timeout=30.0, most_timeout=30.0),
        baudrate=115_200,
        format="8N1",
        character=1e-6,
        silence=1e-4,
        turnaround=turnaround,
        insists=insists,
        permit=permit,
    )


def test_urgent_exchange_is_not_sent_after_expiring_in_the_queue(drive: Drive) -> None:
    fd = drive(lambda request: echo_start(request) if request.address else b"")
    with closing(Port(fd, NO_SETTINGS)) as port:
        assert port.carry_out(written(0, 1, turnaround=0.3)).result == 0
        found = port.carry_out(read(3), expires_ns=boottime_ns() + 50_000_000)
        assert (found.result, found.sent_ns) == (Failure.EXPIRED, 0)


def test_stop_overtakes_waiting_requests_and_cancels_earlier_starts(drive: Drive) -> None:
    """An earlier start of the drive must be sent neither after the stop, nor before it."""
    latch, other = Latch(), Latch()
    requested: list[int] = []
    found: dict[int, Completion] = {}
    go_on = threading.Event()

    def answer(request: Message) -> bytes:
        requested.append(request.start)
        if len(requested) == 1:
            go_on.wait(120)
        return build_reply(Framing.RTU, request) if request.function == 6 else echo_start(request)

    with closing(Port(drive(answer), NO_SETTINGS)) as port:

        def carry_out(exchange: Exchange) -> None:
            found[exchange.request.start] = port.carry_out(exchange)

        start, others = written(2, 50, permit=latch.permit()), written(3, 51, permit=other.permit())
        wanted = [read(0, timeout=30), read(1, timeout=30), start, others, written(2, 98, insists=True)]
        threads = [threading.Thread(target=carry_out, args=[each]) for each in wanted]
        for thread in threads:
            thread.start()
            wait_until_it_sleeps(thread)  # so that the waiting requests arrive in this order
        latch.revoke("a stop was called")
        late = [written(2, 52, permit=latch.permit()), written(2, 99, insists=True)]
        for exchange in late:
            threads.append(threading.Thread(target=carry_out, args=[exchange]))
            threads[-1].start()
            wait_until_it_sleeps(threads[-1])
        go_on.set()
        for thread in threads:
            thread.join(120)
    assert requested == [0, 98, 99, 1, 51, 52]
    assert (found[50].result, found[50].sent_ns) == (Failure.EXPIRED, 0)


def test_write_permit_from_before_or_during_a_stop_stays_invalid() -> None:
    latch = Latch()
    before = latch.permit()
    assert before.is_good
    latch.hold("stop", "a stop")
    assert not before.is_good
    during = latch.permit()
    assert not during.is_good
    latch.let_go("stop")
    assert (before.is_good, during.is_good) == (False, False)
    assert latch.permit().is_good
    latch.shut("the bus was closed")
    assert not latch.permit().is_good


def test_write_permits_are_invalid_until_the_last_of_several_stops_ends() -> None:
    latch = Latch()
    latch.hold(1, "a stop")
    latch.hold(2, "another stop")
    latch.let_go(2)
    assert not latch.permit().is_good
    latch.let_go(1)
    assert latch.permit().is_good


def test_write_permit_is_invalid_if_the_call_began_before_a_stop() -> None:
    latch = Latch()
    seen = latch.c[0]
    assert latch.permit(seen).is_good
    latch.revoke("a stop")
    assert not latch.permit(seen).is_good
    assert latch.permit().is_good


def test_closing_a_port_wakes_its_threads_and_reports_what_was_sent(drive: Drive) -> None:
    """A request that was still waiting when its port was closed is never sent."""
    came = threading.Event()

    def answer(request: Message) -> bytes:
        came.set()
        return b""

    fd = drive(answer)
    port = Port(fd, NO_SETTINGS)
    found: list[Completion] = []
    exchanges = [written(1, 50), written(1, 51)]

    def carry_out(exchange: Exchange) -> None:
        found.append(port.carry_out(exchange))

    threads = [threading.Thread(target=carry_out, args=[each]) for each in exchanges]
    threads[0].start()
    assert came.wait(120)
    threads[1].start()
    wait_until_it_sleeps(threads[1])  # the second request now waits behind the first
    port.stop()
    for thread in threads:
        thread.join(120)
    port.close()
    assert [each.result for each in found] == [Failure.LINE_LOST] * 2
    assert sorted(each.sent_ns > 0 for each in found) == [False, True]


def test_every_counted_exchange_has_a_row_after_the_port_closes() -> None:
    """The port is closed at the moment when a reply comes."""
    values = 0
    for _ in range(60):
        asked = read(7)
        with opened() as (port, far):
            rows = Rows(port)
            port.submit([asked], [0])
            _, request = parse_request(Framing.RTU, far.recv(100))
            assert request is not None
            far.send(echo_start(request))
            port.stop()
            counted = asked.peer.counters().values
            assert len(rows.of("status", counted)) == counted
            assert port.done == counted
        assert port.done == counted
        values += counted
    assert values


def wait_until_it_sleeps(thread: threading.Thread) -> None:
    """Wait until the thread sleeps in the C core."""
    stat = Path(f"/proc/self/task/{thread.native_id}/stat")
    asleep = 0
    while asleep < 20:
        time.sleep(0.001)
        asleep = asleep + 1 if stat.read_text().rpartition(")")[2].split()[0] == "S" else 0


@pytest.mark.parametrize("insists", [False, True], ids=["reads", "stops"])
def test_polling_continues_between_urgent_exchanges_except_during_stops(drive: Drive, insists: bool) -> None:
    """Between urgent exchanges, polling gets one exchange at a time, and never two in a row."""
    asked: list[str] = []
    go_on = threading.Event()

    def answer(request: Message) -> bytes:
        asked.append("urgent" if request.start else "polled")
        if request.start == 9:
            go_on.wait()
        return echo_start(request)

    with closing(Port(drive(answer), NO_SETTINGS)) as port:
        wanted = [read(number, timeout=60.0, insists=insists) for number in (9, 1, 2, 3, 4)]
        threads = [threading.Thread(target=port.carry_out, args=[each]) for each in wanted]
        for thread in threads:
            thread.start()
            wait_until_it_sleeps(thread)
            port.repeat([read(0, timeout=60.0)])
        go_on.set()
        for thread in threads:
            thread.join()
        port.repeat([])
    beside = asked[: len(asked) - asked[::-1].index("urgent")]
    assert beside.count("urgent") == 5
    assert ("polled" in beside) is not insists
    assert ("polled", "polled") not in pairwise(beside)


def test_a_port_is_served_on_time_after_another_port_was_closed(drive: Drive) -> None:
    first = Port(drive(echo_start), NO_SETTINGS)
    with closing(Port(drive(echo_start), NO_SETTINGS)) as port:
        first.close()
        port.submit([read(1)], [now_ns() + 20_000_000])
        until(lambda: not pending(port))


def test_queued_exchanges_are_not_garbage_collected_before_they_end(port: Port, rows: Rows) -> None:
    port.submit([read(1), read(2)], [now_ns() + 20_000_000] * 2)
    gc.collect()
    assert rows.of("value", 2) == [1, 2]


def test_the_result_of_an_exception_reply_has_the_exception_code(drive: Drive) -> None:
    fd = drive(lambda _: build_reply(Framing.RTU, Message(1, 0x03, exception=2)))
    with closing(Port(fd, NO_SETTINGS)) as port:
        assert status_of(port.carry_out(read(0))) == EXCEPTION_STATUS + 2


def test_queued_exchanges_continue_after_a_silent_drive(drive: Drive) -> None:
    fd = drive(lambda request: b"" if request.start == 1 else echo_start(request))
    with closing(Port(fd, NO_SETTINGS)) as port:
        rows = Rows(port)
        queued = [read(0), read(1, timeout=0.02), read(2)]
        port.submit(queued, [0] * 3)
        assert rows.of("status", 3) == [0, Status.NO_REPLY, 0]


def test_a_request_waits_while_a_late_reply_could_be_taken_for_its_reply(drive: Drive) -> None:
    slow = Peer(least_timeout=0.01, most_timeout=0.02)
    fd = drive(lambda request: b"" if request.start == 1 else echo_start(request))
    with closing(Port(fd, NO_SETTINGS)) as port:
        assert port.carry_out(read(1, peer=slow)).result == Failure.NO_REPLY
        slow.c.late_until_ns += MINUTE_NS
        rows = Rows(port)
        queued = read(2, peer=slow)
        port.submit([queued], [0])
        assert rows.of("status", 1) == [Status.LATE_ANSWER_DUE]
        assert slow.failures == 1
        slow.c.late_until_ns -= MINUTE_NS
        wait_until(lambda: now_ns() > slow.late_until_ns)
        assert port.carry_out(queued).result == 7


def test_a_broadcast_waits_only_for_the_turnaround_delay(drive: Drive) -> None:
    requested: list[int] = []

    def answer(request: Message) -> bytes:
        requested.append(request.address)
        return b"" if request.address == 0 else echo_start(request)

    stop = Exchange(
        Framing.RTU,
        Message(0, 0x06, 0x2000, data=words(1)),
        Peer(least_timeout=5, most_timeout=5),
        baudrate=115_200,
        format="8N1",
        character=1e-6,
        silence=1e-4,
        turnaround=1e-3,
    )
    with closing(Port(drive(answer), NO_SETTINGS)) as port:
        sent, read_back = port.carry_out(stop), port.carry_out(read(7))
    assert (status_of(sent), status_of(read_back)) == (0, 0)
    assert requested == [0, 1]
    assert read_back.sent_ns - sent.sent_ns >= 1_000_000  # the turnaround delay, in ns


def test_exchanges_queued_on_a_lost_port_stay_queued() -> None:
    """The poller queues them again on the port that it opens next."""
    with opened() as (port, far):
        far.close()
        until(lambda: port.lost)
        assert port.submit([read(0), read(1), read(2)], [0] * 3) == 3
        assert (port.done, port.cut_off) == (0, False)
        assert port.carry_out(read(0)).result == Failure.LINE_LOST


@table("way", ["queued", "repeated"])
@table("answered", [0, 1])
def test_cut_off_tells_whether_replies_came_before_the_port_was_lost(answered: int, way: str) -> None:
    with opened() as (port, far):
        todo = [read(0), read(1), read(2)]
        port.submit(todo, [0] * 3) if way == "queued" else port.repeat(todo)
        for _ in range(answered):
            _, request = parse_request(Framing.RTU, far.recv(64))
            assert request
            far.send(echo_start(request))
        far.recv(64)
        far.close()
        until(lambda: port.lost)
        assert port.cut_off is (answered > 0)
        if way == "queued":
            until(lambda: port.done == answered + 1)
        else:
            assert port.repeat([]) == 1  # index of the exchange that comes next: the one without a reply


def test_port_is_lost_if_the_far_end_of_a_pty_hangs_up() -> None:
    master, slave = os.openpty()
    os.set_blocking(slave, False)
    with closing(Port(slave, ANY_SETTINGS)) as port:
        os.close(master)
        found = port.carry_out(read(0))
        assert (found.result, found.error) in (
            (Failure.LINE_LOST, errno.EIO),
            (Failure.LINE_LOST, 0),  # end of file
        )
    os.close(slave)


def test_no_request_is_sent_if_the_port_refuses_its_settings() -> None:
    """A request with wrong parity must not be sent. A pty has no parity."""
    master, slave = os.openpty()
    os.set_blocking(slave, False)
    os.set_blocking(master, False)
    with closing(Port(slave, PARITY)) as port:
        found = port.carry_out(read(0, format="8E1"))
        assert (found.result, found.error, found.sent_ns) == (Failure.SETTINGS_REFUSED, PARITY, 0)
    with pytest.raises(BlockingIOError):
        os.read(master, 1)
    with closing(Port(slave, ANY_SETTINGS)) as port:
        assert port.carry_out(read(0, format="8E1", timeout=0.001)).result == Failure.NO_REPLY
    os.close(slave)
    os.close(master)


def test_duration_of_a_settings_change_is_measured() -> None:
    master, slave = os.openpty()
    os.set_blocking(slave, False)
    with closing(Port(slave, ANY_SETTINGS)) as port:
        assert port.switching == 0
        begun = now_ns()
        for format in ("8N1", "8E1", "8N1"):
            port.carry_out(read(0, format=format, timeout=0.001))
        assert 0 < port.switching * 3e9 < now_ns() - begun
    os.close(slave)
    os.close(master)


def test_port_is_lost_if_the_descriptor_has_no_serial_settings(drive: Drive) -> None:
    with closing(Port(drive(echo_start), ANY_SETTINGS)) as port:
        found = port.carry_out(read(0))
        assert (found.result, found.error) == (Failure.LINE_LOST, errno.ENOTTY)


def test_an_invalid_descriptor_raises() -> None:
    with pytest.raises(OSError, match="the core cannot watch the port"):
        Port(-1, NO_SETTINGS)


def test_is_asking_is_true_while_the_drive_has_pending_exchanges() -> None:
    """`is_asking` is true while a drive's exchanges wait or are in flight, but not for another drive."""
    with opened(room=4) as (port, far):
        queued, repeated, other = (read(1, timeout=0.02) for _ in range(3))
        assert not port.is_asking(queued.peer)
        port.submit([queued], [now_ns() + 3600 * 10**9])
        assert port.is_asking(queued.peer)
        assert not port.is_asking(other.peer)
        port.repeat([repeated])
        assert far.recv(100)  # now the request is in flight
        port.repeat([])
        assert port.is_asking(repeated.peer)
        until(lambda: not port.is_asking(repeated.peer))
        later = {"not_before_ns": now_ns() + 3600 * 10**9}
        urgent = threading.Thread(target=port.carry_out, args=[other], kwargs=later)
        urgent.start()
        until(lambda: port.is_asking(other.peer))
        assert port.is_asking(queued.peer)
        port.stop()
        urgent.join()


@pytest.mark.slow
def test_opening_and_closing_a_thousand_ports_leaks_no_descriptor(drive: Drive) -> None:
    """The ports are opened and closed one after another, with or without an exchange in flight."""

    def come_and_go(start: int) -> int:
        with opened(room=4) as (port, _):
            queued = [read(start)]
            port.submit(queued, [0])
        return len(list(Path("/dev/fd").iterdir()))

    before = come_and_go(0)  # opens the descriptors that the C core keeps
    assert {come_and_go(start) for start in range(1, 1000)} == {before}


@pytest.fixture
def descriptors() -> Iterator[int]:
    """Raise the limit of open descriptors to the system's maximum, and return it."""
    least, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    yield most
    resource.setrlimit(resource.RLIMIT_NOFILE, (least, most))


@pytest.mark.long
def test_a_thousand_ports_can_be_open_together(descriptors: int) -> None:
    """All ports are opened twice. Each is closed while the others still have exchanges in flight."""
    if descriptors < 2500:
        pytest.skip(f"a process may have no more than {descriptors} descriptors here")

    def come_and_go() -> int:
        with ExitStack() as stack:
            lines: list[tuple[Port, Rows, Exchange, socket.socket]] = []
            for number in range(1024):
                near, far = map(stack.enter_context, socket.socketpair())
                near.setblocking(False)
                port = stack.enter_context(closing(Port(near.fileno(), NO_SETTINGS, room=4)))
                lines.append((port, Rows(port), read(number, timeout=60.0), far))
                port.submit([lines[-1][2]], [0])
            for number, (port, rows, _, far) in enumerate(lines):
                _, request = parse_request(Framing.RTU, far.recv(64))
                assert request is not None
                far.send(echo_start(request))
                assert rows.of("value", 1) == [number]
                port.close()
        return len(list(Path("/dev/fd").iterdir()))

    assert come_and_go() == come_and_go()


@pytest.mark.slow
@pytest.mark.parametrize("exchanges", [10_000, pytest.param(50_000, marks=pytest.mark.long)])
def test_memory_does_not_grow_over_many_exchanges(drive: Drive, exchanges: int) -> None:
    asked, row_queue = read(0), RowQueue(chunk_rows=1000, most_chunks=4)
    asked.c.silence_ns = 1000

    def resident_after(exchanges: int) -> int:
        """Return the resident memory in bytes after this number of exchanges."""
        while exchanges > 0:
            time.sleep(0.01)
            while columns := row_queue.take():
                exchanges -= len(columns)
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")

    with closing(Port(drive(echo_start), NO_SETTINGS)) as port:
        port.report_to(row_queue, 0)
        port.repeat([asked])
        before = resident_after(5_000)
        assert resident_after(exchanges) - before < 1_000_000  # bytes, for all exchanges together


@table("status", list(Status))
def test_every_status_has_a_text(status: Status) -> None:
    assert str(status)
    assert STATUSES[status] == str(status)
