"""Make random frames, intact or damaged; decode frames with libmodbus and pymodbus into our own types."""

from __future__ import annotations

import random
import struct
import subprocess
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import checksums
from peers import build_with_libmodbus, require_module

from multidrop.core import Framing, Message

Verdict = Message | str  # a decoded message, or the reason why the frame was rejected

JUDGE = Path(__file__).parents[2] / "c" / "libmodbus_judge.c"
EXCEPTIONS = range(12)  # libmodbus' errno offsets for exceptions 00 to 0B; larger ones are its own errors
EMBBADEXC = 14
UNKNOWN_CODE = "an exception without a code"


def pack_bits(bits: Sequence[Any]) -> bytes:
    number = sum(bool(bit) << at for at, bit in enumerate(bits))
    return number.to_bytes((len(bits) + 7) // 8, "little")


def pack_words(words: Sequence[int]) -> bytes:
    return struct.pack(f">{len(words)}H", *words)


def _text(octets: bytes) -> str:
    return octets.hex() or "-"


# ---- libmodbus: a C program that reads all cases together ----


class Libmodbus:
    """Runs libmodbus as server and as client."""

    def __init__(self, built: Path) -> None:
        self._program = build_with_libmodbus(JUDGE, built)

    def _run(self, lines: Iterable[str]) -> list[str]:
        said = "".join(f"{line}\n" for line in lines)
        done = subprocess.run([self._program], input=said, capture_output=True, text=True, check=True)
        return done.stdout.splitlines()

    def hear(self, requests: Sequence[SampleFrame]) -> list[Understood | str]:
        """Return the server's result for each request. All requests are addressed to the server."""
        return [
            _received(line) for line in self._run(f"request {_text(request.frame)}" for request in requests)
        ]

    def ask(self, replies: Sequence[SampleFrame]) -> list[tuple[bytes, Verdict]]:
        """Return the client's request for each reply, and how the client decodes the reply."""
        asked = [reply.request for reply in replies]
        lines = [
            f"reply {ask.address} {ask.function} {ask.start} {ask.count} {_text(ask.data)} "
            f"{_text(said.frame)}"
            for ask, said in zip(asked, replies, strict=True)
        ]
        return [_answered(each, line) for each, line in zip(asked, self._run(lines), strict=True)]


@dataclass(frozen=True)
class Understood:
    """A server's result: number of bytes used, its reply, and the changed cells by (table, address)."""

    used: int
    reply: bytes
    changes: dict[tuple[int, int], int] = field(default_factory=dict)


def _received(line: str) -> Understood | str:
    word, *rest = line.split()
    if word == "refused":
        return line
    used, reply, changes = rest
    cells = [cell.split(":") for cell in changes.split(",") if changes != "-"]
    return Understood(
        int(used),
        b"" if reply == "-" else bytes.fromhex(reply),
        {(int(table), int(address)): int(value) for table, address, value in cells},
    )


def _answered(request: Message, line: str) -> tuple[bytes, Verdict]:
    sent, word, *rest = line.split()
    if word != "error":
        return bytes.fromhex(sent), _confirmed(request, word)
    errno = int(rest[0])
    if errno == EMBBADEXC:
        return bytes.fromhex(sent), UNKNOWN_CODE
    if errno in EXCEPTIONS:
        return bytes.fromhex(sent), Message(request.address, request.function, exception=errno)
    return bytes.fromhex(sent), f"errno {errno}"


def _confirmed(request: Message, values: str) -> Message:
    """Return the reply that a client must have decoded, given the values that it returned."""
    if request.function in ECHOES:
        return request
    data = b""
    if request.function in READS:
        numbers = [int(value) for value in values.split(",")]
        data = pack_bits(numbers) if request.function in BITS else pack_words(numbers)
    return Message(request.address, request.function, request.start, request.count, data)


def expected(used: int, request: Message) -> Understood:
    """Return the result that the application protocol V1.1b3, section 6, requires for this request.

    `used` is the number of bytes that the server must consume.
    """
    changes: dict[tuple[int, int], int] = {}
    reply = _carry_out(request, changes)
    return Understood(used, reply if request.address else b"", changes)


def _cell(function: int, address: int) -> int:
    """Return the initial value at an address of the function's table."""
    fill = {1: int(address % 3 == 0), 2: int(address % 5 == 0), 3: address * 31 + 7, 4: address * 17 + 3}
    return fill[function] & 0xFFFF


def _carry_out(request: Message, changes: dict[tuple[int, int], int]) -> bytes:
    """Carry out a request: add the changed cells to `changes`; return the reply's PDU (function and data)."""
    function, start, count = request.function, request.start, request.count
    if function == 8:
        return bytes([function]) + start.to_bytes(2) + request.data
    most = {1: 2000, 2: 2000, 3: 125, 4: 125, 15: 1968, 16: 123}.get(function, 1)
    many = 1 if function in ECHOES else count
    table = 1 if function in (1, 5, 15) else 3 if function in (3, 6, 16) else function
    coil = {b"\xff\x00": 1, b"\0\0": 0}
    if not 1 <= many <= most or (function == 5 and request.data not in coil):
        return bytes([function | 0x80, 3])
    if start + many > 0x10000:
        return bytes([function | 0x80, 2])
    cells = [_cell(table, start + at) for at in range(many)]
    if function in READS:
        data = pack_bits(cells) if function in BITS else pack_words(cells)
        return bytes([function, len(data)]) + data
    if function == 5:
        written = [coil[request.data]]
    elif function == 15:
        written = [request.data[at // 8] >> at % 8 & 1 for at in range(many)]
    else:
        written = list(struct.unpack(f">{many}H", request.data))
    for at, (before, after) in enumerate(zip(cells, written, strict=True)):
        if before != after:
            changes[table, start + at] = after
    tail = request.data if function in ECHOES else count.to_bytes(2)
    return bytes([function]) + start.to_bytes(2) + tail


class Pymodbus:
    """Runs pymodbus as server and as client, without ports."""

    def __init__(self, framing: Framing) -> None:
        framer = require_module("pymodbus.framer")
        self._pdu = require_module("pymodbus.pdu")
        self._failure = require_module("pymodbus.exceptions").ModbusException
        kind = {
            Framing.RTU: framer.FramerType.RTU,
            Framing.ASCII: framer.FramerType.ASCII,
            Framing.TCP: framer.FramerType.SOCKET,
        }[framing]
        make = framer.FRAMER_NAME_TO_CLASS[kind]
        self._server = make(self._pdu.DecodePDU(True))
        self._client = make(self._pdu.DecodePDU(False))

    def hear(self, said: SampleFrame) -> Verdict:
        """Return the request as pymodbus's server decodes it, or the reason for its rejection."""
        return self._open(self._server, said, address=0)

    def ask(self, said: SampleFrame) -> Verdict:
        """Return the reply as pymodbus's client decodes it, or the reason for its rejection."""
        found = self._open(self._client, said, said.request.address)
        if isinstance(found, Message) and found.function in READS and not found.exception:
            return replace(found, start=said.request.start, count=said.request.count)
        return found

    def _open(self, framer: Any, said: SampleFrame, address: int) -> Verdict:
        try:
            _, pdu = framer.handleFrame(said.frame, address, 0)
        except (ValueError, self._failure) as failure:
            return f"{type(failure).__name__}: {failure}"
        return "no frame" if pdu is None else _said(pdu)

    def build_request(self, request: Message) -> bytes:
        return bytes(self._server.buildFrame(self._pdu_of(self._server, request)))

    def build_reply(self, reply: Message) -> bytes:
        if reply.exception:
            refusal = self._pdu.ExceptionResponse(reply.function, reply.exception, device_id=reply.address)
            refusal.transaction_id = reply.transaction
            return bytes(self._server.buildFrame(refusal))
        return bytes(self._client.buildFrame(self._pdu_of(self._client, reply)))

    def _pdu_of(self, framer: Any, message: Message) -> Any:
        head = bytes([message.address, message.function, 0, 0])  # two bytes of 0: subfunction of function 08
        kind = framer.decoder.lookupPduClass(head)
        return kind(dev_id=message.address, transaction_id=message.transaction, **_fields(message))


def _fields(message: Message) -> dict[str, Any]:
    """Return the message's fields under pymodbus's names."""
    function = message.function
    if function == 0x08:
        return {"message": message.data}
    fields: dict[str, Any] = {"address": message.start}
    if not message.data:
        return fields | {"count": message.count}
    if function == 0x05:
        return fields | {"bits": [message.data == b"\xff\x00"]}
    if function in BITS:
        bits = [bool(message.data[at // 8] >> at % 8 & 1) for at in range(message.count)]
        return fields | {"bits": bits}
    return fields | {"registers": list(struct.unpack(f">{len(message.data) // 2}H", message.data))}


def _said(pdu: Any) -> Message:
    function = pdu.function_code
    if pdu.isError():
        return Message(pdu.dev_id, function & 0x7F, exception=pdu.exception_code)
    if function == 0x08:
        said = pdu.message
        return Message(pdu.dev_id, function, pdu.sub_function_code, data=_octets(said))
    data = b""
    if function == 0x05:
        data = b"\xff\x00" if pdu.bits[0] else b"\0\0"
    elif pdu.bits or pdu.registers:
        data = pack_bits(pdu.bits) if pdu.bits else pack_words(pdu.registers)
    count = 0 if function in ECHOES else pdu.count
    return Message(pdu.dev_id, function, pdu.address, count, data)


def _octets(said: Any) -> bytes:
    """Return the data of function 08 as bytes; pymodbus holds bytes, a number, or a list of numbers."""
    if isinstance(said, bytes):
        return said
    return pack_words([said] if isinstance(said, int) else said)


# ---- generate random Modbus requests and replies, intact and damaged, reproducibly from a seed ----


READS = (0x01, 0x02, 0x03, 0x04)
FUNCTIONS = (*READS, 0x05, 0x06, 0x08, 0x0F, 0x10)
BITS = (0x01, 0x02, 0x0F)
# function code: most values in a request
MOST = {0x01: 2000, 0x02: 2000, 0x03: 125, 0x04: 125, 0x0F: 1968, 0x10: 123}
ECHOES = (0x05, 0x06, 0x08)
COIL_VALUES = (b"\xff\x00", b"\x00\x00")

Body = bytes  # a frame without its start, end and checksum


@dataclass(frozen=True)
class SampleFrame:
    """A frame, perhaps damaged, and its undamaged message; a reply also has its request."""

    framing: Framing
    frame: bytes
    request: Message
    damage: str  # kind of damage, "" if undamaged

    @property
    def body(self) -> Body:
        """Return the frame's body, as far as the damage allows."""
        if self.framing is Framing.RTU:
            return self.frame[:-2]
        digits = self.frame.partition(b":")[2].partition(b"\r")[0]
        try:
            return bytes.fromhex(digits.decode())[:-1]
        except ValueError:
            return b""

    def octet(self, at: int) -> int:
        """Return the body's byte at index `at`, or -1 past its end."""
        return self.body[at] if at < len(self.body) else -1

    @property
    def function(self) -> int:
        return self.octet(1)


def seal(framing: Framing, body: Body) -> bytes:
    return checksums.rtu(body) if framing is Framing.RTU else checksums.ascii(body.hex().upper())


def data_bytes(function: int, count: int) -> int:
    return (count + 7) // 8 if function in BITS else 2 * count


def random_request(chance: random.Random) -> Message:
    function = chance.choice(FUNCTIONS)
    is_broadcast = function in (0x05, 0x06, 0x0F, 0x10) and chance.random() < 0.05
    address = 0 if is_broadcast else chance.choice((1, 247, chance.randint(1, 247)))
    if function == 0x08:
        return Message(address, function, 0, data=chance.randbytes(2))
    count = 1
    if function not in ECHOES:
        count = chance.choice((1, 2, 8, 9, MOST[function], chance.randint(1, MOST[function])))
    start = chance.choice((0, 0x10000 - count, chance.randint(0, 0x10000 - count)))
    if function == 0x05:
        return Message(address, function, start, data=chance.choice(COIL_VALUES))
    if function == 0x06:
        return Message(address, function, start, data=chance.randbytes(2))
    data = b"" if function in READS else _random_data(chance, function, count)
    return Message(address, function, start, count, data)


def random_reply(chance: random.Random, request: Message) -> Message:
    """Return a random valid reply to the request."""
    if chance.random() < 0.15:
        code = chance.choice((1, 2, 3, 4, 6, 0x0B, 0x12, chance.randint(1, 255)))
        return Message(request.address, request.function, exception=code)
    if request.function in READS:
        data = _random_data(chance, request.function, request.count)
        return Message(request.address, request.function, request.start, request.count, data)
    if request.function in ECHOES:
        return request
    return Message(request.address, request.function, request.start, request.count)


def _random_data(chance: random.Random, function: int, count: int) -> bytes:
    data = bytearray(chance.randbytes(data_bytes(function, count)))
    if function in BITS and count % 8:  # unused bits of the last byte are 0 (application protocol, 6.1)
        data[-1] &= (1 << count % 8) - 1
    return bytes(data)


def request_body(request: Message) -> Body:
    head = bytes([request.address, request.function]) + request.start.to_bytes(2)
    if request.function in ECHOES:
        return head + request.data
    head += request.count.to_bytes(2)
    return head if request.function in READS else head + bytes([len(request.data)]) + request.data


def reply_body(reply: Message) -> Body:
    if reply.exception:
        return bytes([reply.address, reply.function | 0x80, reply.exception])
    head = bytes([reply.address, reply.function])
    if reply.function in READS:
        return head + bytes([len(reply.data)]) + reply.data
    if reply.function in ECHOES:
        return head + reply.start.to_bytes(2) + reply.data
    return head + reply.start.to_bytes(2) + reply.count.to_bytes(2)


Change = Callable[[random.Random, Body], Body]


def _put(at: int, choices: Callable[[random.Random, int], int], chance: random.Random, body: Body) -> Body:
    """Return the body with its byte at `at` replaced, if the body is long enough."""
    if at >= len(body):
        return body
    return body[:at] + bytes([choices(chance, body[at]) & 0xFF]) + body[at + 1 :]


def _flip(chance: random.Random, octets: bytes) -> bytes:
    at = chance.randrange(len(octets))
    return octets[:at] + bytes([octets[at] ^ 1 << chance.randrange(8)]) + octets[at + 1 :]


def _near(chance: random.Random, octet: int) -> int:
    return octet + chance.choice((-2, -1, 1, 2, chance.randrange(256)))


def _another_function(chance: random.Random, octet: int) -> int:
    return chance.choice((*FUNCTIONS, 0x00, octet ^ 0x80, 0x89, chance.randrange(256)))


def _another_count(chance: random.Random, body: Body) -> Body:
    count = chance.choice((0, 1, 124, 126, 1969, 2000, 2001, 0xFFFF))
    return body[:4] + count.to_bytes(2) + body[6:]


REPAIRED: dict[str, Change] = {
    "bit flipped": _flip,
    "address": partial(_put, 0, lambda chance, _: chance.choice((0, 248, 255, chance.randrange(256)))),
    "function": partial(_put, 1, _another_function),
    "third byte": partial(_put, 2, _near),  # byte count or exception code of a reply
    "start": partial(_put, 3, _near),
    "value": partial(_put, 5, _near),
    "count": _another_count,
    "byte count": partial(_put, 6, _near),  # damages the byte count of a request
    "shorter": lambda chance, body: body[: chance.randrange(1, len(body))],
    "longer": lambda chance, body: body + chance.randbytes(chance.choice((1, 2, 8))),
    "exception": lambda chance, body: bytes([body[0], body[1] | 0x80, chance.choice((0, 1, 2, 9, 0x20))]),
    "exception to 09": lambda chance, body: bytes([body[0], 0x89, chance.choice((1, 2))]),
}


def _text_damaged(chance: random.Random, frame: bytes) -> bytes:
    at = chance.randrange(len(frame))
    character = chance.choice(b"0123456789abcdefABCDEF:+-_ \r\ng\x00\xff")
    return frame[:at] + bytes([character]) + frame[at + 1 :]


LEFT: dict[str, Change] = {
    "flipped on the line": _flip,
    "cut off": lambda chance, frame: frame[: chance.randrange(len(frame))],
    "followed": lambda chance, frame: frame + chance.randbytes(chance.choice((1, 2, 9))),
}
TEXT: dict[str, Change] = {
    "lower case": lambda chance, frame: frame.lower(),
    "line end": lambda chance, frame: frame[:-2] + chance.choice((b"\n", b"\r\r\n", b"\n\r", b"\r")),
    "character": _text_damaged,
}


def frames(seed: int, framing: Framing, number: int, *, replies: bool) -> list[SampleFrame]:
    """Return `number` requests or replies: intact, damaged (some with a valid checksum), or foreign."""
    chance = random.Random(seed)
    left = LEFT if framing is Framing.RTU else LEFT | TEXT
    found = []
    while len(found) < number:
        request = random_request(chance)
        if replies and request.address == 0:
            continue  # a broadcast, to which no drive replies
        body = reply_body(random_reply(chance, request)) if replies else request_body(request)
        damage = chance.choice(("", "repaired", "left"))
        if replies and chance.random() < 0.1:
            damage, other = "to another request", replace(random_request(chance), address=request.address)
            body = reply_body(random_reply(chance, other))
        if damage == "repaired":
            damage = chance.choice(list(REPAIRED))
            body = REPAIRED[damage](chance, body)
        frame = seal(framing, body)
        if damage == "left":
            damage = chance.choice(list(left))
            frame = left[damage](chance, frame)
        found.append(SampleFrame(framing, frame, request, damage))
    return found
