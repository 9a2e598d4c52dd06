"""A line with several framings, on which pymodbus is the master and `sniff` listens.

In the first test, the listener receives all bytes undamaged. In the second test, some bytes are damaged.
SNIFFED_EXCHANGES is the number of exchanges: 3,000 in .ci/run, 10,000 in a thorough run.
"""

from __future__ import annotations

import itertools
import os
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from peers import require_module
from ptys import opened, receive
from sniffing import sniffing, tapped

from multidrop.core import FrameSpan, Framing, Kind, Message, Splitter, Stream, build_request, parse_reply
from multidrop.drive import Drive
from multidrop.families import DelixiNative, InnovertIBD, InvtCHE
from multidrop.sim import EncodedDrive, Simulator, Wire

EXCHANGES = int(os.environ.get("SNIFFED_EXCHANGES", "300"))
TURN = 10  # exchanges of one master before the next master's turn
BAUDRATE = 1_000_000  # so high that characters and silences take nearly no time
TO_HEAR = ["--baudrate", BAUDRATE]


def drives() -> list[Drive]:
    return [
        type(family.__name__, (family,), {"baudrates": (BAUDRATE,), "needed_silence": lambda drive: 0.0})(
            address, framing=framing
        )
        for address, (family, framing) in enumerate(
            (
                (InnovertIBD, Framing.RTU),
                (InvtCHE, Framing.RTU),
                (InnovertIBD, Framing.ASCII),
                (DelixiNative, Framing.DELIXI),
            ),
            1,
        )
    ]


Said = tuple[int, int, list[int] | int]  # address; function; values, or the negative exception code
NUMBERS = itertools.count(1)  # each number is written only once, so that each exchange is unique


def pymodbus(framer: str, address: int, starts: list[int], written: int) -> Callable[..., Iterator[Said]]:
    """Return a master that reads and writes with pymodbus."""

    def master(port: str, chance: random.Random) -> Iterator[Said]:
        client = require_module("pymodbus.client")
        kind = require_module("pymodbus").FramerType(framer)
        with client.ModbusSerialClient(port, framer=kind, baudrate=BAUDRATE, timeout=60) as connection:
            for _ in range(TURN):
                if chance.random() < 0.6:
                    start = chance.choice(starts)
                    reply = connection.read_holding_registers(
                        start, count=chance.randint(1, 3), device_id=address
                    )
                    yield address, 3, -reply.exception_code if reply.isError() else reply.registers
                else:
                    number = next(NUMBERS) % 10_000
                    assert not connection.write_register(written, number, device_id=address).isError()
                    yield address, 6, [number]

    return master


def delixi(port: str, chance: random.Random) -> Iterator[Said]:
    """Send requests in Delixi's framing, which pymodbus lacks; yield them with their replies."""
    with opened(port) as fd:
        for _ in range(TURN):
            register = chance.choice([DelixiNative.output_frequency, DelixiNative.output_current])
            request = Message(4, 7, register.address, data=bytes(4))
            os.write(fd, build_request(Framing.DELIXI, request))
            _, reply = parse_reply(Framing.DELIXI, receive(fd, 21), request)
            assert reply is not None
            yield 4, 7, [int.from_bytes(reply.data)]


MASTERS = (
    pymodbus("rtu", 1, [0, 1], InnovertIBD.frequency.address),
    pymodbus("rtu", 2, [0x3000, 0x3001], InvtCHE.setpoint.address),
    pymodbus("ascii", 3, [0, 1], InnovertIBD.frequency.address),
    delixi,
)


def mastered(hear: Callable[[bytes], bytes] = bytes) -> tuple[list[Said], list[dict[str, Any]]]:
    """Return the masters' requests with their replies, and the exchanges that `sniff` reports."""
    chance = random.Random(1)
    said: list[Said] = []
    simulator = Simulator([Wire([EncodedDrive(drive) for drive in drives()])])
    with (
        simulator,
        tapped(simulator.wires[0].path, BAUDRATE, hear) as (port, tap),
        sniffing(tap, *TO_HEAR, patient=True) as sniffer,
    ):
        while len(said) < EXCHANGES:
            said += chance.choice(MASTERS)(port, chance)
    return said, sniffer.told


def told_as_said(told: dict[str, Any]) -> Said:
    if "values" not in told and told["result"] != "refused":
        pytest.fail(f"heard, and not understood: {told}")
    values = -told["exception"] if told["result"] == "refused" else list(told["values"].values())
    return told["address"], told["function"], values


@pytest.mark.long
@pytest.mark.slow
def test_every_exchange_on_a_line_with_mixed_framings_is_sniffed() -> None:
    said, told = mastered()
    assert [told_as_said(record) for record in told[:-1]] == said
    assert told[-1]["summary"] == {
        "exchanges": len(said),
        "broadcasts": 0,
        "unanswered": 0,
        "strays": 0,
        "unknown_bytes": 0,
    }
    assert {record["framing"] for record in told[:-1]} == {"rtu", "ascii", "delixi"}


@dataclass
class Damage:
    """Changes, drops or duplicates one byte in a hundred on its way to the listener."""

    said: bytearray = field(default_factory=bytearray)
    damaged: list[int] = field(default_factory=list)  # offsets of damaged bytes in the traffic
    chance: random.Random = field(default_factory=lambda: random.Random(2))

    def __call__(self, said: bytes) -> bytes:
        damaged = bytearray()
        for byte in said:
            kind = self.chance.choice(["changed", "lost", "doubled"]) if self.chance.random() < 0.01 else ""
            if kind:
                self.damaged.append(len(self.said))
            self.said.append(byte)
            if kind != "lost":
                damaged.append(byte ^ self.chance.randrange(1, 256) if kind == "changed" else byte)
            if kind == "doubled":
                damaged.append(byte)
        return bytes(damaged)

    def exchanges(self) -> list[tuple[bool, tuple[str, ...]]]:
        """Return the frames of each exchange, each with True if it is undamaged."""
        stream = Stream()
        stream.put(bytes(self.said), 0)
        stream.end(True)
        spans = list(Splitter().spans(stream))
        assert [span.kind for span in spans] == [Kind.REQUEST, Kind.REPLY] * (len(spans) // 2)
        damaged, found, at = set(self.damaged), [], 0
        for pair in zip(spans[::2], spans[1::2], strict=True):
            length = sum(len(span.raw) for span in pair)
            found.append((damaged.isdisjoint(range(at, at + length)), frames(pair)))
            at += length
        return found


def frames(pair: tuple[FrameSpan, ...]) -> tuple[str, ...]:
    return tuple(span.raw.hex(" ").upper() for span in pair)


@pytest.mark.long
@pytest.mark.slow
def test_undamaged_exchanges_between_damaged_ones_are_sniffed() -> None:
    damage = Damage()
    said, told = mastered(damage)
    exchanges = damage.exchanges()
    assert len(exchanges) == len(said)
    assert len(damage.damaged) > 0.005 * len(damage.said)
    is_whole = [whole for whole, _ in exchanges]
    expected = [exchanges[at][1] for at in range(1, len(exchanges) - 1) if all(is_whole[at - 1 : at + 2])]
    assert len(expected) > 0.3 * len(said)
    sniffed = [tuple(record["frames"]) for record in told[:-1] if record.get("result") in ("ok", "refused")]
    rest = iter(sniffed)
    # each undamaged exchange was sniffed, in the right order
    assert [each for each in expected if each not in rest] == []
    assert set(sniffed) <= {each for _, each in exchanges}  # `sniff` reported no exchange that did not happen
    unknown = sum(len(bytes.fromhex(record["unknown"])) for record in told[:-1] if "unknown" in record)
    assert told[-1]["summary"]["unknown_bytes"] == unknown > 0
