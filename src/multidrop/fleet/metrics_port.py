"""Metrics port: answers `GET /metrics` to this machine's own programs, and nothing else.

Whoever may connect may read, so it listens only on addresses that this machine alone can reach. It checks the
header `Host` too: a page of another site, whose name was made to lead here, reads nothing.
"""

from __future__ import annotations

import asyncio
import logging
import re
import socket
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager, suppress
from ipaddress import ip_address

from multidrop.exposition import MetricFamily, expose_metrics

EXAMPLE = "127.0.0.1:9464"
MOST_HEAD = 8192  # bytes of a request
MOST_CLIENTS = 32
PATIENCE_S = 5.0  # for a request, and for its answer
NAMES = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?")
REASONS = {200: "OK", 400: "Bad Request", 403: "Forbidden", 404: "Not Found", 405: "Method Not Allowed"}
REASONS |= {500: "Internal Server Error"}

_log = logging.getLogger("multidrop.fleet")
Metrics = Callable[[], Iterable[MetricFamily]]


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port. Raises ValueError for what is none, or can be reached by other machines."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > 65535:
        raise ValueError(f"--metrics {text!r} is no address and port; write --metrics {EXAMPLE}")
    if not _is_loopback(host):
        raise ValueError(
            f"--metrics {text} is open to other machines, and there are neither tokens nor TLS here: listen "
            f"on {EXAMPLE}, and let a proxy with TLS pass requests on"
        )
    return host, int(port)


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def listen(text: str) -> socket.socket:
    """Return a listening socket at HOST:PORT. Raises ValueError for another's, OSError for a taken one."""
    address = parse_address(text)
    try:
        family, *_, where = socket.getaddrinfo(*address, type=socket.SOCK_STREAM)[0]
        return socket.create_server(where[:2], family=family)
    except OSError as failure:
        raise OSError(f"--metrics {text} cannot be had: {failure.strerror}") from failure


@asynccontextmanager
async def serving(listener: socket.socket, metrics: Metrics) -> AsyncIterator[None]:
    """Answer while the context lasts."""
    clients: set[asyncio.StreamWriter] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        clients.add(writer)
        try:
            if len(clients) <= MOST_CLIENTS:
                async with asyncio.timeout(PATIENCE_S):
                    writer.write(_answer(await reader.readuntil(b"\r\n\r\n"), metrics))
                    await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # it has gone, takes too long, or says too much
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
    except Exception:  # whoever scrapes sees it, and so does the log
        _log.exception("metrics cannot be told")
        return _response(500, "this gateway fails to tell its metrics; its log says why")


def answer(head: bytes, metrics: Metrics) -> bytes:
    """Return the whole answer to a request, whatever its bytes are."""
    lines = head.decode("latin-1").split("\r\n")
    fields = [line.partition(":") for line in lines[1:] if line]
    headers = {name.strip().lower(): value.strip() for name, _, value in fields}
    words = lines[0].split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        return _response(400, "this is no request of HTTP/1")
    if not NAMES.fullmatch(headers.get("host", "")):
        return _response(403, "this answers to localhost, 127.0.0.1 and [::1] alone")
    if words[0] != "GET":
        return _response(405, "metrics are asked for by GET")
    if words[1].partition("?")[0] != "/metrics":
        return _response(404, "there is /metrics here, and nothing else")
    kind, text = expose_metrics(metrics(), headers.get("accept", ""))
    return _response(200, text, kind)


def _response(status: int, text: str, kind: str = "text/plain; charset=utf-8") -> bytes:
    body = text.encode()
    head = (
        f"HTTP/1.1 {status} {REASONS[status]}\r\ncontent-type: {kind}\r\ncontent-length: {len(body)}\r\n"
        "vary: accept\r\nconnection: close\r\n\r\n"
    )
    return head.encode() + body
