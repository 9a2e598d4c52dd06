"""Pair sniffed requests with their replies, and decode captures to columns.

There is a row for each register that was read or written, and for each failed read.

Rows are like those of a poll. `time` is the request's time stamp; the drive sampled the value between the
time stamps of request and reply. A capture has only one clock, so `monotonic_ns` equals `time`.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from math import isfinite
from typing import Any

from multidrop.capture.pcapng import Capture
from multidrop.core import (
    Columns,
    Decoded,
    Decoder,
    Field,
    FrameSpan,
    Framing,
    Kind,
    Message,
    Names,
    NumberFormat,
    RowLayout,
    Side,
    Status,
    Stream,
    raw_value,
)
from multidrop.drive.family import Drive
from multidrop.drive.number_format import bits_in
from multidrop.drive.register import Carrier, Register, row_field
from multidrop.plant.model import Plant, PlantLine
from multidrop.polling.batch import Batch
from multidrop.printable import format_time

# ---- pairs of request and reply; bytes outside of frames are junk ----

_MOST_JUNK = 4096  # largest number of bytes in one Junk
_COUNTED = ("exchanges", "broadcasts", "unanswered", "strays", "unknown_bytes")


def _is_broadcast(framing: Framing, request: Message) -> bool:
    """Return True for a request to address 0, except on Modbus TCP, where 0 is an ordinary unit id."""
    return request.address == 0 and framing is not Framing.TCP


@dataclass(frozen=True)
class SniffedExchange:
    """A request and its reply; either is None if it was not sniffed or never sent.

    `is_sure` is False if the frame taken for the request may be a reply: replies to functions 05, 06 and 08
    are copies of their requests.
    """

    framing: Framing
    request: Message | None
    reply: Message | None
    time_ns: int
    reply_time_ns: int
    is_sure: bool
    raw: tuple[tuple[Side, bytes, int], ...]  # for each frame: sender, bytes, time in ns

    @property
    def is_broadcast(self) -> bool:
        return self.request is not None and _is_broadcast(self.framing, self.request)


@dataclass(frozen=True)
class Junk:
    """Bytes that belong to no frame."""

    time_ns: int
    raw: bytes


Sniffed = SniffedExchange | Junk


class Pairing:
    """Pairs the requests and replies of one line, and counts them."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(_COUNTED, 0)
        self._asked: FrameSpan | None = None
        self._junk: list[FrameSpan] = []

    def pair(self, spans: Iterable[FrameSpan]) -> Iterator[Sniffed]:
        """Yield the exchanges and the junk in these frames.

        A request stays pending until its reply or another request follows.
        """
        for span in spans:
            if span.kind is Kind.JUNK:
                yield from self._add_junk(span)
                continue
            if span.kind is Kind.REPLY and self._asked:
                asked, self._asked = self._asked, None
                self._counts["exchanges"] += 1
                yield _exchange(asked, span)
                yield from self._flush_junk()
                continue
            yield from self.flush()
            if span.kind in (Kind.REPLY, Kind.STRAY):
                self._counts["strays"] += 1
                yield _exchange(None, span)
            elif _is_broadcast(span.framing, span.message):
                self._counts["broadcasts"] += 1
                yield _exchange(span, None)
            else:
                self._asked = span

    def flush(self) -> Iterator[Sniffed]:
        """Yield the pending request as unanswered, then the pending junk."""
        if self._asked:
            asked, self._asked = self._asked, None
            self._counts["unanswered"] += 1
            yield _exchange(asked, None)
        yield from self._flush_junk()

    def counts(self) -> dict[str, int]:
        return dict(self._counts)

    def _add_junk(self, span: FrameSpan) -> Iterator[Sniffed]:
        self._counts["unknown_bytes"] += len(span.raw)
        self._junk.append(span)
        if sum(len(span.raw) for span in self._junk) >= _MOST_JUNK:
            yield from self._flush_junk()

    def _flush_junk(self) -> Iterator[Junk]:
        if self._junk:
            junk, self._junk = self._junk, []
            yield Junk(junk[0].time_ns, b"".join(span.raw for span in junk))


def _exchange(asked: FrameSpan | None, answer: FrameSpan | None) -> SniffedExchange:
    first = asked or answer
    assert first is not None
    frames = [(Side.ASKING, asked.raw, asked.time_ns)] if asked else []
    frames += [(Side.ANSWERING, answer.raw, answer.time_ns)] if answer else []
    return SniffedExchange(
        first.framing,
        asked.message if asked else None,
        answer.message if answer else None,
        first.time_ns,
        answer.time_ns if answer else 0,
        asked is None or asked.kind is Kind.REQUEST,
        tuple(frames),
    )


# ---- rows ----

ROWS = 1 << 16  # limit of rows per batch
_MOST_NAMES = 60_000  # limit of register names per batch, because a name's code has 16 bits


class Decoding:
    """Decodes a capture to batches. All rows of a batch are from one line."""

    def __init__(self, capture: Capture, known: Plant | None = None) -> None:
        self._capture = capture
        self._plant = known
        self._lines: list[_LineDecoding] = []

    def __iter__(self) -> Iterator[Batch]:
        lines, names = self._lines, self._capture.lines
        for _ in self._capture:
            lines += [_LineDecoding(line_of(self._plant, name)) for name in names[len(lines) :]]
            for line, stream in zip(lines, self._capture.streams, strict=True):
                yield from line.decode(stream)
        for line in lines:
            yield from line.rest()

    def counts(self) -> Counter[str]:
        """Return the numbers of decoded exchanges, frames, unknown bytes and so on, of all lines together."""
        return sum((Counter(line.decoder.counts()) for line in self._lines), Counter())


class _LineDecoding:
    """The decoder of one line's bytes, and the rows of its next batch."""

    def __init__(self, line: PlantLine | None) -> None:
        self._lookup = RegisterLookup(line)
        self.decoder = Decoder()
        self._begin()

    def _begin(self) -> None:
        self._columns = Columns(ROWS)
        self._drives = Names()
        self._registers = Names()

    def decode(self, stream: Stream) -> Iterator[Batch]:
        while (done := self.decoder.decode(stream, self._columns)) is not Decoded.ALL:
            if done is Decoded.UNKNOWN and self._learn():
                continue
            yield Batch(self._columns, self._drives, self._registers)
            self._columns = Columns(ROWS)
            if done is Decoded.UNKNOWN:  # the decoder has no room for another request
                self.decoder.forget()
                self._begin()

    def rest(self) -> Iterator[Batch]:
        if len(self._columns):
            yield Batch(self._columns, self._drives, self._registers)

    def _learn(self) -> bool:
        framing, request = self.decoder.asked
        if len(self._registers) > _MOST_NAMES:
            return False
        target = self._lookup.find(framing, request)
        is_broadcast = request.address == 0 and framing is not Framing.TCP  # a broadcast has no reply
        block = None if is_broadcast else self._layout(target)
        return self.decoder.know(block)

    def _layout(self, target: RequestTarget) -> RowLayout:
        drive = self._drives.number(target.drive)
        fields = []
        for place in target.places:
            code = self._registers.number(place.name)
            if place.register is None:
                fields.append(Field(place.at, place.number_format, code, 1, 1))
            else:
                fields.append(row_field(place.register, place.at, code))
        return RowLayout(drive, fields)


_TABLES = {
    0x01: "coil",
    0x02: "discrete_input",
    0x03: "holding_register",
    0x04: "input_register",
    0x05: "coil",
    0x06: "holding_register",
    0x08: "loopback",
    0x0F: "coil",
    0x10: "holding_register",
}
_BITS = (0x01, 0x02, 0x05, 0x0F)
# limit of values per reply, even if the request asks for more
_MOST = {NumberFormat.BIT: 2000, NumberFormat.U16: 125}
# Function code of a captured request, and the write codes of the registers to which it can belong. A register
# that is declared for writes of one value may also be written as part of a block.
_WRITES = {
    0x05: (0x05,),
    0x06: (0x06,),
    0x0F: (0x05, 0x0F),
    0x10: (0x06, 0x10),
}
_DELIXI_WRITES = {0x02: (0x02,), 0x04: (0x04,), 0x05: (0x05, 0x06), 0x06: (0x05, 0x06)}


@dataclass(frozen=True)
class RegisterPlace:
    """A register (None if unknown) and its offset in the data, in words, or in bits for coils."""

    name: str
    at: int
    number_format: NumberFormat
    register: Register[Any] | None = None


@dataclass(frozen=True)
class RequestTarget:
    """The drive that a request addresses, and the registers that the request reads or writes."""

    drive: str
    is_write: bool
    places: tuple[RegisterPlace, ...]


def line_of(plant: Plant | None, name: str) -> PlantLine | None:
    """Return the plant's line with this name. The only line of a plant is returned for any name."""
    lines = plant.lines if plant else ()
    named = [line for line in lines if line.name == name]
    return named[0] if named else lines[0] if len(lines) == 1 else None


class RegisterLookup:
    """Finds the registers that a request on one line reads or writes."""

    def __init__(self, line: PlantLine | None) -> None:
        drives = [polled.drive for polled in line.drives] if line else []
        self._drives = {(drive.address, drive.framing): drive for drive in drives}

    def find(self, framing: Framing, request: Message) -> RequestTarget:
        drive = self._drives.get((request.address, framing))
        name = drive.name if drive else f"address {request.address}"
        writes = _DELIXI_WRITES if framing is Framing.DELIXI else _WRITES
        is_write = request.function in writes
        functions = writes.get(request.function, (request.function,))
        known = _known(drive, request, functions, is_write) if drive else ()
        return RequestTarget(name, is_write, known or _raw(framing, request))


def _known(
    drive: Drive, request: Message, functions: tuple[int, ...], is_write: bool
) -> tuple[RegisterPlace, ...]:
    found = [
        RegisterPlace(register.name, at, register.number_format, register)
        for register in drive.registers.values()
        if (register.table.write if is_write else register.table.read) in functions
        and (is_write or register.readable)
        and (at := _offset(register, request)) is not None
    ]
    return tuple(sorted(found, key=lambda place: place.at))


def _offset(register: Register[Any], request: Message) -> int | None:
    """Return the register's offset in the request's data, or None unless the data have the whole register."""
    if register.table.carrier is Carrier.NUMBER:
        return 0
    end, reach = request.start + max(request.count, 1), register.reach
    for start in (reach.start, register.ram_address):
        if start is not None and request.start <= start and start + len(reach) <= end:
            return start - request.start + register.address - reach.start
    return None


def _raw(framing: Framing, request: Message) -> tuple[RegisterPlace, ...]:
    if framing is Framing.DELIXI:
        return (RegisterPlace(f"k{request.function}_{request.start:04X}", 0, NumberFormat.U32),)
    table = _TABLES[request.function]
    number_format = NumberFormat.BIT if request.function in _BITS else NumberFormat.U16
    count = min(max(request.count, 1), _MOST[number_format])
    return tuple(RegisterPlace(f"{table}_{request.start + at}", at, number_format) for at in range(count))


_MOST_SHOWN = 16  # largest number of raw registers in a line of text
_MOST_BYTES = 32


class ExchangeFormatter:
    """Formats the exchanges of one line, in engineering units if the plant is known."""

    def __init__(self, lookup: RegisterLookup) -> None:
        self._lookup = lookup

    def text(self, sniffed: Sniffed) -> str:
        """Return the exchange as one line of text, without the name of the serial line."""
        clock = _clock(sniffed.time_ns)
        if isinstance(sniffed, Junk):
            return f"{clock}  unknown: {_hex(sniffed.raw)}"
        request = sniffed.request
        if request is None:
            reply = sniffed.reply
            assert reply is not None
            return (
                f"{clock}  address {reply.address}  function {reply.function:02X}: "
                f"reply without its request: {_hex(sniffed.raw[0][1])}"
            )
        target = self._lookup.find(sniffed.framing, request)
        drive = "all drives" if sniffed.is_broadcast else target.drive
        verb = "writes" if target.is_write else "reads"
        doubt = "" if sniffed.is_sure else " (or its confirmation)"
        return f"{clock}  {drive}  {verb}{doubt} {self._result(sniffed, request, target)}"

    def _result(self, exchange: SniffedExchange, request: Message, target: RequestTarget) -> str:
        places = target.places[:_MOST_SHOWN]
        names = ", ".join(place.name for place in places)
        if exchange.reply is not None and exchange.reply.exception:
            return f"{names}: refused, code {exchange.reply.exception:02X}H{_delay(exchange)}"
        if exchange.reply is None and not target.is_write:
            return f"{names}: no reply"
        data = data_of(exchange, request)
        more = len(target.places) - len(places)
        values = ", ".join(_shown(place, data) for place in places) + (f" and {more} more" if more else "")
        if exchange.is_broadcast:
            return f"{values} (broadcast)"
        return values + (": no reply" if exchange.reply is None else _delay(exchange))

    def json(self, sniffed: Sniffed) -> dict[str, Any]:
        """Return the exchange as an object for JSON, without the name of the serial line."""
        found: dict[str, Any] = {"time": format_time(sniffed.time_ns)}
        if isinstance(sniffed, Junk):
            return found | {"unknown": sniffed.raw.hex(" ").upper()}
        request, reply = sniffed.request, sniffed.reply
        message = request or reply
        assert message is not None
        found |= {
            "framing": str(sniffed.framing),
            "address": message.address,
            "function": message.function,
            "frames": [raw.hex(" ").upper() for _, raw, _ in sniffed.raw],
        }
        if request is None:
            return found | {"result": "reply without its request"}
        target = self._lookup.find(sniffed.framing, request)
        found |= {"drive": target.drive, "access": "write" if target.is_write else "read"}
        if reply is None:
            found["result"] = "broadcast" if sniffed.is_broadcast else "no reply"
        else:
            found["result"] = "refused" if reply.exception else "ok"
            found["reply_after_ns"] = sniffed.reply_time_ns - sniffed.time_ns
            if reply.exception:
                found["exception"] = reply.exception
        if not sniffed.is_sure:
            found["may_be_confirmation"] = True
        if found["result"] == "ok" or target.is_write:
            data = data_of(sniffed, request)
            found["values"] = {place.name: _number(place, data) for place in target.places}
        return found


def data_of(exchange: SniffedExchange, request: Message) -> bytes:
    """Return the data read or written. Written data are from the request: not all replies repeat them."""
    if exchange.framing is Framing.DELIXI and request.function == 0x02:
        return struct.pack(">I", request.start)
    if exchange.framing is not Framing.DELIXI and request.function >= 0x05:
        return request.data
    return exchange.reply.data if exchange.reply else request.data


def _clock(time_ns: int) -> str:
    """Return the time of day (UTC) with microseconds, such as 09:30:00.123456Z."""
    second, rest_ns = divmod(time_ns, 10**9)
    return f"{datetime.fromtimestamp(second, UTC):%H:%M:%S}.{rest_ns // 1000:06}Z"


def _delay(exchange: SniffedExchange) -> str:
    return f"  ({(exchange.reply_time_ns - exchange.time_ns) / 1e6:.1f} ms)"


def _hex(raw: bytes) -> str:
    more = f" and {len(raw) - _MOST_BYTES} bytes more" if len(raw) > _MOST_BYTES else ""
    return raw[:_MOST_BYTES].hex(" ").upper() + more


def _number(place: RegisterPlace, data: bytes) -> float | int | None:
    if place.register is not None:
        number = place.register.number_in(data, place.at)
        if number is None or not isfinite(number):  # JSON has no infinity
            return None
        return number if place.register.values is None else int(number)
    raw = raw_value(data, place.at, place.number_format)
    # NaN (`raw != raw`) means that the reply ends before this register
    return int(raw) if raw == raw else None


def _shown(place: RegisterPlace, data: bytes) -> str:
    register = place.register
    raw = raw_value(data, place.at, place.number_format)
    if register is None:
        return f"{place.name} = {int(raw)}" if raw == raw else f"{place.name} ?"
    value = register.value_in(data, place.at)
    if value is not None:
        return f"{register.name} = {register.format(value)}"
    is_there = bits_in(data, place.at, register.number_format, register.order) is not None
    return f"{register.name}: {Status.NO_VALUE}" if is_there else f"{register.name} ?"
