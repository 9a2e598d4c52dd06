"""Generate random Modbus requests and replies, intact and damaged, reproducibly from a seed."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import checksums

from multidrop.core import Framing, Message

READS = (0x01, 0x02, 0x03, 0x04)
FUNCTIONS = (*READS, 0x05, 0x06, 0x08, 0x0F, 0x10)
BITS = (0x01, 0x02, 0x0F)
MOST = {
    0x01: 2000,
    0x02: 2000,
    0x03: 125,
    0x04: 125,
    0x0F: 1968,
    0x10: 123,
}  # most values per request
ECHOES = (0x05, 0x06, 0x08)
COIL_VALUES = (b"\xff\x00", b"\x00\x00")

Body = bytes  # frame without start, end and checksum


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


# ---- undamaged ----


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


# ---- damaged with a correct checksum ----

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
    "byte count": partial(_put, 6, _near),  # byte count of a request
    "shorter": lambda chance, body: body[: chance.randrange(1, len(body))],
    "longer": lambda chance, body: body + chance.randbytes(chance.choice((1, 2, 8))),
    "exception": lambda chance, body: bytes([body[0], body[1] | 0x80, chance.choice((0, 1, 2, 9, 0x20))]),
    "exception to 09": lambda chance, body: bytes([body[0], 0x89, chance.choice((1, 2))]),
}

# ---- damaged as on a line ----


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
            continue  # this request has no reply
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
