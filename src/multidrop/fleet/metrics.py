"""Metrics of a fleet's gateway in the OpenMetrics format, and the HTTP port that serves them locally.

A figure that is unknown, such as the lease's remaining time when there is no lease, has no sample. Every
client that can connect can read the metrics, so the port listens only on loopback addresses. The port also
checks the `Host` header, so that a web page whose name resolves to this computer cannot read the metrics.
"""

from __future__ import annotations

import asyncio
import logging
import re
import socket
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from ipaddress import ip_address
from typing import Any

from multidrop.exposition import MetricFamily, expose_metrics
from multidrop.fleet.lines.member import MemberState
from multidrop.toml_check import parse_address

_SUFFIXES = {"gauge": "", "counter": "_total"}
_PREFIX = "multidrop_fleet_"
EXAMPLE = "127.0.0.1:9464"
MOST_HEAD = 8192  # size limit of a request's header, in bytes
MOST_CLIENTS = 32
PATIENCE_S = 5.0  # time limit for receiving a request and sending its answer
NAMES = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?")
REASONS = {200: "OK", 400: "Bad Request", 403: "Forbidden", 404: "Not Found", 405: "Method Not Allowed"}
REASONS |= {500: "Internal Server Error"}
_log = logging.getLogger("multidrop.fleet")
Metrics = Callable[[], Iterable[MetricFamily]]


def families_of(state: Mapping[str, Any], version: str) -> Iterator[MetricFamily]:
    """Yield the metrics of a gateway's state."""
    about = {"gateway": state["gateway"], "version": version}
    yield MetricFamily(f"{_PREFIX}gateway", "info", "Name and version.", [("_info", about, 1.0)])
    label = f"{_PREFIX}gateway_state"
    states = [("", {label: one.value}, float(one.value == state["state"])) for one in MemberState]
    yield MetricFamily(label, "stateset", "State of the gateway.", states)
    spool, margin_s = state["spool"], state["margin_s"] if state["session"] else None
    figures: Sequence[tuple[str, str, str, float | None]] = (
        ("lease_margin_seconds", "gauge", "Time until the lease expires.", margin_s),
        ("session", "gauge", "Number of the session.", state["session"] or None),
        ("servers", "gauge", "Servers that its three connections use.", len({*state["paths"]} - {""})),
        ("troubled_lines", "gauge", "Lines that cannot be opened, or fail.", len(state["troubles"])),
        ("lost_lines", "gauge", "Lines that are not polled: their port is lost.", len(state["lost"])),
        ("failing_lines", "gauge", "Lines on which polling failed and is retried.", len(state["failing"])),
        ("unopened_lines", "gauge", "Lines that other gateways should open.", len(state["unopened"])),
        ("lines", "gauge", "Lines that are polled.", state["lines"]),
        ("moves", "counter", "Lines that were claimed or released.", state["moves"]),
        ("spool_bytes", "gauge", "Bytes of all messages on the disk.", spool["bytes"]),
        ("spool_waiting_rows", "gauge", "Rows in memory, not yet on the disk.", spool["waiting"]),
        ("spool_rows", "counter", "Rows that reached the disk.", spool["rows"]),
        ("spool_lost_rows", "counter", "Rows not written, or removed unsent.", spool["lost"]),
        ("sent_messages", "counter", "Messages that the servers stored.", spool["sent"]),
        ("behind_messages", "gauge", "Messages that the servers lack.", spool["behind"]),
        ("behind_seconds", "gauge", "Age of the oldest message that the servers lack.", spool["lag_s"]),
    )
    for name, kind, text, value in figures:
        if value is not None:
            yield MetricFamily(_PREFIX + name, kind, text, [(_SUFFIXES[kind], {}, float(value))])


def local_address(text: str) -> tuple[str, int]:
    """Return host and port. Raises ValueError if they are invalid, or if other computers can reach them."""
    host, port = parse_address(text, f"--metrics {EXAMPLE}")
    if not _is_loopback(host):
        raise ValueError(
            f"--metrics {text} is open to other machines, without tokens or TLS. "
            f"Write --metrics {EXAMPLE}, and let a proxy with TLS forward to it"
        )
    return host, port


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def listen(text: str) -> socket.socket:
    """Return a socket that listens at HOST:PORT.

    Raises ValueError for an invalid address, OSError if the port is in use.
    """
    address = local_address(text)
    try:
        family, *_, where = socket.getaddrinfo(*address, type=socket.SOCK_STREAM)[0]
        return socket.create_server(where[:2], family=family)
    except OSError as failure:
        raise OSError(f"--metrics {text} is not available: {failure.strerror}") from failure


@asynccontextmanager
async def serving(listener: socket.socket, metrics: Metrics) -> AsyncIterator[None]:
    clients: set[asyncio.StreamWriter] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        clients.add(writer)
        try:
            if len(clients) <= MOST_CLIENTS:
                async with asyncio.timeout(PATIENCE_S):
                    writer.write(_answer(await reader.readuntil(b"\r\n\r\n"), metrics))
                    await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the client closed the connection, was too slow, or sent too much
        finally:
            clients.discard(writer)
            writer.close()

    server = await asyncio.start_server(serve, sock=listener, limit=MOST_HEAD)
    try:
        yield
    finally:
        server.close()
        for writer in list(clients):
            writer.transport.abort()
        with suppress(OSError):
            await server.wait_closed()


def _answer(head: bytes, metrics: Metrics) -> bytes:
    try:
        return answer(head, metrics)
    except Exception:  # the client gets status 500, and the failure is logged
        _log.exception("metrics failed")
        return _response(500, "the metrics failed; this gateway's log says why")


def answer(head: bytes, metrics: Metrics) -> bytes:
    """Return the HTTP response to a request, which may be any bytes."""
    lines = head.decode("latin-1").split("\r\n")
    fields = [line.partition(":") for line in lines[1:] if line]
    headers = {name.strip().lower(): value.strip() for name, _, value in fields}
    words = lines[0].split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        return _response(400, "not an HTTP/1 request")
    if not NAMES.fullmatch(headers.get("host", "")):
        return _response(403, "only localhost, 127.0.0.1 and [::1] are served")
    if words[0] != "GET":
        return _response(405, "use GET")
    if words[1].partition("?")[0] != "/metrics":
        return _response(404, "only /metrics is served")
    kind, text = expose_metrics(metrics(), headers.get("accept", ""))
    return _response(200, text, kind)


def _response(status: int, text: str, kind: str = "text/plain; charset=utf-8") -> bytes:
    body = text.encode()
    head = (
        f"HTTP/1.1 {status} {REASONS[status]}\r\ncontent-type: {kind}\r\ncontent-length: {len(body)}\r\n"
        "vary: accept\r\nconnection: close\r\n\r\n"
    )
    return head.encode() + body
