"""Receivers of a gateway's rows, and a process that forwards numbered rows until it is killed.

The process is `python forwarded.py KIND WHERE FOLDER FIRST`.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path
from pkgutil import resolve_name
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
from lines import until
from spooled import EXCHANGES, NOON, numbered

from multidrop import Plant
from multidrop.gateway.forward.forwarder import Forwarding, Outgoing, RepeatingReceiver
from multidrop.gateway.mqtt.broker import Login, parse_broker
from multidrop.gateway.mqtt.rows import json_rows
from multidrop.gateway.mqtt.settings import MqttSettings
from multidrop.gateway.parts import PARTS, build
from multidrop.printable import parse_time
from multidrop.samples import ROWS, Spool

Key = tuple[int, str, str]  # the fields that identify a row: time in ns, drive, register
DRAIN = -1


def forwarding(kind: str, where: str, folder: Path) -> Forwarding:
    """Return the gateway part that forwards rows to `where`; `kind` is the name of its plant table."""
    context: Any = SimpleNamespace(plant=Plant((), folder / "plant.toml"), folder=folder)
    if kind == "mqtt":
        return json_rows(MqttSettings(where, rows=True), context, parse_broker(where), Login())
    key = "database" if kind == "postgres" else "url"
    made: Any = build(kind, resolve_name(PARTS[kind])(**{key: where}), context)
    assert isinstance(made, Forwarding)
    return made


class Recorded:
    """A `deliver` function for a `RepeatingReceiver`: records messages, or raises `failure` if set."""

    def __init__(self) -> None:
        self.failure: Exception | None = None
        self.messages: list[Outgoing] = []
        self.on_call: Callable[[], object] = lambda: None

    def __call__(self, message: Outgoing) -> None:
        self.on_call()
        if self.failure:
            raise self.failure
        self.messages.append(message)

    def at(self, folder: Path) -> RepeatingReceiver:
        return RepeatingReceiver(folder, self)

    @property
    def sequences(self) -> list[int]:
        return [int(one.id.rpartition("-")[2]) for one in self.messages]


def store(spool: Spool, first: int, exchanges: int) -> None:
    """Append exchanges, and wait until they are on the disk as a message."""
    spool.append(numbered(first, exchanges))
    assert spool.sync(30.0)


def rows_at_noon(*given: tuple[str, str, float | None, str, str | None]) -> Any:
    """Return a table of rows (drive, register, value, status, unit); the first row's time is noon."""
    columns: dict[str, list[Any]] = {name: [] for name in ROWS.names}
    for number, one in enumerate(given):
        named = dict(zip(("drive", "register", "value", "status", "unit"), one, strict=True))
        for name in columns:
            times = {"time": NOON + number, "monotonic_ns": number, "uncertainty_ns": None}
            columns[name].append((named | times)[name])
    return pa.table(columns, schema=ROWS)


class Posted:
    """A web server that answers with the HTTP status `status`, and records the JSON it accepts."""

    def __init__(self) -> None:
        self.status = 200
        self.hang = threading.Event()  # requests get no answer while this is not set
        self.hang.set()
        self.batches: list[dict[str, Any]] = []
        self.headers: list[dict[str, str]] = []
        self.url = ""

    def take(self, body: bytes, headers: dict[str, str]) -> int:
        self.hang.wait()
        if self.status == 200:
            self.headers.append(headers)
            self.batches.append(json.loads(body))
        return self.status


@contextmanager
def web_server() -> Iterator[Posted]:
    """Run a web server; its `url` has a secret path."""
    posted = Posted()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            self.send_response(posted.take(body, {k.lower(): v for k, v in self.headers.items()}))
            self.send_header("location", posted.url)  # for the statuses of a redirect
            self.send_header("content-length", "0")
            self.end_headers()

        def log_message(self, *arguments: object) -> None:
            pass

    class Server(ThreadingHTTPServer):
        def handle_error(self, request: Any, client_address: Any) -> None:
            """Ignore killed clients."""

    with Server(("127.0.0.1", 0), Handler) as server:
        posted.url = f"http://127.0.0.1:{server.server_port}/secret-path"
        thread = threading.Thread(target=server.serve_forever, args=[0.01])
        thread.start()
        yield posted
        posted.hang.set()
        server.shutdown()
        thread.join()


def keys_in(batches: list[dict[str, Any]]) -> list[Key]:
    """Return the rows of JSON batches, each batch once; fail if two batches with the same id differ."""
    by_id: dict[str, Any] = {}
    for one in batches:
        assert by_id.setdefault(f"{one['id']} {one.get('topic', '')}", one["rows"]) == one["rows"]
    return [
        (parse_time(row["time"]), row["drive"], row["register"]) for rows in by_id.values() for row in rows
    ]


def main(kind: str, where: str, folder: Path, first: int) -> None:
    """Forward exchanges from number `first` on until killed; print how many are on the disk."""
    part = forwarding(kind, where, folder)
    threading.Thread(target=part._forwarder.run, daemon=True).start()
    print(0, flush=True)
    if first == DRAIN:
        until(lambda: not part._forwarder.behind)
        print("done", flush=True)
        return
    for number in count(1):
        store(part._spool, first + (number - 1) * EXCHANGES, EXCHANGES)
        print(number * EXCHANGES, flush=True)
        time.sleep(0.001)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]))
