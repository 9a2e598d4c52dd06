"""The setpoint that the library believes the drive holds, after each possible outcome of a write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from simulated_bus import SimulatedBus, is_write, one

from multidrop import DelixiModbus, DelixiNative, Drive, ErmanERG220, InnovertIBD
from multidrop.control import records
from multidrop.core import Message, build_reply
from multidrop.drive.state import KnownSetpoint
from multidrop.errors import BusError, DriveException, Expired, NotVerified, Unconfirmed, WriteForbidden

UNREADABLE = [
    pytest.param(lambda: InnovertIBD(1, maximum_frequency=50), id="innovert-ibd"),
    pytest.param(lambda: DelixiNative(1), id="delixi-native"),
]
every_unreadable = pytest.mark.parametrize("make", UNREADABLE)
Make = Callable[[], Drive]


def told(monkeypatch: pytest.MonkeyPatch, make: Make) -> tuple[SimulatedBus, Drive]:
    """Return a bus and its drive, whose setpoint was set to 20 Hz."""
    bus, drive, _ = one(monkeypatch, make())
    drive.set_frequency(20)
    assert drive.commanded is not None
    bus.frames.clear()
    return bus, drive


@every_unreadable
def test_a_refused_setpoint_keeps_the_known_one(monkeypatch: pytest.MonkeyPatch, make: Make) -> None:
    bus, drive = told(monkeypatch, make)
    known = drive.commanded
    with pytest.raises((WriteForbidden, ValueError)):
        drive.set_frequency(-1)
    assert bus.written == []
    assert drive.commanded == known
    drive.start()


@every_unreadable
def test_an_unsent_setpoint_keeps_the_known_one(monkeypatch: pytest.MonkeyPatch, make: Make) -> None:
    """The write expired in the queue. The core reports a write that a stop cancelled in the same way."""
    bus, drive = told(monkeypatch, make)
    known = drive.commanded
    bus.queue_time = 60.0
    with pytest.raises(Expired):
        drive.set_frequency(30)
    assert bus.written == []
    assert drive.commanded == known


def refused(request: Message) -> bytes | None:
    if not is_write(request):
        return None
    return bytes(build_reply(InnovertIBD(1).framing, replace(request, exception=4)))


def test_a_setpoint_that_the_drive_refuses_keeps_the_known_one(monkeypatch: pytest.MonkeyPatch) -> None:
    bus, drive = told(monkeypatch, lambda: InnovertIBD(1, maximum_frequency=50))
    known = drive.commanded
    bus.answers = refused
    with pytest.raises(DriveException):
        drive.set_frequency(30)
    bus.answers = lambda request: None
    assert drive.commanded == known
    drive.start()


@every_unreadable
@pytest.mark.parametrize("arrives", [True, False])
def test_after_a_lost_reply_the_setpoint_is_unknown_and_a_start_is_refused(
    monkeypatch: pytest.MonkeyPatch, make: Make, arrives: bool
) -> None:
    bus, drive = told(monkeypatch, make)
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


def test_a_clamped_setpoint_is_not_the_requested_one(monkeypatch: pytest.MonkeyPatch) -> None:
    _, drive, sim = one(monkeypatch, ErmanERG220(1))
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


def test_a_setpoint_that_eeprom_already_holds_becomes_known_without_a_write(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(records, "LEAST_INTERVAL", 0.0)
    bus, drive, _ = one(monkeypatch, DelixiModbus(1))
    drive.set_frequency(20)
    drive.commanded = None  # as in a new process
    bus.frames.clear()
    drive.set_frequency(20)
    assert bus.written == []
    assert drive.commanded == 20


def test_a_plain_write_sets_the_known_setpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    bus, drive = told(monkeypatch, lambda: InnovertIBD(1, maximum_frequency=50))
    drive.write(drive.register("frequency"), 30)
    assert drive.commanded == 30
    bus.loses = is_write
    with pytest.raises(BusError):
        drive.write(drive.register("frequency"), 40)
    assert drive.commanded is None


# ---- writes on several threads ----


def test_an_unsent_write_does_not_undo_the_setpoint_of_another_write() -> None:
    setpoint = KnownSetpoint()
    setpoint.value = 20.0
    take_back = setpoint.begin_write()
    setpoint.begin_write()
    setpoint.value = 30.0
    take_back()
    assert setpoint.value == 30.0


def test_an_unsent_write_does_not_restore_a_setpoint_that_a_pending_write_made_unknown() -> None:
    setpoint = KnownSetpoint()
    setpoint.value = 20.0
    take_back = setpoint.begin_write()
    setpoint.begin_write()  # this write never ends

    take_back()
    assert setpoint.value is None


def test_two_unsent_writes_restore_the_setpoint_before_both() -> None:
    setpoint = KnownSetpoint()
    setpoint.value = 20.0
    first, second = setpoint.begin_write(), setpoint.begin_write()
    second()
    assert setpoint.value is None
    first()
    assert setpoint.value == 20.0
