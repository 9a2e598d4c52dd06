"""Latches of drives that join and leave, and latches of stops that a signal's exception interrupts."""

from __future__ import annotations

import threading
from gc import collect
from weakref import ref

import pytest
from simulated_bus import one

from multidrop.errors import CancelledByStop
from multidrop.families import InvtCHE


def test_a_thread_that_was_interrupted_in_a_stop_never_waits_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else leaving a `with` block by a signal's exception would take for ever."""
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    latches, stop = line.bus._latches, object()
    latches.begin(stop, [drive])
    latches.await_stops()
    waiting = threading.Thread(target=latches.await_stops, args=[[drive]])
    waiting.start()
    waiting.join(0.05)
    assert waiting.is_alive()
    for _ in range(2):
        latches.over(stop)
    waiting.join(60)
    assert not waiting.is_alive()
    assert latches.latch(drive).permit().is_good


def test_a_drive_attached_after_leaving_is_not_moved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The process is ending and could not stop it; drives that were attached before are not moved either."""
    line, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    line.bus.leave()
    line.bus.detach(drive)
    line.attach(drive)
    for call in (drive.start, drive.jog, lambda: drive.set_frequency(20)):
        with pytest.raises(CancelledByStop, match="the bus was left"):
            call()
    assert line.written == []
    drive.stop()
    assert line.written != []
    assert not sim.motor.energised


def test_a_drive_that_was_taken_off_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bus whose drives change for years does not grow."""
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    drive.stop()
    line.bus.detach(drive)
    line.sims = ()
    known = ref(drive)
    del drive, _
    collect()
    assert known() is None
