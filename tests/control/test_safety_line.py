"""Faults between caller and motor, with the real engine and a pty: sent frames and reported results.

test_safety_bus.py has the same cases on a simulated clock. Here the drive counts the frames that it receives.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from examples import in_turn, usually
from lines import until
from motors import MAKE, ReceivedRequests

from multidrop.bus import Bus
from multidrop.drive import Condition, Drive, read
from multidrop.errors import NoReply, NotVerified, Unconfirmed, WriteForbidden
from multidrop.families import YD1000, DelixiModbus, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.sim import MotorDrive, Simulator, Wire, simulated
from multidrop.transport import peers

every_family = pytest.mark.parametrize("model", usually(*MAKE))
GOODRIVE = 0x010A
PATIENCE = 0.3  # s, with a machine that has much else to do


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "LEAST_TIMEOUT", PATIENCE)


@contextmanager
def line(drive: Drive, other: Drive | None = None) -> Iterator[tuple[Any, MotorDrive, ReceivedRequests]]:
    """Yield the drive as declared, the simulated drive (`other` or the same), and its received requests."""
    drive.response_timeout = PATIENCE
    sim = simulated(other or drive)
    assert isinstance(sim, MotorDrive)
    sim.motor.acceleration_time = sim.motor.deceleration_time = 0.2
    received = ReceivedRequests(sim)
    with Simulator([Wire([sim], unpaced=True)]) as simulator, Bus(simulator.wires[0].path, expiry=60) as bus:
        yield bus.attach(drive), sim, received


@pytest.mark.slow
@every_family
def test_a_start_whose_reply_is_lost_is_sent_once(model: str) -> None:
    with line(MAKE[model](1)) as (drive, sim, received):
        drive.set_frequency(20)
        received.loses = lambda request: request in received.starts
        with pytest.raises(Unconfirmed, match="no reply"):
            drive.start()
        assert len(received.starts) == 1
        assert sim.motor.energised  # it did happen, and the caller was told that it may have


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(("model", "lost"), in_turn(MAKE, [3, 2, 7]))
def test_a_stop_whose_replies_are_lost(model: str, lost: int) -> None:
    """The stop is repeated until it is confirmed, and only its own words are written."""
    with line(MAKE[model](1)) as (drive, sim, received):
        drive.set_frequency(20)
        drive.start()
        begun = len(received.writes)
        received.loses = lambda request: request in received.writes and len(received.writes) <= begun + lost
        drive.stop()
        stops = received.writes[begun:]
        assert len(stops) > lost
        assert all(stop in stops[lost:] for stop in stops[:lost])
        assert len(received.starts) == 1
        assert not sim.motor.energised


OTHERS: dict[str, tuple[Drive, Drive]] = {  # declared, and there: of one framing and baud rate
    "che for ibd": (InvtCHE(1, maximum_frequency=50), InnovertIBD(1)),
    "che for yd1000": (InvtCHE(1, maximum_frequency=50), YD1000(1)),
    "ibd for che": (InnovertIBD(1, confirmed=0), InvtCHE(1)),
    "yd1000 for che": (YD1000(1), InvtCHE(1)),
    "delixi for yd1000": (DelixiModbus(1, framing="rtu"), YD1000(1)),
    "delixi for che": (DelixiModbus(1, framing="rtu"), InvtCHE(1)),
}


@pytest.mark.slow
@pytest.mark.parametrize("pair", OTHERS)
def test_a_drive_of_another_family_is_not_written_to(pair: str) -> None:
    declared, there = OTHERS[pair]
    with line(declared, there) as (drive, sim, received):
        with pytest.raises((WriteForbidden, NoReply)):
            drive.start()
        assert received.requests
        assert received.writes == []
        assert not sim.motor.energised


def test_a_goodrive_is_not_taken_for_a_che() -> None:
    with line(InvtCHE(1, maximum_frequency=50)) as (drive, sim, received):
        sim["device"] = GOODRIVE
        with pytest.raises(WriteForbidden, match="010AH"):
            drive.start()
        assert received.writes == []


def test_a_clamped_setpoint_is_reported_with_the_value_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    with line(ErmanERG220(1)) as (drive, sim, received):
        accept = sim.accept
        monkeypatch.setattr(
            sim, "accept", lambda cell, raw: min(raw, 300) if cell.name == "frequency" else accept(cell, raw)
        )
        with pytest.raises(NotVerified, match=r"45\.0 Hz did not take effect: the drive holds 30\.0 Hz"):
            drive.set_frequency(45)
        assert len(received.writes) == 1


def test_a_trip_while_starting(monkeypatch: pytest.MonkeyPatch) -> None:
    with line(InvtCHE(1, maximum_frequency=50)) as (drive, sim, received):
        drive.set_frequency(20)
        run = sim.motor.run
        monkeypatch.setattr(sim.motor, "run", lambda direction: sim.trip(4))
        with pytest.raises(NotVerified, match=r"tripped: overcurrent while accelerating .OC1"):
            drive.start()
        with pytest.raises(WriteForbidden, match=r"OC1.*reset_fault"):
            drive.start()
        monkeypatch.setattr(sim.motor, "run", run)
        drive.reset_fault()
        assert len(received.starts) == 1
        assert drive.state().condition is Condition.STOPPED
        assert not sim.motor.energised


@pytest.mark.long
@pytest.mark.slow
def test_a_power_cycle_in_mid_ramp() -> None:
    """The drive has forgotten its setpoint: it stays off, and the next start says so."""
    with line(YD1000(1)) as (drive, sim, received):
        drive.set_frequency(40)
        drive.start()
        sim.motor.acceleration_time = 60.0
        until(lambda: drive.perform(read(drive.output_frequency)) > 0)
        assert 0 < sim.motor.frequency < 40
        sim._restart()  # all but the EEPROM is gone, and it is deaf for a while
        sim.deaf_until = float("inf")
        sent = len(received.writes)
        with pytest.raises(NoReply):
            drive.state()
        sim.deaf_until = 0.0
        until(lambda: _condition(drive) is Condition.STOPPED)
        with pytest.raises(WriteForbidden, match="set_frequency"):
            drive.start()
        assert len(received.writes) == sent
        assert not sim.motor.energised
        drive.set_frequency(40)
        drive.start()
        assert len(received.starts) == 2
        assert sim.motor.energised


def _condition(drive: Any) -> Condition | None:
    try:
        return drive.state().condition
    except NoReply:
        return None
