"""The schedule, with a clock that the tests hold in their hands."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from multidrop.schedule import FIRST_REST_NS, LONGEST_REST_NS, SILENT_SHARE, Job, Schedule

MS = 1_000_000


def job(drive: int = 1, period_ms: int | None = None, duration_ms: int = 5) -> Job:
    period_ns = None if period_ms is None else period_ms * MS
    return Job(drive=drive, period_ns=period_ns, duration_ns=duration_ms * MS)


def schedule(*jobs: Job) -> Schedule[Job]:
    made: Schedule[Job] = Schedule()
    for it in jobs:
        made.add(it, 0)
    return made


def take(made: Schedule[Job], now_ms: int, ahead_ms: int, most: int = 1000) -> list[tuple[Job, int]]:
    """From an idle line: the jobs, each with the ms before which it is not to be sent."""
    now = now_ms * MS
    return [(it, due // MS) for it, due in made.take(now, now, now + ahead_ms * MS, most)]


def fail(made: Schedule[Job], drive: int, failures: int, now_ms: int, late_until_ms: int = 0) -> None:
    made.observe(drive, failures, now_ms * MS, late_until_ns=late_until_ms * MS, cost_ns=0)


def test_a_period_keeps_its_own_grid_whenever_it_is_planned() -> None:
    made = schedule(poll := job(period_ms=20))
    planned = [due for now in range(0, 1000, 37) for _, due in take(made, now, 100)]
    assert planned == list(range(0, planned[-1] + 1, 20))
    assert poll.skipped == 0


def test_after_a_stall_slots_are_counted_and_not_made_up_for() -> None:
    made = schedule(poll := job(period_ms=20))
    assert take(made, 0, 1) == [(poll, 0)]
    assert take(made, 110, 1) == [(poll, 20)]  # asked at once, late as it is
    assert poll.skipped == 3  # 40, 60, 80; that of 100 is still worth asking
    assert take(made, 111, 1) == [(poll, 100)]
    assert take(made, 112, 1) == []


def test_the_earliest_due_goes_first_and_the_others_fill_in_turn() -> None:
    timed, late = job(1, 40), job(2, 60)
    first, second, third = job(3), job(4), job(5)
    made = schedule(first, late, second, timed, third)
    planned = [it for it, _ in take(made, 0, 40)]
    assert planned == [late, timed, first, second, third, first, second, third]
    assert [it for it, _ in take(made, 40, 10)] == [timed, first]


def test_a_job_in_turn_is_not_begun_twice_while_others_wait() -> None:
    jobs = [job(drive) for drive in range(5)]
    made = schedule(*jobs)
    assert [it for it, _ in take(made, 0, 35)] == [*jobs, *jobs[:2]]
    assert [it for it, _ in take(made, 0, 10)] == jobs[2:4]


def test_no_more_is_planned_than_there_is_room_for() -> None:
    made = schedule(job(1), job(2, 10))
    assert len(take(made, 0, 1000, most=7)) == 7


def test_at_least_one_job_is_taken_however_long_it_lasts() -> None:
    made = schedule(long := job(duration_ms=500))
    assert take(made, 0, 1) == [(long, 0)]


def test_what_is_queued_already_counts() -> None:
    made = schedule(job(1))
    assert made.take(0, 100 * MS, 100 * MS, 9) == []
    assert len(made.take(0, 90 * MS, 100 * MS, 9)) == 2


def test_a_silent_drive_rests_longer_and_longer_and_the_others_go_on() -> None:
    dead, alive = job(1), job(2)
    made = schedule(dead, alive)
    fail(made, 1, 2, now_ms=0)
    assert {it for it, _ in take(made, 1, 100)} == {alive}
    now, rests = 0, []
    for failures in range(3, 11):
        woken = next(
            at for at in range(now + 1, now + 20_000, 50) if dead in (it for it, _ in take(made, at, 10))
        )
        rests.append(woken - now)
        now = woken
        fail(made, 1, failures, now)
    assert FIRST_REST_NS // MS <= rests[0] <= FIRST_REST_NS // MS + 100
    assert rests == sorted(rests)
    assert LONGEST_REST_NS // MS <= rests[-1] <= LONGEST_REST_NS // MS + 100


def test_all_silent_drives_together_cost_their_share() -> None:
    jobs = [job(drive, duration_ms=40) for drive in range(10)]
    made = schedule(*jobs, job(99))
    cost_ms, asked = 300, 0
    failures = dict.fromkeys(range(10), 2)
    for drive in range(10):
        made.observe(drive, 2, 0, late_until_ns=0, cost_ns=cost_ms * MS)
    for now in range(0, 3_600_000, 1000):
        for it, _ in take(made, now, 5):
            if it.drive < 10:
                asked += 1
                failures[it.drive] += 1
                made.observe(it.drive, failures[it.drive], now * MS, late_until_ns=0, cost_ns=cost_ms * MS)
    assert 0 < asked * cost_ms / 3_600_000 <= SILENT_SHARE


def test_a_drive_that_wakes_is_asked_one_thing_and_is_back_with_its_first_answer() -> None:
    made = schedule(job(1), job(1), other := job(2))
    fail(made, 1, 2, now_ms=0)
    woken = take(made, 501, 50)
    assert len([it for it, _ in woken if it is not other]) == 1
    fail(made, 1, 0, now_ms=520)
    assert len({it for it, _ in take(made, 520, 50)}) == 3


def test_nothing_is_asked_while_a_late_answer_may_still_come() -> None:
    made = schedule(poll := job(1), other := job(2))
    fail(made, 1, 1, now_ms=0, late_until_ms=300)
    assert {it for it, _ in take(made, 0, 299)} == {other}
    assert poll in {it for it, _ in take(made, 300, 20)}


def test_damage_alone_costs_no_rest() -> None:
    made = schedule(poll := job(1))
    fail(made, 1, 1, now_ms=0)
    assert take(made, 0, 5) == [(poll, 0)]


def test_slots_of_a_resting_drive_are_reported_with_the_time_they_were_due() -> None:
    made = schedule(poll := job(1, period_ms=100))
    fail(made, 1, 2, now_ms=0)
    assert take(made, 0, 350) == []
    assert made.unasked == [(poll, due * MS) for due in (0, 100, 200, 300)]


def test_each_rest_is_told_once_for_jobs_in_turn() -> None:
    made = schedule(poll := job(1), job(2))
    fail(made, 1, 2, now_ms=7)
    take(made, 8, 300)
    assert made.unasked == [(poll, 7 * MS)]


def test_while_the_port_is_gone_every_slot_passes() -> None:
    made = schedule(poll := job(1, period_ms=100), fast := job(2))
    assert made.pass_all(150 * MS) == [(fast, 150 * MS), (poll, 0), (poll, 100 * MS)]


@given(
    st.lists(
        st.tuples(st.integers(1, 4), st.none() | st.integers(5, 80), st.integers(1, 10)),
        min_size=1,
        max_size=8,
    ),
    st.lists(st.integers(0, 60), min_size=30, max_size=60),
)
def test_no_drift_no_burst_no_starvation(kinds: list[tuple[int, int | None, int]], stalls: list[int]) -> None:
    made = schedule(*(job(*kind) for kind in kinds))
    busy_until = now = 0
    slots: dict[Job, list[int]] = {it: [] for it in made.jobs}
    for stall in stalls:
        for it, due in made.take(now, busy_until, now + 100 * MS, 64):
            busy_until = max(busy_until, now, due) + it.duration_ns
            slots[it].append(due)
        now += stall * MS
    for it, taken in slots.items():
        if it.period_ns:
            assert all(due % it.period_ns == 0 for due in taken)  # on its grid
            assert taken == sorted(set(taken))  # each slot once
            assert it.due_ns // it.period_ns == len(taken) + it.skipped  # and none unaccounted for
    load = sum(it.duration_ns / it.period_ns for it in made.jobs if it.period_ns)
    if load < 0.5 and now > 1000 * MS:
        assert all(slots.values())
