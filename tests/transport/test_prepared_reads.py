"""Reads by hand are planned and made once, and anew when what they were made for has changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import permutations
from threading import Barrier
from typing import Any

import pytest
from toy import PatientToy, Toy

from multidrop.bus import Bus
from multidrop.core import Completion, Exchange
from multidrop.drive.line_settings import Settings
from multidrop.errors import NoReply
from multidrop.planning.bus_time import silence
from multidrop.sim import SimulatedDrive, Simulator, Wire
from multidrop.transport import prepared as prepared_reads

WANTED = (Toy.output_frequency, Toy.mystery, Toy.acceleration_time)


class Counted:
    """Count the choices of blocks, and the exchanges."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.plans = self.made = 0
        blocks, make_read = prepared_reads.blocks, prepared_reads.make_read

        def choose(*given: Any) -> Any:
            self.plans += 1
            return blocks(*given)

        def make(*given: Any, **details: Any) -> Any:
            self.made += 1
            return make_read(*given, **details)

        monkeypatch.setattr(prepared_reads, "blocks", choose)
        monkeypatch.setattr(prepared_reads, "make_read", make)

    def since(self) -> tuple[int, int]:
        """Since it was asked last."""
        found = self.plans, self.made
        self.plans = self.made = 0
        return found


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counted:
    return Counted(monkeypatch)


@pytest.fixture
def bus() -> Iterator[Bus]:
    drives = [SimulatedDrive(Toy(address)) for address in (1, 2)]
    with Simulator([Wire(drives, unpaced=True)]) as sim, Bus(sim.wires[0].path) as opened:
        yield opened


def given(
    bus: Bus, monkeypatch: pytest.MonkeyPatch, meet: Callable[[], object] = lambda: None
) -> list[Completion]:
    """Return a list that gets the completion which each exchange fills in."""
    carry_out = bus.line.carry_out
    asked: list[Completion] = []

    def noting(exchange: Exchange, **details: Any) -> Completion:
        meet()
        asked.append(carry_out(exchange, **details))
        return asked[-1]

    monkeypatch.setattr(bus.line, "carry_out", noting)
    return asked


@pytest.mark.slow
def test_registers_that_are_read_again_are_planned_once(bus: Bus, counted: Counted) -> None:
    one, other = bus.attach(PatientToy, 1), bus.attach(PatientToy, 2)
    first = one.read_many(WANTED)
    assert counted.since() == (1, 2)
    assert [one.read_many(WANTED) for _ in range(5)] == 5 * [first]
    assert counted.since() == (0, 0)
    one.read(Toy.acceleration_time)  # the block is one of those above
    assert counted.since() == (1, 0)
    other.read_many(WANTED)
    assert counted.since() == (1, 2)


@pytest.mark.slow
def test_a_drive_that_left_leaves_nothing_behind(bus: Bus, counted: Counted) -> None:
    drive = bus.attach(PatientToy, 1)
    drive.read_many(WANTED)
    bus.detach(drive)
    with pytest.raises(ValueError, match="is not attached to this bus"):
        drive.read_many(WANTED)
    assert bus._exchanges._prepared == {}
    counted.since()
    bus.attach(drive)
    drive.read_many(WANTED)
    assert counted.since() == (1, 2)


def test_a_port_that_was_opened_again_is_asked_anew(bus: Bus, counted: Counted) -> None:
    drive = bus.attach(PatientToy, 1)
    drive.read_many(WANTED)
    bus.line.reopen()
    counted.since()
    drive.read_many(WANTED)
    assert counted.since() == (1, 2)


@pytest.mark.parametrize(
    ("name", "value"),
    [("settings", Settings(19200, "8N1")), ("agreed_silence", 0.01), ("response_delay", 0.2), ("address", 3)],
)
def test_what_a_drive_is_told_meanwhile_is_heeded(bus: Bus, name: str, value: object) -> None:
    drive = bus.attach(PatientToy, 1)
    before = bus._exchanges._prepare(drive)
    assert bus._exchanges._prepare(drive) is before
    setattr(drive, name, value)
    after = bus._exchanges._prepare(drive)
    assert after is not before
    assert bus._exchanges._prepare(drive) is after
    made = after.of(WANTED).reads[0].exchange
    assert made.settings[0] == drive.settings.baudrate
    assert made.request.address == drive.address
    assert made.c.silence_ns == round(silence(drive) * 1e9)


def test_no_more_is_kept_than_there_is_room_for(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepared_reads, "MOST_PREPARED", 3)
    drive = bus.attach(PatientToy, 1)
    for wanted in permutations(WANTED):
        assert set(drive.read_many(wanted)) == {register.name for register in WANTED}
    prepared = bus._exchanges._prepare(drive)
    assert prepared.of.cache_info().currsize == 3


def test_each_read_fills_its_completion_in_again_and_again(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = bus.attach(PatientToy, 1)
    asked = given(bus, monkeypatch)
    first = drive.read_many(WANTED)
    assert [drive.read_many(WANTED) for _ in range(3)] == 3 * [first]
    assert len(asked) == 8
    assert len(set(asked)) == 2
    assert asked[:2] * 4 == asked


def test_reads_at_once_go_into_completions_of_their_own(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = bus.attach(PatientToy, 1)
    value = drive.read(Toy.acceleration_time)
    both = Barrier(2)
    asked = given(bus, monkeypatch, lambda: both.wait(60))
    with ThreadPoolExecutor(2) as threads:
        found = [*threads.map(lambda drive: drive.read(Toy.acceleration_time), 2 * [drive])]
    assert found == 2 * [value]
    assert len(set(asked)) == 2


@pytest.mark.slow
def test_a_read_that_failed_keeps_its_completion(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = bus.attach(Toy, 3)
    asked = given(bus, monkeypatch)
    for _ in range(2):
        with pytest.raises(NoReply):
            bus._exchanges.values(gone, [Toy.acceleration_time], 1)
    assert len(set(asked)) == len(asked) >= 2
