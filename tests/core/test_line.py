"""One line's state machine, on a clock that the test sets: silence, request, reply or timeout."""

from __future__ import annotations

import errno
import random
import sys
from dataclasses import replace

import pytest
from frames import words
from line_driver import MS, LineDriver
from multidrop._core import lib
from tables import table

from multidrop.core import (
    Completion,
    Exchange,
    Failure,
    FrameFault,
    Framing,
    Message,
    Peer,
    build_reply,
    build_request,
    crc16,
)

CHARACTER = 1 * MS  # a request of 8 characters takes 8 ms
SILENCE = 4 * MS
TIMEOUT = 100 * MS
TURNAROUND = 200 * MS
ETIMEDOUT = (
    138 if sys.platform == "win32" else errno.ETIMEDOUT
)  # from C's errno.h; Python has the number of Winsock

READ = Message(1, 0x03, 0, 1)
READ_TWO = Message(1, 0x03, 0, 2)
WRITE = Message(1, 0x06, 2, data=words(5000))
BROADCAST = Message(0, 0x06, 2, data=words(0))


def exchange(request: Message, *, silence: int = SILENCE, framing: Framing = Framing.RTU) -> Exchange:
    return Exchange(
        framing,
        request,
        Peer(least_timeout=TIMEOUT / 1e9, most_timeout=TIMEOUT / 1e9),
        baudrate=9600,
        format="8N1",
        character=CHARACTER / 1e9,
        silence=silence / 1e9,
        turnaround=TURNAROUND / 1e9,
    )


def rtu(text: str) -> bytes:
    body = bytes.fromhex(text)
    checksum: int = crc16(body, len(body))
    return body + checksum.to_bytes(2, "little")


def reply_of(value: int, address: int = 1) -> bytes:
    return rtu(f"{address:02X} 03 02 {value:04X}")


@pytest.fixture
def line() -> LineDriver:
    return LineDriver()


def ask(line: LineDriver, request: Message = READ) -> None:
    """Send the request. Afterwards the clock is at the request's first bit."""
    line.send(exchange(request))


def answer(line: LineDriver, received: bytes, piece: int = 4096) -> None:
    line.receive(received, piece)
    line.wait_until_done()


def exchanged(line: LineDriver, received: bytes, request: Message = READ, piece: int = 4096) -> Completion:
    """Send the request, and return the result after these bytes were received."""
    ask(line, request)
    answer(line, received, piece)
    return line.completion


def test_value_time_is_never_later_than_the_reply(line: LineDriver) -> None:
    """The thread may notice late that the request was sent, because writing to the port blocked it."""
    line.begin(exchange(READ))
    while line.want != "write":
        line.now = max(line.now, line.wake)
    begun = line.now
    line.take(held_up=10 * MS)
    line.receive(reply_of(7))  # the reply came while the thread was blocked
    assert line.want == "done"
    assert (line.completion.sent_ns, line.completion.first_ns) == (begun, begun + 10 * MS)


def test_a_value_from_a_pseudo_terminal_has_the_time_of_the_read(line: LineDriver) -> None:
    """A pseudo-terminal transfers a reply at once, so the drive may have read the value just before."""
    ask(line)
    line.now += 1 * MS
    answer(line, reply_of(7))
    line.now += 10 * MS
    ask(line)
    line.now += 60 * MS
    came = line.now
    answer(line, reply_of(7))
    assert (line.completion.first_ns, line.completion.last_ns) == (came, came)


def test_timeout_starts_when_a_delayed_write_is_complete(line: LineDriver) -> None:
    line.begin(exchange(READ))
    while line.want != "write":
        line.now = max(line.now, line.wake)
    line.take(held_up=10 * MS)
    left = line.now + 8 * CHARACTER
    line.wait_until_done()
    assert line.now == left + TIMEOUT + 7 * CHARACTER


def test_no_request_is_sent_before_the_required_silence_has_passed(line: LineDriver) -> None:
    opened = line.now
    line.begin(exchange(READ))
    for now in (opened, opened + SILENCE // 2, opened + SILENCE - 1):
        line.now = now
        assert line.listens
        assert line.wake == opened + SILENCE
    line.now = opened + SILENCE
    assert [line.want, line.want] == ["read", "write"]  # the line reads once more before it writes


@pytest.mark.parametrize(("before", "after"), [(4, 10), (10, 4), (7, 7)])
def test_the_longer_silence_of_two_exchanges_is_kept(line: LineDriver, before: int, after: int) -> None:
    line.send(exchange(READ, silence=before * MS))
    line.now += 20 * MS
    answer(line, reply_of(1))
    ended = line.now
    line.send(exchange(READ, silence=after * MS))
    assert line.now == ended + max(before, after) * MS


def test_silence_counts_from_the_last_byte_received(line: LineDriver) -> None:
    opened = line.now
    line.begin(exchange(READ))
    line.now = opened + 3 * MS
    assert line.listens
    line.receive(b"\xff\xff")
    line.wait_until_write()
    assert line.now == opened + 3 * MS + SILENCE
    answer(line, reply_of(1))
    assert line.completion.stale == 2


def test_silence_restarts_if_bytes_arrive_just_before_sending(line: LineDriver) -> None:
    line.begin(exchange(READ))
    line.now += SILENCE
    assert line.listens
    line.receive(b"\x00")
    assert line.listens
    assert line.wake == line.now + SILENCE


def test_request_is_sent_after_the_timeout_if_noise_never_ends(line: LineDriver) -> None:
    """The request may be a stop, and the noise may exist only in this computer's adapter."""
    opened = line.now
    line.begin(exchange(READ))
    reads = 0
    while line.listens:
        line.receive(b"\xff")
        line.now += MS
        reads += 1
    assert line.now <= opened + SILENCE + TIMEOUT + MS
    line.take()
    line.receive(b"\xff" * 10 + reply_of(7))
    assert line.want == "done"
    assert (line.completion.reply.data, line.completion.stale) == (words(7), reads)


def test_overdue_request_is_sent_within_three_reads_of_a_flood(line: LineDriver) -> None:
    line.begin(exchange(READ))
    line.now += SILENCE + TIMEOUT
    for _ in range(3):
        if line.want == "write":
            return
        line.receive(b"\xff" * 1024)
    raise AssertionError("it still looks at the flood")


def test_bytes_received_on_an_idle_line_belong_to_no_exchange(line: LineDriver) -> None:
    """This includes bytes that come before the first exchange."""
    for value in range(3):
        line.receive(b"\xff" * 4000)
        found = exchanged(line, reply_of(value))
        assert (found.reply.data, found.skipped) == (words(value), 0)


def test_silence_starts_after_the_requests_last_bit(line: LineDriver) -> None:
    """A reply that arrives before the request's last bit does not shorten the silence."""
    ask(line)
    sent = line.now
    answer(line, reply_of(1))
    line.send(exchange(READ))
    assert line.now == sent + 8 * CHARACTER + SILENCE


def test_a_request_is_sent_in_parts_if_the_port_accepts_only_a_few_bytes_at_once(line: LineDriver) -> None:
    line.begin(exchange(READ))
    line.now += SILENCE
    assert [line.want, line.want] == ["read", "write"]
    sent = line.now
    request = line.take(3)
    line.now += 20 * MS
    assert line.want == "write"
    request += line.take(0) + line.take(5)
    assert request == rtu("01 03 00 00 00 01")
    assert line.listens
    assert line.wake == sent + 20 * MS + 5 * CHARACTER + TIMEOUT + 7 * CHARACTER
    line.wait_until_done()
    assert line.completion.sent_ns == sent


def test_a_port_that_accepts_no_bytes_is_lost(line: LineDriver) -> None:
    line.begin(exchange(READ))
    line.now += SILENCE
    assert [line.want, line.want] == ["read", "write"]
    line.take(0)
    line.now = line.wake - 1
    assert line.want == "write"
    line.now += 1
    assert line.want == "done"
    found = line.completion
    assert (found.result, found.error, found.sent_ns) == (Failure.LINE_LOST, ETIMEDOUT, 0)


def test_noise_before_the_requests_first_byte_restarts_the_silence(line: LineDriver) -> None:
    line.begin(exchange(READ))
    line.now += SILENCE
    assert [line.want, line.want] == ["read", "write"]
    line.take(0)
    line.now += MS
    line.receive(b"\xff")
    assert line.want == "wait"
    assert line.wake == line.now + SILENCE


@pytest.mark.parametrize("taken", [0, 3])
def test_bytes_received_before_the_request_is_sent_are_not_its_reply(line: LineDriver, taken: int) -> None:
    line.begin(exchange(READ))
    line.now += SILENCE + TIMEOUT  # longest wait for silence; then the request is sent in any case
    assert [line.want, line.want] == ["read", "write"]
    line.take(taken)
    line.receive(reply_of(1111))
    line.take()
    answer(line, reply_of(2222))
    found = line.completion
    assert (found.reply.data, found.stale, found.skipped) == (words(2222), 7, 0)


@pytest.mark.parametrize("step", ["silent", "listening"])
def test_an_exchange_on_a_failed_port_has_the_status_line_lost(line: LineDriver, step: str) -> None:
    line.begin(exchange(READ))
    if step == "listening":
        line.wait_until_write()
        line.receive(b"\x01\x03")
    line.lose(errno.EIO)
    assert line.want == "done"
    found = line.completion
    assert (found.result, found.error) == (Failure.LINE_LOST, errno.EIO)
    assert found.raw == (b"\x01\x03" if step == "listening" else b"")
    line.lose(errno.ENODEV)  # no exchange is in flight
    assert line.completion.error == errno.EIO


@pytest.mark.parametrize("piece", [7, 3, 1])
def test_a_reply_is_found_if_it_comes_in_pieces(line: LineDriver, piece: int) -> None:
    ask(line)
    sent = line.now
    frame = reply_of(5000)
    line.now += 15 * MS
    for at in range(0, len(frame), piece):
        assert line.listens
        line.receive(frame[at : at + piece])
        line.now += MS
    assert line.want == "done"
    found = line.completion
    assert (found.result, found.raw, found.reply.data) == (7, frame, words(5000))
    last = sent + 15 * MS + (len(frame) - 1) // piece * MS
    # Bytes that are read together are assumed to have come one after another, at the speed of the wire.
    assert found.first_ns == min(sent + 15 * MS, last - (len(frame) - 1) * CHARACTER)
    assert (found.sent_ns, found.last_ns) == (sent, last)
    assert (found.stale, found.skipped) == (0, 0)


def test_an_exception_ends_the_exchange_immediately(line: LineDriver) -> None:
    ask(line)
    line.receive(rtu("01 83 02"))
    assert line.want == "done"
    assert (line.completion.result, line.completion.reply) == (5, Message(1, 0x03, exception=2))


NOISE = random.Random(3).randbytes(5)
# start of a reply of 26 registers, in which two bytes are the correct CRC of the bytes before them
START_WITH_CRC = rtu("01 04 34 bf 31 5d 78 41 9a ed 42 47 bf f8 97")
WHOLE = rtu((START_WITH_CRC + bytes(range(55 - len(START_WITH_CRC)))).hex())


@table(
    ("request_", "pieces", "reply"),
    [
        # pyhys/minimalmodbus#61, eModbus/eModbus#40, wirenboard/wb-mqtt-serial#650, ClassicDIY/ModbusTool#35
        (READ, [b"\0" + rtu("01 83 02") + b"\0"], Message(1, 3, exception=2)),
        (READ, [b"\0" + reply_of(7) + b"\0"], Message(1, 3, count=1, data=words(7))),
        (READ, [reply_of(7) + NOISE], Message(1, 3, count=1, data=words(7))),
        (Message(1, 4, 0, 26), [WHOLE[:17], WHOLE[17:]], Message(1, 4, count=26, data=WHOLE[3:-2])),
    ],
    ids=["exception between zeros", "reply between zeros", "reply before noise", "checksum inside the data"],
)
def test_replies_of_public_bug_reports_are_found(
    line: LineDriver, request_: Message, pieces: list[bytes], reply: Message
) -> None:
    for _ in range(3):  # bytes after a reply must not disturb the next exchange
        ask(line, request_)
        for piece in pieces:
            line.receive(piece)
        line.wait_until_done()
        assert line.completion.reply == reply


def test_the_timeout_counts_from_the_requests_last_bit_and_includes_the_replys_time(line: LineDriver) -> None:
    ask(line)
    sent = line.now
    assert line.listens
    assert line.wake == sent + 8 * CHARACTER + TIMEOUT + 7 * CHARACTER
    line.now = line.wake
    # the line reads once more at the timeout, because it may have been woken late
    assert [line.want, line.want] == ["read", "done"]
    found = line.completion
    assert (found.result, found.raw, found.first_ns, found.last_ns) == (Failure.NO_REPLY, b"", 0, 0)


def test_a_reply_that_is_read_at_the_timeout_is_accepted(line: LineDriver) -> None:
    ask(line)
    assert line.listens
    line.now = line.wake + 50 * MS
    assert line.listens
    assert line.data_after(reply_of(3)) == words(3)


def test_exchange_reads_only_once_more_at_the_timeout(line: LineDriver) -> None:
    ask(line)
    assert line.listens
    line.now = line.wake
    assert line.listens
    line.receive(b"\xff" * 1024)
    assert (line.want, line.completion.result) == ("done", FrameFault.BAD_ADDRESS)


def test_a_frame_from_another_address_does_not_end_the_exchange(line: LineDriver) -> None:
    ask(line)
    line.receive(reply_of(9, address=2))
    line.now += 30 * MS
    assert line.listens
    answer(line, reply_of(8))
    assert (line.completion.reply.data, line.completion.skipped) == (words(8), 7)


def test_a_good_reply_is_found_after_a_damaged_one(line: LineDriver) -> None:
    ask(line)
    line.receive(reply_of(9)[:-1] + b"\x00")
    assert line.listens
    answer(line, reply_of(8))
    assert (line.completion.reply.data, line.completion.skipped) == (words(8), 7)


REASONS = [
    ("nothing", b"", Failure.NO_REPLY),
    ("only the adapter's echo", rtu("01 03 00 00 00 02"), Failure.NO_REPLY),
    ("cut off", b"\x01\x03\x04\x11", Failure.CUT_SHORT),
    ("cut off behind junk", b"\x00\xff\x01\x03\x04\x11", Failure.CUT_SHORT),
    ("damaged", b"\x01\x03\x04\x11\x11\x22\x22\x00\x00", FrameFault.BAD_CHECKSUM),
    ("damaged, behind junk", b"\x00\x01\x03\x04\x11\x11\x22\x22\x00\x00", FrameFault.BAD_CHECKSUM),
    ("damaged, with an address in it", b"\x01\x03\x04\x11\x11\x22\x01\x00\x00", FrameFault.BAD_CHECKSUM),
    ("another address, with ours in it", rtu("02 03 04 00 01 00 05"), FrameFault.BAD_ADDRESS),
    ("another function", rtu("01 04 04 11 11 22 22"), FrameFault.BAD_FUNCTION),
    ("another length", rtu("01 03 02 11 11"), FrameFault.BAD_LENGTH),
    ("junk", b"\xff\xfe\xfd", FrameFault.BAD_ADDRESS),
]


@pytest.mark.parametrize("piece", [4096, 1], ids=["whole", "byte by byte"])
@pytest.mark.parametrize(
    ("received", "reason"), [each[1:] for each in REASONS], ids=[each[0] for each in REASONS]
)
def test_a_timeout_reports_what_is_wrong_with_the_received_bytes(
    line: LineDriver, received: bytes, reason: int, piece: int
) -> None:
    ask(line, READ_TWO)
    sent = line.now
    answer(line, received, piece)
    assert line.now == sent + (8 + 9) * CHARACTER + TIMEOUT  # never before the timeout
    found = line.completion
    assert (found.result, found.raw, found.skipped) == (reason, received, len(received))
    assert found.reply == Message(0, 0)


def test_a_late_reply_is_discarded_before_the_next_request(line: LineDriver) -> None:
    ask(line)
    line.wait_until_done()
    assert line.completion.result == Failure.NO_REPLY
    line.begin(exchange(READ))
    line.now += SILENCE // 2
    assert line.listens
    line.receive(reply_of(1111))
    late = line.now
    line.wait_until_write()
    assert line.now == late + SILENCE
    answer(line, reply_of(2222))
    found = line.completion
    assert (found.reply.data, found.stale, found.skipped) == (words(2222), 7, 0)


def test_repeated_reply_is_not_accepted_by_the_next_exchange(line: LineDriver) -> None:
    exchanged(line, reply_of(1111))
    line.begin(exchange(READ))
    assert line.listens
    line.receive(reply_of(1111))
    line.wait_until_write()
    answer(line, reply_of(2222))
    assert (line.completion.reply.data, line.completion.stale) == (words(2222), 7)


def test_bytes_after_the_reply_are_counted(line: LineDriver) -> None:
    found = exchanged(line, reply_of(1) + reply_of(1) + bytes(2000))
    assert (found.raw, found.skipped) == (reply_of(1), 2007)


@pytest.mark.parametrize("piece", [4096, 100, 1])
@pytest.mark.parametrize("seed", range(3))
def test_a_reply_is_found_after_4096_bytes_of_noise(line: LineDriver, seed: int, piece: int) -> None:
    noise = random.Random(seed).randbytes(4096)
    exchanged(line, noise + reply_of(77), piece=piece)
    found = line.completion
    assert (found.reply.data, found.raw, found.skipped) == (words(77), reply_of(77), 4096)


@pytest.mark.parametrize("received", [b"\x01\x03\xfa", b"\x01", b"\x01\x83", b"\x04\x04", b"\xff"])
def test_few_bytes_are_kept_while_endless_garbage_arrives(line: LineDriver, received: bytes) -> None:
    ask(line, Message(1, 0x03, 0, 125))
    garbage = received * 20_000
    for at in range(0, len(garbage), 64):
        line.receive(garbage[at : at + 64])
        assert line.still_open < 255
    line.wait_until_done()
    found = line.completion
    assert (found.skipped, found.raw) == (len(garbage), garbage[-513:])


def test_turnaround_delay_starts_when_a_broadcast_is_sent(line: LineDriver) -> None:
    ask(line, BROADCAST)
    sent = line.now
    assert line.want == "done"
    assert (line.completion.result, line.completion.sent_ns, line.completion.first_ns) == (0, sent, 0)
    line.send(exchange(READ))
    assert line.now == sent + 8 * CHARACTER + TURNAROUND


@pytest.mark.parametrize("event", ["noise while it is sent", "a failed unsent exchange"])
def test_the_turnaround_delay_is_never_shortened(line: LineDriver, event: str) -> None:
    ask(line, BROADCAST)
    sent = line.now
    if event == "noise while it is sent":
        line.now += MS
        line.receive(b"\xff")
    else:
        line.begin(exchange(READ))
        line.lose(errno.EIO)
    line.send(exchange(READ))
    assert line.now == sent + 8 * CHARACTER + TURNAROUND


def teach_echo(line: LineDriver) -> None:
    found = exchanged(line, rtu("01 03 00 00 00 01") + reply_of(1))
    assert (found.result, found.skipped) == (7, 8)


@pytest.mark.parametrize("piece", [4096, 1], ids=["whole", "byte by byte"])
def test_a_reply_after_another_masters_read_is_not_accepted(line: LineDriver, piece: int) -> None:
    """Both masters read the same drive: its first reply is probably to the other master."""
    ask(line)
    line.receive(rtu("01 03 00 40 00 01") + reply_of(0x1234), piece)
    assert line.listens
    assert line.data_after(reply_of(7), piece) == words(7)
    line.now += 10 * MS
    found = exchanged(line, rtu("01 03 00 40 00 01") + reply_of(0x1234), piece=piece)
    assert found.result == Failure.NO_REPLY


@pytest.mark.parametrize("before", ["02 03 00 40 00 01", "01 04 00 40 00 01", "01 06 00 40 00 01"])
def test_a_reply_is_accepted_if_another_master_sent_a_different_request(
    line: LineDriver, before: str
) -> None:
    assert exchanged(line, rtu(before) + reply_of(7)).reply.data == words(7)


def confirmation() -> bytes:
    return build_reply(Framing.RTU, WRITE)


@pytest.mark.parametrize("piece", [4096, 1], ids=["whole", "byte by byte"])
def test_the_echo_of_a_write_is_not_taken_for_its_confirmation(line: LineDriver, piece: int) -> None:
    teach_echo(line)
    ask(line, WRITE)
    line.receive(confirmation(), piece)
    line.now += 20 * MS
    assert line.listens
    line.receive(confirmation(), piece)
    assert line.want == "done"
    assert (line.completion.result, line.completion.skipped) == (8, 8)


@pytest.mark.parametrize(
    ("after", "result", "reply"),
    [(b"", Failure.NO_REPLY, Message(0, 0)), (rtu("01 86 02"), 5, Message(1, 0x06, exception=2))],
    ids=["nothing", "an exception"],
)
def test_the_echo_of_a_write_is_skipped(line: LineDriver, after: bytes, result: int, reply: Message) -> None:
    teach_echo(line)
    found = exchanged(line, confirmation() + after, WRITE)
    assert (found.result, found.reply) == (result, reply)


def test_an_echo_that_starts_before_the_request_is_sent_is_recognised(line: LineDriver) -> None:
    teach_echo(line)
    line.begin(exchange(WRITE))
    while line.want != "write":
        line.now = max(line.now, line.wake)
    line.receive(line.take(5))
    line.receive(line.take(3))
    assert line.listens
    answer(line, confirmation())
    assert (line.completion.result, line.completion.stale, line.completion.skipped) == (8, 0, 8)


def test_an_echo_is_recognised_after_a_stray_byte(line: LineDriver) -> None:
    teach_echo(line)
    ask(line, WRITE)
    line.receive(b"\x00" + confirmation())
    assert line.listens
    answer(line, b"\x00" + confirmation())
    assert (line.completion.result, line.completion.skipped) == (8, 10)


DAMAGED_ECHOES = {
    "its end is missing": confirmation()[:5],
    "its begin is missing": confirmation()[3:],
    "a bit is wrong": bytes([confirmation()[0] ^ 4]) + confirmation()[1:],
    "its middle is missing": confirmation()[:2] + confirmation()[4:],
}


@pytest.mark.parametrize("piece", [4096, 1], ids=["whole", "byte by byte"])
@pytest.mark.parametrize("echo", DAMAGED_ECHOES)
def test_damaged_echo_of_a_write_is_no_confirmation(line: LineDriver, echo: str, piece: int) -> None:
    """A later copy confirms nothing either: it may be the echo, after noise. The next read succeeds."""
    teach_echo(line)
    ask(line, WRITE)
    line.receive(DAMAGED_ECHOES[echo] + confirmation(), piece)
    line.wait_until_done()
    assert line.completion.result < 0
    line.now += 10 * TIMEOUT
    assert exchanged(line, rtu("01 03 00 00 00 01") + reply_of(2)).reply.data == words(2)


@pytest.mark.parametrize("piece", [4096, 1], ids=["whole", "byte by byte"])
@pytest.mark.parametrize("cut", [(0, 5), (3, 8), (0, 1), (7, 8)])
def test_a_reply_is_found_after_a_damaged_echo(line: LineDriver, cut: tuple[int, int], piece: int) -> None:
    teach_echo(line)
    ask(line)
    echo = rtu("01 03 00 00 00 01")[slice(*cut)]
    answer(line, echo + reply_of(2), piece)
    assert (line.completion.reply.data, line.completion.skipped) == (words(2), len(echo))
    # The confirmation came only once: it is the echo, because the line is still known to echo.
    assert exchanged(line, confirmation(), WRITE).result == Failure.NO_REPLY


def test_write_confirmations_are_accepted_after_two_replies_without_echo(line: LineDriver) -> None:
    """One reply without echo is not enough: the echo may have been lost."""
    teach_echo(line)
    exchanged(line, reply_of(1))
    assert exchanged(line, confirmation(), WRITE).result == Failure.MAYBE_ECHO
    line.now += 10 * TIMEOUT
    exchanged(line, reply_of(1))
    found = exchanged(line, confirmation(), WRITE)
    assert (found.result, found.skipped) == (8, 0)


@pytest.mark.parametrize("piece", [4096, 1], ids=["whole", "byte by byte"])
def test_echo_that_starts_like_a_reply_is_skipped(line: LineDriver, piece: int) -> None:
    """The first seven of the echo's eight bytes are a good reply with one register."""
    echo = rtu("06 03 02 11 00 01")
    assert echo[:7] == rtu("06 03 02 11 00")
    found = exchanged(line, echo + reply_of(7, address=6), Message(6, 3, 0x0211, 1), piece=piece)
    assert (found.reply.data, found.skipped) == (words(7), 8)


def test_confirmations_are_accepted_until_an_echo_is_found(line: LineDriver) -> None:
    line.set_echo(lib.MD_NO_ECHO)
    for _ in range(2):
        found = exchanged(line, confirmation(), WRITE)
        assert (found.result, found.skipped) == (8, 0)
    teach_echo(line)  # an echo is found although "no echo" was configured
    assert exchanged(line, confirmation(), WRITE).result == Failure.NO_REPLY


def test_a_configured_echo_is_expected_even_after_replies_without_an_echo(line: LineDriver) -> None:
    line.set_echo(lib.MD_ECHO)
    for _ in range(3):
        assert exchanged(line, reply_of(1)).result == 7  # the request's echo was lost
    assert exchanged(line, confirmation(), WRITE).result == Failure.NO_REPLY


def test_the_configured_echo_of_a_delixi_query_is_not_taken_for_a_value(line: LineDriver) -> None:
    query, value = Message(1, 0x07, 0x01F4, data=bytes(4)), b"\0\0\x13\x88"
    line.set_echo(lib.MD_ECHO)
    line.send(exchange(query, framing=Framing.DELIXI))
    reply = build_reply(Framing.DELIXI, replace(query, data=value))
    answer(line, build_request(Framing.DELIXI, query) + reply)
    assert (line.completion.reply.data, line.completion.skipped) == (value, 21)


def test_copy_of_a_write_confirms_nothing_if_it_may_be_an_echo(line: LineDriver) -> None:
    found = exchanged(line, confirmation(), WRITE)
    assert (found.result, found.raw) == (Failure.MAYBE_ECHO, confirmation())
    found = exchanged(line, confirmation() + confirmation(), WRITE)  # two copies, so the adapter echoes
    assert (found.result, found.skipped) == (8, 8)
    assert exchanged(line, confirmation(), WRITE).result == Failure.NO_REPLY


def test_a_reply_without_an_echo_shows_that_the_adapter_does_not_echo(line: LineDriver) -> None:
    exchanged(line, reply_of(1))
    found = exchanged(line, confirmation(), WRITE)
    assert (found.result, found.skipped) == (8, 0)


@pytest.mark.parametrize(("stray", "told"), [(1, True), (3, True), (4, False), (8, False)])
def test_stray_bytes_before_a_reply_are_not_taken_for_an_echo(
    line: LineDriver, stray: int, told: bool
) -> None:
    """A line driver may send a zero byte before every reply: confirmations are still accepted."""
    assert exchanged(line, bytes(stray) + reply_of(1)).reply.data == words(1)
    assert (exchanged(line, bytes(stray) + confirmation(), WRITE).result == 8) is told


def test_an_echo_without_a_reply_shows_that_the_adapter_echoes(line: LineDriver) -> None:
    """A read's reply never equals its request. So two copies are an echo, and the drive is dead."""
    exchanged(line, rtu("01 03 00 00 00 01"))
    assert exchanged(line, confirmation(), WRITE).result == Failure.NO_REPLY


def test_a_delixi_value_of_0_is_found_after_the_echo_of_its_query(line: LineDriver) -> None:
    """The echo of a value query equals its reply with the value 0.

    The reply to a state query never equals its request, so it first shows that the adapter echoes.
    """
    state, ask_state = b":010300030000000007\r\n", b":010300000000000004\r\n"
    value, ask_value = b":010701F40000138898\r\n", b":010701F400000000FD\r\n"
    assert line.send(exchange(Message(1, 3, 0, data=words(0, 0)), framing=Framing.DELIXI)) == ask_state
    answer(line, ask_state + state)
    assert line.completion.reply.start == 3
    for reply, frequency in ((value, 5000), (ask_value, 0)):
        assert line.send(exchange(Message(1, 7, 500, data=words(0, 0)), framing=Framing.DELIXI)) == ask_value
        answer(line, ask_value + reply)
        assert (line.completion.reply.data, line.completion.skipped) == (words(0, frequency), 21)


QUERY = Message(1, 0x07, 500, data=bytes(4))
ECHO = build_request(Framing.DELIXI, QUERY)  # as a reply it means the value 0


def query(line: LineDriver) -> None:
    """Query a Delixi drive's state, whose reply shows that there is no echo, and then a parameter."""
    line.send(exchange(Message(1, 3, 0, data=words(0, 0)), framing=Framing.DELIXI))
    answer(line, b":010300030000000007\r\n")
    line.send(exchange(QUERY, framing=Framing.DELIXI))


@pytest.mark.parametrize("piece", [4096, 1], ids=["whole", "byte by byte"])
@pytest.mark.parametrize("gap", [0, 5 * MS, TIMEOUT // 2])
def test_an_echoed_query_is_not_taken_for_a_reply_with_value_0(
    line: LineDriver, gap: int, piece: int
) -> None:
    query(line)
    line.receive(ECHO, piece)
    assert line.listens
    line.now += gap
    answer(line, build_reply(Framing.DELIXI, replace(QUERY, data=b"\0\0\x13\x88")), piece)
    assert (line.completion.reply.data, line.completion.skipped) == (b"\0\0\x13\x88", 21)
    assert line.echo == lib.MD_ECHO


def test_a_value_of_0_is_accepted_when_no_other_reply_follows(line: LineDriver) -> None:
    query(line)
    line.now += 40 * MS
    line.receive(ECHO)
    came = line.now
    assert line.listens
    line.wait_until_done()
    assert (line.completion.reply.data, line.completion.raw) == (bytes(4), ECHO)
    assert (line.completion.first_ns <= came, line.completion.last_ns) == (True, came)
    assert line.echo == lib.MD_NO_ECHO


VALUE = build_reply(Framing.DELIXI, replace(QUERY, data=b"\0\0\x13\x88"))
DELAY = 10 * MS


@pytest.fixture
def steady() -> Peer:
    return Peer(least_timeout=TIMEOUT / 1e9, most_timeout=TIMEOUT / 1e9)


def send_query(line: LineDriver, peer: Peer, *, insists: bool = False) -> int:
    """Query a parameter of a Delixi drive; return the time at which the request's last character is sent."""
    line.begin(
        Exchange(
            Framing.DELIXI,
            QUERY,
            peer,
            baudrate=9600,
            format="8N1",
            character=CHARACTER / 1e9,
            silence=SILENCE / 1e9,
            insists=insists,
        )
    )
    line.wait_until_write()
    return line.now + len(ECHO) * CHARACTER


def make_steady(line: LineDriver, peer: Peer) -> None:
    """Let a drive answer so often that its response delay is well known."""
    for _ in range(10):
        receive_at_pace(line, send_query(line, peer) + DELAY, VALUE)


def receive_at_pace(line: LineDriver, begin: int, frame: bytes) -> None:
    """Let the frame's characters arrive one by one from `begin` on, until the exchange ends."""
    came = 0
    while (want := line.want) != "done":
        there = min(max(0, (line.now - begin) // CHARACTER), len(frame))
        if want == "wait":
            line.now = line.wake
        elif there > came:
            line.receive(frame[came:there])
            came = there
        elif came < len(frame):
            line.now = min(line.wake, begin + (came + 1) * CHARACTER)
        else:
            line.now = line.wake


def test_a_delixi_value_of_0_is_accepted_at_the_drives_usual_delay(line: LineDriver, steady: Peer) -> None:
    """An echo would have come earlier, so this copy of the request is the reply."""
    make_steady(line, steady)
    for _ in range(5):
        end = send_query(line, steady)
        receive_at_pace(line, end + DELAY, ECHO)
        assert (line.completion.reply.data, line.echo) == (bytes(4), lib.MD_NO_ECHO)
        assert line.now - end - DELAY <= (len(ECHO) + 1) * CHARACTER


@pytest.mark.parametrize("insists", [False, True])
def test_a_possible_echo_is_accepted_as_reply_only_at_the_timeout(
    line: LineDriver, steady: Peer, insists: bool
) -> None:
    """A copy of the request came too early for a reply. With `insists`, no arrival time is compared."""
    make_steady(line, steady)
    end = send_query(line, steady, insists=insists)
    if insists:
        receive_at_pace(line, end + DELAY, ECHO)
    else:
        line.receive(ECHO)
        line.wait_until_done()
    assert line.completion.reply.data == bytes(4)
    assert line.now - end >= TIMEOUT


@pytest.mark.parametrize("later", [0, 10 * MS, TIMEOUT // 2])
def test_an_echo_before_the_usual_delay_is_not_a_value_of_0(
    line: LineDriver, steady: Peer, later: int
) -> None:
    make_steady(line, steady)
    end = send_query(line, steady)
    line.receive(ECHO)
    receive_at_pace(line, end + DELAY + later, VALUE)
    assert (line.completion.reply.data, line.completion.skipped) == (b"\0\0\x13\x88", 21)
    assert line.echo == lib.MD_ECHO


def test_two_copies_of_a_query_do_not_show_whether_the_adapter_echoes(line: LineDriver) -> None:
    query(line)
    answer(line, ECHO + ECHO)
    assert line.completion.reply.data == bytes(4)
    assert line.echo == lib.MD_ECHO_UNKNOWN


def test_coils_reply_equal_to_the_request_is_accepted_at_the_timeout(line: LineDriver) -> None:
    """The reply to a read of 17 coils from address 0320H can have the same bytes as the request."""
    copy = rtu("01 01 03 20 00 11")
    exchanged(line, reply_of(1))
    for reply in (copy, copy + rtu("01 01 03 55 55 01")):
        assert exchanged(line, reply, Message(1, 1, 0x320, 17)).reply.data == reply[-5:-2]
