"""Ramps step by step, and staggered starts that fail."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import pytest
from lines import PATIENCE
from motors import MAKE
from profile_families import MAKE as PROFILES
from simulated_bus import SimulatedBus, all_stopped, che_drives, is_write, one, starts
from tables import table
from toy import Toy

from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.ramp import ramp, start_staggered
from multidrop.core import Message
from multidrop.drive import Direction, Drive, Script, read
from multidrop.drive.register import Kept, command, setting
from multidrop.drive.verbs import verb
from multidrop.errors import CancelledByStop, Expired, NoReply, NotAttached, Unconfirmed, WriteForbidden
from multidrop.families import YD1000, DelixiModbus, InnovertIBD, InvtCHE
from multidrop.sim import simulated
from multidrop.transport import clock


def steps(line: SimulatedBus) -> list[int]:
    """Return the raw counts of the setpoints that were written."""
    return [int(frame[12:17].replace(" ", ""), 16) for frame in line.written]


def test_a_ramp_waits_between_its_steps_but_not_after_the_last() -> None:
    line, drive, _ = one(YD1000(1))
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
    assert all(later - earlier == pytest.approx(2.0, abs=0.01) for earlier, later in pairwise(written_at))
    assert line.seconds - written_at[-1] < 0.5


def test_a_long_ramp_does_not_expire_if_each_step_is_slightly_late(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(YD1000(1))
    drive.set_frequency(1)
    monkeypatch.setattr(clock, "sleep", lambda seconds: line.sleep(seconds + 0.01))
    ramp(drive, 60.0, rate=0.5, every=0.5)
    assert steps(line)[-1] == 6000


def test_a_ramp_expires_after_the_computer_slept(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(YD1000(1))
    drive.set_frequency(1)

    def sleep(seconds: float) -> None:
        line.sleep(seconds)
        if len(line.written) == 4:
            line.slept = 1.5

    monkeypatch.setattr(clock, "sleep", sleep)
    with pytest.raises(Expired):
        ramp(drive, 60.0, rate=0.5, every=0.5)
    assert len(line.written) == 4


@table(
    ("drive", "before", "to", "rate", "counts"),
    [
        (YD1000(1), 10, 20.0, 8.0, [1800, 2000]),  # at the rate of the drive's own ramp
        (YD1000(1), 10, 11.0, 1 / 3, [1033, 1067, 1100]),  # rounding errors do not accumulate
        (InvtCHE(1, maximum_frequency=80), 20, 16.0, 2.0, [2250, 2000]),  # 18 Hz and 16 Hz as shares of 80 Hz
    ],
)
def test_ramp_steps_are_written_in_the_unit_of_the_drive(
    drive: Any, before: float, to: float, rate: float, counts: list[int]
) -> None:
    line, drive, _ = one(drive)
    drive.set_frequency(before)
    line.frames.clear()
    ramp(drive, to, rate=rate, every=1.0)
    assert steps(line) == counts


class Ramped(Toy):
    """A drive whose setpoint is a plain setting in RAM, and whose own ramp follows from two settings."""

    model = "ramped"
    maximum_frequency = setting(0x20, "Hz", step=0.1, kept=Kept.RAM)
    acceleration_time = setting(0x21, "s", step=0.1, kept=Kept.RAM)
    frequency = setting(0x22, "Hz", step=0.01, span=(0, 50), kept=Kept.RAM)

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint unless the drive already has it."""
        if (yield from read(self.frequency)) != hz:
            yield from self._write_setpoint(self.frequency, hz)


def ramped(family: type[Drive], **options: float) -> tuple[Any, Any, Any]:
    sim = simulated(family(1))
    line = SimulatedBus(sim)
    return line, line.attach(family(1, **options)), sim


def test_a_ramp_starts_from_the_setpoint_read_from_the_drive() -> None:
    """The ramp also works if `set_frequency` sends no write, because the drive has the setpoint already."""
    line, drive, _ = ramped(Ramped)
    ramp(drive, 2.0, rate=1.0, every=1.0)
    assert steps(line) == [100, 200]
    ramp(drive, 2.0, rate=1.0)
    assert steps(line) == [100, 200]
    with pytest.raises(ValueError, match="60 is outside 0 to 50 Hz"):
        ramp(drive, 60.0, rate=1.0)
    assert steps(line) == [100, 200]
    asked = len(line.frames)
    line.loses = lambda request: len(line.frames) > asked + 3  # only reads of the identity check are answered
    with pytest.raises(NoReply):
        ramp(drive, 3.0, rate=1.0)
    assert steps(line) == [100, 200]


@pytest.mark.parametrize(("most", "seconds"), [(50, 0), (0, 10)])
def test_a_ramp_needs_a_rate_if_the_drives_acceleration_is_unusable(most: int, seconds: int) -> None:
    line, drive, sim = ramped(Ramped)
    sim["maximum_frequency"], sim["acceleration_time"] = most, seconds
    with pytest.raises(
        WriteForbidden, match="the acceleration of ramped@1 cannot be read: pass rate in Hz/s"
    ):
        ramp(drive, 2.0)
    assert line.written == []
    ramp(drive, 2.0, rate=4.0)
    assert steps(line) == [200]


class Nameless(Ramped):
    """A drive whose family has no `identify`."""

    model = "nameless"
    identify = Drive.identify


def test_a_ramp_is_refused_without_the_option_confirmed() -> None:
    line, drive, _ = ramped(Nameless, confirmed=0)
    with pytest.raises(WriteForbidden, match="confirmed = 1"):
        ramp(drive, 2.0, rate=1.0)
    assert line.frames == []
    line, drive, _ = ramped(Nameless, confirmed=1)
    ramp(drive, 2.0, rate=1.0, every=1.0)
    assert steps(line) == [100, 200]


@pytest.mark.parametrize("gap", [0, 0.5])
def test_staggered_starts_keep_the_given_gap(gap: float) -> None:
    line, drives, sims = che_drives(2)
    begun = line.seconds
    start_staggered(drives, gap)
    assert all(sim.motor.energised for sim in sims)
    assert gap <= line.seconds - begun < gap + 1


@pytest.mark.parametrize("gap", [4.0, 25.0])
def test_waiting_drives_are_read_regularly_during_a_staggered_start(gap: float) -> None:
    """Otherwise a start would be refused: after a silence, a setpoint that cannot be read counts as lost."""
    sims: list[Any] = [simulated(InnovertIBD(address, maximum_frequency=50)) for address in range(1, 6)]
    line = SimulatedBus(*sims)
    drives = [line.attach(sim.drive) for sim in sims]
    for drive in drives:
        drive.set_frequency(20)
    begun = line.seconds
    start_staggered(drives, gap)
    assert all(sim.motor.energised for sim in sims)
    assert 4 * gap <= line.seconds - begun < 4 * gap + 10


def test_no_staggered_start_is_sent_after_the_computer_slept(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drives, sims = che_drives(2)

    def sleep(seconds: float) -> None:
        line.sleep(seconds)
        if sims[0].motor.energised:
            line.slept = 60.0

    monkeypatch.setattr(clock, "sleep", sleep)
    with pytest.raises(Expired, match="control = FORWARD was not sent"):
        start_staggered(drives, 4.0)
    assert not any(sim.motor.energised for sim in sims)


def test_a_failed_staggered_start_does_not_stop_drives_not_yet_started() -> None:
    line, drives, sims = che_drives(3)
    sims[1].trip(4)
    line.frames.clear()
    with pytest.raises(WriteForbidden, match="OC1"):
        start_staggered(drives, 1.0)
    assert {request.address for request, _ in line.frames if is_write(request)} == {1, 2}


def test_a_failed_staggered_start_sends_no_stop_to_an_unidentified_drive() -> None:
    """An INNOVERT IBD's stop writes 0001H to the address 2000H, which runs an INVT Goodrive."""
    sims: list[Any] = [simulated(InnovertIBD(1)), simulated(PROFILES["invt-goodrive"](2))]
    line = SimulatedBus(*sims)
    drives: list[Any] = [line.attach(InnovertIBD(address)) for address in (1, 2)]
    drives[0].set_frequency(20)
    with pytest.raises(WriteForbidden, match="confirmed = 1"):
        start_staggered(drives, 1.0)
    assert {request.address for request, _ in line.frames if is_write(request)} == {1}
    assert not any(sim.motor.goal for sim in sims)
    with pytest.raises(WriteForbidden, match="multidrop stop PORT invt-goodrive 2"):
        drives[1].stop(seconds=1)  # sent to a Goodrive, this stop would run the motor
    assert {request.address for request, _ in line.frames if is_write(request)} == {1}


def test_detaching_a_drive_during_staggered_starts_stops_all_motors(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drives, sims = che_drives(2)
    line.frames.clear()

    def leave(request: Message) -> None:
        if request.address == 2 and drives[1].bus:
            line.bus.detach(drives[1])

    monkeypatch.setattr(line, "answers", leave)
    with pytest.raises((CancelledByStop, NotAttached)):
        start_staggered(drives, 1.0)
    assert len(starts(line, "invt-che")) == 1
    assert all_stopped(line, sims)


class NotedCalls:
    """Records the stops that are called: the drive's address, and `seconds`."""

    def __init__(self, drives: list[Any]) -> None:
        self.calls: list[tuple[int, float | None]] = []
        self.acts: dict[int, Callable[[float | None], None]] = {}
        for drive in drives:
            drive.begin_stop = partial(NotedStop, self, drive.address)


class NotedStop:
    """One recorded stop."""

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
        pass

    def result(self) -> None:
        """Return None: the motor has stopped."""


def test_a_failed_staggered_start_stops_the_started_drives_in_parallel() -> None:
    """The stop of a silent drive does not delay the stops of the other drives."""
    _, drives, sims = che_drives(3)
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


def test_all_started_drives_get_a_stop_before_any_stop_is_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """A staggered start has failed, and the system has no thread for the stops."""
    _, drives, sims = che_drives(2)
    sims[1].trip(4)
    noted = NotedCalls(drives)
    monkeypatch.setattr(threading, "Thread", NoThread)
    with pytest.raises(WriteForbidden, match="OC1"):
        start_staggered(drives, 1.0)
    assert noted.calls == [(1, 0.0), (2, 0.0), (1, None), (2, None)]


def test_an_interrupted_stop_is_sent_again_if_no_thread_can_start(monkeypatch: pytest.MonkeyPatch) -> None:
    _, drives, sims = che_drives(2)
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


def test_a_failed_staggered_start_stops_the_started_drives() -> None:
    line, drives, sims = che_drives(3)
    begun = line.seconds
    start_staggered(drives, 2.0, Direction.FORWARD)
    assert 4 <= line.seconds - begun < 6
    assert all(sim.motor.energised for sim in sims)
    line.bus.stop_all()
    sims[1].trip(4)
    line.frames.clear()
    with pytest.raises(WriteForbidden, match="OC1"):
        start_staggered(drives, 2.0)
    assert [each[:17] for each in starts(line, "invt-che")] == ["01 06 10 00 00 01"]
    assert all_stopped(line, sims)


def test_an_invalid_gap_starts_no_motor() -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    line.frames.clear()
    for gap in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=r"^gap = .* s: it must be 0 or more$"):
            start_staggered([drive, drive], gap)
    assert line.frames == []


def test_wrong_arguments_of_a_ramp_raise_type_error_before_any_frame() -> None:
    line, drive, _ = one(YD1000(1))
    with pytest.raises(TypeError, match=r"is not a drive: pass the drive that bus.attach\(\) returned"):
        ramp(cast(Any, [drive]), 20.0)
    with pytest.raises(TypeError, match="rate = '1' is not a number"):
        ramp(drive, 20.0, rate=cast(Any, "1"))
    with pytest.raises(TypeError, match="every = None is not a number"):
        ramp(drive, 20.0, every=cast(Any, None))
    assert line.frames == []


def test_a_ramp_is_never_faster_than_the_ramp_of_the_drive() -> None:
    line, drive, _ = one(YD1000(1))
    drive.set_frequency(10)
    line.frames.clear()
    ramp(drive, 20.0)  # 80 Hz in 10 s: 4 Hz in half a second
    assert steps(line) == [1400, 1800, 2000]
    with pytest.raises(ValueError, match=r"faster than yd1000@1 itself can ramp, 8 Hz/s"):
        ramp(drive, 0.0, rate=9)
    with pytest.raises(ValueError, match=r"rate = 0 Hz/s is not above 0"):
        ramp(drive, 0.0, rate=0)
    with pytest.raises(ValueError, match=r"every = 0 s is not above 0"):
        ramp(drive, 0.0, every=0)
    ramp(drive, 19.0, rate=1.0)
    assert line.written[-2][:17] == "01 06 10 01 07 9E"


def test_a_ramp_needs_a_rate_if_the_family_declares_no_acceleration() -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    with pytest.raises(WriteForbidden, match="pass rate"):
        ramp(drive, 20.0)
    ramp(drive, 2.0, rate=2.0)
    assert steps(line) == [200, 400]  # 1 Hz and 2 Hz, in 0.01 % of 50 Hz


@pytest.mark.parametrize("model", ["yd1000", "invt-che", "innovert-ibd"])
def test_a_ramp_to_a_forbidden_setpoint_sends_no_step(model: str) -> None:
    line, drive, _ = one(MAKE[model](1))
    drive.set_frequency(10)
    line.frames.clear()
    for hz in (5000.0, -5.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match=r"Hz|finite"):
            ramp(drive, hz, rate=5.0)
    assert line.written == []
    ramp(drive, 11, rate=5.0)
    assert len(line.written) == 1


def test_a_ramp_starts_from_the_setpoint_of_the_last_register_write() -> None:
    """The setpoint cannot be read. A ramp from the older setpoint would start with a jump."""
    line, drive, _ = one(InnovertIBD(1, confirmed=1))
    drive.set_frequency(40)
    drive.write(drive.frequency, 10.0)
    line.frames.clear()
    ramp(drive, 14, rate=4.0)
    assert steps(line) == [1200, 1400]


def test_a_ramp_is_refused_after_an_unconfirmed_setpoint() -> None:
    line, drive, _ = one(InnovertIBD(1, confirmed=1))
    drive.set_frequency(40)
    line.loses = is_write
    with pytest.raises(Unconfirmed):
        drive.write(drive.frequency, 10.0)
    for act in (lambda: ramp(drive, 14, rate=4.0), drive.start):
        with pytest.raises(WriteForbidden, match="cannot report its setpoint"):
            act()


def test_a_ramp_is_refused_after_a_broadcast_setpoint() -> None:
    line, drive, _ = one(InnovertIBD(1, confirmed=1))
    drive.set_frequency(40)
    line.bus.broadcast(drive.frequency, 0)
    with pytest.raises(WriteForbidden, match="cannot report its setpoint"):
        ramp(drive, 14, rate=4.0)


class ShareToy(Toy):
    """A drive whose setpoint is a percentage of a maximum that its class does not state."""

    share = setting(0x16, "%", step=0.01, span=(0, 100), kept=Kept.RAM)
    setpoint_name = "share"

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        yield from self._write_setpoint(self.share, hz / 80 * 100)


class AliasToy(Toy):
    """A drive whose setpoint is kept in EEPROM, but is written at an alias address in RAM."""

    frequency = setting(0x15, "Hz", step=0.01, span=(0, 50), kept=Kept.EEPROM, ram_address=0x115)

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        yield from self._write_setpoint(self.frequency, hz)


def test_a_ramp_writes_no_eeprom_if_the_setpoint_has_a_ram_address(tmp_path: Path) -> None:
    line = SimulatedBus(simulated(AliasToy(1)), ledger=tmp_path / "wear.sqlite")
    toy = line.attach(AliasToy(1))
    ramp(toy, 10, rate=8.0)
    assert [frame[:17] for frame in line.written] == [
        "01 06 01 15 01 90",
        "01 06 01 15 03 20",
        "01 06 01 15 03 E8",
    ]
    assert Ledger(tmp_path / "wear.sqlite").wear(0) == []


class KeptToy(Toy):
    """A drive whose setpoint is declared as a command, but is kept in EEPROM."""

    frequency = command(0x2000, "Hz", step=0.01, span=(0, 50), kept=Kept.EEPROM, moves=False)

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        yield from self._write_setpoint(self.frequency, hz)


@table(
    ("drive", "before", "rate", "error"),
    [
        (YD1000(1), 10, None, r"82\.50 Hz is above maximum_frequency, which is 80 Hz"),
        (ShareToy(1), None, 5.0, "is in %: for a ramp, declare maximum_frequency = HZ"),
        (Toy(1), None, 5.0, r"^toy@1 cannot report its setpoint: call set_frequency before a ramp$"),
        (DelixiModbus(1), None, None, "EEPROM"),
        (KeptToy(1), 5, 5.0, "which a ramp would wear out"),
    ],
)
def test_a_refused_ramp_sends_no_step(
    drive: Any, before: float | None, rate: float | None, error: str
) -> None:
    line = SimulatedBus(simulated(drive))
    line.attach(drive)
    if before:
        drive.set_frequency(before)
    line.frames.clear()
    with pytest.raises(WriteForbidden, match=error):
        ramp(drive, 82.5, rate=rate)
    assert line.written == []
