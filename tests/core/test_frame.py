"""Frames: all frames printed in the documents, and wrong replies that other libraries accept."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import product

import checksums
import pytest
from frames import PRINTED, Printed, words
from hypothesis import given, settings
from hypothesis import strategies as st
from line_driver import LineDriver
from multidrop._core import lib
from tables import table

from multidrop.core import (
    Completion,
    Exchange,
    FrameFault,
    Framing,
    Message,
    Peer,
    build_reply,
    build_request,
    crc16,
    lrc,
    parse_reply,
    parse_request,
    reply_length,
    sum8,
)

RTU, ASCII, DELIXI = Framing.RTU, Framing.ASCII, Framing.DELIXI

GOOD_REQUESTS = [each for each in PRINTED if each.direction == "request" and each.verdict != "bad checksum"]
GOOD_REPLIES = [each for each in PRINTED if each.direction == "reply" and isinstance(each.says, Message)]
REFUSED = [each for each in PRINTED if isinstance(each.says, FrameFault)]
# The manual of the ER-G-220 prints this reply with 89H instead of 88H. It is accepted, but simulators never
# send it.
MISPRINTED = "01 89 01 86 50"


def parse(printed: Printed, received: bytes) -> tuple[int, Message | None]:
    if printed.direction == "request":
        return parse_request(printed.framing, received)
    assert printed.request is not None
    return parse_reply(printed.framing, received, printed.request)


def exchange(framing: Framing, request: Message) -> Exchange:
    return Exchange(
        framing,
        request,
        Peer(least_timeout=0.1, most_timeout=0.1),
        baudrate=9600,
        format="8N1",
        character=1e-3,
        silence=4e-3,
        turnaround=0.2,
    )


def carry_out(framing: Framing, request: Message, received: bytes, piece: int = 4096) -> Completion:
    """Return the result of a request that is followed by these bytes, through an adapter without echo."""
    line = LineDriver()
    line.echo = lib.MD_NO_ECHO
    line.send(exchange(framing, request))
    line.receive(received, piece)
    line.wait_until_done()
    return line.completion


def test_all_frames_printed_in_manuals_are_tested() -> None:
    # 19 replies equal their requests
    assert len({(each.framing, each.direction, each.frame) for each in PRINTED}) == 49 + 19
    assert len(GOOD_REQUESTS) + len(GOOD_REPLIES) + len(REFUSED) == len(PRINTED)


def test_frames_from_manuals_are_parsed_as_documented() -> None:
    for printed in GOOD_REQUESTS + GOOD_REPLIES:
        assert parse(printed, printed.frame) == (len(printed.frame), printed.says)


def test_a_request_is_built_as_documented() -> None:
    for printed in GOOD_REQUESTS:
        assert isinstance(printed.says, Message)
        assert build_request(printed.framing, printed.says) == printed.frame


def test_a_reply_is_built_as_documented() -> None:
    for printed in (reply for reply in GOOD_REPLIES if reply.text != MISPRINTED):
        assert isinstance(printed.says, Message)
        assert build_reply(printed.framing, printed.says) == printed.frame


def test_misprinted_function_89h_is_accepted_but_never_sent() -> None:
    refusal = Message(1, 0x08, exception=1)
    request = Message(1, 0x08, 0, data=words(0xA537))
    assert parse_reply(RTU, bytes.fromhex(MISPRINTED), request) == (5, refusal)
    assert build_reply(RTU, refusal) == bytes.fromhex("01 88 01 87 C0")
    # in a reply to function 03, 89H is a wrong function
    assert parse_reply(RTU, bytes.fromhex(MISPRINTED), Message(1, 0x03, 0, 1))[0] == FrameFault.BAD_FUNCTION


def test_a_frame_misprinted_in_a_manual_has_the_expected_fault() -> None:
    for printed in REFUSED:
        assert parse(printed, printed.frame) == (printed.says, None)


def test_a_part_of_a_frame_is_parsed_as_incomplete() -> None:
    for printed in GOOD_REQUESTS + GOOD_REPLIES:
        for length in range(len(printed.frame)):
            assert parse(printed, printed.frame[:length]) == (FrameFault.INCOMPLETE, None)


def test_bytes_after_a_frame_are_ignored() -> None:
    for printed in GOOD_REQUESTS + GOOD_REPLIES:
        for after in (b"\x00", b":", b"\x01\x03\x02", b"\xff" * 300):
            assert parse(printed, printed.frame + after) == (len(printed.frame), printed.says)


def test_a_reply_is_found_after_junk() -> None:
    """The reply comes whole, or byte by byte."""
    for printed in GOOD_REPLIES:
        assert printed.request is not None
        for before, piece in product((b"", b"\x00", b"\x01", b":01", b"\xff\x00" * 40), (4096, 1)):
            found = carry_out(printed.framing, printed.request, before + printed.frame, piece)
            assert (found.result, found.skipped) == (len(printed.frame), len(before))
            assert (found.raw, found.reply) == (printed.frame, printed.says)


def test_reply_is_found_after_an_incomplete_ascii_frame() -> None:
    found = carry_out(ASCII, WRITE_ONE, b":010600" + b":010600101234A3\r\n")
    assert (found.result, found.skipped) == (17, 7)


def test_reply_length_returns_the_length_of_a_good_reply() -> None:
    for printed in GOOD_REPLIES:
        assert printed.request is not None
        assert isinstance(printed.says, Message)
        if not printed.says.exception:
            assert reply_length(printed.framing, printed.request) == len(printed.frame)


@table(("framing", "finish"), [(RTU, checksums.rtu), (ASCII, checksums.ascii)])
def test_longest_possible_reply_is_parsed(framing: Framing, finish: Callable[[str], bytes]) -> None:
    data = bytes(range(250))
    frame = finish(f"0103FA{data.hex().upper()}")
    used, reply = parse_reply(framing, frame, Message(1, 0x03, 0, 125))
    assert (used, reply and reply.data) == (len(frame), data)
    assert parse_reply(framing, frame[:-1], Message(1, 0x03, 0, 125)) == (FrameFault.INCOMPLETE, None)


def rtu(text: str) -> bytes:
    body = bytes.fromhex(text)
    checksum: int = crc16(body, len(body))
    return body + checksum.to_bytes(2, "little")


READ_TWO = Message(1, 0x03, 0, 2)
WRITE_COIL = Message(1, 0x05, 3, data=words(0xFF00))
WRITE_ONE = Message(1, 0x06, 0x10, data=words(0x1234))
WRITE_TWO = Message(1, 0x10, 0x10, 2, words(1, 2))
LOOPBACK = Message(1, 0x08, 0, data=words(0xA537))
RUN_FORWARD = Message(1, 2, 2, data=words(0, 0))
STORE_50_HZ = Message(1, 6, 2, data=words(0, 5000))
ASK_FREQUENCY = Message(1, 7, 500, data=words(0, 0))
ASK_STATE = Message(1, 3, 0, data=words(0, 0))

WRONG = [
    # pymodbus, modbus-tk and uModbus accept a reply with another function
    ("input for holding registers", RTU, READ_TWO, rtu("01 04 04 11 11 22 22"), FrameFault.BAD_FUNCTION),
    ("one input register for two others", RTU, READ_TWO, rtu("01 04 02 11 11"), FrameFault.BAD_FUNCTION),
    ("coils for registers", RTU, READ_TWO, rtu("01 01 04 11 11 22 22"), FrameFault.BAD_FUNCTION),
    ("exception to another function", RTU, READ_TWO, rtu("01 84 02"), FrameFault.BAD_FUNCTION),
    ("exception without a code", RTU, READ_TWO, rtu("01 83 00"), FrameFault.BAD_FUNCTION),
    # pymodbus accepts another number of registers
    ("one register for two", RTU, READ_TWO, rtu("01 03 02 11 11"), FrameFault.BAD_LENGTH),
    ("three registers for two", RTU, READ_TWO, rtu("01 03 06 11 11 22 22 33 33"), FrameFault.BAD_LENGTH),
    ("half a register more", RTU, READ_TWO, rtu("01 03 05 11 11 22 22 33"), FrameFault.BAD_LENGTH),
    ("no register", RTU, READ_TWO, rtu("01 03 00"), FrameFault.BAD_LENGTH),
    ("16 coils for 8", RTU, Message(1, 0x01, 0, 8), rtu("01 01 02 FF FF"), FrameFault.BAD_LENGTH),
    # Confirmations of writes, functions 05, 06 and 10H. If the value differs, pymodbus and libmodbus accept
    # them. If the address differs, libmodbus still accepts them.
    ("coil confirmed off that was set on", RTU, WRITE_COIL, rtu("01 05 00 03 00 00"), FrameFault.BAD_ECHO),
    ("another coil confirmed", RTU, WRITE_COIL, rtu("01 05 00 04 FF 00"), FrameFault.BAD_ECHO),
    ("another value confirmed", RTU, WRITE_ONE, rtu("01 06 00 10 12 35"), FrameFault.BAD_ECHO),
    ("another register confirmed", RTU, WRITE_ONE, rtu("01 06 00 11 12 34"), FrameFault.BAD_ECHO),
    ("another start confirmed", RTU, WRITE_TWO, rtu("01 10 00 11 00 02"), FrameFault.BAD_ECHO),
    ("fewer registers confirmed", RTU, WRITE_TWO, rtu("01 10 00 10 00 01"), FrameFault.BAD_ECHO),
    ("another loopback", RTU, LOOPBACK, rtu("01 08 00 00 A5 38"), FrameFault.BAD_ECHO),
    # Late replies with another function, address or length are rejected. A late reply in which all three fit
    # cannot be recognised by its bytes.
    ("late, to a longer read", RTU, READ_TWO, rtu("01 03 08 00 00 00 00 00 00 00 00"), FrameFault.BAD_LENGTH),
    ("late, to a write", RTU, READ_TWO, rtu("01 06 00 10 12 34"), FrameFault.BAD_FUNCTION),
    ("late, of the drive before", RTU, READ_TWO, rtu("02 03 04 11 11 22 22"), FrameFault.BAD_ADDRESS),
    ("broadcast as a reply", RTU, READ_TWO, rtu("00 03 04 11 11 22 22"), FrameFault.BAD_ADDRESS),
    ("wrong checksum", RTU, READ_TWO, bytes.fromhex("0103041111222200 00"), FrameFault.BAD_CHECKSUM),
    # text framings: ASCII and Delixi
    ("another value as text", ASCII, WRITE_ONE, b":010600101235A2\r\n", FrameFault.BAD_ECHO),
    ("wrong checksum as text", ASCII, WRITE_ONE, b":010600101234A4\r\n", FrameFault.BAD_CHECKSUM),
    ("Delixi's sum for the checksum", ASCII, WRITE_ONE, b":0106001012345D\r\n", FrameFault.BAD_CHECKSUM),
    ("lower case", ASCII, WRITE_ONE, b":010600101234a3\r\n", FrameFault.BAD_CHARACTER),
    ("no line end", ASCII, WRITE_ONE, b":010600101234A3\n\r", FrameFault.BAD_CHARACTER),
    # Delixi's own protocol
    ("run command confirmed as stop", DELIXI, RUN_FORWARD, b":010200010000000004\r\n", FrameFault.BAD_ECHO),
    ("another value stored", DELIXI, STORE_50_HZ, b":0106000200001389A5\r\n", FrameFault.BAD_ECHO),
    ("another parameter's value", DELIXI, ASK_FREQUENCY, b":010701F50000138899\r\n", FrameFault.BAD_ECHO),
    ("setting for query", DELIXI, ASK_FREQUENCY, b":010601F40000138897\r\n", FrameFault.BAD_FUNCTION),
    ("a state with a value", DELIXI, ASK_STATE, b":010300020000000107\r\n", FrameFault.BAD_ECHO),
    ("a refusal that is none", DELIXI, RUN_FORWARD, b":01F1000000000000F2\r\n", FrameFault.BAD_FUNCTION),
]


@table(
    ("framing", "request_", "received", "reason"),
    [each[1:] for each in WRONG],
    ids=[each[0] for each in WRONG],
)
def test_the_result_of_a_wrong_reply_has_a_fault_and_no_data(
    framing: Framing, request_: Message, received: bytes, reason: FrameFault
) -> None:
    assert parse_reply(framing, received, request_) == (reason, None)
    for piece in (4096, 1):
        found = carry_out(framing, request_, received, piece)
        assert (found.result, found.raw, found.skipped) == (reason, received, len(received))
        assert found.reply == Message(0, 0)


def test_values_are_read_despite_a_stray_zero_before_each_reply() -> None:
    line = LineDriver()
    for value in range(30):
        line.send(exchange(RTU, READ_TWO))
        line.receive(b"\x00" + rtu(f"01 03 04 {value:04X} 00 00"))
        line.wait_until_done()
        assert line.completion.reply.data == words(value, 0)
        assert (line.completion.result, line.completion.skipped, line.completion.stale) == (9, 1, 0)


@table("code", [0xF0, 0xFC, 0xFD, 0xFE, 0xFF])
def test_refusal_codes_of_the_delixi_protocol_are_returned_as_exceptions(code: int) -> None:
    frame = build_reply(DELIXI, Message(1, RUN_FORWARD.function, exception=code))
    assert parse_reply(DELIXI, frame, RUN_FORWARD) == (21, Message(1, 2, exception=code))
    assert parse_request(DELIXI, frame) == (FrameFault.BAD_FUNCTION, None)  # only drives send a refusal


def test_state_of_a_delixi_drive_is_read_from_the_parameter_field() -> None:
    used, reply = parse_reply(DELIXI, b":010300020000000006\r\n", ASK_STATE)
    assert (used, reply) == (21, Message(1, 3, 2, data=words(0, 2)))


# Frames of the application protocol V1.1b3, 6.7, 6.13 and 6.21.
IDENTITY = b"\x0e\x01\x01\x00\x00\x02\x00\x03ABB\x01\x02X1"  # two objects: maker and product


@table(
    ("function", "asked", "request", "data", "reply"),
    [
        (0x07, b"", "01 07", b"\x6d", "01 07 6D"),
        (0x11, b"", "01 11", b"\x09\xffVFD", "01 11 05 09 FF 56 46 44"),
        (0x2B, b"\x0e\x01\x00", "01 2B 0E 01 00", IDENTITY, f"01 2B {IDENTITY.hex()}"),
    ],
)
def test_read_functions_without_register_addresses_are_supported(
    function: int, asked: bytes, request: str, data: bytes, reply: str
) -> None:
    message = Message(1, function, data=asked)
    assert build_request(RTU, message) == rtu(request)
    assert parse_request(RTU, rtu(request)) == (len(rtu(request)), message)
    assert parse_reply(RTU, rtu(reply), message) == (len(rtu(reply)), Message(1, function, data=data))
    assert build_reply(RTU, Message(1, function, data=data)) == rtu(reply)
    for length in range(len(rtu(reply))):
        assert parse_reply(RTU, rtu(reply)[:length], message) == (FrameFault.INCOMPLETE, None)


def test_identification_reply_with_wrong_code_or_length_is_refused() -> None:
    message = Message(1, 0x2B, data=b"\x0e\x01\x00")
    other_code = bytes([*IDENTITY[:1], 2, *IDENTITY[2:]])
    assert parse_reply(RTU, rtu(f"01 2B {other_code.hex()}"), message) == (FrameFault.BAD_ECHO, None)
    long = bytes([0x0E, 1, 1, 0, 0, 1, 0, 243])
    assert parse_reply(RTU, rtu(f"01 2B {long.hex()}"), message) == (FrameFault.BAD_LENGTH, None)


# Frames of the application protocol V1.1b3, 6.8 to 6.10, 6.16 and 6.18.
MASK = Message(0x11, 0x16, 0x0004, data=b"\x00\xf2\x00\x25")


@table("framing", [RTU, ASCII, Framing.TCP])
def test_a_mask_write_and_its_confirmation_are_the_same_frame(framing: Framing) -> None:
    frame = build_request(framing, MASK)
    if framing is RTU:
        assert frame == rtu("11 16 00 04 00 F2 00 25")
    assert parse_request(framing, frame) == (len(frame), MASK)
    assert parse_reply(framing, frame, MASK) == (len(frame), MASK)
    other = Message(0x11, 0x16, 0x0004, data=b"\x00\xf2\x00\x24")
    assert parse_reply(framing, frame, other) == (FrameFault.BAD_ECHO, None)


@table(
    ("request", "sent", "reply", "data"),
    [
        (Message(1, 0x08, 0x000B, data=b"\0\0"), "01 08 00 0B 00 00", "01 08 00 0B 01 08", b"\x01\x08"),
        (Message(1, 0x0B), "01 0B", "01 0B FF FF 01 08", b"\xff\xff\x01\x08"),
        (Message(1, 0x0C), "01 0C", "01 0C 08 00 00 01 08 01 21 20 00", b"\0\0\x01\x08\x01\x21\x20\0"),
        (Message(1, 0x18, 0x04DE), "01 18 04 DE", "01 18 00 04 00 01 01 B8", b"\0\x04\0\x01\x01\xb8"),
    ],
)
def test_replies_with_event_counters_logs_or_fifo_queues_are_parsed(
    request: Message, sent: str, reply: str, data: bytes
) -> None:
    assert build_request(RTU, request) == rtu(sent)
    length, found = parse_reply(RTU, rtu(reply), request)
    assert (length, found and found.data) == (len(rtu(reply)), data)
    for end in range(len(rtu(reply))):
        assert parse_reply(RTU, rtu(reply)[:end], request) == (FrameFault.INCOMPLETE, None)


@table(
    "message",
    [
        Message(1, 0x03, 0, 126),
        Message(1, 0x03, 0xFFFF, 2),
        Message(1, 0x03, 0, 0),
        Message(0, 0x03, 0, 1),
        Message(248, 0x03, 0, 1),
        Message(1, 0x05, 0, data=b"\x01\x00"),
        Message(1, 0x06, 0, data=b"\x01"),
        Message(1, 0x10, 0, 2, b"\x00" * 5),
        Message(1, 0x42, 0, 1),
        Message(1, 0x11, data=b"\0"),
        Message(1, 0x2B, data=b"\x0d\0\0"),
    ],
)
def test_a_request_with_a_field_out_of_bounds_raises(message: Message) -> None:
    with pytest.raises(ValueError, match=re.escape(f"out of bounds for a rtu frame: {message}")):
        build_request(RTU, message)
    with pytest.raises(ValueError, match="out of bounds for a rtu frame"):
        exchange(RTU, message)


def test_an_address_of_247_is_accepted_and_248_is_refused() -> None:
    reply = Message(247, 0x03, data=words(7))
    assert build_reply(RTU, reply) == checksums.rtu("F7 03 02 00 07")
    with pytest.raises(ValueError, match="out of bounds for a rtu frame"):
        build_reply(RTU, Message(248, 0x03, data=words(7)))


@table("function", [0x00, 0x09, 0x42, 0xFF])
def test_building_a_reply_with_an_unknown_function_raises(function: int) -> None:
    reply = Message(1, function, data=words(7))
    with pytest.raises(ValueError, match=re.escape(f"out of bounds for a rtu frame: {reply}")):
        build_reply(RTU, reply)


def test_a_request_with_251_data_bytes_raises() -> None:
    with pytest.raises(ValueError, match="a frame holds at most 250 data bytes, not 251"):
        build_request(RTU, Message(1, 0x10, 0, 123, bytes(251)))


@table("count", [0, 126, 127, 128, 0xFFFF])
def test_request_with_an_impossible_count_accepts_only_an_exception_reply(count: int) -> None:
    """A sniffed master may request any count, and an exception is a reply to that request too."""
    request = Message(1, 0x03, 0, count)
    data_len = 2 * count & 0xFF
    assert parse_reply(RTU, bytes([1, 3, data_len]) + bytes(300), request) == (FrameFault.BAD_LENGTH, None)
    assert parse_reply(RTU, rtu("01 83 03"), request) == (5, Message(1, 3, exception=3))


def test_a_request_with_an_impossible_count_is_parsed() -> None:
    frame = rtu("01 03 00 00 00 7E")
    assert parse_request(RTU, frame) == (8, Message(1, 0x03, 0, 126))


@table("function", [0x83, 0xFF, 0x42])
@table("framing", [RTU, ASCII])
def test_a_reply_to_an_unknown_function_has_the_fault_bad_function(framing: Framing, function: int) -> None:
    body = bytes([1, function, 1])
    frames = {
        RTU: rtu(body.hex()),
        ASCII: f":{(body + bytes([-sum(body) & 0xFF])).hex().upper()}\r\n".encode(),
    }
    assert parse_reply(framing, frames[framing], Message(1, function, 0, 1)) == (
        FrameFault.BAD_FUNCTION,
        None,
    )


@table("odd", [{"start": 10**400}, {"start": -1}, {"count": 1 << 16}, {"function": 300}])
def test_a_number_too_large_for_its_field_raises(odd: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="a field is out of bounds"):
        build_request(Framing.RTU, Message(**({"address": 1, "function": 3, "start": 0, "count": 1} | odd)))


@table("framing", [RTU, ASCII])
def test_the_reply_length_of_a_broadcast_is_0(framing: Framing) -> None:
    assert reply_length(framing, Message(0, 6, 0x2000, 1, data=b"\0\1")) == 0


CHECK = b"123456789"


def crc(data: bytes) -> int:
    checksum: int = crc16(data, len(data))
    return checksum


@table(
    ("data", "checksum"),
    [
        (CHECK, 0x4B37),  # CRC-16/MODBUS in the catalogue of parametrised CRC algorithms
        (b"", 0xFFFF),
        (bytes.fromhex("01 04 00 01 00 05"), 0xC961),  # manual of ERMAN ER-G-220; on the wire 61 C9
        (bytes.fromhex("01 06 20 01 13 88"), 0x9CDE),  # INNOVERT IBD, appendix 2
        (bytes.fromhex("01 03 01 F4 00 01"), 0x04C4),  # Delixi, part 2
        (bytes.fromhex("02 07"), 0x1241),  # serial-line guide V1.02, 6.2.2
    ],
)
def test_crc16_equals_published_checksums(data: bytes, checksum: int) -> None:
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
def test_lrc_equals_published_checksums(data: bytes, checksum: int) -> None:
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
def test_the_delixi_checksum_equals_those_in_its_manual(data: bytes, checksum: int) -> None:
    assert sum8(data, len(data)) == checksum


@table("at", range(4))
@table("more", range(4))
def test_crc16_equals_its_bitwise_definition(at: int, more: int) -> None:
    """Four bytes are processed at once. Every byte value is tested at each of the four places, and after."""
    for byte in range(256):
        data = bytes(at) + bytes([byte]) + bytes(3 - at) + bytes([byte] * more)
        assert data + crc(data).to_bytes(2, "little") == checksums.rtu(data)


frames = st.binary(min_size=1, max_size=255)


@settings(deadline=None)
@given(frames)
def test_a_checksum_over_a_frame_and_its_checksum_is_zero(data: bytes) -> None:
    assert crc(data + crc(data).to_bytes(2, "little")) == 0
    assert sum8(data + bytes([lrc(data, len(data))]), len(data) + 1) == 0


@settings(deadline=None)
@given(frames, st.data())
def test_every_single_bit_error_is_detected(data: bytes, more: st.DataObject) -> None:
    bit = more.draw(st.integers(0, 8 * len(data) - 1))
    wrong = bytearray(data)
    wrong[bit // 8] ^= 1 << bit % 8
    for checksum in (crc16, lrc, sum8):
        assert checksum(bytes(wrong), len(wrong)) != checksum(data, len(data))


@settings(deadline=None)
@given(frames, st.data())
def test_a_crc_detects_every_burst_of_up_to_16_bits(data: bytes, more: st.DataObject) -> None:
    burst = more.draw(st.integers(1, 0xFFFF))
    at = more.draw(st.integers(0, max(0, 8 * len(data) - 16)))
    wrong = int.from_bytes(data, "little") ^ burst << at
    if wrong < 1 << 8 * len(data):
        assert crc(wrong.to_bytes(len(data), "little")) != crc(data)
