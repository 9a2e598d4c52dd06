"""Network namespaces on one bridge, whose connections can be cut; a lock for network changes."""

from __future__ import annotations

import fcntl
import itertools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

NOBODYS_CARD = "02:00:00:00:00:00"
BRIDGES_CARD = "02:00:00:00:02:00"
_BRIDGES = itertools.count()  # makes the names of this process's bridges different


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


class Namespace:
    """A namespace that acts as one machine; `prefix` before a command runs the command in it."""

    def __init__(self, bridge: str, net: str, number: int) -> None:
        self.name = f"{bridge}-{number}"
        self.address = f"{net}.{number + 2}"
        self.card = f"02:00:00:00:01:{number:02x}"
        self._cable = f"{bridge}v{number}"
        self._bridge = bridge
        _ip("netns", "add", self.name)
        peer = ("peer", "name", "eth0", "address", self.card, "netns", self.name)
        _ip("link", "add", self._cable, "type", "veth", *peer)
        _ip("link", "set", self._cable, "up", "master", bridge)
        _ip("-n", self.name, "addr", "add", f"{self.address}/24", "dev", "eth0")
        _ip("-n", self.name, "link", "set", "eth0", "up")
        _ip("-n", self.name, "link", "set", "lo", "up")

    @property
    def prefix(self) -> list[str]:
        return ["ip", "netns", "exec", self.name]

    def cut(self) -> None:
        """Drop all packets in both directions, without an error on either side."""
        _ip("link", "set", self._cable, "nomaster")

    def cut_to(self, others: Iterable[Namespace]) -> None:
        """Drop all packets to these namespaces, but receive packets from them."""
        for other in others:
            self._know(other, NOBODYS_CARD)

    def cut_to_here(self, address: str) -> None:
        """Drop packets to this machine's own address on the bridge."""
        self._send_to(address, NOBODYS_CARD)

    def heal_to_here(self, address: str) -> None:
        self._send_to(address, BRIDGES_CARD)

    def heal(self, others: Iterable[Namespace]) -> None:
        """Undo all cuts between this namespace and `others`."""
        _ip("link", "set", self._cable, "master", self._bridge)
        for other in others:
            self._know(other, other.card)

    def _know(self, other: Namespace, card: str) -> None:
        self._send_to(other.address, card)

    def _send_to(self, address: str, card: str) -> None:
        known = ("lladdr", card, "nud", "permanent", "dev", "eth0")
        _ip("-n", self.name, "neigh", "replace", address, *known)

    def close(self) -> None:
        subprocess.run(["ip", "netns", "del", self.name], check=False, capture_output=True)


class Network:
    """A bridge with the IP address `address`, and the namespaces connected to it."""

    def __init__(self, number: int) -> None:
        nth = next(_BRIDGES)
        self._bridge = f"md{os.getpid() % 100_000}-{nth}"
        net = f"10.{100 + os.getpid() % 50}.{(os.getpid() // 50 + 25 * nth) % 250}"
        self.address = f"{net}.1"
        self.namespaces: list[Namespace] = []
        # The bridge gets its own MAC address. Otherwise it would use the address of one of its ports, and
        # cutting that port would block the others.
        _ip("link", "add", self._bridge, "address", BRIDGES_CARD, "type", "bridge")
        try:
            _ip("addr", "add", f"{self.address}/24", "dev", self._bridge)
            _ip("link", "set", self._bridge, "up")
            for at in range(number):
                self.namespaces.append(Namespace(self._bridge, net, at))
            for one in self.namespaces:
                one.heal(self.others(one))
        except BaseException:
            self.close()
            raise

    def others(self, one: Namespace) -> list[Namespace]:
        return [other for other in self.namespaces if other is not one]

    def heal(self) -> None:
        for one in self.namespaces:
            one.heal(self.others(one))

    def close(self) -> None:
        for one in self.namespaces:
            one.close()
        subprocess.run(["ip", "link", "del", self._bridge], check=False, capture_output=True)


@contextmanager
def network(number: int) -> Iterator[Network]:
    """Create `number` namespaces; if that is impossible, skip the test, or fail it in CI."""
    if reason := why_none():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
    with changing_network():
        made = Network(number)
    try:
        yield made
    finally:
        with changing_network():
            made.close()


def why_none() -> str:
    """Return the reason if this machine allows no network namespaces, else ""."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        return "network namespaces need root and the program ip"
    trial = ["ip", "link", "add", f"mdt{os.getpid() % 100_000}", "type", "bridge"]
    tried = subprocess.run(trial, check=False, capture_output=True, text=True)
    subprocess.run(["ip", "link", "del", trial[3]], check=False, capture_output=True)
    return f"this system makes no network of its own: {tried.stderr.strip()}" if tried.returncode else ""


OWN_NETWORK = Path("/proc/self/ns/net")  # each network namespace has its own inode number
NETWORK = OWN_NETWORK.stat().st_ino if OWN_NETWORK.exists() else 0
LOCK = Path(tempfile.gettempdir()) / f"multidrop-network-{os.getuid()}-{NETWORK}"


@contextmanager
def _locked(how: int) -> Iterator[None]:
    with LOCK.open("w") as file:
        fcntl.flock(file, how)
        yield


@contextmanager
def steady_network() -> Iterator[None]:
    """Within the block, hold a shared lock that keeps other processes from changing the network."""
    with _locked(fcntl.LOCK_SH):
        yield


@contextmanager
def changing_network() -> Iterator[None]:
    """Within the block, hold the lock that lets only this process change the network."""
    with _locked(fcntl.LOCK_EX):
        yield
