"""One line of simulated drives on simulated time: which drives receive a byte, and when."""

from __future__ import annotations

import checksums
import pytest
from lines import Own, timeline
from tables import table

from multidrop.drive import Drive
from multidrop.families.delixi_modbus import DelixiModbus
from multidrop.families.delixi_native import DelixiNative
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.families.yd1000 import YD1000
from multidrop.sim import SimulatedDrive, Wire, simulated

READ = checksums.rtu("01 03 00 01 00 01")
CHARACTER_8N1 = 10 / 9600


def exchange(wire: Wire, frame: bytes, now: float, baudrate: int | None = None) -> bytes:
    wire.receive(frame, now, baudrate)
    return b"".join(piece for _, piece in timeline(wire, now + 5))


def test_reply_starts_after_the_requests_last_bit_and_the_response_delay() -> None:
    wire = Wire([SimulatedDrive(Own(1, baudrate=9600), response_delay=0.02)])
    wire.receive(READ, 10.0)
    received = timeline(wire, 11.0)
    assert b"".join(piece for _, piece in received) == checksums.rtu("01 03 02 00 00")
    begin = 10.0 + 8 * CHARACTER_8N1 + 0.02
    assert received[0][0] == pytest.approx(begin + CHARACTER_8N1)
    assert received[-1][0] == pytest.approx(begin + 7 * CHARACTER_8N1)


@table("baudrate", [1200, 9600, 19200, 38400, 115200])
def test_each_byte_is_delivered_at_its_last_bit_or_slightly_later(baudrate: int) -> None:
    drive = Own(1, baudrate=baudrate)
    wire = Wire([SimulatedDrive(drive, response_delay=0.05)])
    wire.receive(checksums.rtu("01 03 00 01 00 02"), 0.0)
    character = 10 / baudrate
    begin = 8 * character + 0.05
    passed = 0
    for at, piece in timeline(wire, 1.0):
        passed += len(piece)
        ends = begin + passed * character
        assert at == pytest.approx(ends)  # the last byte of the piece is on time
        assert at - (ends - (len(piece) - 1) * character) <= max(1e-3, character) + 1e-9  # and the first one
    assert passed == 9


@table("family", [ErmanERG220, InvtCHE, InnovertIBD, DelixiModbus, YD1000])
@table("extra", [b"\0", b"\x01\x03", b"\xff\xff\xff"])
def test_valid_frame_followed_by_more_bytes_gets_no_reply(family: type[Drive], extra: bytes) -> None:
    """ERMAN, section 5: wrong length; CHE, 11.5; YD1000, section 5: nothing may follow the checksum."""
    wire = Wire([simulated(family(1))])
    register = next(each for each in wire.drives[0].drive.readings() if each.step is not None)
    good = checksums.rtu(f"01 {register.table.read:02X} {register.address:04X} 00 01")
    assert exchange(wire, good + extra, 10.0) == b""
    assert exchange(wire, good, 20.0) != b""


def test_rtu_reply_waits_t3_5_even_for_a_shorter_response_delay() -> None:
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
def test_silence_before_a_reply_is_that_of_the_family(drive: Drive, request_: str, silence: float) -> None:
    wire = Wire([simulated(drive, response_delay=0.0)])
    wire.receive(checksums.rtu(request_), 0.0)
    character = drive.settings.character
    assert timeline(wire, 1.0)[-1][0] == pytest.approx((8 + 7) * character + silence)


def test_unpaced_wire_replies_without_delay() -> None:
    wire = Wire([SimulatedDrive(Own(1), response_delay=0.5)], unpaced=True)
    wire.receive(READ, 10.0)
    assert wire.advance(10.0) == checksums.rtu("01 03 02 00 00")
    wire.receive(READ, 10.0)
    assert wire.advance(10.0) == checksums.rtu("01 03 02 00 00")


def test_request_too_soon_after_a_reply_gets_no_reply() -> None:
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


def test_request_during_a_reply_gets_no_reply() -> None:
    sim = SimulatedDrive(Own(1), response_delay=0.02)
    wire = Wire([sim])
    wire.receive(READ, 0.0)
    wire.advance(8 * CHARACTER_8N1 + 0.02 + 2 * CHARACTER_8N1)
    wire.receive(READ, 8 * CHARACTER_8N1 + 0.02 + 3 * CHARACTER_8N1)
    timeline(wire, 5.0)
    assert sim.counters.early == 1
    assert sim.counters.requests == 1


def test_early_request_is_counted_but_answered_unless_the_manual_forbids() -> None:
    sim = SimulatedDrive(Own(1), response_delay=0.02)
    wire = Wire([sim])
    wire.receive(READ, 0.0)
    end = timeline(wire, 5.0)[-1][0]
    assert exchange(wire, READ, end + 1e-3) != b""
    assert sim.counters.early == 1


def test_fast_drives_reply_precedes_a_slow_drives_late_reply() -> None:
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


def test_overlapping_replies_are_sent_one_after_another() -> None:
    slow, quick = SimulatedDrive(Own(1), response_delay=0.5), SimulatedDrive(Own(2), response_delay=0.01)
    wire = Wire([slow, quick])
    wire.receive(READ, 0.0)
    wire.receive(checksums.rtu("02 03 00 01 00 01"), 0.487)
    received = timeline(wire, 5.0)
    first, second = checksums.rtu("02 03 02 00 00"), checksums.rtu("01 03 02 00 00")
    assert b"".join(piece for _, piece in received) in (first + second, second + first)
    assert received[-1][0] - received[0][0] == pytest.approx(13 * CHARACTER_8N1)


def test_late_reply_is_sent_before_the_reply_to_the_next_request() -> None:
    slow, quick = SimulatedDrive(Own(1), response_delay=0.5), SimulatedDrive(Own(2), response_delay=0.01)
    slow["value"], quick["value"] = 1, 2
    wire = Wire([slow, quick])
    wire.receive(READ, 0.0)
    assert timeline(wire, 0.2) == []
    received = exchange(wire, checksums.rtu("02 03 00 01 00 01"), 0.6)
    assert received == checksums.rtu("01 03 02 00 01") + checksums.rtu("02 03 02 00 02")


def test_drives_of_two_framings_share_a_line() -> None:
    rtu, text = Own(1, framing="rtu"), Own(2, framing="ascii")
    native = DelixiNative(3)
    wire = Wire([simulated(rtu), simulated(text), simulated(native)], unpaced=True)
    for frame, reply in [
        (READ, checksums.rtu("01 03 02 00 00")),
        (checksums.ascii("020300010001"), checksums.ascii("0203020000")),
        (checksums.delixi("0303000000000000"), checksums.delixi("0303000100000000")),
        (READ, checksums.rtu("01 03 02 00 00")),
        (checksums.ascii("010300010001"), b""),  # this address belongs to the RTU drive
        (checksums.rtu("02 03 00 01 00 01"), b""),
    ]:
        wire.receive(frame, 0.0)
        assert wire.advance(10.0) == reply


def test_drive_receives_only_its_own_baud_rate() -> None:
    slow, fast = Own(1, baudrate=9600), Own(2, baudrate=19200)
    wire = Wire([simulated(slow), simulated(fast)])
    other = checksums.rtu("02 03 00 01 00 01")
    assert exchange(wire, READ, 0.0, 19200) == b""
    assert exchange(wire, READ, 10.0, 9600) != b""
    assert exchange(wire, other, 20.0, 9600) == b""
    assert exchange(wire, other, 30.0, 19200) != b""
    assert exchange(wire, READ, 40.0, None) != b""  # unknown baud rate: every drive receives


def test_frame_is_dropped_if_the_baud_rate_changes_within_it() -> None:
    wire = Wire([simulated(Own(1, baudrate=9600))])
    wire.receive(READ[:4], 0.0, 9600)
    wire.receive(b"", 0.001, 19200)
    assert exchange(wire, READ, 0.002, 9600) != b""


def test_all_drives_carry_out_a_broadcast_and_none_replies() -> None:
    sims = [
        simulated(Own(address, framing=framing))
        for address, framing in ((1, "rtu"), (2, "rtu"), (3, "ascii"))
    ]
    wire = Wire(sims)
    assert exchange(wire, checksums.rtu("00 06 00 01 00 2A"), 0.0) == b""
    assert [sim["value"] for sim in sims] == [42, 42, 0]


def test_request_to_an_absent_address_gets_no_reply() -> None:
    assert exchange(Wire([simulated(Own(1))]), checksums.rtu("09 03 00 01 00 01"), 0.0) == b""


def test_two_drives_with_the_same_address_are_refused() -> None:
    with pytest.raises(ValueError, match="the same address"):
        Wire([simulated(Own(1)), simulated(Own(1))])
    Wire([simulated(Own(1)), simulated(Own(1, framing="ascii")), simulated(Own(1, baudrate=19200))])
    with pytest.raises(ValueError, match="at least one drive"):
        Wire([])


def test_distort_can_change_replies() -> None:
    class Noisy(Wire):
        def distort(self, reply: bytes) -> bytes:
            return b"\x00" + reply

    assert exchange(Noisy([simulated(Own(1))]), READ, 0.0) == b"\x00" + checksums.rtu("01 03 02 00 00")


def test_idle_wire_has_no_wake_up_time() -> None:
    wire = Wire([simulated(each) for each in (ErmanERG220(1), InvtCHE(2), DelixiModbus(3))])
    assert wire.wake is None
    wire.receive(b"\x01", 0.0)
    assert wire.wake is not None
    timeline(wire, 1.0)
    assert wire.wake is None


def test_path_of_a_wire_that_is_not_open_raises_runtime_error() -> None:
    with pytest.raises(RuntimeError, match="not open"):
        _ = Wire([simulated(Own(1))], name="hall-1").path
