"""Slow and silent HTTP clients do not delay others, and their connections are closed."""

from __future__ import annotations

import asyncio
import http.client
import json
import resource
import socket
import ssl
import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from controlled_loop import Clock
from gateways import Served, certificate, get, served, serving, simulated_plant
from lines import PATIENCE, until
from starlette.requests import Request
from tables import usually

from multidrop.control import CommandResult
from multidrop.control.commands import MOST_STOPS
from multidrop.gateway import gateway as gateway_module
from multidrop.gateway.http import connections, messages
from multidrop.gateway.http import routes as web
from multidrop.gateway.http.connections import (
    AGAIN_S,
    BACKLOG,
    FIRST_S,
    FRESH_S,
    MOST_OPEN,
    STALLED_S,
    Connections,
    Turns,
)
from multidrop.gateway.http.guard import MOST_HEAD
from multidrop.gateway.http.rights import Caller, Right, digest

HEAD = b"POST /api/act HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"
SLOW = [b"", b"POST /api/act HTTP/1.1\r\nhost: loc", HEAD + b"content-length: 100\r\n\r\n{"]
DESCRIPTORS = MOST_OPEN + 4 * BACKLOG  # limit of open files for the gateway: too low for the 500 slow clients


@contextmanager
def slow_clients(port: int, sent: bytes) -> Iterator[list[socket.socket]]:
    """Open 500 connections, send `sent` on each, and then keep silent."""
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
def test_a_stop_is_accepted_while_500_slow_clients_are_connected(
    tmp_path: Path, sent: bytes, way: str
) -> None:
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


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("connections"), '[serve.may]\nstop = "anyone"\n') as found:
        yield found


@contextmanager
def connected(gateway: Served) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", gateway.gateway.port), PATIENCE) as client:
        yield client


@pytest.mark.long
@pytest.mark.parametrize(("sent", "begin"), [(SLOW[1], b""), (SLOW[2], b"HTTP/1.1 408 ")])
def test_a_connection_is_closed_if_a_request_stays_unfinished(
    gateway: Served, monkeypatch: pytest.MonkeyPatch, sent: bytes, begin: bytes
) -> None:
    monkeypatch.setattr(connections, "FIRST_S", 0.1)
    monkeypatch.setattr(messages, "BODY_S", 0.1)
    with connected(gateway) as client:
        client.sendall(sent)
        assert client.recv(1000)[:13] == begin
    assert gateway.get("/api/plant").status == 200


def test_a_request_with_long_headers_is_refused_unless_it_is_a_stop(gateway: Served) -> None:
    cookie = "a=" + "b" * MOST_HEAD
    assert gateway.get("/api/plant", cookie=cookie).status == 431
    assert gateway.get("/api/plant", cookie=cookie[: MOST_HEAD // 2]).status == 200
    assert gateway.post("/api/stop", {}, cookie=cookie).status == 200


def test_http_headers_may_arrive_in_pieces_up_to_the_size_limit(gateway: Served) -> None:
    head = b"GET /api/plant HTTP/1.1\r\nhost: localhost\r\ncookie: "
    with connected(gateway) as client:
        client.sendall(head + b"b" * (MOST_HEAD // 2))
        # when this is answered, the gateway has read the first piece
        assert gateway.get("/page/icon.svg").status == 200
        client.sendall(b"\r\n\r\n")
        assert client.recv(1000).startswith(b"HTTP/1.1 200 ")
    with connected(gateway) as client:
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


def test_an_idle_connection_is_closed_after_a_time_limit(
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
    connections.finish(("10.0.0.9", 9))  # an unknown client, which is ignored
    assert len(connections) == 1


def test_the_longest_idle_connection_is_closed_if_too_many_are_open(
    clock: Clock, pairs: list[tuple[socket.socket, socket.socket]]
) -> None:
    connections = Connections(clock)
    for n in range(MOST_OPEN):
        connections.add(pairs[n][1], ("10.0.0.1", n))
    connections.begin(("10.0.0.1", 0))  # connection 0 has a request in progress
    connections.begin(("10.0.0.1", 1))
    # the request of connection 1 has ended, so it is idle only from now on
    connections.finish(("10.0.0.1", 1))
    connections.add(pairs[MOST_OPEN][1], ("10.0.0.2", 1))
    assert [n for n, pair in enumerate(pairs) if is_ended(pair)] == [2]
    for n in range(MOST_OPEN):
        connections.begin(("10.0.0.1", n))
    connections.begin(("10.0.0.2", 1))
    connections.add(pairs[MOST_OPEN + 1][1], ("10.0.0.2", 2))
    assert len(connections) == MOST_OPEN
    assert not is_ended(pairs[MOST_OPEN + 1])  # the new connection itself stays open


def test_a_new_connection_is_not_closed_before_its_first_request(
    clock: Clock, pairs: list[tuple[socket.socket, socket.socket]]
) -> None:
    """The first request may be a stop, so a newer connection must not replace this one."""
    connections = Connections(clock)
    for n in range(MOST_OPEN):
        connections.add(pairs[n][1], ("10.0.0.1", n))
        connections.begin(("10.0.0.1", n))
    for n in (MOST_OPEN, MOST_OPEN + 1):
        connections.add(pairs[n][1], ("10.0.0.1", n))
    assert [n for n, pair in enumerate(pairs) if is_ended(pair)] == [0, 1]


@pytest.mark.parametrize("is_stalled", [False, True], ids=["sends ahead", "reads nothing"])
def test_connections_of_greedy_clients_are_closed_before_others(
    clock: Clock, pairs: list[tuple[socket.socket, socket.socket]], is_stalled: bool
) -> None:
    connections = Connections(clock)
    for n in range(MOST_OPEN):
        connections.add(pairs[n][1], ("10.0.0.1", n))
    assert connections.is_stop(("10.0.0.1", 0), "/api/stop")
    if is_stalled:
        connections.note_stall(("10.0.0.1", 7), is_stalled=True)
        clock.now += FRESH_S + 0.1
    else:
        connections.note_greed(("10.0.0.1", 7), is_greedy=True)
    assert not connections.is_stop(("10.0.0.1", 5), "/api/plant")
    connections.add(pairs[MOST_OPEN][1], ("10.0.0.2", 0))
    assert [n for n, pair in enumerate(pairs) if is_ended(pair)] == [7]
    connections.add(pairs[MOST_OPEN + 1][1], ("10.0.0.2", 1))
    assert [n for n, pair in enumerate(pairs) if is_ended(pair)] == [1, 7]
    assert len(connections) == MOST_OPEN


def test_a_connection_is_closed_if_its_client_reads_no_answers(
    clock: Clock, pairs: list[tuple[socket.socket, socket.socket]]
) -> None:
    connections = Connections(clock)
    for n in range(2):
        connections.add(pairs[n][1], ("10.0.0.1", n))
        connections.begin(("10.0.0.1", n))
        connections.note_stall(("10.0.0.1", n), is_stalled=True)
    connections.note_stall(("10.0.0.1", 1), is_stalled=False)
    clock.now += STALLED_S + 0.1
    connections.sweep()
    assert [is_ended(pair) for pair in pairs[:2]] == [True, False]


@pytest.mark.long
async def test_http_stops_beyond_a_limit_are_combined_into_one_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "HEAD_S", 0.01)
    called, silent = list[list[str]](), asyncio.Event()

    async def stop(drives: list[str], caller: Caller) -> dict[str, CommandResult]:
        called.append(drives)
        await silent.wait()
        return {}

    async def receive() -> Any:
        return {"type": "http.request", "body": b'{"drives": ["pump-1"]}'}

    gateway: Any = SimpleNamespace(frames=None, commands=SimpleNamespace(stop=stop))
    pages = web.Pages(gateway)
    scope = {"type": "http", "headers": [], "caller": Caller("anna", "http", "127.0.0.1", Right.STOP)}
    await asyncio.gather(*(pages.stop(Request(scope, receive)) for _ in range(MOST_STOPS + 5)))
    while len(called) <= MOST_STOPS:
        await asyncio.sleep(0.01)
    assert called == [["pump-1"]] * (MOST_STOPS + 1)
    silent.set()


async def test_a_stop_is_processed_before_waiting_reads() -> None:
    order: list[str] = []

    async def take(turns: Turns, name: str, waiting: deque[asyncio.Future[None]]) -> None:
        await turns.wait(waiting)
        order.append(name)

    turns = Turns()
    reads = [asyncio.create_task(take(turns, f"read {n}", turns.others)) for n in range(4)]
    await asyncio.sleep(0)
    assert order == ["read 0"]
    stop = asyncio.create_task(take(turns, "stop", turns.stops))
    reads[1].cancel()
    await asyncio.gather(stop, *reads, return_exceptions=True)
    assert order == ["read 0", "read 2", "stop", "read 3"]  # read 2 had its turn before the stop arrived
    await take(turns, "later", turns.others)  # starts immediately, because no other request waits
    assert order[-1] == "later"


def test_a_stop_is_answered_before_earlier_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """20 clients send 5 requests each at the same time and read no answers."""
    order: list[str] = []
    come, go_on = threading.Event(), threading.Event()
    described = web.describe

    def describe(*given: Any, **more: Any) -> Any:
        order.append("read")
        return described(*given, **more)

    def stand_still() -> None:
        come.set()
        assert go_on.wait(PATIENCE)

    monkeypatch.setattr(web, "describe", describe)
    with served(tmp_path, '[serve.may]\nstop = "anyone"\n') as gateway, ExitStack() as stack:
        carry_out, address = gateway.gateway.commands.stop, ("127.0.0.1", gateway.gateway.port)

        async def stop(*given: Any) -> Any:
            order.append("stop")
            return await carry_out(*given)

        monkeypatch.setattr(gateway.gateway.commands, "stop", stop)
        clients = [stack.enter_context(socket.create_connection(address, PATIENCE)) for _ in range(21)]
        until(lambda: len(gateway.gateway.connections) == 21)
        gateway.loop.call_soon_threadsafe(stand_still)
        assert come.wait(PATIENCE)
        *readers, stopper = clients
        for client in readers:
            client.sendall(b"GET /api/plant HTTP/1.1\r\nhost: localhost\r\n\r\n" * 5)
        body = b"content-type: application/json\r\ncontent-length: 2\r\n\r\n{}"
        stopper.sendall(b"POST /api/stop HTTP/1.1\r\nhost: localhost\r\n" + body)
        go_on.set()
        assert stopper.recv(1000).startswith(b"HTTP/1.1 200 ")
        until(lambda: len(order) > 75)
    assert order.index("stop") < 10


def test_an_unfinished_request_is_answered_with_503_at_shutdown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(gateway_module, "GRACE_S", 0)
    entered = threading.Event()

    async def stop(*given: Any) -> None:
        entered.set()
        await asyncio.Event().wait()

    with served(tmp_path, '[serve.may]\nstop = "anyone"\n') as gateway, ThreadPoolExecutor(1) as client:
        monkeypatch.setattr(gateway.gateway.commands, "stop", stop)
        answer = client.submit(gateway.post, "/api/stop")
        assert entered.wait(PATIENCE)
        gateway.loop.call_soon_threadsafe(gateway.gateway.end)
        assert (answer.result(PATIENCE).status, answer.result().json) == (503, {"error": connections.ENDS})
    assert "Traceback" not in caplog.text


def test_a_client_counts_as_greedy_while_two_requests_are_pending(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = asyncio.Event()

    async def after(n: int) -> None:
        await go_on.wait()

    monkeypatch.setattr(gateway.gateway.frames, "after", after)
    with connected(gateway) as client:
        connections, ours = gateway.gateway.connections, client.getsockname()
        client.sendall(b"GET /api/frame HTTP/1.1\r\nhost: localhost\r\n\r\n")
        until(lambda: ours in connections._open and connections._open[ours].is_busy)
        assert not connections._open[ours].is_greedy
        client.sendall(b"GET /api/plant HTTP/1.1\r\nhost: localhost\r\n\r\n")
        until(lambda: connections._open[ours].is_greedy)
        gateway.loop.call_soon_threadsafe(go_on.set)
        until(lambda: not connections._open[ours].is_greedy)
