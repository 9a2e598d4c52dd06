"""What the C core costs when it is called from Python."""

from __future__ import annotations

import os
from ctypes import CDLL
from typing import Any

import pytest

from multidrop.core import (
    Block,
    Columns,
    Completions,
    Exchange,
    Field,
    Framing,
    Message,
    Port,
    Wire,
    build_request,
    crc16,
    parse_reply,
    set_settings,
)

EXCHANGES = 256
READ_TEN = Message(1, 3, 0, 10)
REPLY = bytes.fromhex("010308010001F401F4003225C4")  # ERMAN ER-G-220, section 6, FC03


def unhurried(request: Message) -> Exchange:
    """An exchange that waits for nothing: what is left is the host's own cost."""
    return Exchange(
        Framing.RTU, request, baudrate=115200, format="8N1", character=0.0, silence=0.0, timeout=1.0
    )


@pytest.mark.parametrize("length", [8, 25, 256])
def test_checksum(benchmark: Any, length: int) -> None:
    frame = bytes(range(256))[:length]
    benchmark(crc16, frame, length)


def test_build_request(benchmark: Any) -> None:
    assert benchmark(build_request, Framing.RTU, READ_TEN) == bytes.fromhex("01030000000AC5CD")


def test_check_reply(benchmark: Any) -> None:
    used, reply = benchmark(parse_reply, Framing.RTU, REPLY, Message(1, 3, 1, 4))
    assert used == len(REPLY)
    assert reply.data == REPLY[3:-2]


@pytest.fixture
def fd(responder: str) -> Any:
    opened = os.open(responder, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    set_settings(opened, 115200, "8N1")
    yield opened
    os.close(opened)


def test_256_exchanges(benchmark: Any, fd: int) -> None:
    port = Port(fd, -1)
    exchanges, completions = [unhurried(READ_TEN)] * EXCHANGES, Completions(EXCHANGES)
    assert benchmark(port.run, exchanges, completions) == EXCHANGES
    assert all(completion.result == 25 for completion in completions)


def test_256_exchanges_of_a_bare_c_loop(benchmark: Any, fd: int, bare: CDLL) -> None:
    assert benchmark(bare.bare_exchanges, fd, EXCHANGES) == EXCHANGES


def test_decode_2560_values(benchmark: Any, fd: int) -> None:
    completions = Completions(EXCHANGES)
    Port(fd, -1).run([unhurried(READ_TEN)] * EXCHANGES, completions)
    block = Block([Field(at, Wire.U16, 0, at, 1, 10) for at in range(10)])

    def decode() -> Columns:
        columns = Columns(10 * EXCHANGES)
        for at in range(EXCHANGES):
            columns.add(block, completions, at, 0)
        return columns

    columns = benchmark(decode)
    assert len(columns) == 10 * EXCHANGES
    assert columns.array("value")[0] == 0x0304 / 10
