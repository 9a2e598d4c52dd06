"""A simulated line on simulated time: which drives receive a byte, and when they reply."""

from __future__ import annotations

import random

import checksums
import pytest
from lines import Own, timeline
from tables import table

from multidrop.core import Framing
from multidrop.drive import Drive
from multidrop.families.delixi import DelixiModbus, DelixiNative
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.families.yd1000 import YD1000
from multidrop.sim import SimulatedDrive, Wire, simulated
from multidrop.sim.receiver import Frame, Receiver

READ = checksums.rtu("01 03 00 01 00 01")
CHARACTER_8N1 = 10 / 9600


def exchange(wire: Wire, frame: bytes, now: float, baudrate: int | None = None) -> bytes:
    wire.receive(frame, now, baudrate)
    return b"".join(piece for _, piece in timeline(wire, now + 5))


def test_simulated_reply_starts_one_response_delay_after_the_request() -> None:
    wire = Wire([SimulatedDrive(Own(1, baudrate=9600), response_delay=0.02)])
    wire.receive(READ, 10.0)
    received = timeline(wire, 11.0)
    assert b"".join(piece for _, piece in received) == checksums.rtu("01 03 02 00 00")
    begin = 10.0 + 8 * CHARACTER_8N1 + 0.02
    assert received[0][0] == pytest.approx(begin + CHARACTER_8N1)
    assert received[-1][0] == pytest.approx(begin + 7 * CHARACTER_8N1)


@table("baudrate", [1200, 9600, 19200, 38400, 115200])
def test_each_simulated_byte_arrives_at_its_last_bit_or_slightly_later(baudrate: int) -> None:
    drive = Own(1, baudrate=baudrate)
    wire = Wire([SimulatedDrive(drive, response_delay=0.05)])
    wire.receive(checksums.rtu("01 03 00 01 00 02"), 0.0)
    character = 10 / baudrate
    begin = 8 * character + 0.05
    passed = 0
    for at, piece in timeline(wire, 1.0):
        passed += len(piece)
        ends = begin + passed * character
        assert at == pytest.approx(ends)  # the last byte of each chunk arrives at its last bit
        # A chunk arrives as a whole, so its first byte arrives late: at most 1 ms after the byte's last bit,
        # or at most one character if that is longer.
        assert at - (ends - (len(piece) - 1) * character) <= max(1e-3, character) + 1e-9
    assert passed == 9


@table("family", [ErmanERG220, InvtCHE, InnovertIBD, DelixiModbus, YD1000])
@table("extra", [b"\0", b"\x01\x03", b"\xff\xff\xff"])
def test_simulated_drive_ignores_a_frame_followed_by_more_bytes(family: type[Drive], extra: bytes) -> None:
    """The manuals allow no byte after the checksum (ERMAN, section 5; INVT CHE, 11.5; YD1000, section 5)."""
    wire = Wire([simulated(family(1))])
    register = next(each for each in wire.drives[0].drive.readings() if each.step is not None)
    good = checksums.rtu(f"01 {register.table.read:02X} {register.address:04X} 00 01")
    assert exchange(wire, good + extra, 10.0) == b""
    assert exchange(wire, good, 20.0) != b""


def test_simulated_rtu_reply_waits_t3_5_even_with_a_shorter_response_delay() -> None:
    wire = Wire([SimulatedDrive(Own(1, baudrate=9600), response_delay=0.0)])
    wire.receive(READ, 0.0)
    assert timeline(wire, 1.0)[0][0] == pytest.approx((8 + 3.5 + 1) * CHARACTER_8N1)


@pytest.mark.parametrize(
    ("drive", "request_", "silence"),
    [
        (ErmanERG220(1), "01 04 00 01 00 01", 1.75e-3),
        (InnovertIBD(1), "01 03 00 03 00 01", 10e-3),
        (YD1000(1), "01 03 11 00 00 01", 24 * 11 / 9600),
    ],
    ids=lambda each: getattr(each, "model", None),
)
def test_silence_before_a_simulated_reply_depends_on_the_family(
    drive: Drive, request_: str, silence: float
) -> None:
    wire = Wire([simulated(drive, response_delay=0.0)])
    wire.receive(checksums.rtu(request_), 0.0)
    character = drive.settings.character
    assert timeline(wire, 1.0)[-1][0] == pytest.approx((8 + 7) * character + silence)


def test_simulated_line_without_pacing_replies_without_delay() -> None:
    wire = Wire([SimulatedDrive(Own(1), response_delay=0.5)], unpaced=True)
    wire.receive(READ, 10.0)
    assert wire.advance(10.0) == checksums.rtu("01 03 02 00 00")
    wire.receive(READ, 10.0)
    assert wire.advance(10.0) == checksums.rtu("01 03 02 00 00")


def test_simulated_drive_ignores_a_request_too_soon_after_a_reply() -> None:
    sim = simulated(InnovertIBD(1))
    wire = Wire([sim])
    request = checksums.rtu("01 03 00 03 00 01")
    wire.receive(request, 0.0)
    end = timeline(wire, 5.0)[-1][0]
    assert exchange(wire, request, end + 9.5e-3) == b""
    assert sim.counters.early == 1
    assert exchange(wire, request, end + 1.0) != b""
    end = 100.0
    wire.receive(request, end)
    end = timeline(wire, end + 5)[-1][0]
    assert exchange(wire, request, end + 10e-3) != b""
    assert sim.counters.early == 1


def test_simulated_drive_ignores_a_request_during_a_reply() -> None:
    sim = SimulatedDrive(Own(1), response_delay=0.02)
    wire = Wire([sim])
    wire.receive(READ, 0.0)
    wire.advance(8 * CHARACTER_8N1 + 0.02 + 2 * CHARACTER_8N1)
    wire.receive(READ, 8 * CHARACTER_8N1 + 0.02 + 3 * CHARACTER_8N1)
    timeline(wire, 5.0)
    assert sim.counters.early == 1
    assert sim.counters.requests == 1


def test_simulated_drive_answers_an_early_request_by_default() -> None:
    sim = SimulatedDrive(Own(1), response_delay=0.02)
    wire = Wire([sim])
    wire.receive(READ, 0.0)
    end = timeline(wire, 5.0)[-1][0]
    assert exchange(wire, READ, end + 1e-3) != b""
    assert sim.counters.early == 1


def test_fast_drive_replies_before_the_late_reply_of_a_slow_drive() -> None:
    slow, quick = SimulatedDrive(Own(1), response_delay=0.5), SimulatedDrive(Own(2), response_delay=0.01)
    slow["value"], quick["value"] = 1, 2
    wire = Wire([slow, quick])
    wire.receive(READ, 0.0)
    wire.receive(checksums.rtu("02 03 00 01 00 01"), 0.2)
    received = timeline(wire, 5.0)
    quick_reply, slow_reply = checksums.rtu("02 03 02 00 02"), checksums.rtu("01 03 02 00 01")
    assert b"".join(piece for _, piece in received) == quick_reply + slow_reply
    assert received[6][0] == pytest.approx(0.2 + 0.01 + (8 + 7) * CHARACTER_8N1)
    assert received[-1][0] == pytest.approx(0.5 + (8 + 7) * CHARACTER_8N1)


def test_overlapping_simulated_replies_are_sent_one_after_another() -> None:
    slow, quick = SimulatedDrive(Own(1), response_delay=0.5), SimulatedDrive(Own(2), response_delay=0.01)
    wire = Wire([slow, quick])
    wire.receive(READ, 0.0)
    wire.receive(checksums.rtu("02 03 00 01 00 01"), 0.487)
    received = timeline(wire, 5.0)
    first, second = checksums.rtu("02 03 02 00 00"), checksums.rtu("01 03 02 00 00")
    assert b"".join(piece for _, piece in received) in (first + second, second + first)
    assert received[-1][0] - received[0][0] == pytest.approx(13 * CHARACTER_8N1)


def test_late_simulated_reply_is_sent_before_the_next_reply() -> None:
    slow, quick = SimulatedDrive(Own(1), response_delay=0.5), SimulatedDrive(Own(2), response_delay=0.01)
    slow["value"], quick["value"] = 1, 2
    wire = Wire([slow, quick])
    wire.receive(READ, 0.0)
    assert timeline(wire, 0.2) == []
    received = exchange(wire, checksums.rtu("02 03 00 01 00 01"), 0.6)
    assert received == checksums.rtu("01 03 02 00 01") + checksums.rtu("02 03 02 00 02")


def test_simulated_drives_with_three_framings_share_a_line() -> None:
    rtu, text = Own(1, framing="rtu"), Own(2, framing="ascii")
    native = DelixiNative(3)
    wire = Wire([simulated(rtu), simulated(text), simulated(native)], unpaced=True)
    for frame, reply in [
        (READ, checksums.rtu("01 03 02 00 00")),
        (checksums.ascii("020300010001"), checksums.ascii("0203020000")),
        (checksums.delixi("0303000000000000"), checksums.delixi("0303000100000000")),
        (READ, checksums.rtu("01 03 02 00 00")),
        (checksums.ascii("010300010001"), b""),  # no reply, because this address is that of the RTU drive
        (checksums.rtu("02 03 00 01 00 01"), b""),
    ]:
        wire.receive(frame, 0.0)
        assert wire.advance(10.0) == reply


def test_simulated_drive_ignores_requests_at_another_baud_rate() -> None:
    slow, fast = Own(1, baudrate=9600), Own(2, baudrate=19200)
    wire = Wire([simulated(slow), simulated(fast)])
    other = checksums.rtu("02 03 00 01 00 01")
    assert exchange(wire, READ, 0.0, 19200) == b""
    assert exchange(wire, READ, 10.0, 9600) != b""
    assert exchange(wire, other, 20.0, 9600) == b""
    assert exchange(wire, other, 30.0, 19200) != b""
    # the client's baud rate is unknown, so every drive receives the request
    assert exchange(wire, READ, 40.0, None) != b""


def test_incomplete_frame_is_discarded_when_the_baud_rate_changes() -> None:
    wire = Wire([simulated(Own(1, baudrate=9600))])
    wire.receive(READ[:4], 0.0, 9600)
    wire.receive(b"", 0.001, 19200)
    assert exchange(wire, READ, 0.002, 9600) != b""


def test_broadcast_changes_only_simulated_drives_of_the_same_framing() -> None:
    sims = [
        simulated(Own(address, framing=framing))
        for address, framing in ((1, "rtu"), (2, "rtu"), (3, "ascii"))
    ]
    wire = Wire(sims)
    assert exchange(wire, checksums.rtu("00 06 00 01 00 2A"), 0.0) == b""
    assert [sim["value"] for sim in sims] == [42, 42, 0]


def test_request_to_an_absent_simulated_drive_gets_no_reply() -> None:
    assert exchange(Wire([simulated(Own(1))]), checksums.rtu("09 03 00 01 00 01"), 0.0) == b""


def test_two_simulated_drives_with_the_same_address_are_refused() -> None:
    with pytest.raises(ValueError, match="the same address"):
        Wire([simulated(Own(1)), simulated(Own(1))])
    Wire([simulated(Own(1)), simulated(Own(1, framing="ascii")), simulated(Own(1, baudrate=19200))])
    with pytest.raises(ValueError, match="at least one drive"):
        Wire([])


def test_a_subclass_of_wire_can_change_simulated_replies() -> None:
    class Noisy(Wire):
        def distort(self, reply: bytes) -> bytes:
            return b"\x00" + reply

    assert exchange(Noisy([simulated(Own(1))]), READ, 0.0) == b"\x00" + checksums.rtu("01 03 02 00 00")


def test_idle_simulated_wire_has_no_next_wake_up_time() -> None:
    wire = Wire([simulated(each) for each in (ErmanERG220(1), InvtCHE(2), DelixiModbus(3))])
    assert wire.wake is None
    wire.receive(b"\x01", 0.0)
    assert wire.wake is not None
    timeline(wire, 1.0)
    assert wire.wake is None


def test_the_path_of_a_closed_simulated_wire_raises_runtime_error() -> None:
    with pytest.raises(RuntimeError, match="not open"):
        _ = Wire([simulated(Own(1))], name="hall-1").path


CHARACTER = 1e-3
GAP = 3.5e-3

READ_FRAME = bytes.fromhex("01 03 00 01 00 04 15 C9")  # the frame in section 6 of the ERMAN document
# the frame in section 7 of the ERMAN document
WRITE = bytes.fromhex("01 10 00 0C 00 02 04 00 C8 01 90 73 F8")
RUN = b":010620000012C7\r\n"  # the frame in part 2 of Delixi's document
OVER_TCP = bytes.fromhex("00 01 00 00 00 06 01 03 00 16 00 01")
NATIVE = b":010200020000000005\r\n"  # the frame in part 3 of Delixi's document


def receiver_rtu() -> Receiver:
    return Receiver(Framing.RTU, CHARACTER, GAP)


def functions(frames: list[Frame]) -> list[int]:
    return [frame.function for frame in frames if frame.message]


def test_received_frame_has_the_times_of_its_first_and_last_bit() -> None:
    (frame,) = receiver_rtu().feed(READ_FRAME, 10.0)
    assert frame.message is not None
    assert (frame.begin, frame.end) == pytest.approx((10.0, 10.008))


def test_frame_received_in_chunks_without_a_pause_is_one_frame() -> None:
    receiver = receiver_rtu()
    assert receiver.feed(WRITE[:5], 10.0) == []
    (frame,) = receiver.feed(WRITE[5:], 10.005)
    assert frame.begin == pytest.approx(10.0)
    assert frame.end == pytest.approx(10.013)


def test_end_time_of_a_frame_is_computed_from_the_baud_rate() -> None:
    receiver = receiver_rtu()
    receiver.feed(WRITE[:5], 10.0)
    (frame,) = receiver.feed(WRITE[5:], 10.001)
    assert frame.end == pytest.approx(10.013)


def test_frame_with_a_pause_inside_is_not_received() -> None:
    receiver = receiver_rtu()
    receiver.feed(READ_FRAME[:4], 10.0)
    assert functions(receiver.feed(READ_FRAME[4:], 10.004 + GAP + 1e-4)) == []
    assert functions(receiver.feed(READ_FRAME, 11.0)) == [3]


def test_valid_frame_after_garbage_is_received() -> None:
    assert functions(receiver_rtu().feed(b"\x55\x00\xff" + READ_FRAME, 0.0)) == [3]


def test_garbage_that_looks_like_a_long_frame_does_not_hide_the_next_frame() -> None:
    promise = bytes.fromhex("01 10 00 00 00 7B F6")  # the header of a request that announces 246 more bytes
    assert functions(receiver_rtu().feed(promise + READ_FRAME, 0.0)) == [3]


def test_two_frames_in_one_chunk_are_both_received() -> None:
    assert functions(receiver_rtu().feed(READ_FRAME + WRITE, 0.0)) == [3, 16]


@table(
    "extra",
    [b"\x00", b"\x01", b"\x00\x00", b"\x01\x03", b"\xff" * 5, READ_FRAME[:-1], READ_FRAME[:-1] + b"\x00"],
)
def test_valid_frame_followed_by_other_bytes_is_not_a_request(extra: bytes) -> None:
    receiver = receiver_rtu()
    assert receiver.feed(READ_FRAME + extra, 0.0) == []
    assert functions(receiver.silence(1.0)) == []
    assert functions(receiver.feed(READ_FRAME, 2.0)) == [3]


def test_two_requests_are_received_if_the_second_arrives_in_chunks() -> None:
    receiver = receiver_rtu()
    assert receiver.feed(READ_FRAME + WRITE[:5], 0.0) == []
    assert functions(receiver.feed(WRITE[5:], 0.013)) == [3, 16]


def test_valid_frame_inside_a_longer_request_is_not_received_separately() -> None:
    """A long frame contains a valid request. Its first chunk ends some bytes after that request."""
    whole = checksums.rtu(bytes.fromhex("01 10 00 00 00 0C 18") + READ_FRAME + bytes(16))
    receiver = receiver_rtu()
    frames = receiver.feed(whole[:20], 0.0) + receiver.feed(whole[20:], 0.02)
    assert functions(frames) == [16]


def test_damaged_frame_is_reported_after_silence() -> None:
    receiver = receiver_rtu()
    # the frame in section 6 of the ERMAN document, with its misprinted checksum
    bad = bytes.fromhex("01 04 00 01 00 05 15 C9")
    assert receiver.feed(bad, 0.0) == []
    assert receiver.silent_at == pytest.approx(0.008 + GAP)
    (frame,) = receiver.silence(1.0)
    assert (frame.intact, frame.message, frame.body) == (False, None, bad[:-2])
    assert receiver.silent_at is None


def test_frame_with_an_unknown_function_ends_with_silence() -> None:
    receiver = receiver_rtu()
    assert receiver.feed(checksums.rtu("01 2B"), 0.0) == []
    assert receiver.silence(0.004 + GAP / 2) == []
    (frame,) = receiver.silence(1.0)
    assert (frame.intact, frame.message, frame.address, frame.function) == (True, None, 1, 0x2B)


@table(("framing", "text"), [(Framing.ASCII, RUN), (Framing.DELIXI, NATIVE)])
def test_ascii_or_delixi_frame_is_complete_after_its_line_ending(framing: Framing, text: bytes) -> None:
    receiver = Receiver(framing, CHARACTER, 1.0)
    assert receiver.feed(text[:7], 0.0) == []
    (frame,) = receiver.feed(text[7:], 0.5)
    assert frame.message is not None
    assert frame.address == 1


def test_a_colon_starts_a_new_text_frame() -> None:
    assert functions(Receiver(Framing.ASCII, CHARACTER, 1.0).feed(b"\xff:0106:01" + RUN, 0.0)) == [6]


def test_text_frame_with_a_wrong_checksum_is_damaged() -> None:
    (frame,) = Receiver(Framing.DELIXI, CHARACTER, 10e-3).feed(NATIVE.replace(b"05\r", b"06\r"), 0.0)
    assert (frame.intact, frame.message, frame.address) == (False, None, 1)


@table("text", [b":\r\n", b":0\r\n", b":01\r\n", b":0101\n", b"\n", b":XX0620\r\n", b"::\n"])
def test_incomplete_text_frames_are_ignored(text: bytes) -> None:
    assert Receiver(Framing.ASCII, CHARACTER, 1.0).feed(text, 0.0) == []


@pytest.mark.slow
@table("framing", list(Framing))
def test_receiver_buffer_stays_limited_for_random_bytes(framing: Framing) -> None:
    randomness = random.Random(1)
    good = {Framing.RTU: READ_FRAME, Framing.ASCII: RUN, Framing.DELIXI: NATIVE, Framing.TCP: OVER_TCP}[
        framing
    ]
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
