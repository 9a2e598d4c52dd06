"""The schedule, with a clock that the tests hold in their hands."""

from hypothesis import given
from hypothesis import strategies as st

from multidrop.schedule import FIRST_REST_NS, LONGEST_REST_NS, Job, Schedule

MS = 1_000_000


def job(drive: int = 1, period_ms: int | None = None, duration_ms: int = 5) -> Job:
    period_ns = None if period_ms is None else period_ms * MS
    return Job(drive=drive, period_ns=period_ns, duration_ns=duration_ms * MS)


def schedule(*jobs: Job) -> Schedule[Job]:
    made: Schedule[Job] = Schedule()
    for it in jobs:
        made.add(it, 0)
    return made


def answer(made: Schedule[Job], jobs: list[Job], now_ns: int) -> None:
    for it in jobs:
        made.done(it, now_ns, answered=True)


def test_a_period_keeps_its_own_grid_whatever_the_answers_take() -> None:
    made = schedule(poll := job(period_ms=20))
    for slot in range(50):
        now = slot * 20 * MS + slot % 7 * MS  # up to 6 ms late
        assert made.take(now, MS) == [poll]
        made.done(poll, now + 5 * MS, answered=True)
        assert poll.due_ns == (slot + 1) * 20 * MS
    assert poll.skipped == 0


def test_after_a_stall_slots_are_counted_and_not_made_up_for() -> None:
    made = schedule(poll := job(period_ms=20))
    made.done(poll, 110 * MS, answered=True)  # slots 20, 40, 60, 80 have passed
    assert poll.skipped == 4
    assert made.take(110 * MS, MS) == [poll]  # the one of 100 ms is still worth asking
    made.done(poll, 112 * MS, answered=True)
    assert made.take(113 * MS, MS) == []
    assert made.next_ns(113 * MS) == 120 * MS


def test_the_earliest_due_goes_first_and_the_others_fill_in_turn() -> None:
    urgent, soon = job(1, 10), job(2, 30)
    first, second, third = job(3), job(4), job(5)
    made = schedule(first, soon, second, urgent, third)
    soon.due_ns, urgent.due_ns = 2 * MS, 1 * MS
    assert made.take(5 * MS, 20 * MS) == [urgent, soon, first, second]
    answer(made, [urgent, soon], 25 * MS)
    assert made.take(0, 10 * MS) == [third, first]


def test_at_least_one_job_is_taken_however_long_it_lasts() -> None:
    made = schedule(long := job(duration_ms=500))
    assert made.take(0, MS) == [long]


def test_a_silent_drive_rests_longer_and_longer_and_the_others_go_on() -> None:
    dead, alive = job(1), job(2)
    made = schedule(dead, alive)
    made.done(dead, 0, answered=False)
    made.done(dead, 0, answered=False)
    assert made.take(1, 100 * MS) == [alive]
    now, rests = 0, []
    for _ in range(8):
        woken = next(
            now + step
            for step in range(0, 2 * LONGEST_REST_NS, 100 * MS)
            if dead in made.take(now + step, 100 * MS)
        )
        rests.append(woken - now)
        now = woken
        made.done(dead, now, answered=False)
    assert rests[0] == FIRST_REST_NS
    assert rests == sorted(rests)
    assert rests[-1] == LONGEST_REST_NS


def test_a_drive_that_wakes_is_asked_one_thing_and_is_back_with_its_first_answer() -> None:
    one, other = job(1), job(1)
    made = schedule(one, other)
    made.done(one, 0, answered=False)
    made.done(other, 0, answered=False)
    probe = made.take(FIRST_REST_NS, 100 * MS)
    assert len(probe) == 1
    made.done(probe[0], FIRST_REST_NS, answered=True)
    assert len(made.take(FIRST_REST_NS, 100 * MS)) == 2


def test_nothing_is_asked_while_a_late_answer_may_still_come() -> None:
    made = schedule(poll := job(1), other := job(2))
    made.done(poll, 0, answered=False, late_ns=300 * MS)
    assert made.take(299 * MS, 100 * MS) == [other]
    assert poll in made.take(300 * MS, 100 * MS)


def test_damage_alone_costs_no_rest() -> None:
    made = schedule(poll := job(1))
    made.done(poll, 0, answered=False)
    assert made.take(0, 100 * MS) == [poll]


def test_slots_of_a_resting_drive_are_reported_with_the_time_they_were_due() -> None:
    made = schedule(poll := job(1, period_ms=100))
    made.done(poll, 0, answered=False)
    made.done(poll, 0, answered=False)
    poll.due_ns = 100 * MS
    assert made.unasked(350 * MS) == [(poll, 100 * MS), (poll, 200 * MS), (poll, 300 * MS)]
    assert made.unasked(350 * MS) == []


def test_while_the_port_is_gone_every_slot_passes() -> None:
    made = schedule(poll := job(1, period_ms=100), fast := job(2))
    assert made.pass_all(150 * MS) == [(poll, 0), (poll, 100 * MS), (fast, 150 * MS)]


@given(
    st.lists(
        st.tuples(st.integers(1, 4), st.none() | st.integers(5, 80), st.integers(1, 10)),
        min_size=1,
        max_size=8,
    ),
    st.lists(st.integers(0, 40), min_size=30, max_size=60),
)
def test_no_drift_no_burst_no_starvation(kinds: list[tuple[int, int | None, int]], stalls: list[int]) -> None:
    made = schedule(*(job(*kind) for kind in kinds))
    now, runs = 0, dict.fromkeys(made.jobs, 0)
    for stall in stalls:
        taken = made.take(now, 20 * MS)
        assert len(set(taken)) == len(taken)
        for it in taken:
            now += it.duration_ns
            made.done(it, now, answered=True)
            runs[it] += 1
        now += stall * MS
        for it in made.jobs:
            if it.period_ns:
                assert it.due_ns % it.period_ns == 0
                assert it.due_ns // it.period_ns >= runs[it]
    load = sum(it.duration_ns / it.period_ns for it in made.jobs if it.period_ns)
    if load < 0.5:
        assert all(runs[it] for it in made.jobs)
