"""The guest's hardware, as a process: it accepts adapters that are plugged in, and carries out actions.

    python hardware.py FOLDER

FOLDER is the run's folder with QEMU's sockets. The first line of the output is the port to connect to. The
first line of each connection is JSON:

- {"plug_in": "ftdi", "serial": "A1", ...} plugs an adapter in. After the answer "ok\\n" the guest gives this
  connection to vhci_hcd.
- {"do": "stall", "serial": "A1", "value": true} carries out an action of an adapter, or of this process if
  there is no serial number. The answer is one JSON line.
"""

from __future__ import annotations

import json
import selectors
import socket
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any

from adapters import KINDS, Adapter
from far_end import FarEnd, SimulatedEnd
from usbip import Connection, Timers


class Hardware:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._timers = Timers()
        self._adapters: dict[str, Adapter] = {}  # by serial number, also after they were unplugged
        self._far_ends: dict[str, FarEnd] = {}
        self._connected: dict[str, socket.socket] = {}  # open connections to QEMU, by the name of QEMU's port
        self._selector = selectors.DefaultSelector()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)

    @property
    def port(self) -> int:
        return int(self._listener.getsockname()[1])

    def run(self) -> None:
        while True:
            for key, _ in self._selector.select(self._timers.run()):
                key.data()

    def _accept(self) -> None:
        sock, _ = self._listener.accept()
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        wanted = json.loads(sock.makefile("rb", 0).readline() or b"{}")
        if "plug_in" in wanted:
            self._plug_in(sock, wanted)
            return
        with sock:
            device = self._adapters.get(wanted.get("serial", ""))
            value = wanted.get("value")
            answer = device.do(wanted["do"], value) if device else getattr(self, f"do_{wanted['do']}")(value)
            sock.sendall(json.dumps(answer).encode() + b"\n")

    # ---- adapters ----

    def _far_end(self, wanted: dict[str, Any]) -> FarEnd:
        """Return the drives of a line; an adapter that is plugged in again finds the same drives."""
        line = wanted.get("line") or wanted["serial"]
        if line not in self._far_ends:
            addresses = wanted.get("addresses", [1, 2, 3, 4])
            if family := wanted.get("family"):
                self._far_ends[line] = SimulatedEnd(addresses, family, encoded=wanted.get("encoded", False))
            else:
                self._far_ends[line] = FarEnd(addresses, wanted.get("settings"))
        return self._far_ends[line]

    def _plug_in(self, sock: socket.socket, wanted: dict[str, Any]) -> None:
        serial = "" if wanted.get("is_anonymous") else wanted["serial"]
        kind = KINDS[wanted["plug_in"]]
        connection = Connection(sock, serial, self._timers)
        adapter = kind(connection, self._far_end(wanted), wanted.get("sends_with"))
        self._adapters[wanted["serial"]] = adapter
        sock.sendall(b"ok\n")
        self._selector.register(sock, selectors.EVENT_READ, partial(self._receive, adapter))

    def _receive(self, adapter: Adapter) -> None:
        data = b""
        with suppress(OSError):
            data = adapter.sock.recv(65536)
        if data:
            adapter.feed(data)
            return
        self._selector.unregister(adapter.sock)
        adapter.sock.close()
        adapter.unplugged()

    # ---- QEMU's own hardware ----

    def do_connect(self, wanted: dict[str, Any]) -> None:
        """Connect drives to QEMU's port "uart" or "usb"; connecting to "usb" also plugs its adapter in."""
        name = wanted["serial"]
        if name in self._connected:
            self._disconnect(self._connected[name])
        sock = self._connected[name] = socket.socket(socket.AF_UNIX)
        sock.connect(str(self._folder / name))
        self._far_ends.pop(name, None)
        pass_on = partial(self._pass_on, sock, self._far_end(wanted))
        self._selector.register(sock, selectors.EVENT_READ, pass_on)

    def _disconnect(self, sock: socket.socket) -> None:
        if sock.fileno() >= 0:
            self._selector.unregister(sock)
            sock.close()

    def _pass_on(self, sock: socket.socket, far_end: FarEnd) -> None:
        data = sock.recv(4096)
        if not data:
            self._disconnect(sock)
        elif reply := far_end.feed(data, 0, ""):
            sock.sendall(reply)

    def do_requests(self, name: str) -> list[str]:
        """Return the requests that the devices of a line have received."""
        return [frame.hex() for frame in self._far_ends[name].requests]

    def do_wake(self, after: float) -> None:
        """Wake the suspended guest `after` s from now."""
        self._timers.at(monotonic() + after, self._wake)

    def _wake(self) -> None:
        with socket.socket(socket.AF_UNIX) as sock:
            sock.connect(str(self._folder / "qmp"))
            lines = sock.makefile("rw", encoding="utf-8")
            lines.readline()  # QEMU's greeting
            for command in ("qmp_capabilities", "system_wakeup"):
                print(json.dumps({"execute": command}), file=lines, flush=True)
                lines.readline()

    def do_registers(self, name: None) -> list[str]:
        """Return the UART registers that the guest has read and written, and the speeds that it has set."""
        return (self._folder / "registers").read_text("utf-8").splitlines()


if __name__ == "__main__":
    hardware = Hardware(Path(sys.argv[1]))
    print(hardware.port, flush=True)
    hardware.run()
