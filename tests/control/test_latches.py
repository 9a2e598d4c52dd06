"""Latches of drives that come and go, and of stops at whose beginning a signal raises."""

from __future__ import annotations

from contextlib import AbstractContextManager
from gc import collect
from itertools import count
from types import FrameType
from weakref import ref

import pytest
from interruptions import interrupted_at
from simulated_bus import one

from multidrop.control import latches as of_a_bus
from multidrop.core import latch as of_a_drive
from multidrop.drives import InvtCHE
from multidrop.errors import Overtaken

CODE = {of_a_bus.__file__, of_a_drive.__file__}


def raises_while_it_begins(stopping: AbstractContextManager[None], nth: int) -> bool:
    """Raise before the nth line of a stop's beginning, as a signal may; False where it has fewer lines."""
    has_begun = False

    def counts(frame: FrameType) -> bool:
        return not has_begun and frame.f_code.co_filename in CODE

    try:
        with interrupted_at(nth, counts), stopping:
            has_begun = True
    except KeyboardInterrupt:
        return True
    return False


def test_a_signal_while_a_stop_begins_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else no start would be sent any more, and closing would wait for ever."""
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    latches = line.bus._latches
    for nth in count(1):
        if not raises_while_it_begins(latches.stopping([drive]), nth):
            break
        assert latches.latch(drive).permit().is_good
        assert not latches._stops
    assert nth > 8


def test_a_drive_that_is_attached_to_a_bus_that_was_left_is_not_moved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its process ends, and nobody would stop it; the drives from before are not moved either."""
    line, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    line.bus.leave()
    line.bus.detach(drive)
    line.attach(drive)
    for call in (drive.start, drive.jog, lambda: drive.set_frequency(20)):
        with pytest.raises(Overtaken, match="the bus was left"):
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
