"""A stop that goes on: what any thread is told of it meanwhile, and of a drive that refuses it each time."""

from __future__ import annotations

import pytest
from simulated_bus import SimulatedBus, is_write, one

from multidrop.control.outcome import Seen
from multidrop.core import Message, build_reply
from multidrop.errors import DriveException
from multidrop.families import YD1000, InnovertIBD
from multidrop.sim import simulated


def noting(line: SimulatedBus) -> list[str]:
    """Note what is told at each request; a text that is the same as before is noted once."""
    told: list[str] = []

    def note(request: Message) -> bool:
        for text in line.bus.stops_under_way().values():
            if text not in told[-1:]:
                told.append(text)
        return False

    line.deafens = note
    return told


def test_a_stop_says_what_is_known_of_it_while_the_motor_runs_out(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, YD1000(1))
    drive.set_frequency(20)
    drive.start()
    line.sleep(10)
    told = noting(line)
    drive.stop()
    assert told == [
        f"{drive.name}: no stop was sent yet",
        f"{drive.name}: the stop was confirmed, but the motor is not yet seen to stand",
    ]
    assert line.bus.stops_under_way() == {}


def test_what_is_lost_is_told_as_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, YD1000(1))
    told = noting(line)
    line.loses = is_write
    assert line.bus.stop_all(seconds=5)[drive.name].seen is Seen.SENT
    assert told[:2] == [
        f"{drive.name}: no stop was sent yet",
        f"{drive.name}: the stop was sent, but is not yet confirmed",
    ]
    assert all(text.startswith(told[1]) for text in told[2:])
    assert "it is not known whether" in told[2]


def test_a_drive_that_is_done_is_under_way_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    line = SimulatedBus(monkeypatch, simulated(YD1000(1)), simulated(YD1000(2)))
    names = [line.attach(sim.drive).name for sim in line.sims]
    line.loses = lambda request: request.address == 2
    under_way: list[set[str]] = []

    def note(request: Message) -> bool:
        under_way.append(set(line.bus.stops_under_way()))
        return False

    line.deafens = note
    line.bus.stop_all(seconds=20)
    assert set(names) in under_way
    assert under_way[-1] == {names[1]}


def test_a_stop_that_the_drive_refuses_each_time_is_not_told_as_unsent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line, drive, _ = one(monkeypatch, InnovertIBD(1))
    told: list[str] = []

    def refuse(request: Message) -> bytes | None:
        told.extend(line.bus.stops_under_way().values())
        if not is_write(request):
            return None
        return build_reply(
            drive.framing, Message(request.address, request.function, request.start, exception=1)
        )

    line.answers = refuse
    found = line.bus.stop_all(seconds=2)[drive.name]
    assert found.seen is Seen.REFUSED
    assert str(found).startswith(f"{drive.name}: refused by the drive after 2.")
    with pytest.raises(DriveException):
        drive.stop(seconds=1)
    assert any(text.startswith(f"{drive.name}: the stop was sent, but is not yet confirmed") for text in told)
