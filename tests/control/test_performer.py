"""Verbs and plain writes, step by step: their results, cancellations, undone commands, errors and logs."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from motors import MAKE
from profile_families import MAKE as PROFILES
from simulated_bus import Meanwhile, SimulatedBus, is_write, one, starts, writes
from tables import table, usually

from multidrop import DelixiNative, InnovertIBD
from multidrop.control import records
from multidrop.control.call import written_before
from multidrop.control.outcome import Effect, Seen, Stopped
from multidrop.control.ramp import ramp
from multidrop.control.records import read_audit, written_by
from multidrop.core import Message
from multidrop.drive import Direction, Drive, Script, State, read, write
from multidrop.drive.register import Kept, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import (
    BusError,
    CancelledByStop,
    DriveException,
    Expired,
    LineError,
    NotVerified,
    Unconfirmed,
    WriteForbidden,
)
from multidrop.families import YD1000, DelixiModbus, ErmanERG220, InvtCHE
from multidrop.families.invt_che import CHEControl
from multidrop.sim import MotorDrive, simulated


class Stubborn(Drive):
    """A user's drive whose start retries after each BusError."""

    model = "stubborn"
    title = "OWN 4"
    speed = reading(0x10, "rpm")
    run = setting(0x20, kept=Kept.RAM)

    @verb
    def start(self, direction: Direction | None = None) -> Script[Any]:
        """Start the motor, and return its speed."""
        for _ in range(5):
            try:
                yield from read(self.speed)
                yield from write(self.run, 1)
            except BusError:
                continue
            return (yield from read(self.speed)) + 7
        return None

    @verb
    def stop(self) -> Script[None]:
        yield from write(self.run, 0)


def stubborn() -> tuple[SimulatedBus, Any]:
    line = SimulatedBus(simulated(Stubborn(1)))
    drive = line.attach(Stubborn(1, name="fan", confirmed=1))
    line.bus.check_identity(drive)
    return line, drive


def call_stop_at(line: SimulatedBus, drive: Any, nth: int) -> None:
    """Call the drive's stop, as from another thread, when the nth request from now on is sent."""
    begun = len(line.frames)

    def note(request: Message) -> bytes | None:
        if len(line.frames) == begun + nth:
            line.bus._latches.rise([drive])
        return None

    line.answers = note


def test_a_verb_returns_the_result_of_its_script() -> None:
    _, drive = stubborn()
    assert drive.start() == 7


@table("model", MAKE)
def test_a_verb_returns_a_command_result(model: str) -> None:
    _, drive, _ = one(MAKE[model](1))
    for result in (drive.set_frequency(20), drive.start(), drive.stop()):
        assert result.ok
    assert result.text.startswith("stopped: seen to stand after")
    assert isinstance(drive.state(), State)


def test_a_cancelled_start_sends_no_write_although_the_script_continues() -> None:
    line, drive = stubborn()
    call_stop_at(line, drive, 1)
    with pytest.raises(
        CancelledByStop, match=r"^fan: the start was not sent: a stop was called; nothing more was sent$"
    ):
        drive.start()
    assert line.written == []


def test_the_error_of_a_cancelled_ramp_names_the_unsent_write() -> None:
    line, drive, _ = one(YD1000(1))
    drive.set_frequency(10)
    before = len(line.written)
    call_stop_at(line, drive, 3)
    with pytest.raises(CancelledByStop, match=r"^yd1000@1: frequency was not sent: a stop was called"):
        ramp(drive, 20.0)
    assert len(line.written) == before


def test_the_fault_reset_coil_is_cleared_after_a_stop_during_the_reset(tmp_path: Path) -> None:
    """Otherwise the reset coil would stay on, and reset the next fault by itself."""
    audit = tmp_path / "audit"
    line, drive, _ = one(ErmanERG220(1), audit=audit)
    line.bus.check_identity(drive)

    def note(request: Message) -> bytes | None:
        if is_write(request) and request.start == 9 and request.data != b"\0\0":
            line.bus._latches.rise([drive])
        return None

    line.answers = note
    with pytest.raises(Unconfirmed, match="it was sent, and then a stop was called"):
        drive.reset_fault()
    noted = [entry["write"] for entry in read_audit(audit)]
    assert noted == ["start_coil = OFF", "fault_reset_coil = ON", "fault_reset_coil = OFF"]
    line.bus.close()


def test_a_stop_sent_as_a_register_write_is_recorded(tmp_path: Path) -> None:
    line, drive, _ = one(InvtCHE(1), audit=tmp_path / "audit")
    drive.write(drive.control, CHEControl.STOP)
    line.bus._records.flush(60)
    (entry,) = read_audit(tmp_path / "audit")
    assert (entry["write"], entry["outcome"]) == ("control = STOP", "done")
    line.bus.close()


def test_no_read_is_sent_for_an_expired_write() -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    with written_before(lambda: 0.0), pytest.raises(Expired, match=r"setpoint = 10\.00 %"):
        drive.write(drive.setpoint, 10.0)
    assert line.frames == []


def test_the_watchdog_is_logged_at_the_first_identity_check(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "multidrop.control")
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    drive.stop()
    caplog.clear()
    line.queue = object()  # a new queue, as after the port was reopened
    drive.set_frequency(20)
    drive.start()
    drive.stop()
    drive.start()
    told = [record.getMessage() for record in caplog.records if "PC.04" in record.getMessage()]
    assert told == [f"invt-che@1: {InvtCHE.watchdog}"]


DIRECTED = {  # the families whose state shows a direction
    name: (MAKE | PROFILES)[name]
    for name in ("invt-che", "delixi-native", "yd1000", "delta-vfd-el", "invt-goodrive")
}
every_directed = pytest.mark.parametrize("model", DIRECTED)


def turning(model: str) -> tuple[SimulatedBus, Any, MotorDrive]:
    """Return a bus, a drive and its simulation, whose motor turns forward at 20 Hz (ramp down: 4 s)."""
    line, drive, sim = one(DIRECTED[model](1))
    drive.set_frequency(20)
    drive.start(Direction.FORWARD)
    line.sleep(6)
    sim.pass_time(line.seconds)
    return line, drive, sim


@every_directed
def test_a_reversal_returns_when_the_motor_turns_in_reverse(model: str) -> None:
    line, drive, sim = turning(model)
    drive.start(Direction.REVERSE)
    assert drive.state().direction is Direction.REVERSE
    if model not in ("yd1000", "delta-vfd-el"):  # these two report the commanded direction
        assert sim.motor.frequency < 0
    begun = line.seconds
    drive.start(Direction.REVERSE)  # the motor already turns in this direction
    assert line.seconds - begun < 1


@every_directed
@pytest.mark.parametrize("options", usually({"stop_time": 5}, {}))
def test_a_reversal_is_unconfirmed_if_the_drive_ignores_the_command(
    monkeypatch: pytest.MonkeyPatch, model: str, options: dict[str, float]
) -> None:
    line, drive, sim = turning(model)
    drive.option.update(options)
    monkeypatch.setattr(sim.motor, "run", lambda direction=None: None)
    begun, sent = line.seconds, len(line.written)
    with pytest.raises(Unconfirmed, match="Stop it, or it may turn in reverse later"):
        drive.start(Direction.REVERSE)
    assert len(line.written) == sent + 1
    assert line.seconds - begun < (25 if options else 250)


def test_a_trip_during_a_reversal_raises_not_verified() -> None:
    line, drive, sim = turning("invt-che")
    begun = line.seconds

    def trip(request: Message) -> bool:
        if line.seconds > begun + 1 and not sim.motor.fault:
            sim.trip(4)
        return False

    line.loses = trip
    with pytest.raises(NotVerified, match=r"it tripped: overcurrent while accelerating .OC1"):
        drive.start(Direction.REVERSE)


def test_a_write_is_logged_with_its_author(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "multidrop.control")
    _, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    for who in ((), ("anna",), ("anna", "web")):
        with written_by(*who) if who else nullcontext():
            drive.write(drive.setpoint, 10.0)
    told = [record.getMessage() for record in caplog.records if "setpoint" in record.getMessage()]
    sentence = "invt-che@1: setpoint = 10.00 %: done"
    assert told == [sentence, f"{sentence} (by anna)", f"{sentence} (by anna, web)"]


def test_refused_writes_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "multidrop.control")
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    with pytest.raises(WriteForbidden) as refusal:
        drive.start()
    assert f"refused: {refusal.value}" in [record.getMessage() for record in caplog.records]
    assert line.written == []


def test_a_fault_reset_is_unconfirmed_if_the_fault_record_is_unreadable() -> None:
    """The reply to the reset is lost, and so are the replies to reads of the fault record."""
    line, drive, sim = one(YD1000(1))
    sim.trip(4)
    line.bus.check_identity(drive)

    def loses(request: Message) -> bool:
        is_reset = is_write(request) and bool(request.data[0] & 0x20)
        return is_reset or (request.start == drive.fault_record_1.address and not is_write(request))

    line.loses = loses
    with pytest.raises(Unconfirmed, match="it was sent, and its effect could not be seen: yd1000@1 does not"):
        drive.reset_fault()


def test_is_budget_is_true_only_for_refusals_by_the_eeprom_budget(tmp_path: Path) -> None:
    line, drive, _ = one(DelixiModbus(1), ledger=tmp_path / "wear")
    drive.write(drive.frequency, 12.0)
    with pytest.raises(WriteForbidden, match="was written 0 s ago") as refusal:
        drive.write(drive.frequency, 13.0)
    assert refusal.value.is_budget
    line.sleep(61)
    drive.write(drive.frequency, 13.0)
    with pytest.raises(WriteForbidden, match="does not fit") as refusal:
        drive.write(drive.frequency, 1e9)
    assert not refusal.value.is_budget


def test_the_text_of_a_stops_result_includes_the_reason() -> None:
    assert str(Stopped("fan", Seen.STOPPED, 2.04)) == "fan: stopped after 2.0 s"
    assert str(Stopped("fan", Seen.SENT, 30.0, "no reply")) == "fan: sent but unknown after 30.0 s: no reply"


LOST = LineError("hall", "the port was lost (hung up)")


def test_a_port_lost_after_a_confirmed_start_raises_unconfirmed() -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)

    line.fails = lambda request: LOST if starts(line, "invt-che") and not is_write(request) else None
    with pytest.raises(Unconfirmed, match=r"control = FORWARD took effect: it was confirmed, but .*lost"):
        drive.start()


def test_a_port_lost_during_read_back_makes_the_write_unconfirmed() -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    line.bus.check_identity(drive)

    line.fails = lambda request: LOST if writes(line) and not is_write(request) else None
    outcome = drive.try_write(drive.setpoint, 10.0)
    assert outcome.effect is Effect.UNCONFIRMED
    with pytest.raises(Unconfirmed, match="confirmed, but not read back"):
        assert outcome.value


def test_a_drive_detached_during_read_back_makes_the_write_unconfirmed() -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    line.bus.check_identity(drive)
    Meanwhile(line, 1, lambda: line.bus.detach(drive))
    with pytest.raises(Unconfirmed, match=r"confirmed, but not read back: .*not attached"):
        drive.write(drive.setpoint, 10.0)


UNREADABLE = [
    pytest.param(lambda: InnovertIBD(1, maximum_frequency=50), id="innovert-ibd"),
    pytest.param(lambda: DelixiNative(1), id="delixi-native"),
]
every_unreadable = pytest.mark.parametrize("make", UNREADABLE)
Make = Callable[[], Drive]


def told(make: Make) -> tuple[SimulatedBus, Drive]:
    """Return a bus and its drive, whose setpoint was set to 20 Hz."""
    bus, drive, _ = one(make())
    drive.set_frequency(20)
    assert drive.commanded is not None
    bus.frames.clear()
    return bus, drive


@every_unreadable
def test_the_known_setpoint_is_unchanged_if_the_library_refuses_a_new_one(make: Make) -> None:
    bus, drive = told(make)
    known = drive.commanded
    with pytest.raises((WriteForbidden, ValueError)):
        drive.set_frequency(-1)
    assert bus.written == []
    assert drive.commanded == known
    drive.start()


@every_unreadable
def test_the_known_setpoint_is_unchanged_if_a_new_one_is_not_sent(make: Make) -> None:
    """The write expired in the queue. For a write that a stop cancelled, the core reports the same result."""
    bus, drive = told(make)
    known = drive.commanded
    bus.queue_time = 60.0
    with pytest.raises(Expired):
        drive.set_frequency(30)
    assert bus.written == []
    assert drive.commanded == known


def test_the_known_setpoint_is_unchanged_if_the_drive_refuses_a_new_one() -> None:
    bus, drive = told(lambda: InnovertIBD(1, maximum_frequency=50))
    known = drive.commanded
    bus.refuses = lambda request: 4 if is_write(request) else 0
    with pytest.raises(DriveException):
        drive.set_frequency(30)
    bus.refuses = lambda request: 0
    assert drive.commanded == known
    drive.start()


@every_unreadable
@pytest.mark.parametrize("arrives", [True, False])
def test_a_start_is_refused_if_the_setpoint_write_had_no_reply(make: Make, arrives: bool) -> None:
    bus, drive = told(make)
    if arrives:
        bus.loses = is_write
    else:
        bus.deafens = is_write
    with pytest.raises(Unconfirmed):
        drive.set_frequency(30)
    bus.loses = bus.deafens = lambda request: False
    bus.frames.clear()
    assert drive.commanded is None
    with pytest.raises(WriteForbidden, match="cannot report its setpoint: call set_frequency before start"):
        drive.start()
    assert bus.written == []


def test_the_known_setpoint_is_cleared_if_the_drive_keeps_another_value(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, drive, sim = one(ErmanERG220(1))
    drive.set_frequency(20)
    take = type(sim).answer

    def held_back(sim: object, request: Message, seconds: float) -> Message | None:
        """Confirm a write, but keep the previous value."""
        if not is_write(request):
            return take(sim, request, seconds)  # type: ignore[arg-type]
        return request

    monkeypatch.setattr(type(sim), "answer", held_back)
    with pytest.raises(NotVerified):
        drive.set_frequency(30)
    assert drive.commanded is None


def test_a_setpoint_already_in_eeprom_becomes_known_without_a_write(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(records, "LEAST_INTERVAL", 0.0)
    bus, drive, _ = one(DelixiModbus(1))
    drive.set_frequency(20)
    drive.commanded = None  # unknown, as in a new process
    bus.frames.clear()
    drive.set_frequency(20)
    assert bus.written == []
    assert drive.commanded == 20


def test_a_write_of_the_setpoint_register_sets_the_known_setpoint() -> None:
    bus, drive = told(lambda: InnovertIBD(1, maximum_frequency=50))
    drive.write(drive.register("frequency"), 30)
    assert drive.commanded == 30
    bus.loses = is_write
    with pytest.raises(BusError):
        drive.write(drive.register("frequency"), 40)
    assert drive.commanded is None


@pytest.mark.parametrize("later", [30.0, None])
def test_an_unsent_write_does_not_change_a_later_setpoint(later: float | None) -> None:
    drive = YD1000(1)
    drive.commanded = 20.0
    take_back = drive.begin_setpoint()
    drive.begin_setpoint()  # if `later` is None, this write is still pending
    if later:
        drive.commanded = later
    take_back()
    assert drive.commanded == later


def test_two_unsent_writes_leave_the_known_setpoint_unchanged() -> None:
    drive = YD1000(1)
    drive.commanded = 20.0
    first, second = drive.begin_setpoint(), drive.begin_setpoint()
    second()
    assert drive.commanded is None
    first()
    assert drive.commanded == 20.0
