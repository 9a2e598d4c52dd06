"""USB serial adapters in software, as the Linux drivers expect them, each with a paced line behind it."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Any

from far_end import FarEnd
from usbip import EPROTO, Connection, USBDevice, endpoint, interface

PARITIES = "NOEMS"
STOP_BITS = "112"
DTR, RTS = 1, 2
ANSWER_S = 0.002  # time from the end of a request to its reply
PIECE = 8  # characters of a reply that reach the adapter together
USB_FRAME_S = 0.001
ERROR_BITS = {"parity": 0x04, "framing": 0x08, "break": 0x10}  # bits of a 16550's line status register


class Adapter(USBDevice):
    """An adapter and its line.

    Every request's settings and RTS are recorded in `log`. `sends_with` is the level of RTS with which the
    adapter's transceiver sends; None: RTS has no effect.
    """

    fifo = 128  # characters that the adapter accepts before the line has sent them

    def __init__(self, connection: Connection, far_end: FarEnd, sends_with: int | None) -> None:
        super().__init__(connection)
        self.far_end = far_end
        self.baudrate, self.format, self.lines = 9600, "8N1", 0
        self.latency = 0.016
        self.log: list[dict[str, Any]] = []
        self.is_stalled = False  # True: the adapter accepts no bytes from the guest
        self.broken = 0  # how many of the next transfers to the guest will fail
        # kinds of damage: the first for the next reply, the second for the one after it
        self.damaged: list[str] = []
        self.rts_missing = 0  # number of transfers at whose start RTS kept the transceiver from sending
        self.rts_lateness: list[float] = []  # s from each request's last bit to the fall of RTS; < 0: cut off
        self.rts_given_up = 0  # how often RTS fell although the adapter had not taken the request
        self._sends_with = sends_with
        self._received: deque[int] = deque()  # characters that the line has sent to the guest
        self._errors = 0  # error bits of the characters in `_received`
        self._free_at = 0.0  # when the line will have sent all characters
        self._is_rts_due = False  # RTS has not fallen since the last request
        self._room_at = 0.0  # when the adapter can take the next transfer
        self._is_flush_due = False

    @property
    def character(self) -> float:
        """Duration of a character in s."""
        bits = 2 + int(self.format[0]) + (self.format[1] != "N") + (self.format[2] == "2")
        return bits / self.baudrate

    @property
    def is_sending(self) -> bool:
        return self._free_at > monotonic()

    def unplugged(self) -> None:
        self.log.append({"what": "unplugged"})

    # ---- from the guest to the line ----

    def take(self) -> None:
        if self.is_stalled or not self.outs or self._room_at > monotonic():
            return
        sequence, data = self.outs.popleft()
        self.taken.add(sequence)
        self._send(data)
        self._room_at = max(monotonic(), self._free_at - self.fifo * self.character)
        self.timers.at(self._room_at, self._taken, sequence, len(data))

    def _taken(self, sequence: int, length: int) -> None:
        self._room_at = 0.0
        if sequence in self.taken:  # if not, the guest has called the transfer off meanwhile
            self.taken.remove(sequence)
            self.complete(sequence, 0, length=length)
        self.take()

    def _send(self, data: bytes) -> None:
        is_missing = self._sends_with is not None and bool(self.lines & RTS) != bool(self._sends_with)
        self.rts_missing += is_missing
        self._is_rts_due = True
        self._free_at = max(monotonic(), self._free_at) + len(data) * self.character
        self.log.append(
            {"what": "sent", "bytes": data.hex(), "baudrate": self.baudrate, "format": self.format}
        )
        self.timers.at(self._free_at, self._arrive, data)

    def _arrive(self, data: bytes) -> None:
        reply = self.far_end.feed(data, self.baudrate, self.format)
        if not reply:
            return
        errors = 0
        if self.damaged:
            kind = self.damaged.pop(0)
            errors = ERROR_BITS.get(kind, 0)
            at = len(reply) // 2
            changed = 0 if kind == "break" else reply[at] ^ 0x10
            reply = reply[:at] + bytes((changed,)) + reply[at + 1 :]
        begin = monotonic() + ANSWER_S
        for at in range(0, len(reply), PIECE):
            piece = reply[at : at + PIECE]
            has_error = at <= len(reply) // 2 < at + PIECE
            when = begin + (at + len(piece)) * self.character
            self.timers.at(when, self._hear, piece, errors if has_error else 0)

    def set(self, baudrate: int = 0, format: str = "", lines: int | None = None) -> None:
        """Change settings and control lines; record when RTS falls after a request."""
        before = self.baudrate, self.format, self.lines
        self.baudrate, self.format = baudrate or self.baudrate, format or self.format
        self.lines = self.lines if lines is None else lines
        is_rts_changed = self._sends_with is not None and (before[2] ^ self.lines) & RTS
        if is_rts_changed and bool(self.lines & RTS) != bool(self._sends_with):
            self._rts_falls()
        if (self.baudrate, self.format, self.lines) != before:
            rts = self.lines >> 1 & 1
            self.log.append({"what": "set", "baudrate": self.baudrate, "format": self.format, "rts": rts})

    def _rts_falls(self) -> None:
        if self.outs:
            self.rts_given_up += 1
        elif self._is_rts_due:
            self.rts_lateness.append(monotonic() - self._free_at)
        self._is_rts_due = False

    def _set_lines(self, mask: int, lines: int) -> None:
        self.set(lines=self.lines & ~mask | lines & mask)

    # ---- from the line to the guest ----

    def _hear(self, piece: bytes, errors: int) -> None:
        self._received.extend(piece)
        self._errors |= errors
        self.offered()

    @property
    def patience(self) -> float:
        """How long the adapter keeps received characters, in s, until it sends an incomplete packet."""
        return USB_FRAME_S

    def offered(self) -> None:
        if len(self._received) >= self.packet:
            self._flush()
        elif self._received and not self._is_flush_due:
            self._is_flush_due = True
            self.timers.at(monotonic() + self.patience, self._flush_late)

    def _flush_late(self) -> None:
        self._is_flush_due = False
        self._flush()

    def _flush(self) -> None:
        while self._received and self.ins:
            sequence, length = self.ins.popleft()
            if self.broken:
                self.broken -= 1
                self.complete(sequence, EPROTO)
            else:
                self.complete(sequence, 0, self.packed(length))

    def packed(self, length: int) -> bytes:
        """Return the received characters as a transfer of at most this length."""
        self._errors = 0
        return bytes(self._received.popleft() for _ in range(min(len(self._received), length)))

    # ---- for scenarios ----

    def do(self, action: str, value: Any) -> Any:
        """Carry out an action of a scenario; return its answer."""
        return getattr(self, f"do_{action}")(value)

    def do_stall(self, is_stalled: bool) -> None:
        self.is_stalled = is_stalled
        self.take()

    def do_break_transfers(self, count: int) -> None:
        self.broken = count

    def do_damage(self, kinds: list[str]) -> None:
        self.damaged = list(kinds)

    def do_state(self, value: None) -> dict[str, Any]:
        return {
            "baudrate": self.baudrate,
            "format": self.format,
            "rts_lateness": self.rts_lateness,
            "rts_given_up": self.rts_given_up,
            "rts_missing": self.rts_missing,
            "waiting": len(self.outs),
            "damaged": self.damaged,
            "log": self.log,
            "requests": [frame.hex() for frame in self.far_end.requests],
        }


class FTDI(Adapter):
    """FT232R: every packet starts with two bytes of status."""

    vendor, product, release, name = 0x0403, 0x6001, 0x0600, "FT232R USB UART"
    STATUS = 0x01

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._is_reporting = False

    @property
    def patience(self) -> float:
        return self.latency

    @property
    def _line_status(self) -> int:
        return 0 if self.is_sending else 0x60

    def _tick(self) -> None:
        """At the end of each latency period without data, send only the status.

        A real chip always does so; this one only if RTS switches its transceiver.
        """
        if self.ins and not self._received:
            sequence, _ = self.ins.popleft()
            self.complete(sequence, 0, bytes((self.STATUS, self._line_status)))
        self.timers.at(monotonic() + self.latency, self._tick)

    def offered(self) -> None:
        if self._sends_with is not None and not self._is_reporting:
            self._is_reporting = True
            self.timers.at(monotonic(), self._tick)
        super().offered()

    def packed(self, length: int) -> bytes:
        out = b""
        while self._received and len(out) + 64 <= length:
            status = bytes((self.STATUS, self._line_status | self._errors))
            out += status + super().packed(62)
        return out

    def on_control(self, kind: int, request: int, value: int, index: int, size: int, data: bytes) -> bytes:
        if request == 1:
            self._set_lines(value >> 8, value)
        elif request == 3:
            divisor, eighths = value & 0x3FFF, (0, 4, 2, 1, 3, 5, 6, 7)[value >> 14 | (index >> 8 & 1) << 2]
            fixed = {0: 3000000, 1: 2000000}.get(divisor, 0) if not eighths else 0
            self.set(baudrate=fixed or round(24000000 / (divisor * 8 + eighths)))
        elif request == 4:
            parity, stop = PARITIES[value >> 8 & 7], STOP_BITS[value >> 11 & 3]
            self.set(format=f"{value & 255}{parity}{stop}")
        elif request == 5:
            return bytes((self.STATUS, self._line_status))
        elif request == 9:
            self.latency = max(1, value & 255) / 1000
        elif request == 10:
            return bytes((round(self.latency * 1000),))
        elif request == 0 and value == 1:
            self._received.clear()
        elif kind & 0x80:
            return b"\xff" * size
        return b""


class CP210x(Adapter):
    """CP2102."""

    vendor, product, name = 0x10C4, 0xEA60, "CP2102 USB to UART Bridge Controller"
    bulk_in, bulk_out = 0x82, 0x01
    fifo = 576

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._flow, self._control_word = bytes(16), 0x0800

    def on_control(self, kind: int, request: int, value: int, index: int, size: int, data: bytes) -> bytes:
        answers: dict[int, Callable[[], bytes]] = {
            0xFF: lambda: b"\x02" if value == 0x370B else bytes(size),
            0x1D: lambda: struct.pack("<I", self.baudrate),
            0x04: lambda: struct.pack("<H", self._control_word),
            0x08: lambda: bytes((0x30 | self.lines,)),
            0x14: lambda: self._flow,
            0x10: lambda: struct.pack("<IIIIBBB", 0, 0, len(self._received), self._unsent, 0, 0, 0),
        }
        if kind & 0x80:
            return answers.get(request, lambda: bytes(size))()
        if request == 0x1E:
            self.set(baudrate=int.from_bytes(data[:4], "little"))
        elif request == 0x03:
            self._control_word = value
            self.set(format=f"{value >> 8 & 15}{PARITIES[value >> 4 & 15]}{STOP_BITS[value & 3]}")
        elif request == 0x07:
            self._set_lines(value >> 8, value)
        elif request == 0x13:
            self._flow = data
            self._set_lines(RTS, RTS if data[4] & 0xC0 == 0x40 else 0)
        return b""

    @property
    def _unsent(self) -> int:
        return max(0, round((self._free_at - monotonic()) / self.character))


class CH341(Adapter):
    """CH340."""

    vendor, product, release, name = 0x1A86, 0x7523, 0x0264, "USB Serial"
    bulk_in, bulk_out, packet, interrupt = 0x82, 0x02, 32, 0x81

    def on_control(self, kind: int, request: int, value: int, index: int, size: int, data: bytes) -> bytes:
        if request == 0x5F:
            return b"\x31\x00"
        if request == 0x95:
            return b"\x9f\xee" if value & 255 == 0x06 else bytes(size)
        if request == 0xA4:
            up = ~value
            self.set(lines=(DTR if up & 0x20 else 0) | (RTS if up & 0x40 else 0))
        if (request == 0x9A and value == 0x1312) or (request == 0xA1 and index):
            clock = 48000000 >> (12 - 3 * (index & 3) - (index >> 2 & 1))
            self.set(baudrate=round(clock / (256 - (index >> 8))))
        control = {0x9A: index & 255 if value == 0x2518 else 0, 0xA1: value >> 8}.get(request, 0)
        if control:
            parity = "N" if not control & 8 else "E" if control & 16 else "O"
            self.set(format=f"{5 + (control & 3)}{parity}{2 if control & 4 else 1}")
        return b""


class LineCoding(Adapter):
    """An adapter with the line coding of USB's communication class."""

    interrupt = 0x81

    def on_control(self, kind: int, request: int, value: int, index: int, size: int, data: bytes) -> bytes:
        if kind == 0x21 and request == 0x20:
            baudrate, stop, parity, bits = struct.unpack("<IBBB", data[:7])
            # the driver of the PL2303 sends a divisor of 12 MHz * 32 instead of a baud rate
            if baudrate & 1 << 31:
                shift = baudrate >> 12 & 14 | baudrate >> 16 & 1
                baudrate = round((384000000 >> shift) / (baudrate & 0x7FF))
            self.set(baudrate=baudrate, format=f"{bits}{PARITIES[parity]}{STOP_BITS[stop]}")
        elif kind == 0xA1 and request == 0x21:
            bits, parity, stop = self.format
            coded = STOP_BITS.rindex(stop) if stop == "2" else 0, PARITIES.index(parity), int(bits)
            return struct.pack("<IBBB", self.baudrate, *coded)
        elif kind == 0x21 and request == 0x22:
            self.set(lines=value & 3)
        return bytes(size) if kind & 0x80 else b""


class PL2303(LineCoding):
    """PL2303 HX."""

    vendor, product, release, name = 0x067B, 0x2303, 0x0300, "USB-Serial Controller D"
    bulk_in, bulk_out = 0x83, 0x02
    fifo = 256


class ACM(LineCoding):
    """CH9102, as an adapter of the communication class."""

    vendor, product, name, device_class = 0x1A86, 0x55D3, "USB Single Serial", 2
    bulk_in, bulk_out = 0x83, 0x02

    def interfaces(self) -> tuple[int, bytes]:
        functional = bytes((5, 0x24, 0, 0x10, 1, 5, 0x24, 1, 0, 1, 4, 0x24, 2, 2, 5, 0x24, 6, 0, 1))
        control = interface(0, 1, kind=(2, 2, 1)) + functional + endpoint(self.interrupt, 3, 10, 1)
        ends = endpoint(self.bulk_in, 2, 64) + endpoint(self.bulk_out, 2, 64)
        return 2, control + interface(1, 2, kind=(10, 0, 0)) + ends


KINDS: dict[str, type[Adapter]] = {
    "ftdi": FTDI,
    "cp210x": CP210x,
    "ch341": CH341,
    "pl2303": PL2303,
    "acm": ACM,
}
