"""Modbus TCP: frames from documents and from pymodbus, and exchanges on a simulated clock."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator
from dataclasses import replace
from random import Random

import pytest
from frames import words
from hypothesis import given
from hypothesis import strategies as st
from judges import Pymodbus, frames
from line_driver import CHARACTER, LEAST, MOST, MS, READ, WRITE, LineDriver
from line_driver import exchange as over_rtu
from tables import table

from multidrop.core import (
    Exchange,
    Failure,
    FrameFault,
    Framing,
    Message,
    Peer,
    Port,
    TransactionIds,
    build_reply,
    build_request,
    parse_reply,
    parse_request,
    reply_length,
)

TCP = Framing.TCP
NUMBER = 400  # random frames
EXCEPTION = 9  # bytes of an exception frame, whatever its header states

# As printed: in the messaging guide for TCP/IP V1.0b, 4.4.2 (read one register of unit FF), and in a panel
# meter's manual (write one register, and its reply).
GUIDE = "15 01 00 00 00 06 FF 03 00 04 00 01"
METER = "01 00 00 00 00 09 01 10 05 15 00 01 02 00 08", "01 00 00 00 00 06 01 10 05 15 00 01"


def tcp(transaction: int, body: bytes) -> bytes:
    """Return a Modbus TCP frame, built without the library."""
    return transaction.to_bytes(2) + b"\0\0" + len(body).to_bytes(2) + body


def test_tcp_frames_printed_in_manuals_are_built_and_parsed() -> None:
    read = Message(0xFF, 3, 4, 1, transaction=0x1501)
    assert build_request(TCP, read) == bytes.fromhex(GUIDE)
    assert parse_request(TCP, bytes.fromhex(GUIDE)) == (12, read)
    asked, said = map(bytes.fromhex, METER)
    write = Message(1, 0x10, 0x0515, 1, words(8), transaction=0x0100)
    assert build_request(TCP, write) == asked
    assert parse_request(TCP, asked) == (len(asked), write)
    assert parse_reply(TCP, said, write) == (12, replace(write, data=b""))


@table("replies", [False, True])
def test_a_tcp_frame_is_parsed_like_the_rtu_frame_with_the_same_body(replies: bool) -> None:
    """Whole and damaged frames are tested. Only a wrong length is found earlier, by the TCP header."""
    seen = set()
    for number, said in enumerate(frames(11, Framing.RTU, NUMBER, replies=replies)):
        if said.damage in ("flipped on the line", "cut off", "followed") or len(said.frame) < 4:
            continue
        frame = tcp(number, said.frame[:-2])
        if replies:
            (network, found), (serial, meant) = (
                parse_reply(TCP, frame, said.request),
                parse_reply(Framing.RTU, said.frame, said.request),
            )
        else:
            network, found = parse_request(TCP, frame)
            serial, meant = parse_request(Framing.RTU, said.frame)
        seen.add(serial > 0)
        if meant and serial == len(said.frame):
            assert found == replace(meant, transaction=number)
            assert network == len(frame)
        elif serial in (FrameFault.INCOMPLETE, FrameFault.BAD_CHECKSUM) or serial > 0:
            is_exception = replies and frame[6:8] == bytes(
                [said.request.address, said.request.function | 0x80]
            )
            assert network == (EXCEPTION if is_exception else FrameFault.BAD_LENGTH)
        else:
            assert network == serial
    assert seen == {True, False}


@table("replies", [False, True])
def test_tcp_frames_equal_pymodbus_frames(replies: bool) -> None:
    pymodbus, chance, count = Pymodbus(TCP), Random(12), 0
    for said in frames(13, Framing.RTU, NUMBER, replies=replies):
        request = replace(said.request, transaction=chance.randrange(1 << 16))
        if not replies and request.address:
            assert build_request(TCP, request) == pymodbus.build_request(request)
            count += 1
        if replies and not said.damage:
            reply = parse_reply(Framing.RTU, said.frame, said.request)[1]
            assert reply
            reply = replace(reply, transaction=request.transaction)
            assert build_reply(TCP, reply) == pymodbus.build_reply(reply)
            count += 1
    assert count > NUMBER / 5


@table("unit", [0, 1, 247, 248, 255])
def test_requests_and_replies_may_have_any_unit_id(unit: int) -> None:
    for request in (Message(unit, 3, 0, 2), Message(unit, 6, 1, data=words(2))):
        assert parse_request(TCP, build_request(TCP, request)) == (12, request)
        reply = replace(request, data=request.data or words(3, 4))
        assert parse_reply(TCP, build_reply(TCP, reply), request)[1] == reply
        assert reply_length(TCP, request) == len(build_reply(TCP, reply))


def test_the_longest_tcp_frame_is_built_and_parsed() -> None:
    request = Message(1, 3, 0, 125)
    reply = build_reply(TCP, replace(request, data=bytes(250)))
    assert len(reply) == 259
    assert parse_reply(TCP, reply, request)[0] == 259


@table(
    ("damaged", "fault"),
    [
        ("00 00 00 01 00 05 01 03 02 00 07", FrameFault.NO_START),  # protocol 1
        ("00 00 00 00 00 01 01 03", FrameFault.NO_START),
        ("00 00 00 00 00 FF 01 03", FrameFault.NO_START),
        ("00 00 00 00 00 06 01 03 02 00 07 00", FrameFault.BAD_LENGTH),
        ("00 00 00 00 00 04 01 03 02 00", FrameFault.BAD_LENGTH),
        ("00 00 00 00 00 05 02 03 02 00 07", FrameFault.BAD_ADDRESS),
        ("00 00 00 00 00 05 01 04 02 00 07", FrameFault.BAD_FUNCTION),
        ("00 00 00 00 00 05 01 03 02 00", FrameFault.INCOMPLETE),
        ("00 00 00 00 00 01 01", FrameFault.INCOMPLETE),  # may be the start of an exception
        ("00 00 00", FrameFault.INCOMPLETE),
    ],
)
def test_a_damaged_tcp_reply_has_the_expected_fault(damaged: str, fault: FrameFault) -> None:
    assert parse_reply(TCP, bytes.fromhex(damaged), READ) == (fault, None)


@pytest.fixture
def line() -> LineDriver:
    return LineDriver(TransactionIds.MATCH)


@pytest.fixture
def drive() -> Peer:
    return Peer(least_timeout=LEAST / 1e9, most_timeout=MOST / 1e9)


def exchange(request: Message, drive: Peer) -> Exchange:
    return Exchange(TCP, request, drive, baudrate=9600, format="8N1", character=CHARACTER / 1e9, silence=0.0)


def ask(line: LineDriver, drive: Peer, request: Message = READ) -> int:
    """Send a request; return its transaction id."""
    line.begin(exchange(request, drive))
    sent = line.wait_until_write()
    assert parse_request(TCP, sent)[1] == replace(request, transaction=int.from_bytes(sent[:2]))
    return int.from_bytes(sent[:2])


def value(transaction: int, raw: int) -> bytes:
    return tcp(transaction, bytes([1, 3, 2]) + words(raw))


def miss(line: LineDriver, drive: Peer) -> int:
    transaction = ask(line, drive)
    line.wait_until_done()
    assert line.completion.result == Failure.NO_REPLY
    return transaction


def test_each_request_has_a_new_transaction_id(line: LineDriver, drive: Peer) -> None:
    seen = set()
    for raw in range(300):
        transaction = ask(line, drive)
        seen.add(transaction)
        assert line.data_after(value(transaction, raw)) == words(raw)
    assert len(seen) == 300


def test_modbus_tcp_has_no_silence_between_frames(line: LineDriver, drive: Peer) -> None:
    for _ in range(3):
        began = line.now
        line.receive(value(ask(line, drive), 7))
        assert line.want == "done"
        assert line.now == began


@pytest.mark.parametrize("piece", [1, 2, 5, 7, 4096])
def test_a_modbus_tcp_reply_may_come_in_pieces(line: LineDriver, drive: Peer, piece: int) -> None:
    assert line.data_after(value(ask(line, drive), 7), piece) == words(7)


@pytest.mark.parametrize("cut", range(1, 11))
def test_late_rest_of_an_incomplete_reply_is_skipped(line: LineDriver, drive: Peer, cut: int) -> None:
    late = value(ask(line, drive), 1)
    line.receive(late[:cut])
    line.wait_until_done()
    assert line.completion.result == (Failure.CUT_SHORT if cut > 1 else Failure.NO_REPLY)
    own = ask(line, drive)
    line.receive(late[cut:] + value(own, 2))
    assert line.completion.reply.data == words(2)


def test_late_doubled_and_foreign_replies_are_never_accepted(line: LineDriver, drive: Peer) -> None:
    late = miss(line, drive)
    own = ask(line, drive)
    line.receive(value(late, 1) + value(late, 1) + value((own + 1) & 0xFFFF, 2))
    assert line.want == "read"
    assert line.data_after(value(own, 3) + value(own, 4)) == words(3)
    assert drive.late == 1
    own = ask(line, drive)
    assert line.completion.stale == 0
    line.receive(value(own, 5))
    assert line.completion.reply.data == words(5)


def test_each_request_gets_its_own_reply_in_any_order(drive: Peer) -> None:
    for seed in range(200):
        chance, line = Random(seed), LineDriver(TransactionIds.MATCH)
        missed = [miss(line, drive) for _ in range(chance.randrange(5))]
        own = ask(line, drive)
        came = [value(each, 1000 + at) for at, each in enumerate(missed)] * 2 + [value(own, 7)] * 2
        chance.shuffle(came)
        assert line.data_after(b"".join(came), chance.choice([1, 3, 17, 4096])) == words(7)


def test_a_tcp_request_is_sent_immediately_after_a_missing_reply(line: LineDriver, drive: Peer) -> None:
    for request in (READ, WRITE, WRITE):
        ask(line, drive, request)
        line.wait_until_done()
        assert line.completion.sent_ns
        assert line.completion.result == Failure.NO_REPLY
    assert drive.late_until_ns == 0


def test_the_timeout_adapts_to_the_delay_of_a_late_tcp_reply(line: LineDriver, drive: Peer) -> None:
    late = miss(line, drive)
    sent = line.completion.sent_ns + 8 * CHARACTER  # end of the request on the gateway's serial line
    for _ in range(30):
        miss(line, drive)
    line.now = sent + 2000 * MS
    assert drive.failures == 31
    line.receive(value(late, 1))
    assert drive.failures == 0
    assert drive.timeout == pytest.approx(3.0)


@pytest.mark.parametrize("code", [0x0A, 0x0B])
def test_exception_sent_by_a_gateway_counts_as_no_reply(line: LineDriver, drive: Peer, code: int) -> None:
    for number in (1, 2):
        line.receive(tcp(ask(line, drive), bytes([1, 0x83, code])))
        assert (line.want, line.completion.result) == ("done", Failure.NO_REPLY)
        assert line.completion.raw[-1] == code
        assert drive.failures == number
    assert not drive.has_answered
    line.receive(tcp(ask(line, drive), bytes([1, 0x83, 2])))
    assert line.completion.reply.exception == 2
    assert drive.failures == 0


def test_an_exception_from_the_gateway_is_not_the_drives_late_reply(line: LineDriver, drive: Peer) -> None:
    late = miss(line, drive)
    line.receive(tcp(late, bytes([1, 0x83, 0x0B])))
    assert drive.failures == 1
    assert drive.late == 0


@pytest.mark.parametrize(
    ("body", "result"),
    [
        (bytes([2, 3, 2, 0, 7]), FrameFault.BAD_ADDRESS),
        (bytes([1, 4, 2, 0, 7]), FrameFault.BAD_FUNCTION),
        (bytes([1, 3, 4, 0, 7, 0, 7]), FrameFault.BAD_LENGTH),
        (bytes([1, 3, 2, 0, 7, 0]), FrameFault.BAD_LENGTH),
    ],
)
def test_an_exchange_ends_at_the_timeout_after_a_wrong_reply_with_the_right_id(
    line: LineDriver, drive: Peer, body: bytes, result: FrameFault
) -> None:
    transaction = ask(line, drive)
    line.receive(tcp(transaction, body))
    assert line.want == "read"
    line.wait_until_done()
    assert line.completion.result == result
    assert line.completion.raw == tcp(transaction, body)


def odd(transaction: int, body: bytes, length: int) -> bytes:
    """Return a frame whose header states another length."""
    return transaction.to_bytes(2) + b"\0\0" + length.to_bytes(2) + body


def is_read(line: LineDriver, drive: Peer, raw: int, piece: int = 4096) -> bool:
    line.receive(value(ask(line, drive), raw), piece)
    return line.want == "done" and line.completion.reply.data == words(raw)


@pytest.mark.parametrize("piece", [1, 4096])
@pytest.mark.parametrize("more", [b"", b"\0", b"\1\2\3"], ids=["short", "a byte more", "three bytes more"])
@pytest.mark.parametrize("length", [0, 1, 2, 4, 6, 9, 254, 255, 0xFFFF])
def test_exception_reply_is_read_despite_a_wrong_header_length(
    line: LineDriver, drive: Peer, length: int, more: bytes, piece: int
) -> None:
    assert is_read(line, drive, 1)
    line.receive(odd(ask(line, drive), bytes([1, 0x83, 3]) + more, length), piece)
    assert (line.want, line.completion.reply.exception) == ("done", 3)
    assert is_read(line, drive, 2, piece)
    assert not line.is_out_of_step


@pytest.mark.parametrize("piece", [1, 6, 4096])
@pytest.mark.parametrize("length", [0, 2, 4, 6, 12, 255])
def test_wrong_length_in_a_tcp_header_fails_only_one_exchange(
    line: LineDriver, drive: Peer, length: int, piece: int
) -> None:
    assert is_read(line, drive, 1)
    line.receive(odd(ask(line, drive), bytes([1, 3, 2]) + words(7), length), piece)
    line.wait_until_done()
    assert line.completion.result in (FrameFault.BAD_LENGTH, FrameFault.NO_START)
    assert is_read(line, drive, 2, max(piece, 6))
    assert is_read(line, drive, 3, piece)
    assert not line.is_out_of_step


@pytest.mark.parametrize("missing", range(1, 10))
@pytest.mark.parametrize("transactions", [TransactionIds.MATCH, TransactionIds.IGNORE])
def test_short_tcp_reply_fails_only_one_exchange(
    drive: Peer, missing: int, transactions: TransactionIds
) -> None:
    line = LineDriver(transactions)
    assert is_read(line, drive, 1)
    line.receive(value(ask(line, drive), 7)[:-missing])
    line.wait_until_done()
    assert line.completion.result == Failure.CUT_SHORT
    line.now += max(0, drive.late_until_ns - line.now)
    assert is_read(line, drive, 2)
    assert is_read(line, drive, 3)
    assert not line.is_out_of_step


def test_reply_frame_begun_before_the_request_is_skipped(line: LineDriver, drive: Peer) -> None:
    following = ask(line, drive) + 1
    line.receive(value(following - 1, 1))
    assert line.want == "done"
    line.receive(value(following, 7)[:8])
    assert ask(line, drive) == following
    line.receive(value(following, 7)[8:])
    assert line.listens
    assert line.data_after(value(following, 9)) == words(9)


def test_frames_sent_right_after_connecting_are_not_taken_for_replies(line: LineDriver, drive: Peer) -> None:
    """wills106/homeassistant-solax-modbus#2336: a registration and an exception with transaction id 1."""
    line.receive(tcp(1, b"\0\6ABCDEFGHIJ") + tcp(1, b"\0\x86\3"))
    assert is_read(line, drive, 7)


def test_an_incomplete_reply_fails_two_exchanges_if_bytes_come_singly(line: LineDriver, drive: Peer) -> None:
    assert is_read(line, drive, 1)
    line.receive(value(ask(line, drive), 7)[:-1])
    line.wait_until_done()
    assert not is_read(line, drive, 2, 1)
    line.wait_until_done()
    assert is_read(line, drive, 3, 1)


@pytest.mark.parametrize("piece", [1, 4096])
@pytest.mark.parametrize("noise", [b"\0", b"\xff\xff", bytes(30), b"\1\3\2\0\7\xf9\x86"])
def test_noise_after_good_replies_does_not_break_the_connection(
    line: LineDriver, drive: Peer, noise: bytes, piece: int
) -> None:
    for raw in range(5):
        assert is_read(line, drive, raw, piece)
        line.receive(noise, piece)
    assert not line.is_out_of_step


def test_a_copy_of_a_tcp_write_confirms_the_write(line: LineDriver, drive: Peer) -> None:
    transaction = ask(line, drive, WRITE)
    line.receive(tcp(transaction, build_request(TCP, WRITE)[6:]))
    assert line.want == "done"
    assert line.completion.reply == replace(WRITE, transaction=transaction)


@pytest.mark.parametrize(
    "header", ["00 01 00 01", "01 03 02 00 07 F9 86", "00 00 00 00 00 01", "3A 30 31 30"]
)
def test_connection_ends_if_the_tcp_header_is_invalid(line: LineDriver, drive: Peer, header: str) -> None:
    ask(line, drive)
    assert not line.is_out_of_step
    line.receive(bytes.fromhex(header))
    assert line.is_out_of_step
    line.lose(errno.EPROTO)
    assert (line.completion.result, line.completion.error) == (Failure.LINE_LOST, errno.EPROTO)
    assert line.completion.raw


def test_a_request_of_another_framing_is_not_sent_on_a_tcp_port(line: LineDriver, drive: Peer) -> None:
    line.begin(over_rtu(READ, drive))
    assert (line.want, line.completion.result) == ("done", FrameFault.BAD_REQUEST)
    serial = LineDriver()
    serial.begin(exchange(READ, drive))
    assert (serial.want, serial.completion.result) == ("done", FrameFault.BAD_REQUEST)


def test_memory_stays_limited_while_endless_foreign_frames_arrive(line: LineDriver, drive: Peer) -> None:
    transaction = ask(line, drive)
    for foreign in (transaction ^ 1, transaction):
        line.receive(tcp(foreign, bytes([9]) + bytes(250)) * 50)
    line.receive(value(transaction, 7))
    assert line.completion.reply.data == words(7)


@given(st.lists(st.binary(max_size=40), max_size=20), st.sampled_from(TransactionIds))
def test_every_exchange_ends_whatever_bytes_come(pieces: list[bytes], transactions: TransactionIds) -> None:
    line, drive = LineDriver(transactions), Peer(least_timeout=LEAST / 1e9, most_timeout=MOST / 1e9)
    for piece in pieces:
        line.begin(exchange(READ, drive))
        line.receive(piece[::2])
        if line.is_out_of_step:
            return
        if line.want != "done":
            line.wait_until_write()
        line.receive(piece)
        if line.is_out_of_step:
            return
        line.wait_until_done()


@pytest.fixture
def gateway() -> LineDriver:
    return LineDriver(TransactionIds.IGNORE)


def test_a_reply_with_another_id_is_accepted_if_transaction_ids_are_ignored(
    gateway: LineDriver, drive: Peer
) -> None:
    for raw in range(10):
        line = gateway
        assert line.data_after(value((ask(line, drive) + 1) & 0xFFFF, raw)) == words(raw)


def test_a_late_reply_delays_a_request_if_transaction_ids_are_ignored(
    gateway: LineDriver, drive: Peer
) -> None:
    miss(gateway, drive)
    gateway.begin(exchange(READ, drive))
    assert gateway.completion.result == Failure.LATE_ANSWER_DUE
    assert drive.late_until_ns > gateway.now
    gateway.receive(value(1, 1))
    assert drive.late == 1
    assert drive.late_until_ns == 0
    gateway.receive(value(ask(gateway, drive), 2))
    assert gateway.completion.reply.data == words(2)


def test_a_late_reply_may_follow_an_exception_if_transaction_ids_are_ignored(
    gateway: LineDriver, drive: Peer
) -> None:
    gateway.receive(tcp(ask(gateway, drive), bytes([1, 0x83, 0x0B])))
    assert gateway.completion.result == Failure.NO_REPLY
    assert drive.late_until_ns > gateway.now


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    theirs.settimeout(60)
    with ours, theirs:
        yield ours, theirs


def test_a_tcp_connection_is_lost_if_bytes_of_another_protocol_arrive(
    ends: tuple[socket.socket, socket.socket], drive: Peer
) -> None:
    ours, theirs = ends
    port = Port(ours.fileno(), -1, transactions=TransactionIds.MATCH)
    try:
        theirs.send(bytes.fromhex("01 03 02 00 07 F9 86"))
        found = port.carry_out(exchange(READ, drive))
        while found.result != Failure.LINE_LOST:  # requests may be sent before the bytes are read
            found = port.carry_out(exchange(READ, drive))
        assert found.error == errno.EPROTO, os.strerror(found.error)
        assert port.lost
    finally:
        port.close()
