"""Drives join and leave a bus, on any thread; each drive is on one bus at a time."""

from __future__ import annotations

import threading
from time import sleep
from typing import Any

import pytest
from simulated_bus import SimulatedBus, one

from multidrop.drive import Drive
from multidrop.errors import (
    NotAttached,
)
from multidrop.families import InvtCHE


def test_a_drive_is_on_one_bus_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    other = SimulatedBus(monkeypatch)
    with pytest.raises(ValueError, match=r"invt-che@1 is on the bus at hall: detach it there first"):
        other.attach(drive)
    assert other.bus.drives == []
    drive.state()  # its verbs still go over the first
    line.bus.detach(drive)
    other.attach(drive)
    other.bus.close()
    line.attach(drive)  # the other one is closed


def test_a_drive_is_attached_to_the_next_bus_while_its_last_one_closes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first bus closes afterwards, and the drive stays on the next one."""
    line, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    before = line.bus
    free = before._attached.free
    monkeypatch.setattr(before._attached, "free", lambda: None)
    before.close()
    after = SimulatedBus(monkeypatch, sim)
    after.attach(drive)
    free()
    assert drive.bus is after.bus
    with pytest.raises(ValueError, match="is on the bus at hall: detach it there first"):
        SimulatedBus(monkeypatch).attach(drive)
    drive.stop()
    assert line.written == []
    assert len(after.written) == 1


def test_a_drive_detached_by_another_thread_is_not_detached_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    latches = line.bus._latches
    await_stops = latches.await_stops

    def detach_meanwhile(drives: Any = None) -> None:
        monkeypatch.setattr(latches, "await_stops", await_stops)
        line.bus.detach(drive)

    monkeypatch.setattr(latches, "await_stops", detach_meanwhile)
    with pytest.raises(NotAttached, match="is not attached"):
        line.bus.detach(drive)
    line.attach(drive)


def test_drives_of_a_bus_that_was_closed_are_on_none(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    line.bus.close()
    assert drive.bus is None


def test_many_threads_attach_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    line = SimulatedBus(monkeypatch)
    together = threading.Barrier(8)
    add, inside, most = line.bus._exchanges.add, set[str](), 0

    def slow(drive: Drive) -> None:
        nonlocal most
        inside.add(drive.name)
        most = max(most, len(inside))
        sleep(0.001)  # the others may continue
        inside.discard(drive.name)
        add(drive)

    monkeypatch.setattr(line.bus._exchanges, "add", slow)
    outcomes: list[str] = []

    def attach(address: int) -> None:
        together.wait(120)
        try:
            line.attach(InvtCHE(address))
            outcomes.append("attached")
        except ValueError:
            outcomes.append("taken")

    for _ in range(20):
        outcomes.clear()
        threads = [threading.Thread(target=attach, args=[1 + number % 4]) for number in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(120)
        assert sorted(outcomes) == ["attached"] * 4 + ["taken"] * 4
        assert sorted(drive.address for drive in line.bus.drives) == [1, 2, 3, 4]
        for drive in line.bus.drives:
            line.bus.detach(drive)
    assert most == 1
