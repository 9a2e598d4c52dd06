"""The OPC UA server: hostile and greedy clients, clients that read no answers, and encryption."""

from __future__ import annotations

import asyncio
import os
import random
import socket
import struct
import subprocess
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from gateways import Served, served
from lines import PATIENCE, until

from multidrop.gateway.http.rights import Right

try:
    from asyncua import Client as AsyncClient
    from asyncua import ua
    from asyncua.sync import Client

    from multidrop.gateway.opcua import server
except ImportError:
    if os.environ.get("CI"):
        raise
    pytest.skip("asyncua, the client, is not installed", allow_module_level=True)

pytestmark = pytest.mark.slow  # asyncua takes a second to start

SERVE = '[serve.opcua]\nlisten = "127.0.0.1:0"\n[serve.may]\nlook = "anyone"\nstop = "anyone"\n'
PLANT, PLANT_STOP = "ns=2;i=1", "ns=2;i=2"


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with pytest.MonkeyPatch.context() as patch, served(tmp_path_factory.mktemp("opcua"), SERVE) as gateway:
        patch.setattr(server, "MOST_WAITING", 1 << 20)  # so that MOST_UNREAD is the only limit of the clients
        part: Any = gateway.gateway.feeds["opcua"]
        until(lambda: part.is_ready)
        yield gateway


def port_of(gateway: Served) -> int:
    part: Any = gateway.gateway.feeds["opcua"]
    return int(part.port)


def stop_all(url: str) -> None:
    """Stop all drives by OPC UA, through a new connection."""
    with Client(url, timeout=PATIENCE) as client:
        assert "stop" in client.get_node(PLANT).call_method(client.get_node(PLANT_STOP).nodeid)


def connected(gateway: Served) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port_of(gateway)), timeout=PATIENCE)


@contextmanager
def recorded(port: int) -> Iterator[tuple[str, bytearray]]:
    """Yield the URL of a proxy for one client, and the bytes that this client sends through it."""
    sent = bytearray()

    def passed(source: socket.socket, target: socket.socket, note: bytearray) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                note += data
                target.sendall(data)
            target.shutdown(socket.SHUT_WR)

    with closing(socket.create_server(("127.0.0.1", 0))) as listener:

        def serve() -> None:
            listener.settimeout(PATIENCE)
            peer, _ = listener.accept()
            with closing(peer), closing(socket.create_connection(("127.0.0.1", port))) as far:
                back = threading.Thread(target=passed, args=(far, peer, bytearray()))
                back.start()
                passed(peer, far, sent)
                back.join()

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"opc.tcp://127.0.0.1:{listener.getsockname()[1]}/", sent
        thread.join()


def chunks_of(data: bytes) -> list[bytes]:
    """Return the message chunks (OPC 10000-6, 7.1.2) in these bytes."""
    found = []
    while data:
        (size,) = struct.unpack_from("<I", data, 4)
        found.append(data[:size])
        data = data[size:]
    return found


def read_chunk(peer: socket.socket) -> bytes:
    data = b""
    while len(data) < 8 or len(data) < struct.unpack_from("<I", data, 4)[0]:
        more = peer.recv(65536)
        assert more
        data += more
    return data


def test_the_opc_ua_server_survives_replayed_messages_with_changed_bytes(gateway: Served) -> None:
    """Messages recorded from a client are replayed, with random bytes of one message changed."""
    with recorded(port_of(gateway)) as (url, sent), Client(url, timeout=PATIENCE) as client:
        plant = client.get_node(PLANT)
        plant.get_children()
        client.get_node("ns=2;s=pump-1.status").read_data_value(raise_on_bad_status=False)
        subscription = client.create_subscription(100, None)
        subscription.subscribe_data_change(client.get_node("ns=2;s=pump-1.State"))
        plant.call_method(client.get_node(PLANT_STOP).nodeid)
    hello, opening, *messages = chunks_of(bytes(sent))
    rng = random.Random(43)
    for _ in range(60):
        with closing(connected(gateway)) as peer:
            peer.sendall(hello)
            read_chunk(peer)
            peer.sendall(opening)
            channel = read_chunk(peer)[8:12]
            damaged = rng.randrange(len(messages))
            for at, message in enumerate(messages):
                data = bytearray(message[:8] + channel + message[12:])
                if at == damaged:
                    for place in rng.sample(range(len(data)), 3):
                        data[place] = rng.randrange(256)
                with suppress(OSError):
                    peer.sendall(data)
    for _ in range(60):
        with closing(connected(gateway)) as peer, suppress(OSError):
            peer.sendall(rng.randbytes(rng.randrange(1, 2000)))
    part: Any = gateway.gateway.feeds["opcua"]
    until(lambda: not part._stops._running["pump-1"])
    stop_all(f"opc.tcp://127.0.0.1:{port_of(gateway)}/")
    assert gateway.get("/health").json["parts"]["opcua"] == "ok"


def test_an_opc_ua_client_is_disconnected_if_its_message_is_too_long(gateway: Served) -> None:
    with closing(connected(gateway)) as peer:
        peer.sendall(b"HELF" + struct.pack("<I", 0xFFFF_FFFF))
        with pytest.raises(ConnectionError):
            peer.sendall(bytes(1 << 26))


def test_an_opc_ua_client_is_disconnected_if_it_reads_no_answers(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "MOST_UNREAD", 1 << 16)
    with recorded(port_of(gateway)) as (url, sent), Client(url, timeout=PATIENCE) as client:
        client.read_values([client.get_node("ns=2;s=pump-1.State")] * 500)
    hello, opening, *messages = chunks_of(bytes(sent))
    with closing(connected(gateway)) as peer:
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        peer.sendall(hello)
        read_chunk(peer)
        peer.sendall(opening)
        channel = read_chunk(peer)[8:12]
        create, activate, *others = [message[:8] + channel + message[12:] for message in messages]
        peer.sendall(create + activate)
        read, (number,) = max(others, key=len), struct.unpack_from("<I", activate, 16)
        numbers = count(number + 1)

        def is_cut() -> bool:
            try:
                for _ in range(20):
                    peer.sendall(read[:16] + struct.pack("<I", next(numbers)) + read[20:])
            except ConnectionError:
                return True
            return False

        until(is_cut)


@pytest.mark.parametrize("interval", [0.0, -1.0, 1e-9, 1e300, float("nan")])
def test_the_interval_of_an_opc_ua_subscription_is_limited(gateway: Served, interval: float) -> None:
    with Client(f"opc.tcp://127.0.0.1:{port_of(gateway)}/", timeout=PATIENCE) as client:
        parameters = ua.CreateSubscriptionParameters(RequestedPublishingInterval=interval)
        found = client.tloop.post(client.aio_obj.uaclient.create_subscription(parameters, callback=None))
        assert server.LEAST_INTERVAL_MS <= found.RevisedPublishingInterval <= server.MOST_INTERVAL_MS


async def subscribe_and_vanish(url: str, timeout_ms: float) -> None:
    """Subscribe to a value a thousand times, then abort the connection without closing the session."""
    client = AsyncClient(url, timeout=PATIENCE)
    client.session_timeout = timeout_ms
    await client.connect()
    subscription = await client.create_subscription(1000.0, SimpleNamespace())
    await subscription.subscribe_data_change([client.get_node("ns=2;s=pump-1.State")] * 1000)
    client.uaclient.protocol.transport.abort()
    with suppress(Exception):
        await client.disconnect()


@pytest.mark.long
def test_subscriptions_end_when_the_session_of_a_vanished_client_ends(gateway: Served) -> None:
    part: Any = gateway.gateway.feeds["opcua"]
    there = part._opened[2]._session.subscription_service.subscriptions
    before = set(there)
    for _ in range(3):
        asyncio.run(subscribe_and_vanish(f"opc.tcp://127.0.0.1:{port_of(gateway)}/", 2_000.0))
    assert len(there) == len(before) + 3
    stop_all(f"opc.tcp://127.0.0.1:{port_of(gateway)}/")
    until(lambda: set(there) == before)


def test_an_opc_ua_request_for_too_many_nodes_is_refused(gateway: Served) -> None:
    with Client(f"opc.tcp://127.0.0.1:{port_of(gateway)}/", timeout=PATIENCE) as client:
        state = client.get_node("ns=2;s=pump-1.State")
        limit = client.get_node(ua.ObjectIds.Server_ServerCapabilities_OperationLimits_MaxNodesPerRead)
        assert limit.read_value() == server.MOST_OPERATIONS
        with pytest.raises(ua.UaStatusCodeError, match="BadTooManyOperations"):
            client.read_values([state] * (server.MOST_OPERATIONS + 1))


def test_an_opc_ua_client_may_not_exceed_the_limits_of_its_subscriptions(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Client(f"opc.tcp://127.0.0.1:{port_of(gateway)}/", timeout=PATIENCE) as client:
        state = client.get_node("ns=2;s=pump-1.State")
        subscription = client.create_subscription(1000, SimpleNamespace())
        handle = subscription.subscribe_data_change(state)
        modify = subscription.aio_obj.modify_monitored_item(handle, 1000.0, 1_000_000)
        [changed] = client.tloop.post(modify)
        assert changed.RevisedQueueSize == server.MOST_QUEUED
        monkeypatch.setattr(server, "MOST_ITEMS", 2)
        with pytest.raises(ua.UaStatusCodeError, match="BadTooManyMonitoredItems"):
            subscription.subscribe_data_change([state, state])


def test_opc_ua_clients_cannot_register_servers(gateway: Served) -> None:
    with (
        Client(f"opc.tcp://127.0.0.1:{port_of(gateway)}/", timeout=PATIENCE) as client,
        pytest.raises(ua.UaStatusCodeError, match="BadServiceUnsupported"),
    ):
        client.tloop.post(client.aio_obj.uaclient.register_server(ua.RegisteredServer()))


def test_only_opc_ua_sessions_without_a_login_are_replaced_by_new_sessions(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    part: Any = gateway.gateway.feeds["opcua"]
    until(lambda: not part._opened[2]._session.iserver._external_sessions)
    monkeypatch.setattr(server, "MOST_CLIENTS", 1)  # so at most two sessions
    url = f"opc.tcp://127.0.0.1:{port_of(gateway)}/"

    async def connect() -> None:
        async with AsyncClient(url, timeout=PATIENCE) as first:
            unused = AsyncClient(url, timeout=PATIENCE)
            await unused.connect_socket()
            await unused.send_hello()
            await unused.open_secure_channel()
            await unused.create_session()
            async with AsyncClient(url, timeout=PATIENCE):
                with pytest.raises(ua.UaStatusCodeError, match="BadTooManySessions"):
                    await AsyncClient(url, timeout=PATIENCE).connect()
                await first.get_node("ns=2;s=pump-1.State").read_data_value(raise_on_bad_status=False)
            unused.disconnect_socket()

    asyncio.run(connect())


def make_certificate(folder: Path, name: str) -> None:
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2"),
            *("-subj", f"/CN={name}"),
            *("-addext", f"subjectAltName=URI:urn:{name}:multidrop,DNS:localhost"),
            *("-keyout", f"{folder}/{name}-key.pem", "-out", f"{folder}/{name}.pem"),
        ],
        check=True,
        capture_output=True,
    )


def test_opc_ua_sessions_are_encrypted_if_a_certificate_is_configured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("plant", "client"):
        make_certificate(tmp_path, name)
    files = 'certificate = "plant.pem"\nkey = "plant-key.pem"\n'
    with served(tmp_path, SERVE.replace("[serve.may]", f"{files}[serve.may]")) as gateway:
        part: Any = gateway.gateway.feeds["opcua"]
        until(lambda: part.is_ready)
        url = f"opc.tcp://127.0.0.1:{port_of(gateway)}/"
        plain = Client(url, timeout=PATIENCE)
        # otherwise the client finds no endpoint of its security mode and does not connect
        with monkeypatch.context() as patch:
            patch.setattr(AsyncClient, "find_endpoint", staticmethod(lambda endpoints, *rest: endpoints[0]))
            with pytest.raises(ua.UaStatusCodeError, match="BadSecurityModeRejected"):
                plain.connect()
        plain.disconnect()
        secured = Client(url, timeout=PATIENCE)
        secured.application_uri = "urn:client:multidrop"
        keys = f"{tmp_path}/client.pem,{tmp_path}/client-key.pem"
        secured.set_security_string(f"Basic256Sha256,SignAndEncrypt,{keys}")
        secured.set_user("stopper")
        secured.set_password(gateway.secrets[Right.STOP])
        with secured:
            assert "stop" in secured.get_node(PLANT).call_method(secured.get_node(PLANT_STOP).nodeid)


def test_a_private_key_of_another_certificate_is_reported_in_one_sentence(tmp_path: Path) -> None:
    for name in ("plant", "other"):
        make_certificate(tmp_path, name)
    files = 'certificate = "plant.pem"\nkey = "other-key.pem"\n'
    with (
        pytest.raises(ValueError, match=r"must be an RSA certificate and its key, in PEM"),
        served(tmp_path, SERVE.replace("[serve.may]", f"{files}[serve.may]")),
    ):
        pass
