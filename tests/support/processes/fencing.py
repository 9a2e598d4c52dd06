"""Suspend a master at random moments, take over its lines, and count its late requests at the far end.

The test grants renewals like a fleet. It takes over once the last renewal is older than lease plus guard, by
its own clock. Every later request is stale: by then another master would use the line.
"""

from __future__ import annotations

import os
import random
import select
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from checksums import rtu

CLIENT = Path(__file__).with_name("fenced_client.py")
REQUEST = 8  # number of bytes of a request
REPLY = rtu("01 03 02 00 07")
IDLE_S = 0.005  # s after which everything sent on this machine has arrived
WATCHED_S = 0.08  # how long lines are watched after the suspended master continues, in s
PATIENCE_S = 60.0


def now_s() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class FarEnd:
    """Serial servers with one drive each; they reply immediately and count requests."""

    def __init__(self, lines: int) -> None:
        self.requests = 0
        self._idle = 0  # number of checks in a row without new requests
        self._selector = selectors.DefaultSelector()
        self._servers = [socket.create_server(("127.0.0.1", 0)) for _ in range(lines)]
        self.ports = [f"socket://127.0.0.1:{server.getsockname()[1]}" for server in self._servers]
        for server in self._servers:
            self._selector.register(server, selectors.EVENT_READ, self._accept)
        self._is_over = False
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while not self._is_over:
            ready = self._selector.select(IDLE_S)
            for key, _ in ready:
                key.data(key.fileobj)
            self._idle += not ready

    def _accept(self, server: socket.socket) -> None:
        self._selector.register(server.accept()[0], selectors.EVENT_READ, self._answer)

    def _answer(self, connection: socket.socket) -> None:
        received = b""
        with suppress(ConnectionError):
            received = connection.recv(4096)
            if received:
                self.requests += -(-len(received) // REQUEST)
                connection.send(REPLY)
        if not received:
            self._selector.unregister(connection)
            connection.close()

    def settle(self, seconds: float) -> None:
        """Wait until requests stop arriving, at most `seconds`."""
        before, end = self._idle, now_s() + seconds
        while self._idle < before + 2 and now_s() < end:
            time.sleep(0.001)

    def close(self) -> None:
        self._is_over = True
        self._thread.join()
        for key in [*self._selector.get_map().values()]:
            key.fileobj.close()  # type: ignore[union-attr]
        self._selector.close()


@dataclass
class Round:
    """Result of one suspension: stale requests, and whether the kernel killed the former master."""

    stale: int
    is_killed: bool


class Fence:
    """Processes that poll several lines, one after another; each may send `beyond` s after its lease."""

    def __init__(
        self, lines: int, lease: float, guard: float, *, timer: float = 0.0, beyond: float = 0.0
    ) -> None:
        self.far = FarEnd(lines)
        self._lease, self._guard, self._beyond = lease, guard, beyond
        self.early = 0  # masters that died before the test suspended them
        self._timer = timer or guard  # s; the kernel's timer fires after half of this time
        self._ours, self._theirs = socket.socketpair()
        self._theirs.set_inheritable(True)
        self._client = subprocess.Popen(
            [sys.executable, str(CLIENT)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            pass_fds=[self._theirs.fileno()],
        )

    def close(self) -> None:
        assert self._client.stdin
        assert self._client.stdout
        self._client.stdin.close()
        self._client.wait(PATIENCE_S)
        self._client.stdout.close()
        self._ours.close()
        self._theirs.close()
        self.far.close()

    @contextmanager
    def _master(self) -> Iterator[int]:
        """Start a process that polls, yield its id, and kill it at the end."""
        assert self._client.stdin
        assert self._client.stdout
        times = (self._lease, self._guard, self._timer, self._beyond)
        words = [self._theirs.fileno(), *times, *self.far.ports]
        self._client.stdin.write(" ".join(map(str, words)) + "\n")
        self._client.stdin.flush()
        pid = int(self._client.stdout.readline())
        watched = os.pidfd_open(pid)
        try:
            yield watched
        finally:
            _signal(watched, signal.SIGKILL)
            _await_death(watched, PATIENCE_S)
            os.close(watched)
            while select.select([self._ours], [], [], 0)[0]:
                self._ours.recv(4096)

    def _grant(self, seconds: float) -> bool:
        """Wait up to `seconds` for a renewal request and grant it; return False if none arrives."""
        if not select.select([self._ours], [], [], max(seconds, 0))[0]:
            return False
        self._ours.recv(4096)
        self._ours.send(b"!")
        return True

    def stop_once(self, chance: random.Random) -> Round:
        """Suspend a polling master at a random moment, take over, and let it continue; return the result."""
        while True:
            with self._master() as master:
                if self._is_polling(master):
                    return self._stop(master, chance)
                self.early += 1

    def _is_polling(self, master: int) -> bool:
        """Wait until the process `master` polls its lines steadily; return False if it died."""
        asked, granted, end = self.far.requests, 0, now_s() + PATIENCE_S
        while self.far.requests < asked + 20 * len(self.far.ports):
            granted += self._grant(0.01)
            if _await_death(master, 0):
                return False
            if now_s() > end:
                _signal(master, signal.SIGUSR1)  # the master prints the stack of each of its threads
                time.sleep(1.0)
                requests = self.far.requests - asked
                raise AssertionError(
                    f"the master polls no lines yet: {granted} renewals, {requests} requests"
                )
        return True

    def _stop(self, master: int, chance: random.Random) -> Round:
        stop_s = now_s() + chance.uniform(0, self._lease)
        seen_s = now_s()
        while (left := stop_s - now_s()) > 0:
            if self._grant(left):
                seen_s = now_s()
        _signal(master, signal.SIGSTOP)
        while (left := seen_s + self._lease + self._guard - now_s()) > 0:
            if self._grant(left):  # grants a renewal that the master requested before the suspension
                seen_s = now_s()
        # From here on another master takes over: grant no renewals.
        self.far.settle(1.0)
        before = self.far.requests
        time.sleep(chance.uniform(0, 0.02))
        _signal(master, signal.SIGCONT)
        time.sleep(WATCHED_S)
        self.far.settle(0.1)
        return Round(self.far.requests - before, _await_death(master, 0))


def _signal(master: int, number: int) -> None:
    with suppress(ProcessLookupError):
        signal.pidfd_send_signal(master, number)


def _await_death(master: int, seconds: float) -> bool:
    return bool(select.select([master], [], [], seconds)[0])
