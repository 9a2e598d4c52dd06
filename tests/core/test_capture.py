"""Sniffed bytes are split into requests and replies: frames from the documents, mixed and damaged."""

from __future__ import annotations

import random
from collections.abc import Iterable
from functools import partial
from itertools import pairwise

import pytest
from frames import PRINTED, Printed
from hypothesis import given
from hypothesis import strategies as st
from interruptions import every, interrupted
from tables import table

from multidrop.core import (
    STREAM_ROOM,
    Columns,
    Decoded,
    Decoder,
    Field,
    FrameSpan,
    Framing,
    Kind,
    Message,
    NumberFormat,
    RowLayout,
    Side,
    Splitter,
    Stream,
    Unpacker,
)

Pair = tuple[Printed, Printed]
REPLIES = [each for each in PRINTED if each.request is not None and isinstance(each.says, Message)]
WRITE = bytes.fromhex("01 06 20 01 13 88 DE 9C")  # a write, whose reply is equal
READ, ANSWER = bytes.fromhex("01 03 00 16 00 01 65 CE"), bytes.fromhex("01 03 02 18 00 B2 44")
OTHER_READ = bytes.fromhex("01 03 01 F4 00 01 C4 04")
ALSO_ANSWER = bytes.fromhex("01 03 02 13 88 B5 12")  # another reply with the length of ANSWER


def split(*pieces: bytes) -> list[FrameSpan]:
    """Return the spans of a stream's pieces; piece i is received at time i."""
    stream = Stream()
    for time, piece in enumerate(pieces):
        stream.put(piece, time)
    stream.end(True)
    return list(Splitter().spans(stream))


def kinds(spans: Iterable[FrameSpan]) -> list[Kind]:
    return [span.kind for span in spans]


def raw(spans: Iterable[FrameSpan]) -> list[tuple[Kind, bytes]]:
    return [(span.kind, span.raw) for span in spans]


@table("reply", REPLIES)
def test_exchange_printed_in_a_manual_is_split_into_request_and_reply(reply: Printed) -> None:
    asked, answered = split(reply.request_frame, reply.frame)
    assert (answered.kind, answered.framing) == (Kind.REPLY, reply.framing)
    assert asked.kind in (Kind.REQUEST, Kind.EITHER)
    assert (asked.message, answered.message) == (reply.request, reply.says)
    assert (asked.raw, answered.raw) == (reply.request_frame, reply.frame)


@given(st.lists(st.sampled_from(REPLIES), max_size=30), st.data())
def test_same_frames_are_found_however_the_bytes_are_cut(line: list[Printed], data: st.DataObject) -> None:
    bytes_ = READ + ANSWER + b"".join(each.request_frame + each.frame for each in line)
    stream, splitter, spans = Stream(), Splitter(), []
    at = 0
    while at < len(bytes_):
        size = data.draw(st.integers(1, 60))
        stream.put(bytes_[at : at + size], at)
        spans += splitter.spans(stream)
        at += size
    stream.end(True)
    spans += splitter.spans(stream)
    expected = [(Kind.REQUEST, READ), (Kind.REPLY, ANSWER)]
    for each in line:
        expected += [(Kind.REQUEST, each.request_frame), (Kind.REPLY, each.frame)]
    assert raw(spans) == expected


@given(
    st.lists(
        st.binary(min_size=1, max_size=40) | st.sampled_from([reply.frame for reply in REPLIES]), max_size=30
    )
)
def test_every_sniffed_byte_is_reported_exactly_once(pieces: list[bytes]) -> None:
    assert b"".join(span.raw for span in split(*pieces)) == b"".join(pieces)


def test_a_sniffed_frame_has_the_time_of_its_first_piece() -> None:
    spans = split(READ[:3], READ[3:] + ANSWER[:2], ANSWER[2:], b"\xff")
    assert [span.time_ns for span in spans] == [0, 1, 3]


def test_second_copy_of_a_write_request_counts_as_the_reply() -> None:
    assert kinds(split(READ, ANSWER, *[WRITE] * 6)) == [Kind.REQUEST, Kind.REPLY] * 4


def test_a_write_frame_after_junk_may_be_request_or_reply() -> None:
    assert kinds(split(WRITE)) == [Kind.EITHER]
    assert kinds(split(READ, ANSWER, WRITE[:-1], WRITE, READ)) == [
        *(Kind.REQUEST, Kind.REPLY, Kind.JUNK, Kind.EITHER, Kind.REQUEST)
    ]


def test_a_delixi_reply_is_not_mistaken_for_a_request() -> None:
    (query,) = {reply for reply in REPLIES if reply.request_frame.startswith(b":0107")}
    assert raw(split(query.request_frame[:-3], query.frame, query.request_frame, query.frame)) == [
        (Kind.JUNK, query.request_frame[:-3]),
        (Kind.STRAY, query.frame),
        (Kind.REQUEST, query.request_frame),
        (Kind.REPLY, query.frame),
    ]


def test_repeated_write_from_the_masters_side_is_no_reply() -> None:
    stream = Stream()
    stream.put(WRITE, 0, side=Side.ANSWERING)
    stream.put(WRITE, 1, side=Side.ASKING)
    stream.put(WRITE, 2, side=Side.ASKING)
    stream.put(WRITE, 3, side=Side.ANSWERING)
    stream.end(True)
    spans = list(Splitter().spans(stream))
    assert kinds(spans) == [Kind.JUNK, Kind.REQUEST, Kind.REQUEST, Kind.REPLY]
    assert b"".join(span.raw for span in spans) == 4 * WRITE


def test_reply_after_a_damaged_request_is_not_paired_with_an_older_request() -> None:
    damaged = bytes([OTHER_READ[0] ^ 1]) + OTHER_READ[1:]
    assert kinds(split(READ, damaged, ALSO_ANSWER)) == [Kind.REQUEST, Kind.JUNK, Kind.STRAY]


def test_a_reply_after_a_damaged_request_is_stray() -> None:
    lost = OTHER_READ[:-1]
    assert kinds(split(READ, ANSWER, WRITE, lost, ALSO_ANSWER, WRITE, WRITE)) == [
        *(Kind.REQUEST, Kind.REPLY, Kind.REQUEST, Kind.JUNK, Kind.STRAY, Kind.REQUEST, Kind.REPLY)
    ]


def test_exchange_continues_after_a_reply_from_another_address() -> None:
    other = bytes.fromhex("02 83 02 30 F1")
    assert kinds(split(READ, other, ANSWER)) == [Kind.REQUEST, Kind.STRAY, Kind.REPLY]


def test_a_reply_after_two_equal_requests_belongs_to_the_second() -> None:
    assert kinds(split(READ, READ, ANSWER, ANSWER)) == [*(Kind.REQUEST, Kind.REQUEST, Kind.REPLY, Kind.STRAY)]


def test_a_reply_is_found_after_noise() -> None:
    assert raw(split(READ, b"\xff\x00", ANSWER)) == [
        (Kind.REQUEST, READ),
        (Kind.JUNK, b"\xff\x00"),
        (Kind.REPLY, ANSWER),
    ]


@pytest.mark.parametrize("first", ["", "FF"])
def test_pause_ends_a_false_frame_start_in_junk(first: str) -> None:
    """The junk looks like the start of a long write, and the next frames look like the rest of that write."""
    junk = bytes.fromhex(first + "01 10 00 00 00 7B F6")
    stream, splitter = Stream(), Splitter()
    stream.put(READ + ANSWER[:2], 0)
    stream.put(junk, 1)
    stream.put(OTHER_READ, 2, after_pause=True)
    stream.put(ALSO_ANSWER, 3, after_pause=True)
    spans = list(splitter.spans(stream))
    assert raw(spans)[-2:] == [(Kind.REQUEST, OTHER_READ), (Kind.REPLY, ALSO_ANSWER)]
    assert b"".join(span.raw for span in spans if span.kind is Kind.JUNK) == ANSWER[:2] + junk


def test_the_splitter_waits_for_the_rest_of_a_long_frame_if_pauses_are_unknown() -> None:
    stream, splitter = Stream(), Splitter()
    stream.put(bytes.fromhex("01 10 00 00 00 7B F6") + OTHER_READ, 0)
    assert list(splitter.spans(stream)) == []
    stream.end(True)
    assert kinds(splitter.spans(stream)) == [Kind.JUNK, Kind.REQUEST]


def test_bytes_that_cannot_be_a_frame_are_reported_as_junk_immediately() -> None:
    stream, splitter = Stream(), Splitter()
    stream.put(b"\xff" * 1000, 0)
    assert sum(len(span.raw) for span in splitter.spans(stream)) > 990


def test_adding_bytes_to_a_full_stream_raises() -> None:
    stream = Stream()
    stream.put(bytes(STREAM_ROOM), 0)
    with pytest.raises(BufferError, match=r"take its frames with Splitter\.spans first"):
        stream.put(b"\0", 1)


def damaged(frame: bytes, chance: random.Random) -> bytes:
    """Return the frame with one byte in a hundred changed, removed or doubled."""
    found = bytearray()
    for byte in frame:
        kind = chance.choice(["changed", "lost", "doubled"]) if chance.random() < 0.01 else ""
        if kind != "lost":
            found.append(byte ^ chance.randrange(1, 256) if kind == "changed" else byte)
        if kind == "doubled":
            found.append(byte)
    return bytes(found)


@pytest.mark.long
@table("seed", range(5))
def test_all_exchanges_are_found_except_next_to_damaged_frames(seed: int) -> None:
    chance = random.Random(seed)
    line = chance.choices(REPLIES, k=2000)
    sent = [frame for each in line for frame in (each.request_frame, each.frame)]
    came = [damaged(frame, chance) for frame in sent]
    found = split(*came)
    spans = {(span.kind, span.time_ns, span.raw) for span in found}
    whole = [came[i] == sent[i] for i in range(len(sent))]
    expected = range(2, len(sent) - 2, 2)
    expected = [i for i in expected if all(whole[i - 2 : i + 4])]
    assert len(expected) > 500
    for i in expected:
        assert (Kind.REQUEST, i, sent[i]) in spans
        assert (Kind.REPLY, i + 1, sent[i + 1]) in spans
    frames = [span for span in found if span.kind is not Kind.JUNK]
    for asked, answered in pairwise(frames):  # checks also that each reply is assigned to its request
        if answered.kind is Kind.REPLY:
            assert answered.time_ns == asked.time_ns + 1 or answered.raw == asked.raw


def test_the_framing_of_each_frame_is_detected() -> None:
    by_framing = {reply.framing: reply for reply in REPLIES}
    assert set(by_framing) == {*Framing} - {Framing.TCP}  # Modbus TCP streams never mix with other framings
    frames = [each.request_frame + each.frame for each in by_framing.values()]
    assert [span.framing for span in split(*frames, *frames)] == [
        framing for framing in (*by_framing, *by_framing) for _ in range(2)
    ]


def test_an_interrupted_decoder_reads_no_freed_memory() -> None:
    """After an interruption, the decoder decodes the file's next bytes. A memory sanitizer checks this."""

    def act(nth: int) -> bool:
        decoder, stream, columns = Decoder(), Stream(), Columns(16)
        unpacker = Unpacker(0, is_pcapng=False, is_big_endian=False)
        unpacker.look_at(bytes(100_000), 0)
        was = interrupted(partial(unpacker.look_at, bytes(200_000), 0), nth, set())
        unpacker.unpack()
        for time in (0, 1):
            stream.put(READ + ANSWER + READ, time)
            while decoder.decode(stream, columns) is Decoded.UNKNOWN:
                decoder.know(RowLayout(0, [Field(0, NumberFormat.U16, 0, 1, 1)]))
            was |= interrupted(decoder.forget, nth, set())
        return was

    assert every(1, act) > 5
