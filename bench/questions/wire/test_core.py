"""Cost of the C core when it is called from Python."""

from __future__ import annotations

import os
from contextlib import closing
from ctypes import CDLL
from typing import Any

import pytest
from multidrop._core import ffi, lib

from multidrop.core import (
    Columns,
    Exchange,
    Field,
    Framing,
    Message,
    NumberFormat,
    Peer,
    Port,
    RowLayout,
    RowQueue,
    build_request,
    crc16,
    parse_reply,
    set_settings,
)

EXCHANGES = 256
READ_TEN = Message(1, 3, 0, 10)
REPLY = bytes.fromhex("010308010001F401F4003225C4")  # from ERMAN ER-G-220's document, section 6, FC03


TEN_VALUES = RowLayout(0, [Field(at, NumberFormat.U16, at, 1, 10) for at in range(10)])


def unhurried(request: Message) -> Exchange:
    """Return an exchange without silence and without time on the wire, to measure only the host's cost."""
    return Exchange(
        Framing.RTU,
        request,
        Peer(least_timeout=1, most_timeout=1),
        baudrate=115200,
        format="8N1",
        character=0.0,
        silence=0.0,
        block=TEN_VALUES,
    )


@pytest.mark.parametrize("length", [8, 25, 256])
def test_time_of_a_checksum(benchmark: Any, length: int) -> None:
    frame = bytes(range(256))[:length]
    benchmark(crc16, frame, length)


def test_time_to_build_a_request(benchmark: Any) -> None:
    assert benchmark(build_request, Framing.RTU, READ_TEN) == bytes.fromhex("01030000000AC5CD")


def test_time_to_check_a_reply(benchmark: Any) -> None:
    used, reply = benchmark(parse_reply, Framing.RTU, REPLY, Message(1, 3, 1, 4))
    assert used == len(REPLY)
    assert reply.data == REPLY[3:-2]


@pytest.fixture
def fd(responder: str) -> Any:
    opened = os.open(responder, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    set_settings(opened, 115200, "8N1")
    yield opened
    os.close(opened)


def carry_out(port: Port, exchanges: list[Exchange], row_queue: RowQueue) -> Columns:
    """Carry out the exchanges on the engine's thread; return their rows."""
    last = port.done + len(exchanges)
    port.submit(exchanges, [0] * len(exchanges))
    while port.done != last:
        row_queue.await_calls(0.02)
    columns = row_queue.take()
    assert columns is not None
    return columns


def test_time_of_256_exchanges_with_2560_values(benchmark: Any, fd: int) -> None:
    with closing(Port(fd, -1, room=EXCHANGES)) as port:
        row_queue = RowQueue()
        port.report_to(row_queue, 0)
        columns = benchmark(carry_out, port, [unhurried(READ_TEN)] * EXCHANGES, row_queue)
    assert len(columns) == 10 * EXCHANGES
    assert set(columns.array("status")) == {0}
    assert columns.array("value")[0] == 0x0304 / 10


def test_time_of_256_exchanges_in_a_minimal_c_loop(benchmark: Any, fd: int, bare: CDLL) -> None:
    assert benchmark(bare.bare_exchanges, fd, EXCHANGES) == EXCHANGES


def test_time_to_decode_ten_values(benchmark: Any, fd: int) -> None:
    found = ffi.new("struct md_completion *")
    with closing(Port(fd, -1)) as port:
        reply = port.carry_out(unhurried(READ_TEN)).reply
    found.result, found.sent_ns, found.first_ns = 25, 1, 2
    found.reply.data_len = len(reply.data)
    found.reply.data[0 : len(reply.data)] = list(reply.data)
    columns = Columns(10)

    def decode() -> None:
        columns.c.rows = 0
        lib.md_columns_add(columns.c, TEN_VALUES.c, found, 0)

    benchmark(decode)
    assert columns.array("value")[0] == 0x0304 / 10
