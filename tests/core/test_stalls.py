"""An adapter that takes no bytes, and closing its port.

The adapter is the far end of a socket pair, which does not read: the system reports its bytes as queued, as
a serial driver does. A drive with baud rate 0 leaves the pair's settings alone.
"""

from __future__ import annotations

import errno
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest

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
    close_descriptor,
)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems do not count a pair's bytes")
READ = Message(1, 0x03, 0x10, 1)
START = Message(1, 0x06, 0x20, data=b"\0\1")
STOP = Message(1, 0x06, 0x20, data=b"\0\0")
SET_ALL = Message(0, 0x06, 0x21, data=b"\0\1")
TIMEOUT_S = 0.02


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, adapter = socket.socketpair()
    ours.setblocking(False)
    adapter.setblocking(False)
    with ours, adapter:
        yield ours, adapter


@pytest.fixture
def port(ends: tuple[socket.socket, socket.socket]) -> Iterator[Port]:
    made = Port(ends[0].fileno(), must_take=0)
    yield made
    made.stop()


def exchange(
    message: Message, *, insists: bool = False, timeout: float = TIMEOUT_S, peer: Peer | None = None
) -> Exchange:
    peer = peer or Peer(least_timeout=timeout, most_timeout=timeout)
    settings = {"baudrate": 0, "format": "0\0000"[:3], "character": 1e-5, "silence": 1e-4}
    return Exchange(Framing.RTU, message, peer, insists=insists, **settings)


def taken(adapter: socket.socket) -> list[bytes]:
    """Return the frames that have reached the adapter; each has eight bytes."""
    received = adapter.recv(4096)
    return [received[at : at + 8] for at in range(0, len(received), 8)]


def frame(message: Message) -> bytes:
    return build_request(Framing.RTU, message)


def test_a_command_is_not_written_behind_held_bytes_but_a_stop_is(
    ends: tuple[socket.socket, socket.socket], port: Port
) -> None:
    assert port.carry_out(exchange(READ)).result == Failure.NO_REPLY
    assert port.is_stalled
    start = port.carry_out(exchange(START))
    assert (start.result, start.error, start.sent_ns) == (Failure.LINE_LOST, errno.ETIMEDOUT, 0)
    assert port.carry_out(exchange(STOP, insists=True)).sent_ns > 0
    assert (port.lost, port.called_off) == (False, False)
    assert taken(ends[1]) == [frame(READ), frame(STOP)]


def test_a_broadcast_command_is_not_written_behind_held_bytes(port: Port) -> None:
    assert port.carry_out(exchange(READ)).result == Failure.NO_REPLY
    held = port.carry_out(exchange(SET_ALL))
    assert (held.result, held.error, held.sent_ns) == (Failure.LINE_LOST, errno.ETIMEDOUT, 0)


def test_a_broadcast_command_does_not_wait_for_late_replies(
    ends: tuple[socket.socket, socket.socket], port: Port
) -> None:
    adapter = ends[1]
    adapter.setblocking(True)
    reader = threading.Thread(target=adapter.recv, args=(8,))
    reader.start()
    peer = Peer(least_timeout=TIMEOUT_S, most_timeout=TIMEOUT_S)
    assert port.carry_out(exchange(START, peer=peer)).result == Failure.NO_REPLY
    reader.join()
    assert port.carry_out(exchange(START, peer=peer)).result == Failure.LATE_ANSWER_DUE
    assert port.carry_out(exchange(SET_ALL, peer=peer)).sent_ns > 0


def test_a_held_command_loses_the_port_at_its_timeout(port: Port) -> None:
    start = port.carry_out(exchange(START))
    assert (start.result, start.error) == (Failure.LINE_LOST, errno.ETIMEDOUT)
    assert start.sent_ns > 0
    assert (port.lost, port.lost_error, port.called_off) == (True, errno.ETIMEDOUT, True)


def test_a_command_that_the_adapter_took_does_not_lose_the_port(
    ends: tuple[socket.socket, socket.socket], port: Port
) -> None:
    adapter = ends[1]
    adapter.setblocking(True)
    reader = threading.Thread(target=adapter.recv, args=(8,))
    reader.start()
    assert port.carry_out(exchange(START)).result == Failure.NO_REPLY
    reader.join()
    assert (port.is_stalled, port.lost, port.called_off) == (False, False, False)


def test_a_reply_ends_a_stall(ends: tuple[socket.socket, socket.socket], port: Port) -> None:
    assert port.carry_out(exchange(READ)).result == Failure.NO_REPLY
    adapter = ends[1]
    adapter.recv(4096)
    adapter.setblocking(True)

    def answer() -> None:
        adapter.recv(8)
        adapter.send(build_reply(Framing.RTU, Message(1, 0x03, 0x11, 1, data=b"\0\7")))

    drive = threading.Thread(target=answer)
    drive.start()
    assert port.carry_out(exchange(Message(1, 0x03, 0x11, 1), timeout=1.0)).result > 0
    drive.join()
    assert not port.is_stalled


def test_closing_calls_off_a_command_in_flight(ends: tuple[socket.socket, socket.socket], port: Port) -> None:
    found: list[Completion] = []
    caller = threading.Thread(target=lambda: found.append(port.carry_out(exchange(START, timeout=30.0))))
    caller.start()
    select.select([ends[1]], [], [])  # until the command is written
    port.stop()
    caller.join()
    assert (found[0].result, port.called_off) == (Failure.LINE_LOST, True)


def test_close_descriptor_does_not_wait_for_a_stalled_far_end() -> None:
    """A TCP connection that lingers for 60 s waits in close(2) as a serial port does."""
    handled: list[int] = []
    before = signal.signal(signal.SIGRTMAX, lambda number, frame: handled.append(number))
    try:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            sender = socket.create_connection(listener.getsockname())
            accepted, _ = listener.accept()
            sender.setblocking(False)
            with suppress(BlockingIOError):
                while True:
                    sender.send(bytes(65536))
            sender.setblocking(True)
            sender.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 60))
            begun = time.monotonic()
            close_descriptor(sender.detach(), 0.01)
            assert time.monotonic() - begun < 30
            accepted.close()
        assert handled == []
        assert signal.getsignal(signal.SIGRTMAX) not in (signal.SIG_DFL, before)
    finally:
        signal.signal(signal.SIGRTMAX, before)
