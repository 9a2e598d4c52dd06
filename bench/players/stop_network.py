"""A network between client and responder that can be cut in one direction: from client to responder."""

from __future__ import annotations

import os
import random
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from namespaces import changing_network
from responder import Responder, ResponderLine
from responder_drives import KINDS, ResponderDrive

from bench.players.stop_victim import Counters, Victim, victim

NEAR, FAR, PREFIX = "10.249.17.1", "10.249.17.2", 30
NOBODY = "02:00:00:00:00:99"  # no interface has this address: packets to it are lost
LISTEN = (
    "import socket, sys; it = socket.create_server((sys.argv[1], 0));"
    "socket.send_fds(socket.socket(fileno=int(sys.argv[2])), [b'x'], [it.fileno()])"
)


class Network:
    """A second network namespace, connected to this process's namespace by a pair of interfaces."""

    def __init__(self) -> None:
        self.name = f"stops{os.getpid()}"
        self._near = f"mdn{os.getpid() % 10**6}"

    def __enter__(self) -> Network:
        far = f"mdf{os.getpid() % 10**6}"
        _ip("netns", "add", self.name)
        try:
            _ip("link", "add", self._near, "type", "veth", "peer", "name", far, "netns", self.name)
            _ip("addr", "add", f"{NEAR}/{PREFIX}", "dev", self._near)
            _ip("link", "set", self._near, "up")
            _ip("-n", self.name, "addr", "add", f"{FAR}/{PREFIX}", "dev", far)
            _ip("-n", self.name, "link", "set", far, "up")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *failure: object) -> None:
        with suppress(subprocess.CalledProcessError):
            _ip("link", "del", self._near)
        with suppress(subprocess.CalledProcessError):
            _ip("netns", "del", self.name)

    def listen(self) -> socket.socket:
        """Return a socket of this process that listens in the second namespace."""
        ours, theirs = socket.socketpair()
        with ours, theirs:
            words = [
                "ip",
                "netns",
                "exec",
                self.name,
                sys.executable,
                "-c",
                LISTEN,
                FAR,
                str(theirs.fileno()),
            ]
            subprocess.run(words, check=True, pass_fds=[theirs.fileno()])
            _, (fd,), _, _ = socket.recv_fds(ours, 1, 1)
        return socket.socket(fileno=fd)

    def cut(self) -> None:
        """Drop all packets to the responder from now on; its own packets still arrive."""
        _ip("neigh", "replace", FAR, "lladdr", NOBODY, "dev", self._near, "nud", "permanent")

    def mend(self) -> None:
        _ip("neigh", "del", FAR, "dev", self._near)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@contextmanager
def network() -> Iterator[Network | None]:
    """Yield a network, or None if this machine does not allow it."""
    made = None
    with changing_network():
        if shutil.which("ip") and os.geteuid() == 0:
            with suppress(subprocess.CalledProcessError):
                made = Network().__enter__()
        try:
            yield made
        finally:
            if made:
                made.__exit__()


def cut_networks(chance: random.Random, rounds: int, is_long: bool) -> Counters:
    """Cut the network just before a client starts a motor, until the client has reported a failure."""
    counters = Counters()
    with network() as made:
        if made is None:
            print("skipped: a cut network needs root, ip, and namespaces of the network", file=sys.stderr)
            return counters
        for _ in range(rounds):
            for telnet in (False, True):
                kind = chance.choice(list(KINDS))
                line = ResponderLine([ResponderDrive(KINDS[kind], 1)])
                far = Responder([line], listening=[made.listen()], telnet=telnet)
                with victim([[(kind, 1)]], sets=True, far=far) as client:
                    _cut_one(chance, client, line, made, counters, is_long)
    return counters


def _cut_one(
    chance: random.Random,
    client: Victim,
    line: ResponderLine,
    made: Network,
    counters: Counters,
    is_long: bool,
) -> None:
    """Cut the network immediately before the write of a start.

    Two earlier starts show how many reads precede this write. `counters` counts frames that move the motor
    after the client has reported a failed start.
    """
    looks = 0
    for _ in range(2):
        begun = len(line.log)
        client.ask(do="call", drive=0, verb="start")
        client.hear("called")
        looks = next(at for at, each in enumerate(line.log[begun:]) if each.what == "moves")
        client.ask(do="call", drive=0, verb="stop")
        client.hear("called")
    client.hold(looks - 1)
    client.begin(turning=False)
    client.ask(do="call", drive=0, verb="start")
    line.held.wait(10)
    made.cut()
    client.release()
    said = client.hear("called")
    told_ns = said["at"]
    if chance.random() < 0.5:
        client.leave()
        client.hear("left")
    time.sleep(chance.uniform(0.0, 10.0) if is_long else 0.0)
    made.mend()
    time.sleep(3.0 if is_long else 1.5)  # during this time TCP retransmits bytes that were lost
    counters.rounds += 1
    late = [each for each in client.received(line, 1, "moves") if each.at > told_ns]
    counters.moved += len(late)
    port = client.far.ports[0].partition(":")[0]
    counters.stories += [
        f"{port}, told {said['failure']!r}: {(each.at - told_ns) / 1e9:.1f} s later {each}" for each in late
    ]
