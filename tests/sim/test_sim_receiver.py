"""Split received bytes into requests; the frames are printed in the families' documents."""

import random

import checksums
import pytest
from tables import table

from multidrop.core import Framing
from multidrop.sim.receiver import Frame, Receiver

CHARACTER = 1e-3
GAP = 3.5e-3

READ = bytes.fromhex("01 03 00 01 00 04 15 C9")  # ERMAN, section 6
WRITE = bytes.fromhex("01 10 00 0C 00 02 04 00 C8 01 90 73 F8")  # ERMAN, section 7
RUN = b":010620000012C7\r\n"  # Delixi, part 2
OVER_TCP = bytes.fromhex("00 01 00 00 00 06 01 03 00 16 00 01")
NATIVE = b":010200020000000005\r\n"  # Delixi, part 3


def receiver_rtu() -> Receiver:
    return Receiver(Framing.RTU, CHARACTER, GAP)


def functions(frames: list[Frame]) -> list[int]:
    return [frame.function for frame in frames if frame.message]


def test_frame_has_the_times_of_its_first_and_last_bit() -> None:
    (frame,) = receiver_rtu().feed(READ, 10.0)
    assert frame.message is not None
    assert (frame.begin, frame.end) == pytest.approx((10.0, 10.008))


def test_frame_received_in_pieces_without_a_gap_is_one_frame() -> None:
    receiver = receiver_rtu()
    assert receiver.feed(WRITE[:5], 10.0) == []
    (frame,) = receiver.feed(WRITE[5:], 10.005)
    assert frame.begin == pytest.approx(10.0)
    assert frame.end == pytest.approx(10.013)


def test_bytes_received_too_fast_get_the_times_of_the_baud_rate() -> None:
    receiver = receiver_rtu()
    receiver.feed(WRITE[:5], 10.0)
    (frame,) = receiver.feed(WRITE[5:], 10.001)
    assert frame.end == pytest.approx(10.013)


def test_gap_within_a_frame_damages_it() -> None:
    receiver = receiver_rtu()
    receiver.feed(READ[:4], 10.0)
    assert functions(receiver.feed(READ[4:], 10.004 + GAP + 1e-4)) == []
    assert functions(receiver.feed(READ, 11.0)) == [3]


def test_valid_frame_after_garbage_is_received() -> None:
    assert functions(receiver_rtu().feed(b"\x55\x00\xff" + READ, 0.0)) == [3]


def test_garbage_that_looks_like_a_long_frame_does_not_hide_the_next_frame() -> None:
    promise = bytes.fromhex("01 10 00 00 00 7B F6")  # header of a request with 246 more bytes
    assert functions(receiver_rtu().feed(promise + READ, 0.0)) == [3]


def test_two_frames_in_one_chunk_are_both_received() -> None:
    assert functions(receiver_rtu().feed(READ + WRITE, 0.0)) == [3, 16]


@table("extra", [b"\x00", b"\x01", b"\x00\x00", b"\x01\x03", b"\xff" * 5, READ[:-1], READ[:-1] + b"\x00"])
def test_valid_frame_followed_by_other_bytes_is_not_a_request(extra: bytes) -> None:
    """ERMAN, section 5 (wrong length); YD1000, section 5 (nothing may follow the checksum); CHE, 11.5."""
    receiver = receiver_rtu()
    assert receiver.feed(READ + extra, 0.0) == []
    assert functions(receiver.silence(1.0)) == []
    assert functions(receiver.feed(READ, 2.0)) == [3]


def test_request_in_pieces_after_another_request_damages_neither() -> None:
    receiver = receiver_rtu()
    assert receiver.feed(READ + WRITE[:5], 0.0) == []
    assert functions(receiver.feed(WRITE[5:], 0.013)) == [3, 16]


def test_request_bytes_inside_a_longer_request_are_not_a_request() -> None:
    """The frame writes twelve registers whose values are a valid request; it is cut after that request."""
    whole = checksums.rtu(bytes.fromhex("01 10 00 00 00 0C 18") + READ + bytes(16))
    receiver = receiver_rtu()
    frames = receiver.feed(whole[:20], 0.0) + receiver.feed(whole[20:], 0.02)
    assert functions(frames) == [16]


def test_damaged_frame_is_reported_after_silence() -> None:
    receiver = receiver_rtu()
    bad = bytes.fromhex("01 04 00 01 00 05 15 C9")  # ERMAN, section 6: misprinted
    assert receiver.feed(bad, 0.0) == []
    assert receiver.silent_at == pytest.approx(0.008 + GAP)
    (frame,) = receiver.silence(1.0)
    assert (frame.intact, frame.message, frame.body) == (False, None, bad[:-2])
    assert receiver.silent_at is None


def test_frame_of_unknown_function_ends_with_silence() -> None:
    receiver = receiver_rtu()
    assert receiver.feed(checksums.rtu("01 2B"), 0.0) == []
    assert receiver.silence(0.004 + GAP / 2) == []
    (frame,) = receiver.silence(1.0)
    assert (frame.intact, frame.message, frame.address, frame.function) == (True, None, 1, 0x2B)


@pytest.mark.parametrize(("framing", "text"), [(Framing.ASCII, RUN), (Framing.DELIXI, NATIVE)])
def test_text_frames_are_split_at_their_line_ends(framing: Framing, text: bytes) -> None:
    receiver = Receiver(framing, CHARACTER, 1.0)
    assert receiver.feed(text[:7], 0.0) == []
    (frame,) = receiver.feed(text[7:], 0.5)
    assert frame.message is not None
    assert frame.address == 1


def test_colon_starts_a_new_text_frame() -> None:
    assert functions(Receiver(Framing.ASCII, CHARACTER, 1.0).feed(b"\xff:0106:01" + RUN, 0.0)) == [6]


def test_text_frame_with_a_wrong_checksum_is_damaged() -> None:
    (frame,) = Receiver(Framing.DELIXI, CHARACTER, 10e-3).feed(NATIVE.replace(b"05\r", b"06\r"), 0.0)
    assert (frame.intact, frame.message, frame.address) == (False, None, 1)


@table("text", [b":\r\n", b":0\r\n", b":01\r\n", b":0101\n", b"\n", b":XX0620\r\n", b"::\n"])
def test_incomplete_text_frames_are_ignored(text: bytes) -> None:
    assert Receiver(Framing.ASCII, CHARACTER, 1.0).feed(text, 0.0) == []


@pytest.mark.slow
@table("framing", list(Framing))
def test_random_bytes_never_raise_or_exceed_the_buffer_limit(framing: Framing) -> None:
    randomness = random.Random(1)
    good = {Framing.RTU: READ, Framing.ASCII: RUN, Framing.DELIXI: NATIVE, Framing.TCP: OVER_TCP}[framing]
    receiver = Receiver(framing, CHARACTER, GAP)
    now = 0.0
    for _ in range(300):
        chunk = randomness.choice([randomness.randbytes(randomness.randrange(1, 60)), good[:-3], b":" * 99])
        receiver.feed(chunk, now)
        now += randomness.choice([0.0, 0.01])
        assert len(receiver._buffer) <= 1024
    now += 1000
    receiver.silence(now)
    assert len(functions(receiver.feed(good, now))) == 1
