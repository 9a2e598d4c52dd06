"""How drives that are silent, answer slowly, or need an interval between requests affect the polling.

Most tests use a clock that the test sets.
"""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest
from clocked_lines import ClockedLines, ClockedWire, S
from lines import polled, rows_of
from simulated_bus import SimulatedBus
from tables import table
from toy import Picky, Toy, family

from multidrop.control.call import Call
from multidrop.control.stops import StopAttempt, stop_together
from multidrop.core import Latch, Message, Peer
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, reading
from multidrop.drive.verbs import Insist, Script
from multidrop.families import InvtCHE
from multidrop.planning.blocks import planned
from multidrop.planning.prediction import predict
from multidrop.planning.schedule import Job, Schedule
from multidrop.polling.batch import Row
from multidrop.polling.jobs import JobMaker
from multidrop.polling.polled_line import PolledLine
from multidrop.sim import Faults, SimulatedDrive, simulated
from multidrop.transport import clock
from multidrop.transport.drive_reads import NO_ROWS, make_exchange

# ---- silent drives ----


DRIVES = 31
FIRST, LATER = 8, 30  # s; values are counted in the first 8 s and in the 30 s after them
BACK = 45  # s; time limit until dead drives are polled again after they get power


def test_a_poll_skipped_in_advance_gets_its_row_only_when_due() -> None:
    """The poller decides in advance which polls of a silent drive it skips."""
    toy = Toy(1, name="pump-1")
    silent = simulated(toy)
    silent.deaf_until = float("inf")
    with ClockedLines(ClockedWire([silent], Faults()), [polled(toy, [Toy.fault], 0.01)]) as clocked:
        clocked.run(5)
        for _ in range(100):
            rows = clocked.run(0.05)
            assert clocked.now - 0.02 * S <= rows[-1].monotonic_ns <= clocked.now
            assert all(row.monotonic_ns <= clocked.now for row in rows)
    assert all(row.monotonic_ns <= clocked.now for row in rows_of(clocked.poller))
    assert clocked.poller.summary()["lines"]["line"]["misses"]["not asked: drive is silent"] > 400


@pytest.mark.parametrize(("is_silent", "looks"), [(False, 20), (True, 40)])
def test_a_line_is_checked_more_often_while_a_drive_is_silent(
    monkeypatch: pytest.MonkeyPatch, is_silent: bool, looks: int
) -> None:
    """While all drives of a line with a period answer, the line is checked only to refill its queue."""
    looked: list[int] = []
    tend = PolledLine.tend

    def noted(line: PolledLine, now_ns: int) -> None:
        looked.append(now_ns)
        tend(line, now_ns)

    monkeypatch.setattr(PolledLine, "tend", noted)
    drives = [Toy(1, name="pump-1"), Toy(2, name="pump-2")]
    sims = [simulated(drive) for drive in drives]
    sims[1].deaf_until = float("inf") if is_silent else 0.0
    with ClockedLines(
        ClockedWire(sims, Faults()), [polled(drive, [Toy.fault], 0.1) for drive in drives]
    ) as clocked:
        clocked.run(5)
        looked.clear()
        rows = clocked.run(2)
        assert len([row for row in rows if row.value is not None]) == (20 if is_silent else 40)
        # a few further checks when a drive falls silent or answers again
        assert abs(len(looked) - looks) <= 3


@pytest.mark.long
@pytest.mark.story
@pytest.mark.parametrize(("dead", "back_s"), [(1, 5), (5, 25), (10, 45)])
def test_silent_drives_hardly_slow_the_other_drives(dead: int, back_s: int) -> None:
    """Once the silent drives answer again, all are polled within `back_s` seconds."""
    drives = [InvtCHE(address, name=f"drive-{address}", baudrate=38_400) for address in range(1, DRIVES + 1)]
    sims = [simulated(drive) for drive in drives]
    clocked = ClockedLines(
        ClockedWire(sims, Faults()), [polled(each, each.readings()[:1]) for each in drives]
    )
    gone = {each.name for each in drives[:dead]}

    def answered(seconds: float) -> int:
        return sum(1 for row in clocked.run(seconds) if row.value is not None)

    with clocked:
        clocked.run(5)  # the poller measures the response delays
        healthy = answered(10)
        for sim in sims[:dead]:
            sim.deaf_until = float("inf")
        clocked.run(10)  # the poller notices that these drives are silent
        assert answered(50) >= 0.97 * 5 * healthy
        for sim in sims[:dead]:
            sim.deaf_until = 0.0
        revived, back = clocked.now, set()
        while not gone <= back:
            assert clocked.now <= revived + back_s * S
            back |= {row.drive for row in clocked.run(0.5) if row.value is not None}


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.story
@pytest.mark.parametrize(("count", "dead", "every"), [(16, 5, None), (16, 1, 0.5), (31, 10, None)])
def test_drives_that_are_dead_from_the_start_hardly_slow_others(
    count: int, dead: int, every: float | None
) -> None:
    """Every third drive is dead, so that most answering drives are polled after a dead one."""
    gone = {3 * number + 1 for number in range(dead)}

    def answered(addresses: list[int]) -> list[int]:
        """Return the numbers of answers in the first FIRST s, and in the LATER s after that."""
        drives = [InvtCHE(address, name=f"drive-{address}", baudrate=38_400) for address in addresses]
        sims = [simulated(drive) for drive in drives]
        for sim in sims:
            sim.deaf_until = float("inf") if sim.drive.address in gone else 0.0
        clocked = ClockedLines(
            ClockedWire(sims, Faults()), [polled(each, each.readings()[:1], every) for each in drives]
        )
        with clocked:
            found = [sum(row.value is not None for row in clocked.run(span)) for span in (FIRST, LATER)]
            for sim in sims:
                sim.deaf_until = 0.0
            revived, back = clocked.now, set[str]()
            while not back >= {each.name for each in drives}:
                assert clocked.now < revived + BACK * S
                back |= {row.drive for row in clocked.run(1) if row.value is not None}
            return found

    every_drive = list(range(1, count + 1))
    first, later = answered(every_drive)
    without_first, without_later = answered([address for address in every_drive if address not in gone])
    assert first >= 0.9 * without_first
    assert later >= 0.98 * without_later


SOON, LATE = 0.005, 0.06  # short and long response delay in s


class Wide(Toy):
    """A drive with two registers far apart. One request for both pays only if replies are slow."""

    most_registers = {HOLDING: 100}
    readable_gaps = {HOLDING: range(100)}

    near = reading(0x20)
    far = reading(0x38)


NAMES = (Wide.near.name, Wide.far.name)


def asked_together(rows: list[Row]) -> set[bool]:
    """Return, for each exchange, True if it read both registers."""
    assert {row.status for row in rows} == {"ok"}
    return {count == len(NAMES) for count in Counter(row.monotonic_ns for row in rows).values()}


@pytest.mark.slow
@table(("document", "truth"), [(SOON, LATE), (LATE, SOON)], ids=["later", "sooner"])
@table("every", [None, 0.75], ids=["in turn", "at a rate"])
def test_requests_are_planned_again_if_the_response_delay_differs_from_the_manual(
    document: float, truth: float, every: float | None
) -> None:
    drive = Wide(1, name="pump-1")
    drive.response_delay = document
    sim = SimulatedDrive(Wide(1), response_delay=truth)
    with ClockedLines(ClockedWire([sim], Faults()), [polled(drive, [Wide.near, Wide.far], every)]) as clocked:
        first = clocked.run(0.7)
        assert asked_together(first) == {document == LATE}
        between = clocked.run(3.0)
        after = clocked.run(9.0)
        assert asked_together(after) == {truth == LATE}
        summary = clocked.poller.summary()["lines"]["line"]
    assert summary["misses"] == {}
    if every:
        assert summary["overrun_slots"] == 0
        for name in NAMES:
            slots = [row.monotonic_ns for row in first + between + after if row.register == name]
            dues = {round((at - slots[0]) / (every * S)) for at in slots}
            assert dues == set(range(len(dues)))  # each poll has exactly one row


def test_a_new_plan_for_one_drive_keeps_the_polling_order() -> None:
    drives = [Wide(address, name=f"pump-{address}") for address in (1, 2, 3)]
    drives[1].response_delay = LATE
    sims = [SimulatedDrive(Wide(address), response_delay=SOON) for address in (1, 2, 3)]
    with ClockedLines(
        ClockedWire(sims, Faults()), [polled(each, [Wide.near, Wide.far]) for each in drives]
    ) as clocked:
        clocked.run(5.0)
        rows = [(row.drive, row.register) for row in clocked.run(2.0)]
    at = rows.index(("pump-1", "near"))
    assert rows[at : at + 6] == [(drive.name, name) for drive in drives for name in NAMES]


@pytest.mark.slow
def test_memory_is_bounded_if_a_response_delay_keeps_changing() -> None:
    drive = Wide(1, name="pump-1")
    sim = SimulatedDrive(Wide(1), response_delay=SOON)
    with ClockedLines(ClockedWire([sim], Faults()), [polled(drive, [Wide.near, Wide.far])]) as clocked:
        (line,) = clocked.poller._lines
        seen = set()
        for _ in range(6):
            for sim.response_delay in (SOON, LATE):
                clocked.run(6.0)
                seen.add(len(line._maker._made))
    assert seen == {2, 3}


@pytest.mark.slow
def test_a_read_plan_changes_only_if_another_plan_is_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measured delays always vary a little. That alone must not change the requests."""
    drive = Wide(1, name="pump-1")
    sim = SimulatedDrive(Wide(1), response_delay=SOON)
    choose, chosen = JobMaker.plan, []
    monkeypatch.setattr(JobMaker, "plan", lambda *given: chosen.append(given) or choose(*given))
    with ClockedLines(ClockedWire([sim], Faults()), [polled(drive, [Wide.near, Wide.far])]) as clocked:
        for sim.response_delay in (SOON / 20, 2 * SOON, SOON / 5, SOON):
            assert asked_together(clocked.run(6.0)) == {False}
        assert len(chosen) == 1
        sim.response_delay = LATE
        clocked.run(6.0)
        assert len(chosen) == 2


# ---- drives that need a pause between requests (`least_interval`); it does not delay other drives ----


INTERVAL = 0.1
SLACK = 1e-6


class Slow(Picky):
    """A simulated drive that records when requests arrive, and counts those too soon after its last reply."""

    def __init__(self, drive: Drive) -> None:
        super().__init__(drive)
        self.times: list[float] = []
        self.early = 0
        self._replied = 0.0

    def answer(self, request: Message, now: float) -> Message | None:
        if request.address != self.drive.address:
            return None
        self.times.append(now)
        self.early += now < self._replied + INTERVAL - SLACK
        self._replied = now + self.delay
        return super().answer(request, now)


def slow(registers: int = 3, most: int = 1) -> tuple[Drive, Slow]:
    drive = family(registers, least_interval=INTERVAL, most_registers={HOLDING: most})(1, name="slow")
    return drive, Slow(drive)


def quick(address: int) -> tuple[Drive, Picky]:
    drive = family(2)(address, name=f"quick-{address}")
    return drive, Picky(drive)


@pytest.mark.long
@table("every", [None, 0.01, 0.5])
@table("others", [0, 2])
def test_all_registers_are_polled_equally_often_if_the_drive_needs_pauses(
    every: float | None, others: int
) -> None:
    drive, sim = slow()
    rest = [quick(address) for address in range(2, 2 + others)]
    drives = [
        polled(drive, drive.registers.values(), every),
        *(polled(one, one.readings()) for one, _ in rest),
    ]
    with ClockedLines(ClockedWire([sim, *(one for _, one in rest)], Faults()), drives) as clocked:
        clocked.run(2)
        del sim.times[:]
        rows = clocked.run(12)
    counts = [sum(row.register == f"r{at}" and row.drive == "slow" for row in rows) for at in range(3)]
    assert sim.early == 0
    assert {row.status for row in rows} == {"ok"}
    assert max(counts) - min(counts) <= 1
    each = INTERVAL + (0.06 if others else 0.03)  # s; an exchange takes at most 30 ms
    wanted = 12 / max(each, (every or 0) / 3)
    assert sum(counts) >= 0.9 * wanted


@pytest.mark.slow
def test_a_drive_that_needs_pauses_hardly_slows_the_other_drives() -> None:
    (drive, sim), (other, its_sim) = slow(), quick(2)

    def exchanges(*drives: Drive) -> int:
        before = [polled(drive, drive.readings()) for drive in drives]
        with ClockedLines(ClockedWire([sim, its_sim], Faults()), before) as clocked:
            clocked.run(2)
            return sum(row.drive == other.name for row in clocked.run(10))

    alone, together = exchanges(other), exchanges(drive, other)
    assert together >= 0.75 * alone  # the slow drive's exchanges take less than a quarter of the bus time
    assert sim.early == 0


@pytest.mark.slow
def test_a_stop_is_the_first_request_after_the_drives_pause() -> None:
    (drive, sim), (other, its_sim) = slow(), quick(2)
    drives = [polled(drive, drive.readings()), polled(other, other.readings())]
    with ClockedLines(ClockedWire([sim, its_sim], Faults()), drives) as clocked:
        clocked.run(1)
        for _ in range(20):
            clocked.run(0.037)
            assert clocked.port is not None
            called, asked = clocked.now / S, len(its_sim.asked)
            bus = clocked.poller.bus("line")
            stop = make_exchange(
                drive, Message(1, 0x06, 0x20, data=b"\0\0"), bus.peer(drive), NO_ROWS, insists=True
            )
            clocked.port.begin_urgent(stop)
            before = len(sim.times)
            while len(sim.times) == before:
                clocked.run(0.001)
            assert len(its_sim.asked) - asked <= 1  # only the request in flight delays the stop
            assert sim.times[-1] <= called + INTERVAL + 0.06  # 0.06 s: one exchange with each drive
    assert sim.early == 0


def test_single_reads_keep_the_pause_between_requests() -> None:
    (drive, sim), (other, its_sim) = slow(), quick(2)
    with ClockedLines(ClockedWire([sim, its_sim], Faults()), [polled(other, other.readings())]) as clocked:
        bus = clocked.poller.bus("line")
        bus.attach(drive)
        clocked.run(1)
        for _ in range(3):
            clocked.command(drive, Message(1, 0x03, 0, 1))
            clocked.run(0.3)
        for _ in range(3):
            clocked.command(drive, Message(1, 0x03, 0, 1))
            asked = len(its_sim.asked)
            clocked.command(drive, Message(1, 0x03, 1, 1))
            clocked.run(0.3)
            assert len(its_sim.asked) > asked + 3
    assert len(sim.times) == 9
    assert sim.early == 0


def test_the_pause_between_requests_extends_the_expiry_of_a_write() -> None:
    drive = family(1, least_interval=2.0)(1)
    SimulatedBus(Picky(drive)).attach(drive)
    patient = Call(drive, Latch().permit(), 1.0)
    eager = Call(family(1)(2), Latch().permit(), 1.0)
    assert patient.expires_ns - eager.expires_ns == 2 * S


@pytest.mark.slow
def test_the_predicted_rate_includes_the_interval_between_requests() -> None:
    drive, sim = slow()
    wanted = planned(drive, [(register, None) for register in drive.readings()])
    found = predict(wanted, lateness=0.0)
    with ClockedLines(ClockedWire([sim], Faults()), [polled(drive, drive.readings())]) as clocked:
        clocked.run(2)
        rows = clocked.run(20)
    measured = sum(row.register == "r0" for row in rows) / 20
    assert found.rates[0].reached == pytest.approx(measured, rel=0.03)
    assert found.cycle == pytest.approx(1 / measured, rel=0.03)
    assert found.utilisation < 0.5
    hasty = predict(planned(drive, [(register, 0.1) for register in drive.readings()]))
    assert not hasty.fits


def test_a_schedule_sends_all_requests_equally_often_if_a_drive_needs_pauses() -> None:
    """Takes ten thousand turns from a schedule, without a clock."""
    schedule: Schedule[Job] = Schedule()
    jobs = [Job(drive=1, period_ns=None, duration_ns=10, interval_ns=1000) for _ in range(5)]
    jobs += [Job(drive=2, period_ns=None, duration_ns=10) for _ in range(7)]
    for job in jobs:
        schedule.add(job, 0)
    at, taken = 0, []
    for _ in range(10_000):
        ((job, not_before_ns, _),) = schedule.take(at, at, 1 << 62, 1)
        begun = max(at, not_before_ns)
        taken.append((begun, job))
        at = begun + job.duration_ns
    own = [begun for begun, job in taken if job.drive == 1]
    counts = [sum(job is other for _, other in taken) for job in jobs]
    assert min(later - sooner for sooner, later in pairwise(own)) >= 1010
    assert max(counts[:5]) - min(counts[:5]) <= 1
    assert max(counts[5:]) - min(counts[5:]) <= 1
    assert not [gap for (sooner, _), (later, _) in pairwise(taken) if (gap := later - sooner) != 10]


def test_a_schedule_has_no_repeatable_cycle_if_a_drive_needs_pauses() -> None:
    schedule: Schedule[Job] = Schedule()
    first, second = (Job(drive=1, period_ns=None, duration_ns=10, interval_ns=1000) for _ in range(2))
    other = Job(drive=2, period_ns=None, duration_ns=10)
    schedule.add(first, 0)
    schedule.add(second, 0)
    assert schedule.cycle(0) == []
    assert [turn.job for turn in schedule.take(0, 0, 1, 9)] == [first]
    schedule.remove(first)
    assert schedule.cycle(0) == []
    schedule.add(other, 0)
    schedule.remove(second)
    assert schedule.cycle(0) == [other]


def test_a_poll_removed_during_its_drives_pause_is_never_sent() -> None:
    schedule: Schedule[Job] = Schedule()
    other = Job(drive=2, period_ns=None, duration_ns=10)
    first, second = (Job(drive=1, period_ns=None, duration_ns=10, interval_ns=1000) for _ in range(2))
    for job in (other, first, second):
        schedule.add(job, 0)
    assert [turn.job for turn in schedule.take(0, 0, 30, 9)] == [other, first, other]
    schedule.remove(second)
    assert [turn.job for turn in schedule.take(2000, 2000, 2001, 9)] == [first]
    schedule.remove(other)
    assert [turn.job for turn in schedule.take(2010, 2010, 3011, 9)] == [first]
    schedule.back_off.observe(1, 1, 3020, late_until_ns=9000, cost_ns=0)
    # the drive's pause ends now, but the drive is silent
    assert schedule.take(4020, 4020, 5000, 9) == []


def test_the_drive_whose_pause_ends_first_gets_the_next_request() -> None:
    schedule: Schedule[Job] = Schedule()
    slow, fast = (
        Job(drive=drive, period_ns=None, duration_ns=10, interval_ns=1000 // drive) for drive in (1, 2)
    )
    schedule.add(slow, 0)
    schedule.add(fast, 0)
    taken = [(turn.job, turn.not_before_ns) for turn in schedule.take(0, 0, 700, 9)]
    assert taken == [(slow, 0), (fast, 0), (fast, 520)]


def test_the_pause_of_one_drive_does_not_delay_the_stop_of_another(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(clock, "now_ns", lambda: round(now[0] * 1e9))
    monkeypatch.setattr(clock, "sleep", lambda seconds: None)
    first, second = slow()[0], family(1)(2, name="other")
    sent: list[str] = []

    def script() -> Script[None]:
        yield Insist(Toy.control, 0)

    def do(stop: StopAttempt, step: object) -> None:
        sent.append(stop.drive.name)

    resting = Peer(least_timeout=1.0, most_timeout=1.0)
    resting.c.ready_ns = round((now[0] + INTERVAL) * 1e9)
    stops = [StopAttempt(drive, script, now[0], None, {first: resting}) for drive in (first, second)]
    stop_together(stops, do, lambda stop: None)
    assert sent == ["other", "slow"]
