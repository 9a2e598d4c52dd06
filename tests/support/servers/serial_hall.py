"""Serial servers for many lines; they record which master sends when. Each connection counts as a master.

A request on an old connection after the first request on a newer connection is an overlap. Old connections
stay open so that overlaps are detected.
"""

from __future__ import annotations

import selectors
import socket
import struct
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from checksums import rtu

REQUEST = 8  # number of bytes of a Modbus RTU read request
MAKE = {0x02BC: 1, 0x02BE: 1}  # registers that identify an INNOVERT IBD: baud rate (1 means 9600) and address


@dataclass
class LineSeen:
    """Requests seen on a line, and its masters in the order of their first request."""

    name: str
    port: int
    masters: list[int] = field(default_factory=list)
    last_s: float = 0.0
    longest_s: float = 0.0  # longest gap without requests since `reset`, in s
    requests: int = 0
    overlaps: int = 0

    def note(self, connection: int, now: float) -> None:
        if connection not in self.masters:
            self.masters.append(connection)
        elif connection != self.masters[-1]:
            self.overlaps += 1
        if self.last_s:
            self.longest_s = max(self.longest_s, now - self.last_s)
        self.last_s = now
        self.requests += 1


class SerialHall:
    """Listens on a port per line; replies to Modbus RTU reads with zeros, and confirms each write.

    Zeros mean that all motors are at rest; only the two registers that identify the make are not 0. Lines
    named in `refusing` reject writes.
    """

    def __init__(self, number: int, host: str = "127.0.0.1", names: Sequence[str] = ()) -> None:
        self._selector = selectors.DefaultSelector()
        self.lines: dict[str, LineSeen] = {}
        self._buffers: dict[socket.socket, tuple[LineSeen, int, bytearray]] = {}
        self._listeners: list[socket.socket] = []
        self._count = 0
        self._lock = threading.Lock()
        self._is_over = False
        self.host = host
        self.refusing: set[str] = set()
        for at in range(number):
            listener = socket.create_server((host, 0))
            listener.setblocking(False)
            line = LineSeen(names[at] if names else f"line-{at}", listener.getsockname()[1])
            self.lines[line.name] = line
            self._selector.register(listener, selectors.EVENT_READ, line)
            self._listeners.append(listener)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def plant(self, every: str = "100 ms") -> str:
        """Return the text of a plant file that polls one drive on each line."""
        return "\n".join(
            f'[[line]]\nname = "{line.name}"\nport = "socket://{self.host}:{line.port}"\n'
            f'[[line.drive]]\nname = "drive-{line.name}"\nmodel = "innovert-ibd"\naddress = 1\n'
            f'poll = ["output_current"]\nevery = "{every}"\n'
            for line in self.lines.values()
        )

    def reset(self) -> None:
        """Restart the measurement of the longest gaps."""
        with self._lock:
            for line in self.lines.values():
                line.longest_s = 0.0

    def overlaps(self) -> int:
        with self._lock:
            return sum(line.overlaps for line in self.lines.values())

    def requests(self) -> int:
        with self._lock:
            return sum(line.requests for line in self.lines.values())

    def gaps(self) -> dict[str, float]:
        """Return each line's longest gap (s) without requests, including the gap up to now."""
        now = time.monotonic()
        with self._lock:
            return {line.name: max(line.longest_s, now - line.last_s) for line in self.lines.values()}

    def are_polled(self, within_s: float) -> bool:
        now = time.monotonic()
        with self._lock:
            return all(now - line.last_s < within_s for line in self.lines.values())

    def _serve(self) -> None:
        while not self._is_over:
            for key, _ in self._selector.select(0.1):
                one = key.fileobj
                assert isinstance(one, socket.socket)
                if one in self._buffers:
                    self._read(one)
                else:
                    self._accept(one, key.data)

    def _accept(self, listener: socket.socket, line: LineSeen) -> None:
        client, _ = listener.accept()
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._count += 1
        self._buffers[client] = (line, self._count, bytearray())
        self._selector.register(client, selectors.EVENT_READ)

    def _read(self, client: socket.socket) -> None:
        line, number, buffer = self._buffers[client]
        try:
            data = client.recv(4096)
        except OSError:
            data = b""
        if not data:
            self._selector.unregister(client)
            del self._buffers[client]
            client.close()
            return
        now = time.monotonic()
        buffer += data
        while len(buffer) >= REQUEST:
            request = bytes(buffer[:REQUEST])
            if rtu(request[:-2]) != request:
                del buffer[0]
                continue
            del buffer[:REQUEST]
            with self._lock:
                line.note(number, now)
            _answer(client, request, takes_writes=line.name not in self.refusing)

    def close(self) -> None:
        self._is_over = True
        self._thread.join()
        for one in (*self._listeners, *self._buffers):
            one.close()
        self._selector.close()


def _answer(client: socket.socket, request: bytes, *, takes_writes: bool) -> None:
    address, function, first, count = struct.unpack(">BBHH", request[:6])
    if function in (3, 4) and count <= 125:
        words = (MAKE.get(register, 0) for register in range(first, first + count))
        body = bytes([address, function, 2 * count]) + struct.pack(f">{count}H", *words)
    elif function == 6 and takes_writes:
        body = request[:-2]
    else:
        body = bytes([address, function | 0x80, 1])
    try:
        client.sendall(rtu(body))
    except OSError:
        return  # the client has closed the connection
