"""Ramps step by step, and staggered starts that fail."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import pytest
from lines import PATIENCE
from simulated_bus import SimulatedBus, is_write, one
from toy import Toy

from multidrop.control.ramp import ramp, start_staggered
from multidrop.core import Message
from multidrop.drive import Drive, Script, read
from multidrop.drive.register import Kept, setting
from multidrop.drive.verbs import verb
from multidrop.errors import NoReply, WriteForbidden
from multidrop.families import YD1000, InnovertIBD, InvtCHE
from multidrop.sim import simulated

# ---- ramps ----


def steps(line: SimulatedBus) -> list[int]:
    """Return the counts that were written."""
    return [int(frame[12:17].replace(" ", ""), 16) for frame in line.written]


def test_a_ramp_waits_between_its_steps_but_not_after_the_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line, drive, _ = one(monkeypatch, YD1000(1))
    drive.set_frequency(10)
    line.frames.clear()
    written_at: list[float] = []

    def note(request: Message) -> bytes | None:
        if is_write(request):
            written_at.append(line.seconds)
        return None

    line.answers = note
    begun = line.seconds
    ramp(drive, 15.0, rate=1.0, every=2.0)
    assert steps(line) == [1200, 1400, 1500]
    assert written_at[0] - begun < 0.5
    assert all(2.0 <= later - earlier < 2.5 for earlier, later in pairwise(written_at))
    assert line.seconds - written_at[-1] < 0.5


def test_a_ramp_may_be_as_steep_as_the_drive_s_own(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, YD1000(1))
    drive.set_frequency(10)
    line.frames.clear()
    ramp(drive, 20.0, rate=8.0, every=1.0)
    assert steps(line) == [1800, 2000]


def test_steps_that_are_no_whole_counts_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, YD1000(1))
    drive.set_frequency(10)
    line.frames.clear()
    ramp(drive, 11.0, rate=1 / 3, every=1.0)
    assert steps(line) == [1033, 1067, 1100]


def test_a_ramp_of_percents_goes_on_from_the_hertz_that_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=80))
    drive.set_frequency(20)
    line.frames.clear()
    ramp(drive, 16.0, rate=2.0, every=1.0)
    assert steps(line) == [2250, 2000]  # 18 Hz and 16 Hz of 80 Hz


class Ramped(Toy):
    """Its setpoint is a plain setting in RAM; without an acceleration, it has no slope of its own."""

    model = "ramped"
    maximum_frequency = setting(0x20, "Hz", step=0.1, kept=Kept.RAM)
    acceleration_time = setting(0x21, "s", step=0.1, kept=Kept.RAM)
    frequency = setting(0x22, "Hz", step=0.01, span=(0, 50), kept=Kept.RAM)

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write no setpoint that the drive already has."""
        if (yield from read(self.frequency)) != hz:
            yield from self._hold(self.frequency, hz)


def ramped(monkeypatch: pytest.MonkeyPatch, family: type[Drive], **options: float) -> tuple[Any, Any, Any]:
    sim = simulated(family(1))
    line = SimulatedBus(monkeypatch, sim)
    return line, line.attach(family(1, **options)), sim


def test_a_ramp_whose_setpoint_is_looked_at_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the last step, which is checked first, writes no setpoint."""
    line, drive, _ = ramped(monkeypatch, Ramped)
    ramp(drive, 2.0, rate=1.0, every=1.0)
    assert steps(line) == [100, 200]
    ramp(drive, 2.0, rate=1.0)
    assert steps(line) == [100, 200]
    with pytest.raises(ValueError, match="60 is outside 0 to 50 Hz"):
        ramp(drive, 60.0, rate=1.0)
    assert steps(line) == [100, 200]
    asked = len(line.frames)
    line.loses = lambda request: len(line.frames) > asked + 3  # what its check reads, and no more
    with pytest.raises(NoReply):
        ramp(drive, 3.0, rate=1.0)
    assert steps(line) == [100, 200]


@pytest.mark.parametrize(("most", "seconds"), [(50, 0), (0, 10)])
def test_a_drive_without_a_slope_of_its_own_needs_a_rate(
    monkeypatch: pytest.MonkeyPatch, most: int, seconds: int
) -> None:
    line, drive, sim = ramped(monkeypatch, Ramped)
    sim["maximum_frequency"], sim["acceleration_time"] = most, seconds
    with pytest.raises(
        WriteForbidden, match="the acceleration of ramped@1 cannot be read: give a rate in Hz/s"
    ):
        ramp(drive, 2.0)
    assert line.written == []
    ramp(drive, 2.0, rate=4.0)
    assert steps(line) == [200]


class Nameless(Ramped):
    """A drive whose family cannot be verified."""

    model = "nameless"
    identify = Drive.identify


def test_a_ramp_of_an_unconfirmed_drive_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = ramped(monkeypatch, Nameless, confirmed=0)
    with pytest.raises(WriteForbidden, match="confirmed = 1"):
        ramp(drive, 2.0, rate=1.0)
    assert line.frames == []
    line, drive, _ = ramped(monkeypatch, Nameless, confirmed=1)
    ramp(drive, 2.0, rate=1.0, every=1.0)
    assert steps(line) == [100, 200]


# ---- staggered starts ----


def che(monkeypatch: pytest.MonkeyPatch, count: int) -> tuple[SimulatedBus, list[Any], list[Any]]:
    """Return a line of drives that have their setpoints, and their simulations."""
    sims: list[Any] = [simulated(InvtCHE(address, maximum_frequency=50)) for address in range(1, count + 1)]
    line = SimulatedBus(monkeypatch, *sims)
    drives = [line.attach(sim.drive) for sim in sims]
    for drive in drives:
        drive.set_frequency(20)
    return line, drives, sims


@pytest.mark.parametrize("gap", [0, 0.5])
def test_starts_may_follow_at_once(monkeypatch: pytest.MonkeyPatch, gap: float) -> None:
    line, drives, sims = che(monkeypatch, 2)
    begun = line.seconds
    start_staggered(drives, gap)
    assert all(sim.motor.energised for sim in sims)
    assert gap <= line.seconds - begun < gap + 1


@pytest.mark.parametrize("gap", [4.0, 25.0])
def test_drives_that_wait_for_their_start_are_read(monkeypatch: pytest.MonkeyPatch, gap: float) -> None:
    """Else those that cannot say their setpoint would be refused: they may have lost it with their power."""
    sims: list[Any] = [simulated(InnovertIBD(address, maximum_frequency=50)) for address in range(1, 6)]
    line = SimulatedBus(monkeypatch, *sims)
    drives = [line.attach(sim.drive) for sim in sims]
    for drive in drives:
        drive.set_frequency(20)
    begun = line.seconds
    start_staggered(drives, gap)
    assert all(sim.motor.energised for sim in sims)
    assert 4 * gap <= line.seconds - begun < 4 * gap + 10


def test_a_staggered_start_does_not_stop_drives_it_never_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drives, sims = che(monkeypatch, 3)
    sims[1].trip(4)
    line.frames.clear()
    with pytest.raises(WriteForbidden, match="OC1"):
        start_staggered(drives, 1.0)
    assert {request.address for request, _ in line.frames if is_write(request)} == {1, 2}


class NotedCalls:
    """The stops that were called, with the seconds that each was given."""

    def __init__(self, drives: list[Any]) -> None:
        self.calls: list[tuple[int, float | None]] = []
        self.acts: dict[int, Callable[[float | None], None]] = {}
        for drive in drives:
            drive.begin_stop = partial(NotedStop, self, drive.address)


class NotedStop:
    """One of them."""

    def __init__(
        self, noted: NotedCalls, address: int, verb: str, make: object, seconds: float | None
    ) -> None:
        self._noted = noted
        self._address = address
        self._seconds = seconds

    def carry_out(self) -> None:
        self._noted.calls.append((self._address, self._seconds))
        if act := self._noted.acts.get(self._address):
            act(self._seconds)

    def interrupted(self, interruption: BaseException) -> None:
        """No step is left to send."""

    def result(self) -> None:
        """It stands."""


def test_started_drives_are_stopped_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is silent keeps its own stop up, and no other's."""
    _, drives, sims = che(monkeypatch, 3)
    sims[2].trip(4)
    noted = NotedCalls(drives)
    others = threading.Semaphore(0)

    def wait_for_both(seconds: float | None) -> None:
        for _ in range(2):
            assert others.acquire(timeout=PATIENCE)

    noted.acts[1] = wait_for_both
    noted.acts[2] = noted.acts[3] = lambda seconds: others.release()
    with pytest.raises(WriteForbidden, match="OC1"):
        start_staggered(drives, 1.0)
    assert sorted(noted.calls) == [(1, None), (2, None), (3, None)]
    assert not others.acquire(blocking=False)


class NoThread(threading.Thread):
    def start(self) -> None:
        raise RuntimeError("can't start new thread")


def test_without_threads_each_is_sent_its_stop_before_any_is_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, drives, sims = che(monkeypatch, 2)
    sims[1].trip(4)
    noted = NotedCalls(drives)
    monkeypatch.setattr(threading, "Thread", NoThread)
    with pytest.raises(WriteForbidden, match="OC1"):
        start_staggered(drives, 1.0)
    assert noted.calls == [(1, 0.0), (2, 0.0), (1, None), (2, None)]


def test_an_interruption_of_stops_without_threads_has_each_sent_once_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, drives, sims = che(monkeypatch, 2)
    sims[1].trip(4)
    noted = NotedCalls(drives)

    def press(seconds: float | None) -> None:
        if seconds is None:
            raise KeyboardInterrupt

    noted.acts[1] = press
    monkeypatch.setattr(threading, "Thread", NoThread)
    with pytest.raises(KeyboardInterrupt):
        start_staggered(drives, 1.0)
    assert noted.calls == [(1, 0.0), (2, 0.0), (1, None), (1, 0.0), (2, 0.0)]
