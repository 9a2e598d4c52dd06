"""Signals that raise while a stop begins: they leave nothing behind that a later call would wait for."""

from __future__ import annotations

from contextlib import AbstractContextManager
from itertools import count
from types import FrameType

import pytest
from interruptions import interrupted_at
from simulated_bus import one

from multidrop.control import latches as of_a_bus
from multidrop.core import latch as of_a_drive
from multidrop.drives import InvtCHE

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
