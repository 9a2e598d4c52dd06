"""Concurrent users of a gateway in a separate process, which counts their results.

The users are viewers that receive each frame, stalled viewers, a metrics scraper, history queries, Modbus
masters, and an MQTT listener.
"""

from __future__ import annotations

import asyncio
import gzip
import json
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

sys.path.extend(map(str, Path(__file__).parents[1].iterdir()))

from commands import BoundProcess
from simulated_pumps import FIRST_READING, POLLED, UNPOLLED

VIEWERS, STALLED, MASTERS = 5, 10, 2
SCRAPE_S = QUERY_S = 1.0
MASTER_S = 0.02  # s between a Modbus master's requests
PASS_EVERY = 10  # one in ten requests of the second master reads an unpolled register
ASKED_ONES = 200  # requests that a stalled viewer sends without reading a reply
PATIENCE_S = 30.0
ROUND_S = 1.0  # s before a user reconnects
WORDS = 10  # number of polled registers
COMMON, COMMON_WORDS = 0xF000, 6  # address and size of the block shared by several drives

SERVE = """[serve]
listen = "127.0.0.1:{http}"
[serve.may]
stop = "anyone"
[serve.history]
rotate = "{rotate}"
[serve.mqtt]
broker = "mqtt://127.0.0.1:{broker}"
home_assistant = true
[serve.modbus]
listen = "127.0.0.1:{modbus}"
units = {{ {units} }}
"""


class Place(NamedTuple):
    """A gateway's ports, and what its users request."""

    http: int
    modbus: int
    broker: int
    drives: int
    first: int  # first address of the polled registers
    unpolled: int  # address of a register that is not polled
    series: list[str]


def place_of(drives: int, http: int, modbus: int, broker: int) -> Place:
    """Return the ports and requests for a gateway with `drives` simulated pumps."""
    series = [f"pump-{number}.{name}" for number in range(1, drives + 1) for name in POLLED]
    return Place(http, modbus, broker, drives, FIRST_READING, UNPOLLED, series)


def serve_tables(place: Place, rotate: str) -> str:
    """Return the `[serve]` tables of a plant file that enable all parts of the gateway."""
    units = ", ".join(f"pump-{number} = {number}" for number in range(1, place.drives + 1))
    return SERVE.format(http=place.http, modbus=place.modbus, broker=place.broker, units=units, rotate=rotate)


class Users:
    """All users; `counts` has the number of each result, `failures` the number of each unexpected result."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self.counts: dict[str, float] = {}
        self.failures: dict[str, int] = {}

    def count(self, what: str, number: float = 1) -> None:
        self.counts[what] = self.counts.get(what, 0) + number

    def most(self, what: str, number: float) -> None:
        self.counts[what] = max(self.counts.get(what, 0.0), number)

    def fail(self, what: str) -> None:
        self.failures[what] = self.failures.get(what, 0) + 1

    async def run(self) -> None:
        users = [
            *(self._viewer for _ in range(VIEWERS)),
            *(self._stalled for _ in range(STALLED)),
            self._scraper,
            self._asker,
            self._cached_master,
            self._uncached_master,
        ]
        await asyncio.gather(*(self._again(user) for user in users))

    async def _again(self, user: Callable[[], Awaitable[None]]) -> None:
        while True:
            try:
                await user()
            except (OSError, EOFError, ValueError) as failure:
                self.fail(f"{user.__name__.strip('_')}: {type(failure).__name__}: {failure}"[:200])
            await asyncio.sleep(ROUND_S)

    async def _viewer(self) -> None:
        """Receive frames as fast as possible and check their numbers."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.place.http)
        with closing(writer):
            newest = -1
            while True:
                status, body = await _get(reader, writer, f"/api/frame?after={newest}")
                if status == 304:
                    self.fail("viewer: no frame for 20 s")
                    continue
                number = re.match(rb'\{"n":(\d+)', body)
                if status != 200 or number is None:
                    raise ValueError(f"a frame is {status} {body[:80]!r}")
                if int(number[1]) <= newest:
                    self.fail(f"viewer: frame {int(number[1])} after {newest}")
                newest = int(number[1])
                self.count("frames")

    async def _stalled(self) -> None:
        """Request many frames, and read nothing until released."""
        with closing(socket.socket()) as peer:
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            peer.setblocking(False)
            await asyncio.get_running_loop().sock_connect(peer, ("127.0.0.1", self.place.http))
            peer.send(_request("/api/frame?after=-1") * ASKED_ONES)
            while True:
                await asyncio.sleep(ROUND_S)
                info = peer.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)
                if info[0] != 1:  # the TCP connection is not established
                    self.count("stalled, let go")
                    return

    async def _scraper(self) -> None:
        await self._ask_over_and_over("scrapes", SCRAPE_S, lambda: "/metrics")

    async def _asker(self) -> None:
        turns = 0

        def question() -> str:
            nonlocal turns
            turns += 1
            seconds = (60, 600, 3600)[turns % 3]
            names = self.place.series[turns % 7 :: 7][: 1 + turns % 4]
            now = time.time_ns() // 1_000_000
            wanted = "&".join(f"series={name}" for name in names)
            return f"/api/history?{wanted}&from={now - seconds * 1000}&to={now}&points=800"

        await self._ask_over_and_over("queries", QUERY_S, question)

    async def _ask_over_and_over(self, what: str, every: float, path: Callable[[], str]) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", self.place.http)
        with closing(writer):
            due = time.monotonic()
            while True:
                begun = time.monotonic()
                status, body = await _get(reader, writer, path())
                if status != 200:
                    raise ValueError(f"{what}: {status} {body[:200]!r}")
                self.count(what)
                self.count(f"{what}, s", time.monotonic() - begun)
                self.most(f"{what}, longest s", time.monotonic() - begun)
                due = max(due + every, time.monotonic())
                await asyncio.sleep(max(0.0, due - time.monotonic()))

    async def _cached_master(self) -> None:
        await self._master(lambda turn: (self.place.first, WORDS), "reads")

    async def _uncached_master(self) -> None:
        """Read the common registers of each drive in turn, and sometimes an unpolled register."""

        def wanted(turn: int) -> tuple[int, int]:
            return (COMMON, COMMON_WORDS) if turn % PASS_EVERY else (self.place.unpolled, 1)

        await self._master(wanted, "reads of others")

    async def _master(self, wanted: Callable[[int], tuple[int, int]], what: str) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", self.place.modbus)
        with closing(writer):
            turn = 0
            while True:
                turn += 1
                number, unit = turn & 0xFFFF, 1 + turn % self.place.drives
                start, count = wanted(turn)
                writer.write(struct.pack(">HHHBBHH", number, 0, 6, unit, 3, start, count))
                begun = time.monotonic()
                head = await asyncio.wait_for(reader.readexactly(8), PATIENCE_S)
                transaction, protocol, length, replied, function = struct.unpack(">HHHBB", head)
                await reader.readexactly(length - 2)
                if (transaction, protocol, replied) != (number, 0, unit):
                    raise ValueError(f"{what}: unit {unit} {number} is answered by {head.hex()}")
                if function == 3 and length == 3 + 2 * count:
                    self.count(what)
                    self.most(f"{what}, longest s", time.monotonic() - begun)
                else:
                    self.count(f"{what}, exceptions")
                await asyncio.sleep(MASTER_S)


def _request(path: str) -> bytes:
    return f"GET {path} HTTP/1.1\r\nhost: localhost\r\naccept-encoding: gzip\r\n\r\n".encode()


async def _get(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, path: str) -> tuple[int, bytes]:
    """Send a GET request on a persistent connection; return status and body."""
    writer.write(_request(path))
    head = (await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE_S)).decode("latin-1").lower()
    length = re.search(r"content-length: (\d+)", head)
    body = await reader.readexactly(int(length[1])) if length else b""
    status = int(head.split()[1])
    return status, gzip.decompress(body) if "content-encoding: gzip" in head else body


class GatewayUsers:
    """Controls the users, who run in a process of their own."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    @property
    def pid(self) -> int:
        return self._process.pid

    def counts(self) -> tuple[Mapping[str, float], Mapping[str, int]]:
        """Return the numbers of results so far, and of unexpected results."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(file=self._process.stdin, flush=True)
        counts, failures = json.loads(self._process.stdout.readline())
        return counts, failures


@contextmanager
def gateway_users(place: Place) -> Iterator[GatewayUsers]:
    """Start the users in a separate process; the MQTT listener is mosquitto_sub."""
    words = [sys.executable, __file__, json.dumps(place)]
    with BoundProcess(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield GatewayUsers(process)
        finally:
            process.terminate()


async def _live(place: Place) -> None:
    users = Users(place)
    loop = asyncio.get_running_loop()

    task = asyncio.current_task()
    assert task is not None

    def tell() -> None:
        if not sys.stdin.readline():
            loop.remove_reader(sys.stdin)  # the parent process has ended, and with it standard input
            task.cancel()
            return
        print(json.dumps([users.counts, users.failures]), flush=True)

    loop.add_reader(sys.stdin, tell)
    loop.add_signal_handler(signal.SIGTERM, task.cancel)
    command = ["mosquitto_sub", "-p", str(place.broker), "-t", "#", "-q", "1", "-F", "%t"]
    listener = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)

    async def listen() -> None:
        assert listener.stdout is not None
        while await listener.stdout.readline():
            users.count("messages")
        users.fail("the listener of the broker ended")

    try:
        await asyncio.gather(users.run(), listen())
    finally:
        listener.kill()
        await listener.wait()


def main(place: list[Any]) -> None:
    """Run all users until the process is terminated."""
    with suppress(asyncio.CancelledError):
        asyncio.run(_live(Place(*place)))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
