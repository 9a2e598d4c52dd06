"""Nothing of what is called within a time limit is sent after it, but a stop."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from math import inf
from typing import Any

import pytest
from simulated_bus import SimulatedBus, one
from tables import table

from multidrop.control.time_limit import written_before
from multidrop.drive import Direction, Drive, Script, read, wait, write
from multidrop.drive.register import Kept, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import CancelledByStop, Expired
from multidrop.families import InvtCHE
from multidrop.sim import simulated


@pytest.fixture
def line(monkeypatch: pytest.MonkeyPatch) -> SimulatedBus:
    found, _, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    found.bus.drives[0].set_frequency(10)  # its identity is known from then on
    return found


def within(line: SimulatedBus, seconds: float) -> AbstractContextManager[None]:
    until_ns = (line.seconds + seconds) * 1e9
    return written_before(lambda: until_ns)


def written(line: SimulatedBus) -> list[str]:
    return [text for request, text in line.frames if request.function in (5, 6, 15, 16)]


def test_what_is_called_in_time_is_sent(line: SimulatedBus) -> None:
    before = len(written(line))
    with within(line, 0.5):
        line.sleep(0.4)
        line.bus.drives[0].set_frequency(20)
    assert len(written(line)) == before + 1


@pytest.mark.parametrize("seconds", [0, 0.5, 0.9])
def test_what_is_held_up_after_the_call_is_not_sent(line: SimulatedBus, seconds: float) -> None:
    """The bus alone would send it: it has a second from the call on."""
    before = len(written(line))
    with within(line, seconds):
        line.sleep(0.45)
        line.queue_time = 0.5
        with pytest.raises(Expired):
            line.bus.drives[0].set_frequency(20)
    assert len(written(line)) == before


@pytest.mark.parametrize("slept_before", [0, 3600])
def test_the_machine_s_sleep_within_the_block_counts_and_no_other(
    line: SimulatedBus, slept_before: float
) -> None:
    line.slept += slept_before
    before = len(written(line))
    with within(line, 0.5):
        line.bus.drives[0].set_frequency(20)
        line.slept += 1
        with pytest.raises(Expired):
            line.bus.drives[0].set_frequency(25)
    assert len(written(line)) == before + 1


class Slow(Drive):
    """A drive that is looked at for long before it is started, and in between."""

    model = "slow"
    title = "SLOW 1"
    speed = reading(0x10, "rpm")
    ratio = setting(0x21, kept=Kept.RAM)
    before = 0.0  # s
    between = 0.0

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor, in two steps."""
        yield from read(self.speed)
        yield from wait(self.before)
        yield from write(self.ratio, 1)
        yield from wait(self.between)
        yield from write(self.ratio, 2)


@pytest.mark.parametrize(("before", "between", "sent"), [(0.1, 0.1, 2), (0.1, 5.0, 2), (0.9, 0.1, 0)])
def test_no_verb_begins_later_and_none_is_cut_off(
    monkeypatch: pytest.MonkeyPatch, before: float, between: float, sent: int
) -> None:
    """A bus alone counts no time that a script waits by itself."""
    line = SimulatedBus(monkeypatch, simulated(Slow(1)))
    drive = line.bus.attach(Slow(1, confirmed=1))
    drive.before, drive.between = before, between
    with within(line, 0.8), nullcontext() if sent else pytest.raises(Expired):
        drive.start()
    assert len(written(line)) == sent


def test_an_inner_limit_is_never_longer_and_ends_with_its_block(line: SimulatedBus) -> None:
    with within(line, 0.2), within(line, 60):
        line.sleep(0.3)
        with pytest.raises(Expired):
            line.bus.drives[0].set_frequency(20)
    line.bus.drives[0].set_frequency(20)


def test_a_bus_s_own_expiry_counts_where_it_is_shorter(line: SimulatedBus) -> None:
    line.queue_time = 1.5
    with within(line, 60), pytest.raises(Expired):
        line.bus.drives[0].set_frequency(20)


def test_a_limit_that_is_no_number_is_past(line: SimulatedBus) -> None:
    before = len(written(line))
    with written_before(lambda: float("nan")), pytest.raises(Expired):
        line.bus.drives[0].set_frequency(20)
    assert len(written(line)) == before


def test_a_stop_is_sent_whenever_it_is(line: SimulatedBus) -> None:
    before = len(written(line))
    with within(line, 0):
        line.sleep(5)
        line.bus.drives[0].stop()
    assert len(written(line)) > before


def test_the_limit_is_asked_for_when_a_stop_would_end_the_call(line: SimulatedBus) -> None:
    """Whoever notes a stop before it is called, and looks at the note in `limit`, misses none."""
    drive = line.bus.drives[0]
    before = len(written(line))

    def limit() -> float:
        drive.stop()  # at the latest moment
        return inf

    with written_before(limit), pytest.raises(CancelledByStop):
        drive.set_frequency(20)
    assert written(line)[before:] == written(line)[-1:]  # the stop


@table("limit", [0.5, True, "1", None])
def test_under_what_is_no_function_a_stop_alone_is_sent(monkeypatch: pytest.MonkeyPatch, limit: Any) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    with written_before(limit):
        for call in (lambda: drive.set_frequency(20), drive.start):
            with pytest.raises(TypeError, match=r"must be a function that returns a time"):
                call()
        assert not written(line)
        drive.stop()
    assert len(written(line)) == 1
