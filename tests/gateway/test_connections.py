"""Connections of slow and silent clients: they keep nobody out, and end."""

from __future__ import annotations

import http.client
import json
import resource
import socket
import ssl
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest
from clocks import Clock
from examples import usually
from gateways import certificate, get, served, serving, simulated_plant
from lines import PATIENCE

from multidrop.gateway import connections, request_fields
from multidrop.gateway.connections import AGAIN_S, FIRST_S, MOST_OPEN, Connections
from multidrop.gateway.guard import MOST_HEAD
from multidrop.gateway.listener import BACKLOG
from multidrop.gateway.rights import digest

HEAD = b"POST /api/act HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"
SLOW = [b"", b"POST /api/act HTTP/1.1\r\nhost: loc", HEAD + b"content-length: 100\r\n\r\n{"]
DESCRIPTORS = MOST_OPEN + 4 * BACKLOG  # fewer than the slow clients and the rest would take


@contextmanager
def slow_clients(port: int, sent: bytes) -> Iterator[list[socket.socket]]:
    """500 connections that say this, and no more."""
    with ExitStack() as stack:
        found = []
        for _ in range(500):
            client = stack.enter_context(closing(socket.create_connection(("127.0.0.1", port), PATIENCE)))
            if sent:
                client.sendall(sent)
            found.append(client)
        yield found


def descriptors(pid: int) -> int:
    return sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())


@pytest.mark.long
@pytest.mark.parametrize("sent", usually(*SLOW), ids=["silent", "headers", "body"])
@pytest.mark.parametrize("way", usually("http", "https"))
def test_a_stop_gets_in_beside_500_slow_clients(tmp_path: Path, sent: bytes, way: str) -> None:
    certificate(tmp_path, "own")
    (tmp_path / "tokens").write_text(f"anna stop {digest('secret')}\n")
    keys = 'certificate = "own.pem"\nkey = "own.key"\ntokens = "tokens"\n' if way == "https" else ""
    serve = f'[serve]\nlisten = "127.0.0.1:0"\n{keys}[serve.may]\nstop = "anyone"\n'
    with simulated_plant(tmp_path, serve) as path, serving(path) as (process, url):
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))
        port = int(url.rstrip("/").rpartition(":")[2])

        def connection() -> http.client.HTTPConnection:
            if way == "http":
                return http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
            context = ssl.create_default_context(cafile=str(tmp_path / "own.pem"))
            return http.client.HTTPSConnection("localhost", port, timeout=PATIENCE, context=context)

        with closing(connection()) as viewer:
            get(viewer, "/api/frame")
            with slow_clients(port, sent), closing(connection()) as stopper:
                stopper.request("POST", "/api/stop", "{}", {"content-type": "application/json"})
                told = json.loads(stopper.getresponse().read())
                assert [one["done"] for one in told.values()] == [True, True]
                assert descriptors(process.pid) < DESCRIPTORS
            process.terminate()
            assert "Traceback" not in process.communicate(timeout=PATIENCE)[1]


def test_a_slow_body_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(request_fields, "BODY_S", 0.1)
    with (
        served(tmp_path, '[serve.may]\nstop = "anyone"\n') as gateway,
        socket.create_connection(("127.0.0.1", gateway.gateway.port), PATIENCE) as client,
    ):
        client.sendall(SLOW[2])
        assert client.recv(1000).startswith(b"HTTP/1.1 408 ")
        assert gateway.get("/api/plant").status == 200


@pytest.mark.slow
def test_slow_headers_are_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "FIRST_S", 0.1)
    with (
        served(tmp_path) as gateway,
        socket.create_connection(("127.0.0.1", gateway.gateway.port), PATIENCE) as client,
    ):
        client.sendall(SLOW[1])
        assert client.recv(1000) == b""
        assert gateway.get("/api/plant").status == 200


def test_long_headers_are_refused_and_no_stop_is(tmp_path: Path) -> None:
    with served(tmp_path, '[serve.may]\nstop = "anyone"\n') as gateway:
        cookie = "a=" + "b" * MOST_HEAD
        assert gateway.get("/api/plant", cookie=cookie).status == 431
        assert gateway.get("/api/plant", cookie=cookie[: MOST_HEAD // 2]).status == 200
        assert gateway.post("/api/stop", {}, cookie=cookie).status == 200


def test_headers_in_pieces_are_taken_up_to_a_length(tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        address = "127.0.0.1", gateway.gateway.port
        head = b"GET /api/plant HTTP/1.1\r\nhost: localhost:%d\r\ncookie: " % address[1]
        with socket.create_connection(address, PATIENCE) as client:
            client.sendall(head + b"b" * (MOST_HEAD // 2))
            assert gateway.get("/page/icon.svg").status == 200  # it read that piece before
            client.sendall(b"\r\n\r\n")
            assert client.recv(1000).startswith(b"HTTP/1.1 200 ")
        with socket.create_connection(address, PATIENCE) as client:
            client.sendall(head + b"b" * MOST_HEAD)
            assert client.recv(1000).startswith(b"HTTP/1.1 400 ")


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def pairs() -> Iterator[list[tuple[socket.socket, socket.socket]]]:
    with ExitStack() as stack:
        found = [socket.socketpair() for _ in range(MOST_OPEN + 2)]
        for pair in found:
            for end in pair:
                stack.enter_context(end)
        yield found


def is_ended(pair: tuple[socket.socket, socket.socket]) -> bool:
    pair[0].setblocking(False)
    try:
        return pair[0].recv(1) == b""
    except BlockingIOError:
        return False


def test_the_first_request_and_later_ones_have_their_time(
    clock: Clock, pairs: list[tuple[socket.socket, socket.socket]]
) -> None:
    connections = Connections(clock)
    for n in range(4):
        connections.add(pairs[n][1], ("10.0.0.1", n, 0, 0))
    connections.begin(("10.0.0.1", 1))
    connections.begin(("10.0.0.1", 2))
    connections.finish(("10.0.0.1", 2))
    pairs[3][1].close()
    clock.now += FIRST_S - 1
    connections.sweep()
    assert (len(connections), connections.ended) == (3, 0)
    clock.now += 2
    connections.sweep()
    assert [is_ended(pair) for pair in pairs[:3]] == [True, False, False]
    clock.now += AGAIN_S
    connections.sweep()
    assert [is_ended(pair) for pair in pairs[1:3]] == [False, True]
    assert (len(connections), connections.ended) == (1, 2)
    connections.finish(("10.0.0.9", 9))  # nobody knows it: nothing happens
    assert len(connections) == 1


def test_the_one_that_was_idle_for_longest_makes_room(
    clock: Clock, pairs: list[tuple[socket.socket, socket.socket]]
) -> None:
    connections = Connections(clock)
    for n in range(MOST_OPEN):
        connections.add(pairs[n][1], ("10.0.0.1", n))
    connections.begin(("10.0.0.1", 0))  # a request is under way
    connections.begin(("10.0.0.1", 1))
    connections.finish(("10.0.0.1", 1))  # idle since now
    connections.add(pairs[MOST_OPEN][1], ("10.0.0.2", 1))
    assert [n for n, pair in enumerate(pairs) if is_ended(pair)] == [2]
    for n in range(MOST_OPEN):
        connections.begin(("10.0.0.1", n))
    connections.begin(("10.0.0.2", 1))
    connections.add(pairs[MOST_OPEN + 1][1], ("10.0.0.2", 2))
    assert len(connections) == MOST_OPEN
    assert not is_ended(pairs[MOST_OPEN + 1])  # the newest one is never the one that goes
