"""Learning from a drive's replies: when to read the port, how long to wait, which replies may be late."""

from __future__ import annotations

import pytest
from frames import words
from line_driver import (
    CHARACTER,
    LEAST,
    LONGER,
    MOST,
    MS,
    OTHER,
    READ,
    SILENCE,
    WRITE,
    LineDriver,
    answer,
    ask,
    drive,
    exchange,
    line,
    reply,
)
from multidrop._core import ffi, lib

from multidrop.core import (
    Failure,
    Field,
    FrameFault,
    Framing,
    Message,
    NumberFormat,
    Peer,
    RowLayout,
    Status,
    build_reply,
    build_request,
)

__all__ = ["drive", "line"]  # fixtures


def is_barred(line: LineDriver, drive: Peer, request: Message) -> bool:
    """Return True if the request is not sent, because a late reply could be mistaken for its reply."""
    line.begin(exchange(request, drive))
    return line.want == "done" and line.completion.result == Failure.LATE_ANSWER_DUE


def test_the_response_delay_of_a_drive_is_learnt_from_its_replies(line: LineDriver, drive: Peer) -> None:
    assert drive.response_delay == 0
    for _ in range(40):
        answer(line, drive, 15 * MS)
    assert drive.response_delay == pytest.approx(15e-3, rel=0.01)


def test_the_port_is_not_read_before_a_reply_can_be_complete(line: LineDriver, drive: Peer) -> None:
    for _ in range(40):
        answer(line, drive, 15 * MS)
    left = ask(line, drive)
    whole = left + 15 * MS + 7 * CHARACTER
    assert line.want == "wait"
    assert whole - 2 * CHARACTER <= line.wake <= whole


def looks(
    line: LineDriver, drive: Peer, delay: int, details: dict[str, RowLayout] | None = None
) -> tuple[int, int]:
    """Carry out an exchange. Return how often the port was read, and how late after the reply's end (ns)."""
    line.send(exchange(READ, drive, **(details or {})))
    left = line.now + 8 * CHARACTER
    times = [left + delay + (at + 1) * CHARACTER for at in range(len(reply()))]
    seen = found = 0
    while line.want != "done":
        line.wait_for_look()
        if found and line.now < times[seen]:  # wait for the next character
            line.now = times[seen]
        come = sum(time <= line.now for time in times)
        line.receive(reply()[seen:come])
        seen = come
        found += 1
    return found, line.now - times[-1]


def test_the_port_is_first_read_shortly_before_the_replys_end(line: LineDriver, drive: Peer) -> None:
    for _ in range(20):
        assert looks(line, drive, 15 * MS)[1] == looks(line, drive, 16 * MS)[1] == 0


def test_wait_for_the_rest_of_a_reply_depends_on_the_missing_characters(
    line: LineDriver, drive: Peer
) -> None:
    ask(line, drive)
    line.now += 60 * MS
    line.receive(reply()[:3])
    assert (line.want, line.wake) == ("wait", line.now + 3 * CHARACTER)  # four characters are missing
    line.now = line.wake
    line.receive(reply()[3:6])
    assert line.want == "read"
    line.receive(reply()[6:])
    assert line.want == "done"


def test_an_exception_ends_the_wait_for_a_longer_reply(line: LineDriver, drive: Peer) -> None:
    refusal = build_reply(Framing.RTU, Message(1, 3, exception=2))
    ask(line, drive, Message(1, 3, 0, 100))
    line.receive(refusal[:2])
    assert line.want == "read"
    line.receive(refusal[2:])
    assert line.want == "done"


def test_the_port_is_read_earlier_when_a_drive_becomes_quicker(line: LineDriver, drive: Peer) -> None:
    """At first the reply is complete long before the port is read. Then each read comes a little earlier."""
    for _ in range(40):
        answer(line, drive, 40 * MS)
    for _ in range(120):
        looks(line, drive, 5 * MS)
    assert drive.response_delay < 10e-3


def given_up(line: LineDriver, drive: Peer, request: Message = READ) -> int:
    """Return the time from the request's last bit to the end of the wait for a silent drive."""
    left = ask(line, drive, request)
    line.wait_until_done()
    assert line.completion.result == Failure.NO_REPLY
    return line.now - left


def time_out(line: LineDriver, drive: Peer, request: Message = READ) -> int:
    """Return the timeout, without the time of the reply's 7 characters."""
    return given_up(line, drive, request) - 7 * CHARACTER


def test_the_timeout_follows_the_drives_response_delay(line: LineDriver, drive: Peer) -> None:
    for number in range(200):
        answer(line, drive, (40 + number % 3) * MS)
    assert 45 * MS < given_up(line, drive) - AWAITED < 60 * MS


def test_a_learnt_timeout_is_never_shorter_than_least_timeout(line: LineDriver, drive: Peer) -> None:
    for _ in range(100):
        answer(line, drive, MS // 10)
    assert given_up(line, drive) == LEAST + AWAITED


def test_a_silent_drive_gets_the_longest_timeout_once_and_then_rarely(line: LineDriver, drive: Peer) -> None:
    found, reckoned = [], []
    for _ in range(20):
        line.now = max(line.now, drive.late_until_ns)
        reckoned.append(drive.next_timeout_ns // MS)
        found.append(time_out(line, drive) // MS)
    assert found == reckoned == [60, 300, *(15 * [60]), 300, 60, 60]
    assert drive.failures == 20
    line.now = drive.late_until_ns
    answer(line, drive, 5 * MS)
    assert drive.failures == 0


def test_learnt_timeout_does_not_shorten_the_timeout_of_a_write(line: LineDriver, drive: Peer) -> None:
    """Its timeout does not shrink with that of reads, because an unconfirmed write is worse than waiting."""
    for _ in range(12):
        answer(line, drive, 2 * MS)
    assert given_up(line, drive) < 100 * MS
    line.send(exchange(WRITE, drive, timeout=1.0))
    left = line.now + 8 * CHARACTER
    line.wait_until_done()
    assert line.now - left == 1000 * MS + 8 * CHARACTER


AWAITED = 3 * CHARACTER  # added to the timeout: the duration of the reply's first character, and of two more
LONG = Message(1, 3, 0, 100)  # its reply has 205 characters


def gathered(line: LineDriver, drive: Peer, request: Message = READ) -> None:
    """Carry out an exchange whose adapter delivers the reply only once it is whole."""
    left = ask(line, drive, request)
    text = build_reply(Framing.RTU, Message(1, 3, data=bytes(2 * request.count)))
    while line.now < left + 15 * MS + len(text) * CHARACTER:
        assert line.listens
        line.now = min(left + 15 * MS + len(text) * CHARACTER, max(line.wake, line.now + CHARACTER))
    line.receive(text)
    assert line.want == "done"


@pytest.mark.parametrize("asked", [READ, LONG], ids=["short", "long"])
def test_timeout_of_a_missing_reply_ignores_the_expected_length(
    line: LineDriver, drive: Peer, asked: Message
) -> None:
    answer(line, drive, 2 * MS)
    assert given_up(line, drive, asked) == LEAST + AWAITED


def test_line_waits_for_the_rest_of_a_started_reply(line: LineDriver, drive: Peer) -> None:
    answer(line, drive, 2 * MS)
    left = ask(line, drive, LONG)
    text = build_reply(Framing.RTU, Message(1, 3, data=bytes(200)))
    line.now = left + LEAST + CHARACTER
    line.receive(text[:1])
    while line.listens:
        line.now += 10 * CHARACTER
        arrived = min(len(text), (line.now - left - LEAST) // CHARACTER)
        line.receive(text[line.completion.skipped : arrived])
    assert line.completion.result == len(text)


def test_the_next_request_gets_the_longest_timeout_after_a_failure(line: LineDriver, drive: Peer) -> None:
    answer(line, drive, 2 * MS)
    given_up(line, drive)
    line.now = drive.late_until_ns
    assert given_up(line, drive) == MOST + 7 * CHARACTER


def test_an_echo_does_not_count_as_the_start_of_a_reply(line: LineDriver, drive: Peer) -> None:
    answer(line, drive, 2 * MS)
    left = ask(line, drive)
    line.receive(build_request(Framing.RTU, READ))
    line.wait_until_done()
    assert line.now == left + LEAST + AWAITED


@pytest.mark.parametrize("asked", [READ, LONG], ids=["short", "long"])
def test_timeout_includes_the_reply_length_if_replies_arrive_whole(
    line: LineDriver, drive: Peer, asked: Message
) -> None:
    """Such an adapter delivers no byte before the end of the reply."""
    for _ in range(20):
        gathered(line, drive, asked)
    assert given_up(line, drive, LONG) >= LEAST + 205 * CHARACTER


def test_noise_is_not_mistaken_for_byte_by_byte_delivery(line: LineDriver, drive: Peer) -> None:
    ask(line, drive)
    line.receive(b"\x01")
    line.receive(b"\x03\x07")
    line.now += 20 * MS
    line.receive(reply())
    assert line.want == "done"
    assert given_up(line, drive, LONG) >= LEAST + 205 * CHARACTER


def test_reply_after_a_shortened_timeout_is_recognised_as_late(line: LineDriver, drive: Peer) -> None:
    answer(line, drive, 2 * MS)
    given_up(line, drive)
    assert is_barred(line, drive, OTHER)
    line.receive(reply(1111))
    assert (drive.counters().late, drive.late_until_ns) == (1, 0)


def test_no_request_is_sent_while_a_late_reply_could_be_taken_for_its_reply(
    line: LineDriver, drive: Peer
) -> None:
    time_out(line, drive)
    line.begin(exchange(OTHER, drive))
    assert line.want == "done"
    assert (line.completion.result, line.completion.sent_ns) == (Failure.LATE_ANSWER_DUE, 0)
    assert drive.failures == 1  # only the first request was sent


def test_a_late_reply_is_expected_after_a_lost_port_is_reopened(line: LineDriver, drive: Peer) -> None:
    ask(line, drive)
    line.lose(0)
    again = LineDriver()
    again.now = line.now
    again.begin(exchange(OTHER, drive))
    assert (again.completion.result, again.completion.sent_ns) == (Failure.LATE_ANSWER_DUE, 0)
    again.now = drive.late_until_ns
    ask(again, drive, OTHER)


@pytest.mark.parametrize("is_row", [True, False], ids=["for a row", "for a client"])
def test_possibly_late_polled_value_has_the_time_of_the_first_request(
    line: LineDriver, drive: Peer, is_row: bool
) -> None:
    """A read by `Bus` gets no value yet: the C core must first be sure that no late reply is due."""
    drive.prove_by([exchange(LONGER, drive), exchange(Message(1, 3, 0, 3), drive)])
    rows = RowLayout(0, [Field(0, NumberFormat.U16, 0, 1.0, 1.0)]) if is_row else None
    asked = exchange(READ, drive, block=rows)
    line.send(asked)
    first_ns = line.completion.sent_ns
    line.wait_until_done()
    line.now = drive.late_until_ns
    line.send(asked)
    line.now += 20 * MS
    line.receive(reply(1234))
    assert line.want == "done"
    found = line.completion
    if is_row:
        assert (found.result, found.sent_ns, found.reply.data) == (7, first_ns, words(1234))
        assert found.first_ns == line.now
    else:
        assert (found.result, found.reply.data) == (Failure.LATE_ANSWER_DUE, b"")
    assert drive.counters().late == 1


@pytest.mark.parametrize(("asked", "times"), [(READ, 2), (WRITE, 1)], ids=["a read", "a write"])
def test_only_reads_are_repeated_if_the_reply_may_be_late(drive: Peer, asked: Message, times: int) -> None:
    """The reply may be to an earlier request. A write is not repeated: it may have started a motor."""
    slots, turn = ffi.new("struct md_slot[]", 1), ffi.new("struct md_turn *")
    wake, found = ffi.new("int64_t *"), ffi.new("struct md_completion *")
    made = exchange(asked, drive)
    urgent = ffi.new("struct md_urgent *", {"exchange": made.c, "completion": found})
    lib.md_turn_init(turn, slots, 1, 0)
    lib.md_turn_add_urgent(turn, urgent)
    line = ffi.addressof(turn.line)
    while lib.md_turn_want(turn, wake, wake[0]) != lib.MD_WRITE:
        pass
    lib.md_line_sent(line, line.tx_len, wake[0], wake[0])
    lib.md_line_abandon(line, Failure.LATE_ANSWER_DUE, 0)
    lib.md_turn_want(turn, wake, wake[0])
    assert urgent.is_done
    assert drive.exchanges == times


def test_a_stop_precedes_the_repetition_of_a_read(drive: Peer) -> None:
    """Otherwise the stop would also wait for the proof that precedes the repetition."""
    drive.prove_by([exchange(LONGER, drive)])
    drive.doubt_first_reply()
    slots, turn = ffi.new("struct md_slot[]", 1), ffi.new("struct md_turn *")
    wake, found = ffi.new("int64_t *"), ffi.new("struct md_completion *")
    asked, stop = exchange(READ, drive), exchange(WRITE, drive, insists=True)
    urgent = ffi.new("struct md_urgent *", {"exchange": asked.c, "completion": found})
    stopping = ffi.new("struct md_urgent *", {"exchange": stop.c, "completion": found})
    lib.md_turn_init(turn, slots, 1, 0)
    lib.md_turn_add_urgent(turn, urgent)
    line = ffi.addressof(turn.line)
    while lib.md_turn_want(turn, wake, wake[0]) != lib.MD_WRITE:
        pass
    lib.md_line_sent(line, line.tx_len, wake[0], wake[0])
    lib.md_turn_add_urgent(turn, stopping)
    lib.md_line_received(line, reply(), len(reply()), wake[0])
    lib.md_turn_want(turn, wake, wake[0])
    assert line.exchange == stop.c


def test_no_late_reply_is_expected_if_the_request_was_not_sent(line: LineDriver, drive: Peer) -> None:
    line.begin(exchange(READ, drive))
    line.lose(0)
    assert drive.late_until_ns == 0


def test_write_does_not_wait_for_the_late_reply_to_a_read(line: LineDriver, drive: Peer) -> None:
    """A stop is a write: the late reply to a read differs from its reply."""
    time_out(line, drive)
    ask(line, drive, WRITE)


def test_a_read_waits_for_a_late_exception_to_another_read(line: LineDriver, drive: Peer) -> None:
    time_out(line, drive)
    assert is_barred(line, drive, LONGER)


def test_late_replies_to_several_requests_are_expected(line: LineDriver, drive: Peer) -> None:
    time_out(line, drive)
    first_until = drive.late_until_ns
    time_out(line, drive, WRITE)  # the late reply to READ cannot be the reply to this write
    assert drive.late_until_ns > first_until
    assert is_barred(line, drive, OTHER)
    line.receive(build_request(Framing.RTU, WRITE))  # the write's confirmation
    assert drive.counters().late == 1
    assert is_barred(line, drive, OTHER)  # the late reply to READ may still come


def test_a_write_waits_for_a_late_exception_to_another_write(line: LineDriver, drive: Peer) -> None:
    """Otherwise a second write that started a motor could be reported as refused."""
    time_out(line, drive, WRITE)
    assert is_barred(line, drive, Message(1, 6, 9, data=words(1)))
    ask(line, drive, READ)  # a late exception to a write does not fit a read


def delixi(function: int, start: int, value: int = 0) -> Message:
    return Message(1, function, start, data=words(0, value))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (delixi(7, 500), delixi(7, 501)),  # replies name the parameter, refusals do not
        (delixi(7, 500), delixi(7, 500)),
        (delixi(3, 0), delixi(3, 0)),
        (delixi(3, 0), delixi(7, 0)),
        (delixi(6, 2, 5000), delixi(6, 3, 1)),
        (delixi(7, 500), delixi(2, 1)),
    ],
    ids=["another parameter", "the same one", "a state", "a state and a parameter", "a write", "a command"],
)
def test_delixi_request_waits_for_a_late_reply_that_looks_alike(
    line: LineDriver, drive: Peer, first: Message, second: Message
) -> None:
    line.send(exchange(first, drive, Framing.DELIXI))
    line.wait_until_done()
    assert line.completion.result == Failure.NO_REPLY
    line.begin(exchange(second, drive, Framing.DELIXI))
    assert line.completion.result == Failure.LATE_ANSWER_DUE


def test_a_late_reply_to_a_write_is_expected_after_the_writes_timeout(line: LineDriver, drive: Peer) -> None:
    """Otherwise a late exception to this write would be taken for a refusal of the next write."""
    line.send(exchange(WRITE, drive, timeout=5 * MOST / 1e9))
    line.wait_until_done()
    line.now += 3 * LEAST
    assert is_barred(line, drive, Message(1, 6, 9, data=words(1)))
    line.now = drive.late_until_ns
    ask(line, drive, WRITE)


def test_a_stop_does_not_wait_for_late_replies(line: LineDriver, drive: Peer) -> None:
    time_out(line, drive, WRITE)
    stop = exchange(WRITE, drive)
    stop.c.insists = 1
    assert line.send(stop) == build_request(Framing.RTU, WRITE)


def test_stop_timeout_doubles_from_the_second_failure_on(line: LineDriver, drive: Peer) -> None:
    """A stop must be repeated before the longest documented timeout has passed.

    The first failure is that of the read before the stop. It does not double the timeout, because other
    drives wait for their stops.
    """
    found = []
    for _ in range(5):
        stop = exchange(WRITE, drive)
        stop.c.insists = 1
        line.send(stop)
        left = line.now + 8 * CHARACTER
        line.wait_until_done()
        found.append((line.now - left - 8 * CHARACTER) // MS)
    assert found == [60, 60, 120, 240, 300]


def test_late_reply_is_still_expected_after_bytes_like_a_damaged_reply(line: LineDriver, drive: Peer) -> None:
    ask(line, drive)
    inside = bytes([1, 3, 2, 0, 0, 0, 0])  # looks like a reply with a wrong checksum
    line.receive(build_reply(Framing.RTU, Message(1, 4, data=bytes(1) + inside)))
    line.wait_until_done()
    assert line.completion.result == FrameFault.BAD_CHECKSUM
    assert is_barred(line, drive, OTHER)


def test_a_late_reply_of_a_drive_does_not_delay_other_drives(line: LineDriver, drive: Peer) -> None:
    time_out(line, drive)
    other = Peer(least_timeout=LEAST / 1e9, most_timeout=MOST / 1e9)
    ask(line, other, Message(2, 3, 0, 1))


def test_no_late_reply_is_expected_after_the_longest_documented_delay(line: LineDriver, drive: Peer) -> None:
    left = line.now + SILENCE + 8 * CHARACTER
    time_out(line, drive)
    assert drive.late_until_ns >= left + MOST
    line.now = drive.late_until_ns
    ask(line, drive, OTHER)


@pytest.mark.parametrize("piece", [7, 1], ids=["whole", "byte by byte"])
def test_next_request_is_sent_once_the_late_reply_has_come(line: LineDriver, drive: Peer, piece: int) -> None:
    time_out(line, drive)
    line.receive(reply(1111), piece)
    assert drive.late_until_ns == 0
    assert drive.counters().late == 1
    ask(line, drive, OTHER)
    line.receive(reply(2222))
    assert line.want == "done"
    found = line.completion
    assert (found.reply.data, found.stale) == (words(2222), 7)


def peer() -> Peer:
    return Peer(least_timeout=LEAST / 1e9, most_timeout=MOST / 1e9)


def answer_of(address: int, *values: int) -> bytes:
    return build_reply(Framing.RTU, Message(address, 3, data=words(*values)))


@pytest.mark.parametrize("piece", [4096, 1], ids=["whole", "byte by byte"])
@pytest.mark.parametrize(
    "junk", [b"", b"\x00", b"\x02", b"\x01"], ids=["", "00", "our address", "its address"]
)
def test_a_late_reply_is_recognised_during_another_drives_exchange(
    line: LineDriver, drive: Peer, junk: bytes, piece: int
) -> None:
    time_out(line, drive)
    ask(line, peer(), Message(2, 3, 0, 1))
    line.receive(junk + reply(1111), piece)
    assert line.listens
    assert (drive.counters().late, drive.late_until_ns) == (1, 0)
    line.receive(answer_of(2, 5), piece)
    assert line.want == "done"
    assert (line.completion.reply.data, line.completion.skipped) == (words(5), len(junk) + 7)
    ask(line, drive, OTHER)  # the late reply to READ is no longer expected


def test_late_replies_of_several_drives_are_recognised(line: LineDriver) -> None:
    drives = {address: peer() for address in (1, 2, 3)}
    for address, each in drives.items():
        time_out(line, each, Message(address, 3, 0, address))
    ask(line, peer(), Message(9, 3, 0, 1))
    line.receive(answer_of(3, 1, 2, 3) + answer_of(1, 1))
    assert [drive.counters().late for drive in drives.values()] == [1, 0, 1]
    assert [bool(drive.late_until_ns) for drive in drives.values()] == [False, True, False]
    line.receive(answer_of(2, 1, 2) + answer_of(9, 4))
    assert line.completion.reply.data == words(4)
    assert drives[2].counters().late == 1


def test_a_late_reply_is_recognised_during_the_drives_next_exchange(line: LineDriver, drive: Peer) -> None:
    time_out(line, drive)
    ask(line, drive, WRITE)
    line.receive(reply(1111))
    assert line.listens
    assert (drive.counters().late, drive.late_until_ns) == (1, 0)
    line.receive(build_request(Framing.RTU, WRITE) * 2)  # first the echo, then the equal confirmation
    assert line.completion.result == 8


def test_a_late_reply_is_not_reported_as_a_reply_from_another_address(line: LineDriver, drive: Peer) -> None:
    time_out(line, drive)
    ask(line, other := peer(), Message(2, 3, 0, 1))
    line.receive(reply(1111))
    line.wait_until_done()
    assert (line.completion.result, line.completion.skipped) == (Failure.NO_REPLY, 7)
    assert other.late_until_ns > line.now


def test_a_reply_is_accepted_although_its_data_look_like_a_late_reply(line: LineDriver, drive: Peer) -> None:
    """The data of the reply contain a copy of the late reply that is due."""
    time_out(line, drive)
    until = drive.late_until_ns
    inside = reply(1111) + b"\x00"
    ask(line, peer(), Message(2, 3, 0, 4))
    line.receive(build_reply(Framing.RTU, Message(2, 3, data=inside)), 1)
    assert line.completion.reply.data == inside
    assert (drive.counters().late, drive.late_until_ns) == (0, until)


def test_frame_from_a_drive_without_open_requests_is_not_a_late_reply(line: LineDriver, drive: Peer) -> None:
    time_out(line, drive)
    line.now = drive.late_until_ns
    ask(line, peer(), Message(2, 3, 0, 1))
    line.receive(reply(1111))
    line.wait_until_done()
    assert (line.completion.result, drive.counters().late) == (FrameFault.BAD_ADDRESS, 0)


def test_damaged_replies_are_not_counted_as_failures_of_the_drive(line: LineDriver, drive: Peer) -> None:
    for _ in range(5):
        ask(line, drive)
        line.receive(reply(1)[:-1] + b"\x00")
        line.wait_until_done()
        assert line.completion.result == FrameFault.BAD_CHECKSUM
    assert drive.failures == 0


def test_counters_include_every_exchange(line: LineDriver, drive: Peer) -> None:
    answer(line, drive, 5 * MS)
    time_out(line, drive)
    line.begin(exchange(OTHER, drive))
    line.now = drive.late_until_ns
    ask(line, drive)
    line.receive(b"\xff" + build_reply(Framing.RTU, Message(1, 3, exception=2)))
    counters = drive.counters()
    assert (counters.exchanges, counters.answered, counters.values, counters.exceptions) == (4, 2, 1, 1)
    assert counters.missed == {Status.NO_REPLY: 1, Status.LATE_ANSWER_DUE: 1}
    assert (counters.stray_bytes, counters.late) == (1, 0)


FIELDS = RowLayout(0, [Field(0, NumberFormat.U16, 0, 1.0, 1.0)])
FOR_A_CLIENT, FOR_A_ROW = {"values": FIELDS}, {"block": FIELDS}
STEADY = 60 * [15 * MS]


def all_looks(
    line: LineDriver, drive: Peer, delays: list[int], details: dict[str, RowLayout]
) -> list[tuple[int, int]]:
    return [looks(line, drive, delay, details) for delay in delays]


def test_seven_of_eight_replies_need_one_read_if_delays_are_constant(line: LineDriver, drive: Peer) -> None:
    all_looks(line, drive, STEADY, FOR_A_CLIENT)
    found = all_looks(line, drive, 80 * [15 * MS], FOR_A_CLIENT)
    assert sum(times == 1 for times, _ in found) == 70
    assert max(late for _, late in found) <= CHARACTER


def test_polled_replies_are_read_without_delay(line: LineDriver, drive: Peer) -> None:
    all_looks(line, drive, STEADY, FOR_A_CLIENT)
    found = all_looks(line, drive, STEADY, FOR_A_ROW)
    assert min(times for times, _ in found) > 1
    assert {late for _, late in found} == {0}


def test_replies_of_a_drive_with_varying_delays_are_read_without_delay(line: LineDriver, drive: Peer) -> None:
    all_looks(line, drive, 20 * [15 * MS, 19 * MS], FOR_A_CLIENT)
    assert {late for _, late in all_looks(line, drive, 20 * [15 * MS, 19 * MS], FOR_A_CLIENT)} == {0}


def test_the_port_is_read_earlier_when_constant_delays_become_shorter(line: LineDriver, drive: Peer) -> None:
    all_looks(line, drive, [*STEADY, *(120 * [5 * MS])], FOR_A_CLIENT)
    assert looks(line, drive, 5 * MS, FOR_A_CLIENT)[1] <= CHARACTER
    assert drive.response_delay < 6e-3


def test_the_port_is_read_later_when_constant_delays_become_longer(line: LineDriver, drive: Peer) -> None:
    found = all_looks(line, drive, [*STEADY, *(120 * [18 * MS])], FOR_A_CLIENT)
    assert max(late for _, late in found) <= CHARACTER
    assert drive.response_delay > 17.5e-3
