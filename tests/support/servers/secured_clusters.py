"""Run NATS servers and whole fleets with TLS and with the rights that `fleet rights` writes."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from commands import kill_all
from fleet_drills import CommandEnd, fleet_status, run_here
from fleet_scale import until
from nats_clusters import Cluster, Node, server_program, started_cluster
from peers import require_program
from serial_hall import SerialHall

from multidrop.fleet.servers.connections import connect_options
from multidrop.fleet.servers.files import ROUTE_PORTS, STORE, TlsFiles, write_files

GATEWAYS = ("gw-a", "gw-b", "gw-c")
PATIENCE_S = 120.0
Change = Callable[[str], str]  # a function that edits the text of rights.conf


def _as_written(rights: str) -> str:
    return rights


def in_one_account(rights: str) -> str:
    """Return rights.conf with all users in the account of the streams, instead of separate accounts."""
    users = re.findall(r"\{ # .*?\n        \}\n      \}", rights, re.DOTALL)
    assert users
    return f"accounts {{ {STORE} {{ jetstream: enabled, users: [\n" + "\n".join(users) + "\n] } }\n"


def certificates(folder: Path, host: str = "127.0.0.1") -> TlsFiles:
    """Create a certificate authority, and a certificate signed by it for this host."""
    openssl = require_program("openssl")
    folder.mkdir(parents=True, exist_ok=True)
    own = ["req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2"]
    names = f"subjectAltName=IP:{host}"
    for words in (
        [*own, "-subj", "/CN=fleet", "-keyout", "ca-key.pem", "-out", "ca.pem"],
        [
            *(*own, "-subj", "/CN=server", "-addext", names, "-CA", "ca.pem", "-CAkey", "ca-key.pem"),
            *("-keyout", "server-key.pem", "-out", "server.pem"),
        ],
    ):
        subprocess.run([openssl, *words], cwd=folder, check=True, capture_output=True, timeout=PATIENCE_S)
    return TlsFiles(folder / "server.pem", folder / "server-key.pem", folder / "ca.pem")


def ports_with_routes(number: int) -> list[int]:
    """Return free ports, each with a free port ROUTE_PORTS above it for the cluster's routes."""
    found: list[int] = []
    while len(found) < number:
        with closing(socket.socket()) as one, closing(socket.socket()) as other:
            one.bind(("127.0.0.1", 0))
            port = int(one.getsockname()[1])
            with suppress(OSError, OverflowError):
                other.bind(("127.0.0.1", port + ROUTE_PORTS))
                found.append(port)
    return found


def _reloads(log: str) -> int:
    return log.count("Reloaded server configuration")


class SecuredNode(Node):
    """A NATS server process with its own configuration file."""

    def __init__(self, folder: Path, name: str, port: int, monitor: int) -> None:
        self.name, self.port, self.monitor = name, port, monitor
        self.place, self.host = None, "127.0.0.1"
        self._log = folder / f"{name}.log"
        self._command = [server_program(), "-c", str(folder / f"{name}.conf"), "-m", str(monitor)]
        self.start()

    @property
    def url(self) -> str:
        return f"tls://{self.host}:{self.port}"

    def log(self) -> str:
        return self._log.read_text("utf-8", "replace")


class SecuredCluster(Cluster):
    """NATS servers with rights, and the keys of all users."""

    def __init__(
        self, folder: Path, number: int, gateways: Sequence[str], change: Change = _as_written
    ) -> None:
        ports, monitors = ports_with_routes(number), ports_with_routes(number)
        self.folder = folder
        self.tls = certificates(folder / "tls")
        urls = [f"tls://127.0.0.1:{port}" for port in ports]
        write_files(folder, gateways, urls, self.tls, folder)
        rights = folder / "rights.conf"
        rights.write_text(change(rights.read_text()))
        self.nodes = [SecuredNode(folder, f"n{at + 1}", ports[at], monitors[at]) for at in range(number)]

    def key(self, user: str) -> Path:
        return self.folder / "keys" / f"{user}.key"

    def give_rights_to(self, gateways: Sequence[str]) -> None:
        """Rewrite the rights for only these gateways, and reload the servers' configuration."""
        write_files(self.folder, gateways, self.urls, self.tls, self.folder)
        self.reload()

    def reload(self) -> None:
        """Reload the servers' configuration, and wait until it is in effect."""
        done = [_reloads(node.log()) for node in self.nodes]
        for node in self.nodes:
            node.process.send_signal(signal.SIGHUP)
        ends = time.monotonic() + PATIENCE_S
        while any(_reloads(node.log()) == before for node, before in zip(self.nodes, done, strict=True)):
            assert time.monotonic() < ends, "a server does not reload"
            time.sleep(0.02)

    def options(self, user: str) -> dict[str, Any]:
        return connect_options(self.urls, self.key(user), self.tls.ca)

    def environment(self, user: str) -> dict[str, str]:
        return {
            **os.environ,
            "MULTIDROP_NATS": ",".join(self.urls),
            "MULTIDROP_NATS_CREDENTIALS": str(self.key(user)),
            "MULTIDROP_NATS_CA": str(self.tls.ca),
        }


@contextmanager
def secured_cluster(
    folder: Path, number: int = 3, gateways: Sequence[str] = GATEWAYS, change: Change = _as_written
) -> Iterator[SecuredCluster]:
    with started_cluster(
        lambda attempt: SecuredCluster(folder / str(attempt), number, gateways, change)
    ) as running:
        yield running


def multidrop(servers: SecuredCluster, user: str, *words: str) -> CommandEnd:
    return run_here(servers.environment(user), *words)


class SecuredFleet:
    """Gateway processes for six lines; each gateway has a folder of its name."""

    def __init__(self, folder: Path, servers: SecuredCluster) -> None:
        self.servers = servers
        self.hall = SerialHall(6)
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        # arguments of `start`, by gateway name
        self._started: dict[str, tuple[tuple[str, str], dict[str, str]]] = {}
        self._folder = folder
        (folder / "plant.toml").write_text(self.hall.plant())
        made = multidrop(servers, "operator", "fleet", "init", str(folder / "plant.toml"))
        assert made.returncode == 0, made.stderr

    def start(self, name: str, kept: str = "", **environment: str) -> None:
        """Start a gateway; `kept` is the name of its folder if that is not `name`."""
        kept = kept or name
        self._started[kept] = (name, kept), environment
        words = ["fleet", "serve", name, "--folder", str(self._folder / kept)]
        with (self._folder / f"{kept}.log").open("ab") as log:
            self.running[kept] = subprocess.Popen(
                [sys.executable, "-m", "multidrop", *words],
                env={**self.servers.environment(name), **environment},
                stdout=log,
                stderr=log,
            )

    def log(self, kept: str) -> str:
        return (self._folder / f"{kept}.log").read_text()

    def status(self, user: str = "viewer") -> dict[str, Any]:
        return fleet_status(self.servers.environment(user))

    def kill(self, name: str) -> None:
        process = self.running.pop(name)
        process.kill()
        process.wait()

    def wait_for_polling(self) -> None:
        """Wait until all lines are polled; restart gateways that the kernel killed on a busy machine."""

        def are_polled() -> bool:
            for kept, process in list(self.running.items()):
                if process.poll() == -signal.SIGKILL:
                    self.start(*self._started[kept][0], **self._started[kept][1])
            return self.hall.are_polled(0.5)

        until(are_polled, "all lines are polled")

    def close(self) -> None:
        kill_all(self.running.values())
        self.hall.close()


@contextmanager
def secured_fleet(
    folder: Path,
    number: int = 3,
    gateways: Sequence[str] = GATEWAYS,
    environments: Mapping[str, Mapping[str, str]] | None = None,
) -> Iterator[SecuredFleet]:
    """Yield a fleet on `number` servers with all gateways started."""
    with (
        secured_cluster(folder / "nats", number, gateways) as servers,
        closing(SecuredFleet(folder, servers)) as fleet,
    ):
        for name in gateways:
            fleet.start(name, **(environments or {}).get(name, {}))
        yield fleet
