"""MBAP: requests are parsed correctly however their bytes are divided."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tables import table

from multidrop.gateway.modbus_server.protocol import Garbage, MbapRequest, take_request

# MODBUS Messaging on TCP/IP Implementation Guide V1.0b, 4.4.2.1 and the example of section 3.1.3:
# transaction 1501H, protocol 0, length 6, unit FFH, function 03, start 0004H, count 0001H
PRINTED = bytes.fromhex("15 01 00 00 00 06 FF 03 00 04 00 01")


def test_example_of_the_modbus_guide_is_parsed_and_answered() -> None:
    buffer = bytearray(PRINTED)
    found = take_request(buffer)
    assert found == MbapRequest(0x1501, 0xFF, 3, bytes.fromhex("00 04 00 01"))
    assert not buffer
    assert found.reply(bytes.fromhex("02 00 05")) == bytes.fromhex("15 01 00 00 00 05 FF 03 02 00 05")
    assert found.exception(2) == bytes.fromhex("15 01 00 00 00 03 FF 83 02")


def test_request_that_arrives_byte_by_byte_is_parsed() -> None:
    buffer = bytearray()
    for byte in PRINTED[:-1]:
        buffer.append(byte)
        assert take_request(buffer) is None
    buffer.append(PRINTED[-1])
    assert take_request(buffer) is not None


@table(
    "header",
    [
        "00 01 00 01",  # another protocol id
        "00 01 FF FF 00 06 01 03",
        "47 45 54 20",  # GET
        "16 03 01 02",  # TLS
        "00 01 00 00 00 00",
        "00 01 00 00 00 01",
        "00 01 00 00 00 FF",  # one byte longer than the longest frame
        "00 01 00 00 FF FF",
    ],
)
def test_invalid_header_raises_garbage_as_soon_as_it_is_visible(header: str) -> None:
    with pytest.raises(Garbage):
        take_request(bytearray.fromhex(header))


frames = st.builds(
    lambda transaction, unit, function, data: (
        struct.pack(">HHHBB", transaction, 0, 2 + len(data), unit, function) + data
    ),
    st.integers(0, 0xFFFF),
    st.integers(0, 255),
    st.integers(0, 255),
    st.binary(max_size=252),
)


@given(st.lists(frames, max_size=6), st.lists(st.integers(1, 40), min_size=1, max_size=40))
def test_requests_are_parsed_the_same_however_they_are_divided(sent: list[bytes], cuts: list[int]) -> None:
    whole = b"".join(sent)
    buffer, found, at = bytearray(), [], 0
    while at < len(whole):
        size = cuts[len(found) % len(cuts)]
        buffer += whole[at : at + size]
        at += size
        while taken := take_request(buffer):
            found.append(taken)
    assert not buffer
    assert [
        struct.pack(">HHHBB", one.transaction, 0, 2 + len(one.data), one.unit, one.function) + one.data
        for one in found
    ] == sent
