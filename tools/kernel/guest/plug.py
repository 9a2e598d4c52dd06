"""Plug adapters into the guest, unplug them, and control their faults."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HOST = "10.0.2.2"  # address of the host, as seen from QEMU's guest
HARDWARE = (HOST, 0)  # address of hardware.py; the agent sets the port
HUB = Path("/sys/devices/platform/vhci_hcd.0")
FREE, USB_2 = "004", "hs"
HIGH_SPEED_ID, FULL_SPEED = 0x10001, 2
PATIENCE_S = 120.0


class Adapter:
    """An adapter that is plugged in: `tty` is its name, such as ttyUSB0."""

    def __init__(self, kind: str, serial: str, *, socket_number: int | None = None, **options: Any) -> None:
        self.serial = serial
        self._wanted = {"plug_in": kind, "serial": serial, **options}
        self.socket_number = free_sockets()[0] if socket_number is None else socket_number
        self.plug_in()

    def plug_in(self, socket_number: int | None = None) -> None:
        """Plug the adapter into the USB socket with this number, or by default into its previous socket."""
        if socket_number is not None:
            self.socket_number = socket_number
        before = set(ttys())
        with socket.create_connection(HARDWARE) as sock:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.sendall(json.dumps(self._wanted).encode() + b"\n")
            assert sock.recv(3) == b"ok\n"
            attached = f"{self.socket_number} {sock.fileno()} {HIGH_SPEED_ID} {FULL_SPEED}"
            (HUB / "attach").write_text(attached, "ascii")
        wait_until(lambda: set(ttys()) - before)
        settle()
        self.tty = (set(ttys()) - before).pop()

    @property
    def path(self) -> str:
        return f"/dev/{self.tty}"

    @property
    def by_id(self) -> str:
        """The link in /dev/serial/by-id."""
        return self._link("by-id")

    @property
    def by_path(self) -> str:
        """The link in /dev/serial/by-path."""
        return self._link("by-path")

    def _link(self, kind: str) -> str:
        links = Path("/dev/serial", kind).iterdir()
        return next(str(link) for link in links if os.path.realpath(link) == self.path)

    def unplug(self) -> None:
        (HUB / "detach").write_text(str(self.socket_number), "ascii")
        wait_until(lambda: self.tty not in ttys() and self.socket_number in free_sockets())

    def do(self, action: str, value: Any = None) -> Any:
        """Let the adapter do something: see the methods `do_...` of tools/kernel/adapters.py."""
        return do(action, value, self.serial)

    @property
    def state(self) -> dict[str, Any]:
        return dict(self.do("state"))


def do(action: str, value: Any = None, serial: str = "") -> Any:
    with socket.create_connection(HARDWARE) as sock:
        sock.sendall(json.dumps({"do": action, "value": value, "serial": serial}).encode() + b"\n")
        return json.loads(sock.makefile(encoding="utf-8").readline())


def ttys() -> list[str]:
    return [path.name for path in Path("/dev").iterdir() if re.match(r"tty(USB|ACM)\d", path.name)]


def _sockets() -> dict[int, str]:
    """Return the state of each USB socket."""
    rows = [line.split() for line in (HUB / "status").read_text("ascii").splitlines()[1:]]
    return {int(number): state for hub, number, state, *_ in rows if hub == USB_2}


def free_sockets() -> list[int]:
    return [number for number, state in _sockets().items() if state == FREE]


def unplug_all() -> None:
    for number, state in _sockets().items():
        if state != FREE:
            (HUB / "detach").write_text(str(number), "ascii")
    wait_until(lambda: len(free_sockets()) == len(_sockets()))
    settle()


def settle() -> None:
    subprocess.run(["udevadm", "settle"], check=True)


def wait_until(is_met: Callable[[], object], patience: float = PATIENCE_S) -> None:
    end = time.monotonic() + patience
    while not is_met():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.1)
