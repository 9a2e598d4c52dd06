"""Network ports: stalled requests are never sent later, and a flood does not fill the memory."""

from __future__ import annotations

import os
import resource
import shutil
import socket
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lines import PATIENCE, until
from namespaces import changing_network
from network_server import END, manager
from serial import SerialException, rfc2217
from toy import Status, Toy

from multidrop.bus import Bus
from multidrop.errors import Unconfirmed
from multidrop.transport import network_port
from multidrop.transport.exchange import WRITE_TIMEOUT
from multidrop.transport.network_port import (
    MOST_AGE,
    MOST_CHUNKS,
    MOST_RECEIVED,
    MOST_STALL_MS,
    Bridge,
    RFC2217Port,
    SocketPort,
    Telnet,
    discard_late_bytes,
)

SERVER = Path(__file__).parents[1] / "support" / "servers" / "network_server.py"
IAC, SB, SE = rfc2217.IAC, rfc2217.SB, rfc2217.SE

pyserials_own = pytest.mark.filterwarnings("ignore:set(Daemon|Name)\\(\\) is deprecated:DeprecationWarning")


def pieces(stream: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(at % (len(stream) + 1) for at in cuts), len(stream)]
    return [stream[begin:end] for begin, end in pairwise(edges)]


def split(chunks: list[bytes]) -> list[tuple[bytes, bytes]]:
    """Return the data and commands of a telnet stream, with adjacent data joined."""
    telnet, found = Telnet(), list[tuple[bytes, bytes]]()
    for chunk in chunks:
        for kind, content in telnet.split(chunk):
            if not kind and found and not found[-1][0]:
                found[-1] = b"", found[-1][1] + content
            else:
                found.append((kind, content))
    return found


@pytest.mark.long
@given(st.binary(max_size=200), st.lists(st.integers(0, 1000), max_size=20))
def test_data_escaped_for_telnet_are_the_same_after_decoding(data: bytes, cuts: list[int]) -> None:
    near, far = socket.socketpair()
    stream = b"".join(manager(near).escape(data))
    near.close()
    far.close()
    assert split(pieces(stream, cuts)) == ([(b"", data)] if data else [])


@given(
    st.lists(st.sampled_from([IAC, SB, SE, rfc2217.DO, rfc2217.WONT, b"\xf1", b"a", b"\x2c"]), max_size=40),
    st.lists(st.integers(0, 1000), max_size=20),
)
def test_a_telnet_stream_may_arrive_in_pieces_of_any_size(stream: list[bytes], cuts: list[int]) -> None:
    whole = b"".join(stream)
    assert split(pieces(whole, cuts)) == split([whole])


def test_a_telnet_stream_is_split_into_data_and_commands() -> None:
    stream = b"ab" + IAC + rfc2217.DO + b"\x2c" + IAC + SB + b"\x2c\x65" + IAC + IAC + IAC + SE + b"c"
    assert split([stream]) == [(b"", b"ab"), (rfc2217.DO, b"\x2c"), (SB, b"\x2c\x65\xff"), (b"", b"c")]


def test_an_endless_telnet_suboption_does_not_fill_the_memory() -> None:
    telnet, flood = Telnet(), bytes(65536)
    assert not list(telnet.split(IAC + SB))
    tracemalloc.start()
    try:
        for _ in range(100):
            for _, content in telnet.split(flood):
                assert len(content) <= len(flood)
        assert tracemalloc.get_traced_memory()[0] < len(flood)  # less memory than one of the hundred chunks
    finally:
        tracemalloc.stop()


@contextmanager
def flooding() -> Iterator[tuple[str, threading.Event]]:
    """Yield the URL of a port that sends endlessly, and an event that is set after 32 MB."""
    listener = socket.create_server(("127.0.0.1", 0))
    sent = threading.Event()

    def flood(client: socket.socket) -> None:
        with suppress(OSError):
            for _ in range(512):
                client.sendall(bytes(65536))
        sent.set()

    def serve() -> None:
        client, _ = listener.accept()
        far = manager(client)
        floods = threading.Thread(target=flood, args=(client,))
        purges = 0
        with suppress(OSError):
            while received := client.recv(1024):
                b"".join(far.filter(received))
                purges += received.count(rfc2217.COM_PORT_OPTION + rfc2217.PURGE_DATA)
                # the client sends its second purge when it has opened the port
                if purges == 2 and not floods.ident:
                    floods.start()
        client.close()
        floods.join()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield f"rfc2217://127.0.0.1:{listener.getsockname()[1]}", sent
    thread.join()
    listener.close()


@pytest.mark.slow
@pyserials_own
def test_an_unread_flood_does_not_fill_the_memory() -> None:
    with flooding() as (url, sent):
        port = RFC2217Port()
        port.port = url
        port.timeout = 0.01
        port.open()
        assert sent.wait(60)
        held = sum(len(chunk) for chunk in list(port._read_buffer.queue))
        port.close()
    assert 0 < held <= MOST_CHUNKS * MOST_RECEIVED


class HeldUp:
    """A port whose `write` blocks until it is released, and records the requests."""

    def __init__(self) -> None:
        self.begun, self.free = threading.Event(), threading.Event()
        self.written: list[bytes] = []
        self.timeout = 0.0

    def write(self, request: bytes) -> None:
        self.begun.set()
        self.free.wait()
        self.written.append(request)

    def read(self, size: int) -> bytes:
        time.sleep(self.timeout)
        return b""

    def read_all(self) -> bytes:
        return b""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="this system does not say when a request was written")
def test_request_is_never_sent_after_waiting_behind_a_blocked_one() -> None:
    """The waiting request has expired, and may be a start."""
    port = HeldUp()
    bridge = Bridge(port)  # type: ignore[arg-type]
    os.write(bridge.theirs.fileno(), b"first")
    assert port.begun.wait(60)
    os.write(bridge.theirs.fileno(), b"start")
    time.sleep(2 * MOST_AGE)
    port.free.set()

    def later() -> bool:
        os.write(bridge.theirs.fileno(), b"later")
        return b"later" in port.written

    until(later)
    bridge.close()
    assert b"start" not in port.written


class AsOnWindows:
    """A socket without the calls that only POSIX systems have."""

    def __init__(self, whole: socket.socket) -> None:
        self._whole = whole

    def __getattr__(self, name: str) -> Any:
        if name in ("recvmsg", "sendmsg"):
            raise AttributeError(name)
        return getattr(self._whole, name)


@pytest.mark.slow
def test_a_pyserial_bridge_needs_no_socket_timestamps(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = socket.socketpair()
    monkeypatch.setattr(network_port, "_STAMPED", False)
    monkeypatch.setattr(network_port, "_pair", lambda: (AsOnWindows(ours), theirs))
    port = HeldUp()
    port.free.set()
    bridge = Bridge(port)  # type: ignore[arg-type]
    theirs.send(b"request")
    until(lambda: port.written == [b"request"])
    bridge.close()


def test_a_pyserial_bridge_raises_os_error_if_no_thread_can_start(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[threading.Thread] = []
    start = threading.Thread.start

    def first_alone(thread: threading.Thread) -> None:
        if started:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", first_alone)
    with pytest.raises(OSError, match="can't start new thread"):
        Bridge(HeldUp())  # type: ignore[arg-type]
    assert not started[0].is_alive()


def test_a_pyserial_bridge_passes_long_input_in_pieces() -> None:
    port = HeldUp()
    arrived = bytes(range(256)) * 20
    chunks = [arrived[:1], b""]
    port.read = lambda size: chunks.pop(0) if chunks else b""  # type: ignore[method-assign]
    port.read_all = lambda: arrived[1:]  # type: ignore[method-assign]
    bridge = Bridge(port)  # type: ignore[arg-type]
    taken = b""

    def all_of_it() -> bool:
        nonlocal taken
        with suppress(BlockingIOError):
            taken += os.read(bridge.theirs.fileno(), 1024)
        return len(taken) >= len(arrived)

    until(all_of_it)
    bridge.close()
    assert taken == arrived


def test_a_pyserial_bridge_with_unread_data_can_be_closed() -> None:
    port = HeldUp()
    port.read = lambda size: bytes(1024)  # type: ignore[method-assign]
    bridge = Bridge(port)  # type: ignore[arg-type]
    bridge.close()
    assert not any(thread.is_alive() for thread in bridge._threads)


def test_a_write_fails_immediately_if_the_socket_buffer_is_full() -> None:
    near, far = socket.socketpair()
    near.settimeout(3600)  # a write that waited would last an hour
    port = RFC2217Port()
    port.is_open, port._socket, port._write_lock = True, near, threading.Lock()

    def fill() -> None:
        while True:
            port.write(bytes(1024))

    with pytest.raises(SerialException, match=r"the connection failed|accepts only a part of the bytes"):
        fill()
    port.is_open = False
    near.close()
    far.close()


_DONE, _TIME_WAIT = "05", "06"  # states in which all our data has arrived (net/tcp_states.h: TCP_FIN_WAIT2)
_numbers = count()


def connections(port: int) -> list[list[str]]:
    """Return this computer's connections to that port on which the kernel may still send data."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return [row for row in rows if row[2].endswith(f":{port:04X}") and row[3] not in (_DONE, _TIME_WAIT)]


def waits_to_arrive(port: int) -> bool:
    """Return True while the kernel has data that the far end has not acknowledged."""
    return any(int(row[4].partition(":")[0], 16) for row in connections(port))


class FarNetwork:
    """A separate network namespace with a server, which can be disconnected and connected again."""

    def __init__(self, kind: str) -> None:
        number = next(_numbers)
        self.name = f"md{os.getpid()}-{number}"
        ours, theirs = f"{self.name}a", f"{self.name}b"
        self._theirs = theirs
        net = f"10.{200 + os.getpid() % 50}.{os.getpid() // 50 % 250}"
        near, far = f"{net}.{4 * number + 1}", f"{net}.{4 * number + 2}"
        self._ip("netns", "add", self.name)
        try:
            self._make(ours, near, far)
        except subprocess.CalledProcessError:
            self._ip("netns", "del", self.name)
            raise
        words = ["ip", "netns", "exec", self.name, sys.executable, str(SERVER), kind, far]
        self._server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert self._server.stdout is not None
        self.port = int(self._server.stdout.readline())
        self.address = far
        self.url = f"{kind}://{self.address}:{self.port}"

    def _make(self, ours: str, near: str, far: str) -> None:
        """Make a pair of network interfaces that know each other's address, so that no packet must wait."""
        near_card, far_card = "02:00:00:00:00:01", "02:00:00:00:00:02"
        peer = ("peer", "name", self._theirs, "address", far_card, "netns", self.name)
        self._ip("link", "add", ours, "address", near_card, "type", "veth", *peer)
        self._ip("addr", "add", f"{near}/30", "dev", ours)
        self._ip("link", "set", ours, "up")
        self._ip("-n", self.name, "addr", "add", f"{far}/30", "dev", self._theirs)
        self.join()
        known = ("nud", "permanent", "dev")
        self._ip("neigh", "replace", far, "lladdr", far_card, *known, ours)
        self._ip("-n", self.name, "neigh", "replace", near, "lladdr", near_card, *known, self._theirs)

    def _ip(self, *words: str) -> None:
        subprocess.run(["ip", *words], check=True, capture_output=True)

    def cut(self) -> None:
        self._ip("-n", self.name, "link", "set", self._theirs, "down")

    def join(self) -> None:
        self._ip("-n", self.name, "link", "set", self._theirs, "up")

    def _ends(self) -> bool:
        with suppress(OSError), socket.create_connection((self.address, self.port), timeout=1) as last:
            last.sendall(END)
            while last.recv(1024):
                pass
            return True
        return False

    def all_received(self) -> str:
        """Return the bytes on the server's serial line, once the network is restored."""
        self.join()
        until(lambda: not connections(self.port))  # until the kernel has stopped retransmitting
        until(self._ends)
        taken, _ = self._server.communicate()
        return taken

    def close(self) -> None:
        if self._server.poll() is None:
            self._server.kill()
            self._server.communicate()
        self._ip("netns", "del", self.name)


@pytest.fixture(params=["rfc2217", "socket"])
def far_network(request: pytest.FixtureRequest) -> Iterator[FarNetwork]:
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("a network of its own needs root and ip")
    with changing_network():
        try:
            network = FarNetwork(request.param)
        except (subprocess.CalledProcessError, OSError) as failure:
            pytest.skip(f"this system makes no network namespace: {failure}")
        yield network
        network.close()


START = "010600140001"  # writes 1 to the control register of drive 1: its motor starts


def start_into_the_cut(bus: Bus, toy: Toy, network: FarNetwork) -> None:
    """Send a START that expires in the cut network. It is not delayed, because no late reply is due."""
    toy.send_raw(6, 0x14, bytes([0, 2]))
    network.cut()
    with pytest.raises(Unconfirmed):
        toy.send_raw(6, 0x14, bytes([0, Status.RUNNING]))


@pytest.mark.long
@pyserials_own
def test_start_command_in_a_network_failure_never_arrives_after_closing(
    far_network: FarNetwork,
) -> None:
    with Bus(far_network.url, echo="off", expiry=PATIENCE) as bus:
        start_into_the_cut(bus, bus.attach(Toy, 1), far_network)
    taken = far_network.all_received()
    assert "010600140002" in taken
    assert START not in taken


@pytest.mark.slow
@pyserials_own
@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="this system knows no such time-out")
def test_start_command_in_a_network_failure_never_arrives_on_the_open_port(
    far_network: FarNetwork,
) -> None:
    """The network is restored as soon as the call has returned."""
    with Bus(far_network.url, echo="off", expiry=PATIENCE) as bus:
        start_into_the_cut(bus, bus.attach(Toy, 1), far_network)
        far_network.join()
        until(lambda: not waits_to_arrive(far_network.port))  # the data arrived, or the kernel dropped it
    taken = far_network.all_received()
    assert "010600140002" in taken
    assert START not in taken


def test_a_stalled_connection_is_closed_before_a_write_times_out() -> None:
    """Otherwise a write could arrive after it was reported as unconfirmed."""
    assert MOST_AGE + MOST_STALL_MS / 1000 <= WRITE_TIMEOUT


def test_every_connection_limits_unacknowledged_data() -> None:
    """The test only reads the socket options, so it needs no network that it can cut."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        near = socket.create_connection(listener.getsockname())
        far, _ = listener.accept()
        discard_late_bytes(near)
        assert near.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8) == bytes([1, 0, 0, 0, 0, 0, 0, 0])
        near.close()
        with pytest.raises(ConnectionResetError):
            far.recv(1)
        far.close()


def test_closing_a_port_that_was_never_opened_prints_nothing() -> None:
    """Python 3.13 would print errors of the port's finalizer."""
    port = SocketPort()
    port.close()
    assert not port.is_open


def test_a_socket_port_works_with_a_descriptor_above_1023() -> None:
    """Hundreds of lines need more than the 1024 descriptors that select() supports."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 1400:
        pytest.skip("this system gives a process fewer than 1400 descriptors")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 1400), hard))
    with ExitStack() as stack:
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        for _ in range(1100):
            stack.callback(os.close, os.dup(listener.fileno()))
        port = SocketPort(f"socket://127.0.0.1:{listener.getsockname()[1]}")
        stack.callback(port.close)
        assert port.fileno() > 1023
        far, _ = listener.accept()
        stack.callback(far.close)
        far.sendall(b"of before")
        assert port._socket is not None
        port._socket.setblocking(True)
        assert port._socket.recv(1, socket.MSG_PEEK) == b"o"
        port._socket.setblocking(False)
        port.reset_input_buffer()
        with pytest.raises(BlockingIOError):
            port._socket.recv(1)
