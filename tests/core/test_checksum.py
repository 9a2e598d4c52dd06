"""The three checksums: published check values, and what they promise."""

from __future__ import annotations

import checksums
from hypothesis import given, settings
from hypothesis import strategies as st
from tables import table

from multidrop.core import crc16, lrc, sum8

CHECK = b"123456789"


def crc(data: bytes) -> int:
    checksum: int = crc16(data, len(data))
    return checksum


@table(
    ("data", "checksum"),
    [
        (CHECK, 0x4B37),  # CRC-16/MODBUS in the catalogue of parametrised CRC algorithms
        (b"", 0xFFFF),
        (bytes.fromhex("01 04 00 01 00 05"), 0xC961),  # ERMAN, E1: 61 C9 on the wire
        (bytes.fromhex("01 06 20 01 13 88"), 0x9CDE),  # INNOVERT IBD, appendix 2
        (bytes.fromhex("01 03 01 F4 00 01"), 0x04C4),  # Delixi, part 2
        (bytes.fromhex("02 07"), 0x1241),  # serial-line guide V1.02, 6.2.2
    ],
)
def test_crc16(data: bytes, checksum: int) -> None:
    assert crc(data) == checksum


@table(
    ("data", "checksum"),
    [
        (b"", 0),
        (bytes.fromhex("01 06 20 01 13 88"), 0x3D),  # INNOVERT IBD, appendix 2
        (bytes.fromhex("01 03 01 F4 00 01"), 0x06),  # Delixi, part 2
        (bytes.fromhex("01 03 02 13 88"), 0x5F),
    ],
)
def test_lrc(data: bytes, checksum: int) -> None:
    assert lrc(data, len(data)) == checksum


@table(
    ("data", "checksum"),
    [
        (b"", 0),
        (bytes.fromhex("01 02 00 02 00 00 00 00"), 0x05),  # Delixi, part 3, examples 1-4
        (bytes.fromhex("01 04 00 01 00 00 13 88"), 0xA1),
        (bytes.fromhex("01 06 00 02 00 00 13 88"), 0xA4),
        (bytes.fromhex("01 07 01 F4 00 00 13 88"), 0x98),
    ],
)
def test_delixi_s_sum(data: bytes, checksum: int) -> None:
    assert sum8(data, len(data)) == checksum


@table("at", range(4))
@table("more", range(4))
def test_crc16_is_what_is_defined_bit_by_bit(at: int, more: int) -> None:
    """Every byte value at every place among the four that are taken at once, and single ones behind."""
    for byte in range(256):
        data = bytes(at) + bytes([byte]) + bytes(3 - at) + bytes([byte] * more)
        assert data + crc(data).to_bytes(2, "little") == checksums.rtu(data)


frames = st.binary(min_size=1, max_size=255)


@settings(deadline=None)
@given(frames)
def test_nothing_is_left_of_a_sealed_frame(data: bytes) -> None:
    assert crc(data + crc(data).to_bytes(2, "little")) == 0
    assert sum8(data + bytes([lrc(data, len(data))]), len(data) + 1) == 0


@settings(deadline=None)
@given(frames, st.data())
def test_every_single_wrong_bit_shows(data: bytes, more: st.DataObject) -> None:
    bit = more.draw(st.integers(0, 8 * len(data) - 1))
    wrong = bytearray(data)
    wrong[bit // 8] ^= 1 << bit % 8
    for checksum in (crc16, lrc, sum8):
        assert checksum(bytes(wrong), len(wrong)) != checksum(data, len(data))


@settings(deadline=None)
@given(frames, st.data())
def test_crc_sees_every_burst_of_up_to_16_bits(data: bytes, more: st.DataObject) -> None:
    burst = more.draw(st.integers(1, 0xFFFF))
    at = more.draw(st.integers(0, max(0, 8 * len(data) - 16)))
    wrong = int.from_bytes(data, "little") ^ burst << at
    if wrong < 1 << 8 * len(data):
        assert crc(wrong.to_bytes(len(data), "little")) != crc(data)
