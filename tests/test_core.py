"""The core as Python sees it: exchanges carried out on descriptors, and what is told when they fail."""

from __future__ import annotations

import errno
import os
import socket
import threading
from collections.abc import Callable, Iterator

import pytest
from frames import words

from multidrop.core import (
    EXCEPTION_STATUS,
    REFUSALS,
    Completions,
    Exchange,
    Framing,
    Message,
    Port,
    Result,
    build_reply,
    now_ns,
    parse_request,
    status_text,
)

PARITY = next(bit for bit, name in REFUSALS.items() if name == "parity")
ANY_SETTINGS, NO_SETTINGS = 0, -1


def read(start: int, *, timeout: float = 5.0, format: str = "8N1") -> Exchange:
    """A read of one register; without a reply it takes `timeout`, which no passing test waits for."""
    return Exchange(
        Framing.RTU,
        Message(1, 0x03, start, 1),
        baudrate=115_200,
        format=format,
        character=1e-6,
        silence=1e-4,
        timeout=timeout,
        turnaround=1e-4,
    )


def echo_start(request: Message) -> bytes:
    """A drive whose registers hold their own addresses."""
    data = words(request.start)
    return build_reply(Framing.RTU, Message(request.address, request.function, data=data))


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
                os.write(self.fd, self._answer(request))
                received = received[used:]
                used, request = parse_request(Framing.RTU, received)

    def join(self) -> None:
        self._thread.join()
        os.close(self.fd)


@pytest.fixture
def drive() -> Iterator[Callable[[Callable[[Message], bytes]], int]]:
    """Makes a line with a drive at its far end; the near end's descriptor."""
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


def test_run_of_exchanges(drive: Drive) -> None:
    port, done = Port(drive(echo_start), NO_SETTINGS), Completions(100)
    began = now_ns()
    assert port.run([read(start) for start in range(100)], done) == len(done) == 100
    before = began
    for start, found in enumerate(done):
        assert (found.result, found.status, found.reply) == (7, 0, Message(1, 0x03, start, 1, words(start)))
        assert found.raw == echo_start(Message(1, 0x03, start, 1))
        assert before <= found.sent_ns <= found.first_ns <= found.last_ns <= now_ns()
        before = found.last_ns
        assert (found.stale, found.skipped, found.error) == (0, 0, 0)


def test_exception_is_a_completion_like_any_other(drive: Drive) -> None:
    fd = drive(lambda _: build_reply(Framing.RTU, Message(1, 0x03, exception=2)))
    port, done = Port(fd, NO_SETTINGS), Completions(2)
    assert port.run([read(0), read(1)], done) == 2
    assert [found.status for found in done] == [EXCEPTION_STATUS + 2] * 2


def test_silent_drive_does_not_end_the_run(drive: Drive) -> None:
    fd = drive(lambda request: b"" if request.start == 1 else echo_start(request))
    port, done = Port(fd, NO_SETTINGS), Completions(3)
    assert port.run([read(0), read(1, timeout=0.02), read(2)], done) == 3
    assert [found.status for found in done] == [0, -Result.NO_REPLY, 0]


def test_broadcast_is_sent_and_nobody_waited_for(drive: Drive) -> None:
    heard: list[int] = []

    def answer(request: Message) -> bytes:
        heard.append(request.address)
        return b"" if request.address == 0 else echo_start(request)

    stop = Exchange(
        Framing.RTU,
        Message(0, 0x06, 0x2000, data=words(1)),
        baudrate=115_200,
        format="8N1",
        character=1e-6,
        silence=1e-4,
        timeout=5,
        turnaround=1e-3,
    )
    port, done = Port(drive(answer), NO_SETTINGS), Completions(2)
    assert port.run([stop, read(7)], done) == 2
    assert [found.status for found in done] == [0, 0]
    assert heard == [0, 1]
    assert done[1].sent_ns - done[0].sent_ns >= 1_000_000  # the turnaround delay


def test_run_ends_where_the_line_is_lost() -> None:
    near, far = socket.socketpair()
    near.setblocking(False)
    port, done = Port(near.fileno(), NO_SETTINGS), Completions(3)
    far.close()
    assert port.run([read(0), read(1), read(2)], done) == 1
    assert done[0].result == Result.LINE_LOST
    near.close()
    assert port.run([read(0)], done) == 1
    assert (done[0].result, done[0].error) == (Result.LINE_LOST, errno.EBADF)


def test_pty_whose_far_end_hangs_up() -> None:
    master, slave = os.openpty()
    os.set_blocking(slave, False)
    port, done = Port(slave, ANY_SETTINGS), Completions(2)
    os.close(master)
    assert port.run([read(0), read(1)], done) == 1
    assert (done[0].result, done[0].error) in (
        (Result.LINE_LOST, errno.EIO),
        (Result.LINE_LOST, 0),  # the end of the file
    )
    os.close(slave)


def test_refused_settings_that_must_be_taken() -> None:
    """Nothing is sent with wrong parity. A pty takes none."""
    master, slave = os.openpty()
    os.set_blocking(slave, False)
    os.set_blocking(master, False)
    done = Completions(1)
    assert Port(slave, PARITY).run([read(0, format="8E1")], done) == 1
    assert (done[0].result, done[0].error, done[0].sent_ns) == (Result.SETTINGS_REFUSED, PARITY, 0)
    with pytest.raises(BlockingIOError):
        os.read(master, 1)
    assert Port(slave, ANY_SETTINGS).run([read(0, format="8E1", timeout=0.001)], done) == 1
    assert done[0].result == Result.NO_REPLY
    os.close(slave)
    os.close(master)


def test_port_that_should_have_settings_and_has_none(drive: Drive) -> None:
    done = Completions(1)
    assert Port(drive(echo_start), ANY_SETTINGS).run([read(0)], done) == 1
    assert (done[0].result, done[0].error) == (Result.LINE_LOST, errno.ENOTTY)


def test_yielding_keeps_a_run_from_beginning(drive: Drive) -> None:
    port, done = Port(drive(echo_start), NO_SETTINGS), Completions(2)
    port.yield_now(True)
    assert port.run([read(0), read(1)], done) == len(done) == 0
    port.yield_now(False)
    assert port.run([read(0), read(1)], done) == 2


def test_yielding_ends_a_run_after_the_exchange_under_way(drive: Drive) -> None:
    ports: list[Port] = []

    def answer(request: Message) -> bytes:
        ports[0].yield_now(request.start == 2)  # while this exchange is under way
        return echo_start(request)

    ports.append(Port(drive(answer), NO_SETTINGS))
    done = Completions(5)
    assert ports[0].run([read(start) for start in range(5)], done) == 3
    assert [found.reply.start for found in done] == [0, 1, 2]


def test_more_exchanges_than_room_for_what_becomes_of_them() -> None:
    port = Port(0, NO_SETTINGS)
    with pytest.raises(ValueError, match="3 exchanges, but room for 2 completions"):
        port.run([read(0)] * 3, Completions(2))


def test_completions_end_where_the_run_did(drive: Drive) -> None:
    port, done = Port(drive(echo_start), NO_SETTINGS), Completions(5)
    port.run([read(0), read(1)], done)
    assert len(list(done)) == 2
    for at in (2, -1):
        with pytest.raises(IndexError):
            done[at]


@pytest.mark.parametrize("result", list(Result))
def test_every_result_has_its_words(result: Result) -> None:
    assert status_text(-result)
    assert status_text(-result) == str(result)
