"""An adapter that takes no bytes: commands, stops, and closing its port.

The adapter is the far end of a socket pair, and does not read: the system reports its bytes as queued, as
a serial driver does. If the far end only peeks at the bytes, their count stays above 0 although it replies.
An exchange with baud rate 0 leaves the pair's settings alone.
"""

from __future__ import annotations

import errno
import os
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from line_driver import LineDriver
from lines import PATIENCE, until
from multidrop._core import lib

from multidrop.core import (
    Completion,
    Exchange,
    Failure,
    Framing,
    Message,
    Peer,
    Port,
    build_reply,
    build_request,
    close_behind,
)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems do not count a pair's bytes")
READ = Message(1, 0x03, 0x10, 1)
START = Message(1, 0x06, 0x20, data=b"\0\1")
STOP = Message(1, 0x06, 0x20, data=b"\0\0")
SET_ALL = Message(0, 0x06, 0x21, data=b"\0\1")
OTHER = Message(1, 0x03, 0x11, 1)
SILENT = Message(2, 0x03, 0x10, 1)
TIMEOUT_S = 0.02
Ends = tuple[socket.socket, socket.socket]
SO_PEEK_OFF = 42  # Linux's number; with it, each peek continues after the last one


@pytest.fixture
def ends() -> Iterator[Ends]:
    ours, adapter = socket.socketpair()
    ours.setblocking(False)
    adapter.setblocking(False)
    with ours, adapter:
        yield ours, adapter


@pytest.fixture
def port(ends: Ends) -> Iterator[Port]:
    made = Port(ends[0].fileno(), must_take=0)
    yield made
    made.stop()


@pytest.fixture
def free_port() -> Iterator[Port]:
    """Return the port of an adapter that takes each frame and never replies: a pty, which counts no bytes."""
    far_end, terminal = os.openpty()
    os.set_blocking(terminal, False)
    made = Port(terminal, must_take=0)
    yield made
    made.stop()
    os.close(terminal)
    os.close(far_end)


def exchange(
    message: Message,
    *,
    insists: bool = False,
    timeout: float = TIMEOUT_S,
    peer: Peer | None = None,
    baudrate: int = 0,
) -> Exchange:
    peer = peer or Peer(least_timeout=timeout, most_timeout=timeout)
    form = "8N1" if baudrate else "0\0000"[:3]
    timing = {"character": 1e-5, "silence": 1e-4}
    return Exchange(Framing.RTU, message, peer, insists=insists, baudrate=baudrate, format=form, **timing)


def taken(adapter: socket.socket) -> list[bytes]:
    """Return the frames that have reached the adapter; each has eight bytes."""
    received = adapter.recv(4096)
    return [received[at : at + 8] for at in range(0, len(received), 8)]


def frame(message: Message) -> bytes:
    return build_request(Framing.RTU, message)


REQUESTS = {frame(request): request for request in (READ, OTHER, START)}


class Device:
    """A device that takes and answers each request to drive 1, in a thread, until `count` requests have come.

    Its driver still counts the bytes of a request for `lag` s after the reply. From the request with the
    index `miscounted` on, it counts them for ever.
    """

    def __init__(
        self, adapter: socket.socket, count: int = 1, *, miscounted: int = 100, lag: float = 0.0
    ) -> None:
        self.heard: list[bytes] = []
        self._adapter, self._count, self._miscounted, self._lag = adapter, count, miscounted, lag
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Device:
        self._adapter.setblocking(True)
        self._adapter.setsockopt(socket.SOL_SOCKET, SO_PEEK_OFF, 0)
        self._thread.start()
        return self

    def __exit__(self, *failure: object) -> None:
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        for number in range(self._count):
            self.heard.append(self._adapter.recv(8, socket.MSG_PEEK))
            if request := REQUESTS.get(self.heard[-1]):
                self._adapter.send(build_reply(Framing.RTU, replace(request, data=b"\0\1")))
            if number < self._miscounted:
                time.sleep(self._lag)
                self._adapter.recv(8)


def test_stalled_adapter_gets_stops_but_no_other_commands(ends: Ends, port: Port) -> None:
    assert port.carry_out(exchange(READ)).result == Failure.NO_REPLY
    assert port.is_stalled
    start = port.carry_out(exchange(START))
    assert (start.result, start.error, start.sent_ns) == (Failure.LINE_LOST, errno.ETIMEDOUT, 0)
    assert port.carry_out(exchange(STOP, insists=True)).sent_ns > 0
    assert (port.lost, port.called_off) == (False, False)
    assert taken(ends[1]) == [frame(READ), frame(STOP)]


@pytest.mark.parametrize("insists", [False, True], ids=["read", "read of a stop"])
def test_only_one_read_is_written_to_a_stalled_adapter_before_a_stop(
    ends: Ends, port: Port, insists: bool
) -> None:
    peer = Peer(least_timeout=TIMEOUT_S, most_timeout=TIMEOUT_S)
    assert port.carry_out(exchange(READ)).result == Failure.NO_REPLY
    for _ in range(3):
        read = port.carry_out(exchange(READ, insists=insists, peer=peer))
        assert (read.result, read.sent_ns) == (Failure.STALLED, 0)
    assert (peer.failures, peer.owes, port.miscounts) == (0, False, False)
    assert port.carry_out(exchange(STOP, insists=True)).sent_ns > 0
    assert not port.lost
    assert taken(ends[1]) == [frame(READ), frame(STOP)]


def test_stop_overtakes_reads_that_wait_for_a_stalled_adapter(ends: Ends, port: Port) -> None:
    """The read is sent after the stop, once the adapter has taken the stop and the earlier read."""
    assert port.carry_out(exchange(READ)).result == Failure.NO_REPLY
    port.submit([exchange(OTHER)] + [exchange(OTHER, timeout=0.2)] * 64, [0] * 65)
    until(lambda: port.done > 0)  # the first queued read has ended unsent; the second one waits
    assert port.carry_out(exchange(STOP, insists=True)).sent_ns > 0
    assert taken(ends[1]) == [frame(READ), frame(STOP)]
    select.select([ends[1]], [], [])
    assert taken(ends[1])[0] == frame(OTHER)


@pytest.mark.long
def test_a_reply_after_a_stall_is_not_taken_for_the_reply_to_the_next_read(ends: Ends, port: Port) -> None:
    """The stall is longer than the time for which late replies are expected."""
    adapter, peer = ends[1], Peer(least_timeout=0.2, most_timeout=0.2)

    def answer(value: bytes) -> bytes:
        request = adapter.recv(8)
        time.sleep(TIMEOUT_S / 4)  # the device's response delay
        adapter.send(build_reply(Framing.RTU, replace(READ, data=value)))
        return request

    def read() -> Completion:
        return port.carry_out(exchange(OTHER, peer=peer))

    assert port.carry_out(exchange(READ, peer=peer)).result == Failure.NO_REPLY
    while (held := read()).result == Failure.LATE_ANSWER_DUE:
        time.sleep(TIMEOUT_S)
    assert held.result == Failure.STALLED
    adapter.setblocking(True)
    with ThreadPoolExecutor(2) as pool:
        reading = pool.submit(read)
        time.sleep(TIMEOUT_S)
        assert answer(b"\0\7") == frame(READ)
        answering = pool.submit(answer, b"\0\x09")
        completion = reading.result()
        while not completion.sent_ns:
            completion = read()
        assert completion.reply.data == b"\0\x09"
        assert answering.result() == frame(OTHER)


def test_polling_ends_without_waiting_for_a_read_on_a_stalled_adapter(port: Port) -> None:
    assert port.carry_out(exchange(READ)).result == Failure.NO_REPLY
    port.submit([exchange(READ), exchange(READ, timeout=30.0)], [0, 0])
    until(lambda: port.done > 0)  # the first queued read has ended unsent; the second one waits
    assert not port.end()


def test_a_broadcast_command_is_not_written_to_a_stalled_adapter(port: Port) -> None:
    assert port.carry_out(exchange(READ)).result == Failure.NO_REPLY
    held = port.carry_out(exchange(SET_ALL))
    assert (held.result, held.error, held.sent_ns) == (Failure.LINE_LOST, errno.ETIMEDOUT, 0)


def test_a_broadcast_command_does_not_wait_for_late_replies(free_port: Port) -> None:
    peer = Peer(least_timeout=TIMEOUT_S, most_timeout=PATIENCE)  # late replies are expected for PATIENCE
    start, set_all = (exchange(message, peer=peer, baudrate=9600) for message in (START, SET_ALL))
    assert free_port.carry_out(start).result == Failure.NO_REPLY
    assert free_port.carry_out(start).result == Failure.LATE_ANSWER_DUE
    assert free_port.carry_out(set_all).sent_ns > 0


def test_a_port_is_lost_if_its_adapter_does_not_accept_a_command(port: Port) -> None:
    start = port.carry_out(exchange(START))
    assert (start.result, start.error) == (Failure.LINE_LOST, errno.ETIMEDOUT)
    assert start.sent_ns > 0
    assert (port.lost, port.lost_error, port.called_off) == (True, errno.ETIMEDOUT, True)


def test_a_port_is_not_lost_if_its_adapter_accepted_the_command(free_port: Port) -> None:
    assert free_port.carry_out(exchange(START, baudrate=9600)).result == Failure.NO_REPLY
    assert (free_port.is_stalled, free_port.lost, free_port.called_off) == (False, False, False)


def test_a_reply_ends_the_stall_of_an_adapter(ends: Ends, port: Port) -> None:
    assert port.carry_out(exchange(READ)).result == Failure.NO_REPLY
    ends[1].recv(4096)
    with Device(ends[1]):
        read = exchange(OTHER, timeout=PATIENCE, insists=True)  # does not wait for late replies
        assert port.carry_out(read).result > 0
    assert not port.is_stalled


def test_closing_a_port_cancels_a_command_in_flight(ends: Ends, port: Port) -> None:
    found: list[Completion] = []
    caller = threading.Thread(target=lambda: found.append(port.carry_out(exchange(START, timeout=30.0))))
    caller.start()
    select.select([ends[1]], [], [])  # waits until the command is written
    port.stop()
    caller.join()
    assert (found[0].result, port.called_off) == (Failure.LINE_LOST, True)


def patient(message: Message) -> Exchange:
    return exchange(message, timeout=PATIENCE)


def test_unsent_byte_count_is_ignored_if_always_above_0(ends: Ends, port: Port) -> None:
    requests = [READ, OTHER, READ, START, SILENT, OTHER]
    with Device(ends[1], len(requests), miscounted=0) as device:
        for request in requests[:4]:
            assert port.carry_out(patient(request)).result > 0
        assert port.miscounts
        assert port.carry_out(exchange(SILENT)).result == Failure.NO_REPLY
        assert not port.is_stalled
        assert port.carry_out(patient(OTHER)).result > 0
    assert device.heard == [frame(request) for request in requests]


@pytest.mark.long
def test_wrong_unsent_byte_count_does_not_stall_other_drives(ends: Ends, port: Port) -> None:
    requests = [READ, OTHER, SILENT, READ, SILENT]
    with Device(ends[1], len(requests), miscounted=0):
        for request in requests[:2]:
            assert port.carry_out(patient(request)).result > 0
        assert port.carry_out(exchange(SILENT, timeout=0.2)).result == Failure.NO_REPLY
        assert port.carry_out(patient(READ)).result > 0  # sent 1 s later, because SILENT seems to be unsent
        assert port.carry_out(exchange(SILENT, timeout=0.2)).result == Failure.NO_REPLY
    assert (port.miscounts, port.is_stalled) == (True, False)


@pytest.mark.parametrize(("failures", "was_wrong", "seconds"), [(0, 0, 30), (1, 0, 40), (0, 1, 1), (1, 1, 1)])
def test_wait_for_a_stalled_adapter_depends_on_earlier_failures(
    failures: int, was_wrong: int, seconds: int
) -> None:
    peer, line = Peer(least_timeout=1, most_timeout=1), LineDriver()
    peer.c.failures = failures
    line.begin(exchange(READ, peer=peer))
    assert lib.md_line_hold_ns(line._line, was_wrong) == seconds * 10**9


def test_wrong_unsent_byte_count_is_ignored_after_three_replies(ends: Ends, port: Port) -> None:
    with Device(ends[1], 6, miscounted=2):
        for _ in range(3):
            assert port.carry_out(patient(READ)).result > 0
        held = port.carry_out(exchange(START, timeout=0.2))
        assert (held.result, held.sent_ns, port.miscounts) == (Failure.LINE_LOST, 0, False)
        for _ in range(2):
            assert port.carry_out(patient(READ)).result > 0
        assert port.carry_out(patient(START)).result > 0
    assert port.miscounts


def test_unsent_byte_count_is_still_used_if_updated_late(ends: Ends, port: Port) -> None:
    with Device(ends[1], 5, lag=TIMEOUT_S / 2):
        for _ in range(5):
            assert port.carry_out(patient(READ)).result > 0
    assert port.carry_out(exchange(SILENT)).result == Failure.NO_REPLY
    assert (port.miscounts, port.is_stalled) == (False, True)


def test_stop_does_not_wait_for_a_wrong_unsent_byte_count(ends: Ends, port: Port) -> None:
    """The port ignores a wrong count after three requests that waited for it. The stop does not wait."""
    stop = exchange(START, timeout=PATIENCE, insists=True)
    with Device(ends[1], 4, miscounted=0):
        for each in (patient(READ), stop, patient(READ), patient(READ)):
            assert port.carry_out(each).result > 0
    assert not port.miscounts


def test_a_port_closes_without_waiting_for_a_stalled_far_end() -> None:
    """The test uses a TCP connection: with a linger time of 60 s, its `close` blocks like a serial port's."""
    handled: list[int] = []
    before = signal.signal(signal.SIGRTMAX, lambda number, frame: handled.append(number))
    try:
        with socket.create_server(("127.0.0.1", 0)) as listener, Path(os.devnull).open() as other:
            sender = socket.create_connection(listener.getsockname())
            accepted, _ = listener.accept()
            sender.setblocking(False)
            with suppress(BlockingIOError):
                while True:
                    sender.send(bytes(65536))
            sender.setblocking(True)
            sender.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 60))
            begun = time.monotonic()
            close_behind(sender.fileno(), other.fileno(), 0.01)
            assert time.monotonic() - begun < 30
            accepted.close()
            assert os.path.sameopenfile(sender.fileno(), other.fileno())
            os.close(sender.detach())
        assert handled == []
        assert signal.getsignal(signal.SIGRTMAX) not in (signal.SIG_DFL, before)
    finally:
        signal.signal(signal.SIGRTMAX, before)
