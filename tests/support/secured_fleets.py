"""A whole fleet with rights: gateway processes with their own keys, and lines that check their requests."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fleet_status import fleet_status
from kills import kill_all
from secured_clusters import GATEWAYS, SecuredCluster, secured_cluster
from serial_hall import SerialHall

PATIENCE_S = 120.0


def multidrop(servers: SecuredCluster, user: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command as this user."""
    return subprocess.run(
        [sys.executable, "-m", "multidrop", *words],
        env=servers.environment(user),
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )


def until(condition: Callable[[], bool], what: str) -> None:
    ends = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < ends, what
        time.sleep(0.1)


class SecuredFleet:
    """Gateways on six lines; each has a folder of its name."""

    def __init__(self, folder: Path, servers: SecuredCluster) -> None:
        self.servers = servers
        self.hall = SerialHall(6)
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self._folder = folder
        (folder / "plant.toml").write_text(self.hall.plant())
        made = multidrop(servers, "operator", "fleet", "init", str(folder / "plant.toml"))
        assert made.returncode == 0, made.stderr

    def start(self, name: str, kept: str = "", **environment: str) -> None:
        """Start a gateway; `kept` names another folder."""
        kept = kept or name
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

    def wait_for_polling(self) -> None:
        until(lambda: self.hall.are_polled(0.5), "all lines are polled")

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
    """Give a fleet on this many servers, with all gateways started."""
    with secured_cluster(folder / "nats", number, gateways) as servers:
        fleet = SecuredFleet(folder, servers)
        try:
            for name in gateways:
                fleet.start(name, **(environments or {}).get(name, {}))
            yield fleet
        finally:
            fleet.close()
