"""A USB device in software, which a guest's vhci_hcd attaches by the USB/IP protocol 1.1.1."""

from __future__ import annotations

import heapq
import socket
import struct
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from time import monotonic
from typing import Any, NamedTuple

SUBMIT, RET_SUBMIT, RET_UNLINK = 1, 3, 4
HEAD = 48  # size of the header of every message, in bytes
EPIPE, EPROTO, ECONNRESET = -32, -71, -104


class Timers:
    """Calls planned for later."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, Callable[..., object], tuple[Any, ...]]] = []
        self._count = 0

    def at(self, when: float, call: Callable[..., object], *arguments: Any) -> None:
        self._count += 1
        heapq.heappush(self._heap, (when, self._count, call, arguments))

    def run(self) -> float | None:
        """Make all calls that are due; return the time in s until the next call, or None."""
        while self._heap and self._heap[0][0] <= monotonic():
            _, _, call, arguments = heapq.heappop(self._heap)
            call(*arguments)
        return max(0.0, self._heap[0][0] - monotonic()) if self._heap else None


def descriptor(*values: int) -> bytes:
    return bytes((len(values) + 1, *values))


def endpoint(address: int, kind: int, size: int, interval: int = 0) -> bytes:
    return descriptor(5, address, kind, size & 255, size >> 8, interval)


def interface(number: int, endpoints: int, *, kind: tuple[int, int, int] = (255, 255, 255)) -> bytes:
    return descriptor(4, number, 0, endpoints, *kind, 2)


class Connection(NamedTuple):
    """The resources of a plugged-in USB device: its connection, serial number and timers."""

    sock: socket.socket  # connection to the guest's vhci_hcd
    serial: str  # the device's serial number; "" if it has none
    timers: Timers


class USBDevice:
    """Answers a guest's transfers; a subclass defines the device."""

    vendor, product, release, name = 0, 0, 0x0100, "device"
    device_class = 0
    bulk_in, bulk_out, interrupt, packet = 0x81, 0x02, 0, 64

    def __init__(self, connection: Connection) -> None:
        self.sock, self.serial, self.timers = connection
        self.ins: deque[tuple[int, int]] = deque()  # transfers of the guest that wait for the device's data
        self.outs: deque[tuple[int, bytes]] = deque()  # transfers that the device has not taken yet
        self.taken: set[int] = set()  # transfers that the device has taken, but not completed yet
        self._interrupts: deque[tuple[int, int]] = deque()
        self._newest = 0  # sequence number of the newest submitted transfer
        self._called_off: set[int] = set()  # transfers that were called off before they came
        self._buffer = b""

    # ---- a subclass implements these ----

    def offered(self) -> None:
        """Called when the guest waits for data: a transfer was added to `ins`."""

    def take(self) -> None:
        """Take from `outs` the data that the guest has sent."""

    def on_control(self, kind: int, request: int, value: int, index: int, size: int, data: bytes) -> bytes:
        """Return the answer to a control request that is not a standard one."""
        raise NotImplementedError

    def interfaces(self) -> tuple[int, bytes]:
        """Return the number of interfaces and their descriptors."""
        ends = [endpoint(self.bulk_in, 2, self.packet), endpoint(self.bulk_out, 2, self.packet)]
        if self.interrupt:
            ends.insert(0, endpoint(self.interrupt, 3, 10, 1))
        return 1, interface(0, len(ends)) + b"".join(ends)

    # ---- transfers ----

    def complete(self, sequence: int, status: int, data: bytes = b"", length: int | None = None) -> None:
        size = len(data) if length is None else length
        self._put(struct.pack(">5Iiiiii8x", RET_SUBMIT, sequence, 0, 0, 0, status, size, 0, 0, 0) + data)

    def _put(self, data: bytes) -> None:
        with suppress(OSError):  # the guest has unplugged the device
            self.sock.sendall(data)

    def feed(self, data: bytes) -> None:
        """Receive bytes from the guest."""
        self._buffer += data
        while len(self._buffer) >= HEAD:
            command, sequence, _, is_in, end = struct.unpack_from(">5I", self._buffer)
            (length,) = struct.unpack_from(">i", self._buffer, 24)
            whole = HEAD + (length if command == SUBMIT and not is_in else 0)
            if len(self._buffer) < whole:
                return
            message, self._buffer = self._buffer[:whole], self._buffer[whole:]
            if command == SUBMIT:
                self._submit(sequence, bool(is_in), end, length, message[40:HEAD], message[HEAD:])
            else:
                self._unlink(sequence, *struct.unpack_from(">I", message, 20))

    def _unlink(self, sequence: int, victim: int) -> None:
        """Call off the transfer `victim`; vhci_hcd may send this request before the transfer itself."""
        if victim > self._newest:
            self._called_off.add(victim)
        status = ECONNRESET if victim in self.taken | self._called_off else 0
        self.taken.discard(victim)
        for queue in (self.ins, self.outs, self._interrupts):
            for transfer in [transfer for transfer in queue if transfer[0] == victim]:
                queue.remove(transfer)  # type: ignore[arg-type]
                status = ECONNRESET
        self._put(struct.pack(">5Ii24x", RET_UNLINK, sequence, 0, 0, 0, status))

    def _submit(self, sequence: int, is_in: bool, end: int, length: int, setup: bytes, data: bytes) -> None:
        self._newest = max(self._newest, sequence)
        if sequence in self._called_off:
            self._called_off.remove(sequence)
        elif end == 0:
            answer = self._control(setup, data)
            if answer is None:
                self.complete(sequence, EPIPE)
            else:
                self.complete(sequence, 0, answer[:length] if is_in else b"", None if is_in else len(data))
        elif is_in and end == self.bulk_in & 15:
            self.ins.append((sequence, length))
            self.offered()
        elif is_in:
            self._interrupts.append((sequence, length))
        else:
            self.outs.append((sequence, data))
            self.take()

    # ---- control requests ----

    def _control(self, setup: bytes, data: bytes) -> bytes | None:
        """Return the answer; None if the device does not know the request."""
        kind, request, value, index, size = struct.unpack("<BBHHH", setup)
        if kind & 0x60:
            return self.on_control(kind, request, value, index, size, data)
        if request == 0:
            return b"\0\0"
        return self._described(value >> 8, value & 255, size) if request == 6 else b""

    def _described(self, kind: int, index: int, size: int) -> bytes | None:
        if kind == 1:
            numbers = struct.pack("<HHH", self.vendor, self.product, self.release)
            serial = 3 if self.serial else 0
            return descriptor(1, 0x00, 0x02, self.device_class, 0, 0, 64, *numbers, 1, 2, serial, 1)[:size]
        if kind == 2:
            count, body = self.interfaces()
            head = descriptor(2, *struct.pack("<H", 9 + len(body)), count, 1, 0, 0x80, 50)
            return (head + body)[:size]
        if kind != 3:
            return None
        if index == 0:
            return b"\x04\x03\x09\x04"
        text = {1: "multidrop", 2: self.name, 3: self.serial}.get(index, "").encode("utf-16le")
        return (bytes((2 + len(text), 3)) + text)[:size]
