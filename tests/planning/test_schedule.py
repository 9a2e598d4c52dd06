"""The order in which a line's requests are sent, with a clock that the test sets."""

from __future__ import annotations

import itertools
from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from tables import examples, usually

from multidrop.planning.schedule import FIRST_PAUSE_NS, LONGEST_PAUSE_NS, TURN_SHARE, Job, Schedule

MS = 1_000_000


def job(drive: int = 1, period_ms: int | None = None, duration_ms: int = 5, kind: int = 0) -> Job:
    period_ns = None if period_ms is None else period_ms * MS
    return Job(drive=drive, period_ns=period_ns, duration_ns=duration_ms * MS, kind=kind)


def schedule(*jobs: Job) -> Schedule[Job]:
    made: Schedule[Job] = Schedule()
    for job in jobs:
        made.add(job, 0)
    return made


def take(made: Schedule[Job], now_ms: int, ahead_ms: int, most: int = 1000) -> list[tuple[Job, int]]:
    """Return the requests planned until `ahead_ms` from now: pairs of a job and its earliest time in ms."""
    now = now_ms * MS
    return [
        (each, not_before // MS) for each, not_before, _ in made.take(now, now, now + ahead_ms * MS, most)
    ]


def carry_out(made: Schedule[Job], seconds: int) -> list[tuple[Job, int | None, int]]:
    """Carry out one job at a time. Return each with the start of its slot and the time of its request."""
    at, done = 0, []
    while at < seconds * 1000 * MS:
        ((chosen, not_before, due),) = made.take(at, at, at + 10_000 * MS, 1)
        sent = max(at, not_before)
        done.append((chosen, due, sent))
        at = sent + chosen.duration_ns
    return done


def fail(made: Schedule[Job], drive: int, failures: int, now_ms: int, late_until_ms: int = 0) -> None:
    made.back_off.observe(drive, failures, now_ms * MS, late_until_ns=late_until_ms * MS, cost_ns=0)


def test_periodic_polls_are_due_at_multiples_of_the_period() -> None:
    made = schedule(poll := job(period_ms=20))
    planned = [due for now in range(0, 1000, 37) for _, due in take(made, now, 100)]
    assert planned == list(range(0, planned[-1] + 1, 20))
    assert poll.skipped == 0


def test_polls_missed_during_a_stall_are_counted_and_skipped() -> None:
    made = schedule(poll := job(period_ms=20))
    assert take(made, 0, 1) == [(poll, 0)]
    assert take(made, 110, 1) == [(poll, 100)]  # the polls due at 20, 40, 60 and 80 ms were missed
    assert poll.skipped == 4
    assert take(made, 111, 10) == [(poll, 120)]


def test_a_poll_is_skipped_if_its_period_ends_before_the_line_is_free() -> None:
    """Earlier requests keep the line busy until the poll's period is over."""
    made = schedule(poll := job(period_ms=20))
    assert made.take(0, 110 * MS, 111 * MS, 9) == [(poll, 100 * MS, 100 * MS)]
    assert poll.skipped == 5


def test_the_most_urgent_poll_is_sent_first() -> None:
    timed, late = job(1, 40), job(2, 60)
    first, second, third = job(3), job(4), job(5)
    made = schedule(first, late, second, timed, third)
    planned = [each for each, _ in take(made, 0, 40)]
    assert planned == [timed, late, first, second, third, first, second, third]
    assert [each for each, _ in take(made, 40, 10)] == [timed, first]


def test_slow_polls_that_are_due_together_do_not_delay_a_fast_poll() -> None:
    slow = [job(drive, 1000, duration_ms=20) for drive in range(2, 32)]
    made = schedule(*slow, fast := job(1, 50, duration_ms=10))
    done = carry_out(made, 10)
    waited = [sent - due for each, due, sent in done if each is fast]
    assert len(waited) == pytest.approx(200, abs=1)
    assert max(waited) <= 20 * MS  # the longest wait is the duration of the exchange in progress
    assert [each.skipped for each in made.jobs] == [0] * 31


def test_every_poll_is_sent_on_an_overloaded_line() -> None:
    fast = [job(drive, 20, duration_ms=10) for drive in (1, 2, 3)]
    slow = [job(drive, 1000, duration_ms=10) for drive in (4, 5)]
    turn = [job(drive, duration_ms=10) for drive in (6, 7)]
    made = schedule(*turn, *fast, *slow)
    done = carry_out(made, 100)
    counts = {each: sum(1 for other, _, _ in done if other is each) for each in made.jobs}
    # no poll of a slow job is skipped
    assert [counts[each] for each in slow] == pytest.approx([100, 100], abs=1)
    assert max(counts[each] for each in fast) - min(counts[each] for each in fast) <= 2
    assert sum(counts[each] for each in turn) / len(done) == pytest.approx(TURN_SHARE, abs=0.002)
    assert abs(counts[turn[0]] - counts[turn[1]]) <= 1
    for each in (*fast, *slow):  # every due poll was either sent or counted as skipped
        slots = 100_000 * MS // (each.period_ns or 1)
        assert counts[each] + each.skipped == pytest.approx(slots, abs=1)


def test_a_poll_without_a_period_continues_when_an_overload_starts() -> None:
    made = schedule(turn := job(1, duration_ms=10))
    take(made, 0, 10_000)  # requests sent before the overload starts
    for drive in (2, 3):
        made.add(job(drive, 10, duration_ms=10), 10_000 * MS)
    taken = [each for each, _ in take(made, 10_000, 3_000)]
    assert taken.count(turn) >= 3000 / 10 * TURN_SHARE - 6


def test_a_poll_without_a_period_does_not_accumulate_unused_time() -> None:
    made = schedule(job(1, 10, duration_ms=10))
    take(made, 0, 10_000)
    made.add(turn := job(2, duration_ms=10), 10_000 * MS)
    assert [each for each, _ in take(made, 10_000, 100)].count(turn) <= 1


def test_the_polls_with_equal_line_settings_are_sent_in_a_row_if_none_is_late() -> None:
    jobs = [job(drive, 210, duration_ms=10, kind=drive % 2) for drive in range(1, 21)]
    done = carry_out(schedule(*jobs), 20)
    switches = sum(one.kind != other.kind for (one, _, _), (other, _, _) in pairwise(done))
    assert switches < len(done) / 5  # about two changes of line settings for every twenty jobs
    assert [each.skipped for each in jobs] == [0] * 20


def test_an_urgent_poll_goes_before_polls_with_the_present_line_settings() -> None:
    made = schedule(one := job(1, 30, 10, kind=1), *(job(drive, 1000, 10, kind=2) for drive in range(2, 12)))
    made.take(0, 0, 1, 1)
    waited = [sent - due for each, due, sent in carry_out(made, 1) if each is one]
    assert max(waited) < 30 * MS
    assert one.skipped == 0


def test_polls_without_a_period_are_sent_in_rotation() -> None:
    jobs = [job(drive) for drive in range(5)]
    made = schedule(*jobs)
    assert [each for each, _ in take(made, 0, 35)] == [*jobs, *jobs[:2]]
    assert [each for each, _ in take(made, 0, 10)] == jobs[2:4]


def test_an_interrupted_round_of_polls_continues_at_the_same_poll() -> None:
    """If the round started again from its first job, frequent interruptions would starve the last jobs."""
    jobs = [job(drive) for drive in range(5)]
    made = schedule(*jobs)
    assert made.cycle(0) == jobs
    made.go_on(jobs[3])
    fail(made, 0, 1, now_ms=0)
    assert made.cycle(0) == []
    assert [each for each, _ in take(made, 0, 15)] == [jobs[3], jobs[4], jobs[0]]
    fail(made, 0, 0, now_ms=15)
    assert made.cycle(15 * MS) == [*jobs[1:], jobs[0]]
    made.remove(jobs[2])
    made.go_on(jobs[2])  # the round was interrupted before job 2
    assert made.cycle(15 * MS)[0] in jobs


def test_a_schedule_returns_at_most_the_given_number_of_requests() -> None:
    made = schedule(job(1), job(2, 10))
    assert len(take(made, 0, 1000, most=7)) == 7


def test_a_schedule_returns_a_request_longer_than_the_planned_time() -> None:
    made = schedule(long := job(duration_ms=500))
    assert take(made, 0, 1) == [(long, 0)]


def test_no_request_is_planned_while_queued_requests_fill_the_planning_horizon() -> None:
    made = schedule(job(1))
    assert made.take(0, 100 * MS, 100 * MS, 9) == []
    assert len(made.take(0, 90 * MS, 100 * MS, 9)) == 2


@pytest.mark.parametrize(("silence", "end_ms"), [({}, 25), ({"silence_ns": 2 * MS}, 23)])
def test_the_silence_before_a_request_takes_no_time_on_an_idle_line(
    silence: dict[str, int], end_ms: int
) -> None:
    """The line is idle from 15 to 20 ms, when the jobs are due again."""
    for later_ns, planned in ((0, 1), (1, 2), (5 * MS, 2), (5 * MS + 1, 3)):
        jobs = [Job(drive=drive, period_ns=20 * MS, duration_ns=5 * MS, **silence) for drive in (1, 2, 3)]
        made = schedule(*jobs)
        assert len(made.take(0, 0, 15 * MS, 9)) == 3
        assert len(made.take(15 * MS, 15 * MS, end_ms * MS + later_ns, 9)) == planned


def test_a_silent_drive_is_retried_at_growing_intervals() -> None:
    dead, alive = job(1), job(2)
    made = schedule(dead, alive)
    fail(made, 1, 2, now_ms=0)
    assert {each for each, _ in take(made, 1, 100)} == {alive}
    now, rests = 0, []
    for failures in range(3, 11):
        woken = next(
            at for at in range(now + 1, now + 20_000, 50) if dead in (each for each, _ in take(made, at, 10))
        )
        rests.append(woken - now)
        now = woken
        fail(made, 1, failures, now)
    assert FIRST_PAUSE_NS // MS <= rests[0] <= FIRST_PAUSE_NS // MS + 100
    assert rests == sorted(rests)
    assert LONGEST_PAUSE_NS // MS <= rests[-1] <= LONGEST_PAUSE_NS // MS + 100


def test_a_silent_drive_is_retried_exactly_when_its_pause_ends() -> None:
    made = schedule(dead := job(1))
    at = 0
    for failures, rest_ms in enumerate([500, 1000, 2000, 2000], 2):
        fail(made, 1, failures, at // MS)
        at += rest_ms * MS
        assert made.take(at - 1, at - 1, at, 9) == []
        assert [each for each, _, _ in made.take(at, at, at + 1, 9)] == [dead]


def test_only_the_first_pause_of_a_drive_with_long_timeouts_is_short() -> None:
    made = schedule(lossy := job(1))
    for failures, at_ms, rest_ms in ((2, 0, 500), (3, 500, 20_000)):
        made.back_off.observe(1, failures, at_ms * MS, late_until_ns=0, cost_ns=300 * MS)
        end = (at_ms + rest_ms) * MS
        assert made.take(end - 1, end - 1, end, 9) == []
        assert [each for each, _, _ in made.take(end, end, end + 1, 9)] == [lossy]


def test_requests_to_silent_drives_take_a_limited_share_of_time() -> None:
    jobs = [job(drive, duration_ms=40) for drive in range(10)]
    made = schedule(*jobs, job(99))
    cost_ms, asked = 300, 0
    failures = dict.fromkeys(range(10), 2)
    for drive in range(10):
        made.back_off.observe(drive, 2, 0, late_until_ns=0, cost_ns=cost_ms * MS)
    for now in range(0, 3_600_000, 1000):
        for each, _ in take(made, now, 5):
            if each.drive < 10:
                asked += 1
                failures[each.drive] += 1
                made.back_off.observe(
                    each.drive, failures[each.drive], now * MS, late_until_ns=0, cost_ns=cost_ms * MS
                )
    assert 0.01 < asked * cost_ms / 3_600_000 <= 0.02


@pytest.mark.long
@pytest.mark.story
@pytest.mark.parametrize("dead", usually(10, 1, 5))
@pytest.mark.parametrize("period_ms", [None, 400], ids=["in turn", "at a rate"])
def test_a_drive_keeps_97_percent_of_its_rate_beside_dead_drives(dead: int, period_ms: int | None) -> None:
    """Of 31 drives, some are dead. The others keep 97 % of the rate that they have without the dead ones."""
    answered: list[int] = []
    for count in (31, 31 - dead):
        made = schedule(*(job(drive, period_ms, duration_ms=12) for drive in range(count)))
        failures = dict.fromkeys(range(31 - dead, 31), 0)
        at, good = 0, 0
        while at < 200_000 * MS:
            ((chosen, not_before, _),) = made.take(at, at, at + 10_000 * MS, 1)
            at = max(at, not_before) + chosen.duration_ns
            if chosen.drive in failures:
                at += 300 * MS
                failures[chosen.drive] += 1
                made.back_off.observe(
                    chosen.drive, failures[chosen.drive], at, late_until_ns=at, cost_ns=300 * MS
                )
            elif at > 20_000 * MS:
                good += 1
        answered.append(good)
    assert answered[0] >= 0.97 * answered[1]


def test_a_silent_drive_gets_a_single_request_until_it_answers() -> None:
    made = schedule(job(1), job(1), other := job(2))
    fail(made, 1, 2, now_ms=0)
    woken = take(made, 501, 50)
    assert len([each for each, _ in woken if each is not other]) == 1
    fail(made, 1, 0, now_ms=520)
    assert len({each for each, _ in take(made, 520, 50)}) == 3


def test_a_silent_drive_is_retried_with_its_shortest_request() -> None:
    made = schedule(job(1, 100, 20), short := job(1, 60_000, 7), job(1, None, 9))
    fail(made, 1, 2, now_ms=0)
    take(made, 1, 400)
    # The retry of a silent drive is an extra request: the job is still due after 60 s.
    assert take(made, 501, 50) == [(short, 0)]
    fail(made, 1, 0, now_ms=502)
    assert (short, 60_000) in take(made, 502, 60_000, most=10_000)


def test_a_silent_drive_is_retried_in_the_spare_time_of_other_drives() -> None:
    made = schedule(dead := job(1), timed := job(2, 10, 5))
    fail(made, 1, 2, now_ms=0)
    take(made, 0, 450)
    taken = take(made, 500, 40)
    assert [each for each, _ in taken[:3]] == [timed, dead, timed]


def test_a_silent_drive_is_retried_even_without_spare_time() -> None:
    made = schedule(dead := job(1), job(2, 10, 10), job(3, 10, 10))
    fail(made, 1, 2, now_ms=0)
    asked = sum(dead in (each for each, _ in take(made, now, 100)) for now in range(0, 5000, 100))
    assert asked >= 3


def test_a_drive_gets_no_request_while_its_late_reply_may_come() -> None:
    made = schedule(poll := job(1), other := job(2))
    fail(made, 1, 1, now_ms=0, late_until_ms=300)
    assert {each for each, _ in take(made, 0, 299)} == {other}
    assert poll in {each for each, _ in take(made, 300, 20)}


def test_a_drive_gets_a_request_once_its_late_reply_has_come() -> None:
    made = schedule(poll := job(1), job(2))
    fail(made, 1, 1, now_ms=0, late_until_ms=900)
    assert poll not in [each for each, _ in take(made, 0, 100)]
    fail(made, 1, 1, now_ms=100, late_until_ms=0)
    assert poll in [each for each, _ in take(made, 100, 20)]


def test_a_silent_drive_is_retried_once_after_a_late_reply() -> None:
    made = schedule(poll := job(1), job(2))
    fail(made, 1, 2, now_ms=0, late_until_ms=900)
    fail(made, 1, 2, now_ms=100, late_until_ms=0)
    assert [each for each, _ in take(made, 100, 60)].count(poll) == 1


def test_a_poll_with_the_present_line_settings_goes_first_if_time_permits() -> None:
    """If the time is a nanosecond too short, the job whose slot ends first is sent first."""
    for less, order in ((0, [2, 1]), (1, [1, 2])):
        made = schedule(job(3, 1000, 10, kind=2))
        take(made, 0, 1)
        for drive, period_ms in ((1, 20), (2, 1000)):
            made.add(job(drive, period_ms, 10, kind=drive), 10 * MS - less)
        assert [each.drive for each, _ in take(made, 10, 1 + 19)] == order


def test_the_most_urgent_poll_goes_first_again_after_a_delay() -> None:
    made = schedule(quick := job(1, 10, 2), slow := job(2, 1000, 2), middling := job(3, 100, 2))
    take(made, 0, 1, most=3)
    taken = take(made, 1000, 1010)  # the quick job's polls of the last second were missed
    assert [each for each, due in taken if due >= 2000] == [quick, middling, slow]


def test_a_due_poll_is_skipped_if_its_drive_falls_silent() -> None:
    made = schedule(one := job(1, 100), two := job(2, 100))
    assert take(made, 0, 100, most=1) == [(one, 0)]
    fail(made, 2, 1, now_ms=5, late_until_ms=60)
    assert take(made, 10, 50) == []
    assert made.unasked == [(two, 0)]
    assert {each for each, _ in take(made, 100, 20)} == {one, two}


def test_other_drives_are_polled_while_a_drive_is_paused() -> None:
    made = schedule(*(jobs := [job(drive, None, 10) for drive in range(3)]))
    fail(made, 1, 1, now_ms=0, late_until_ms=10_000)
    assert [each for each, _ in take(made, 0, 40)] == [jobs[0], jobs[2], jobs[0], jobs[2]]


def test_the_schedule_reserves_the_whole_timeout_for_a_request_to_a_silent_drive() -> None:
    made = schedule(dead := job(1), job(2))
    made.back_off.observe(1, 2, 0, late_until_ns=0, cost_ns=2 * MS)
    take(made, 1, 400)
    made.back_off.observe(1, 3, 0, late_until_ns=0, cost_ns=300 * MS)
    assert take(made, 60_000, 300) == [(dead, 0)]


def test_repeated_failure_reports_do_not_end_a_drives_pause() -> None:
    made = schedule(poll := job(1), job(2))
    for now in (0, 100):
        fail(made, 1, 2, now_ms=now)
    assert poll not in [each for each, _ in take(made, 100, 300)]


def test_polling_of_a_drive_does_not_pause_after_one_failure() -> None:
    made = schedule(poll := job(1))
    fail(made, 1, 1, now_ms=0)
    assert made.unasked == []
    assert take(made, 0, 5) == [(poll, 0)]


def test_every_poll_of_a_silent_drive_is_reported_with_its_due_time() -> None:
    made = schedule(poll := job(1, period_ms=100))
    fail(made, 1, 2, now_ms=0)
    assert take(made, 0, 350) == []
    assert made.unasked == [(poll, due * MS) for due in (0, 100, 200, 300)]


def test_a_poll_without_a_period_counts_as_missed_once_per_pause() -> None:
    made = schedule(poll := job(1), job(2))
    fail(made, 1, 2, now_ms=7)
    take(made, 8, 300)
    assert made.unasked == [(poll, 7 * MS)]


def test_skipping_all_polls_includes_polls_without_a_period() -> None:
    made = schedule(poll := job(1, period_ms=100), fast := job(2))
    assert made.pass_all(150 * MS) == [(fast, 150 * MS), (poll, 0), (poll, 100 * MS)]


def test_skipping_due_polls_returns_every_missed_period() -> None:
    made = schedule(poll := job(1, period_ms=100), job(2))
    take(made, 0, 50)
    assert made.pass_slots(250 * MS) == [(poll, 100 * MS), (poll, 200 * MS)]


def test_skipping_due_polls_includes_polls_due_now() -> None:
    made = schedule(one := job(1, 100), two := job(2, 100), begun := job(3, 1000))
    assert [each for each, _ in take(made, 0, 100, most=2)] == [one, two]
    assert made.pass_slots(100 * MS) == [(begun, 0), (one, 100 * MS), (two, 100 * MS)]


def test_the_order_of_polls_stays_when_one_is_removed() -> None:
    jobs = [job(drive) for drive in range(4)]
    made = schedule(*jobs, timed := job(9, 1000), other := job(8, 1000))
    assert [each for each, _ in take(made, 0, 20)] == [timed, other, *jobs[:2]]
    for each in (jobs[0], timed):
        made.remove(each)
    assert [each for each, _ in take(made, 20, 15)] == [jobs[2], jobs[3], jobs[1]]
    assert [each for each, _ in take(made, 1000, 5)] == [other]
    assert made.jobs == [*jobs[1:], other]


def test_a_due_poll_is_not_sent_after_its_removal() -> None:
    made = schedule(first := job(1, 1000), second := job(2, 1000))
    assert take(made, 0, 100, most=1) == [(first, 0)]
    made.remove(second)
    assert take(made, 5, 100) == []


def test_a_new_poll_gets_the_place_and_due_time_of_the_replaced_one() -> None:
    jobs = [job(drive) for drive in range(4)]
    made = schedule(*jobs)
    assert [each for each, _ in take(made, 0, 10)] == jobs[:2]
    made.replace([jobs[0], jobs[2]], [both := job(8)], 0)
    made.replace([jobs[3]], [one := job(5), other := job(6)], 0)
    assert [each for each, _ in take(made, 10, 25)] == [both, one, other, jobs[1], both]
    made.add(timed := job(9, 100), 40 * MS)
    assert take(made, 40, 1) == [(timed, 40)]
    made.replace([timed], [slower := job(7, 100)], timed.due_ns)
    assert [(each, due) for each, due in take(made, 140, 1)] == [(slower, 140)]
    assert set(made.jobs) == {jobs[1], both, one, other, slower}


def test_a_poll_without_a_period_gets_the_place_of_the_replaced_one() -> None:
    made = schedule(*(jobs := [job(drive) for drive in range(3)]))
    assert take(made, 0, 1) == [(jobs[0], 0)]
    made.replace(jobs[1:2], [new := job(1)], 0)
    assert [asked for asked, _ in take(made, 100, 15)] == [new, jobs[2], jobs[0]]


def test_a_schedule_has_no_repeatable_cycle_with_silent_drives_or_periodic_polls() -> None:
    made = schedule(one := job(1), two := job(2))
    assert made.cycle(0) == [one, two]
    fail(made, 1, 0, now_ms=0)
    assert made.cycle(0) == [one, two]
    fail(made, 2, 1, now_ms=0)
    assert made.cycle(0) == []
    fail(made, 2, 0, now_ms=0, late_until_ms=100)
    assert made.cycle(100 * MS - 1) == []
    assert made.cycle(100 * MS) == [one, two]
    made.add(timed := job(3, 1000), 100 * MS)
    assert made.cycle(100 * MS) == []
    made.remove(timed)
    assert made.cycle(100 * MS) == [one, two]


KINDS = st.lists(
    st.tuples(st.integers(1, 4), st.none() | st.integers(5, 80), st.integers(1, 10), st.integers(0, 2)),
    min_size=1,
    max_size=8,
)


@pytest.mark.slow
@given(KINDS, st.lists(st.integers(0, 60) | st.just(700), min_size=30, max_size=60))
def test_periodic_polls_neither_drift_nor_pile_up_after_stalls(
    kinds: list[tuple[int, int | None, int, int]], stalls: list[int]
) -> None:
    """The line or the Python process stalls for longer than requests are planned in advance."""
    made = schedule(*(job(*kind) for kind in kinds))
    busy_until = now = 0
    slots: dict[Job, list[int]] = {each: [] for each in made.jobs}
    for stall in stalls:
        for each, not_before, due in made.take(now, busy_until, now + 100 * MS, 64):
            busy_until = max(busy_until, now, not_before)
            if due is not None and each.period_ns:
                assert busy_until < due + each.period_ns  # the period is not over
                slots[each].append(due)
            busy_until += each.duration_ns
        now += stall * MS
    for each, taken in slots.items():
        if each.period_ns:
            # polls are due at each multiple of the period
            assert all(due % each.period_ns == 0 for due in taken)
            assert taken == sorted(set(taken))  # each poll is sent once
            assert each.due_ns // each.period_ns == len(taken) + each.skipped  # none uncounted


@settings(max_examples=examples(50))
@given(KINDS)
def test_every_poll_is_sent_repeatedly_on_any_overloaded_line(
    kinds: list[tuple[int, int | None, int, int]],
) -> None:
    made = schedule(*(job(*kind) for kind in kinds))
    done = carry_out(made, 3)
    # The limit is the sum of three waits: for one request of each other job, for jobs without a period, and
    # for jobs with the present line settings.
    longest = 80 * MS + 8 * 10 * MS / TURN_SHARE + 1000 * MS
    for each in made.jobs:
        sent = [0, *(at for other, _, at in done if other is each), 3000 * MS]
        assert max(after - before for before, after in pairwise(sent)) <= longest
    turns = [sum(1 for other, _, _ in done if other is each) for each in made.jobs if each.period_ns is None]
    assert not turns or max(turns) - min(turns) <= 1


@settings(max_examples=examples(50))
@given(KINDS)
def test_no_poll_is_skipped_if_all_fit_into_one_period(kinds: list[tuple[int, int | None, int, int]]) -> None:
    """All jobs together fit into the shortest period, so no poll is ever skipped."""
    least = sum(duration for _, _, duration, _ in kinds)
    made = schedule(*(job(d, p and p + least, duration, kind) for d, p, duration, kind in kinds))
    done = carry_out(made, 3)
    assert [each.skipped for each in made.jobs] == [0] * len(kinds)
    for each in made.jobs:
        if each.period_ns:
            assert sum(1 for other, _, _ in done if other is each) >= 2900 * MS // each.period_ns


def test_a_drive_gets_no_request_while_an_earlier_reply_may_come() -> None:
    """The first of two requests got no reply, so `late_until_ns` is set. The second one was answered."""
    made = schedule(quick := job(1), timed := job(2, period_ms=10))
    fail(made, 1, 0, now_ms=0, late_until_ms=100)
    fail(made, 2, 0, now_ms=0, late_until_ms=60)
    assert take(made, 10, 40) == []
    assert {each.drive for each, _ in take(made, 70, 20)} == {timed.drive}
    assert {each.drive for each, _ in take(made, 101, 50)} == {quick.drive, timed.drive}


class Operation(RuleBasedStateMachine):
    """Random events on a line: jobs come and go, the host stalls, drives fall silent, the port is lost."""

    AHEAD = 100 * MS

    def __init__(self) -> None:
        super().__init__()
        self.made: Schedule[Job] = Schedule()
        self.now = self.busy_until = 1000 * MS
        self.added: dict[Job, int] = {}
        self.slots: dict[Job, list[int]] = {}  # times at which the sent polls were due
        # number of polls that were reported as skipped
        self.passed: Counter[Job] = Counter()
        self.failures = dict.fromkeys(range(4), 0)
        self.silent_until = dict.fromkeys(range(4), 0)  # time until which a late reply may come, by drive

    @rule(drive=st.integers(0, 3), period=st.none() | st.integers(5, 80), duration=st.integers(1, 10))
    def add(self, drive: int, period: int | None, duration: int) -> None:
        if len(self.made.jobs) < 8:
            chosen = job(drive, period, duration)
            self.made.add(chosen, self.now)
            self.made.back_off.observe(
                drive, self.failures[drive], self.now, late_until_ns=self.silent_until[drive], cost_ns=0
            )
            self.added[chosen], self.slots[chosen] = self.now, []

    @precondition(lambda self: self.made.jobs)
    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        chosen = data.draw(st.sampled_from(self.made.jobs))
        self.made.remove(chosen)

    @rule(drive=st.integers(0, 3), late=st.integers(0, 400))
    def fall_silent(self, drive: int, late: int) -> None:
        self._observe(drive, self.failures[drive] + 1, self.now + late * MS)

    @rule(drive=st.integers(0, 3))
    def wake(self, drive: int) -> None:
        self._observe(drive, 0, 0)

    def _observe(self, drive: int, failures: int, until: int) -> None:
        if any(job.drive == drive for job in self.made.jobs):
            self.failures[drive], self.silent_until[drive] = failures, until
            self.made.back_off.observe(drive, failures, self.now, late_until_ns=until, cost_ns=30 * MS)

    @rule()
    def lose_the_port(self) -> None:
        told = self.made.pass_all(self.now)
        self.passed.update(each for each, _ in told if each.period_ns)
        assert all(due <= self.now for _, due in told)

    @rule(stall=st.integers(0, 300))
    def go_on(self, stall: int) -> None:
        self.now += stall * MS
        taken = self.made.take(self.now, self.busy_until, self.now + self.AHEAD, 64)
        at = max(self.now, self.busy_until)
        for each, not_before, due in taken:
            at = max(at, not_before)
            assert each in self.made.jobs
            # No request is sent while a late reply may come, even if the line is ready earlier.
            assert max(self.now, not_before) >= self.silent_until[each.drive]
            if each.period_ns and due is None:  # a retry does not replace a periodic poll
                assert self.failures[each.drive] >= 2
            elif each.period_ns:
                # polls are due at each multiple of the period
                assert (due - self.added[each]) % each.period_ns == 0
                assert due > max(self.slots[each], default=-1)  # each poll is sent once, in order
                assert due > at - each.period_ns  # no request is made for a period that is over
                self.slots[each].append(due)
            else:
                self.slots[each].append(at)
            at += each.duration_ns
        self.busy_until = at if taken else self.busy_until

    @invariant()
    def every_slot_is_accounted_for(self) -> None:
        self.passed.update(each for each, _ in self.made.unasked if each.period_ns)
        self.made.unasked.clear()
        for job in self.made.jobs:
            if job.period_ns:
                slots = (job.due_ns - self.added[job]) // job.period_ns
                assert slots == len(self.slots[job]) + job.skipped + self.passed[job]

    def teardown(self) -> None:
        """Check that all drives are polled again once they answer: in turn, or at their rates."""
        for drive in range(4):
            self.wake(drive)
        load = sum(job.duration_ns / job.period_ns for job in self.made.jobs if job.period_ns)
        before = {job: len(self.slots[job]) for job in self.made.jobs}
        for _ in range(100):
            self.go_on(20)
        counts = {job: len(self.slots[job]) - before[job] for job in self.made.jobs}
        in_turn = [count for each, count in counts.items() if each.period_ns is None]
        if load < 0.5:
            assert all(counts.values())
            assert max(in_turn, default=0) - min(in_turn, default=0) <= 1


TestOperation = Operation.TestCase
TestOperation.settings = settings(max_examples=examples(100), stateful_step_count=30, deadline=None)


def test_the_next_due_poll_is_found_after_another_poll_was_removed() -> None:
    made: Schedule[Job] = Schedule()
    jobs = {at: job(at, 1000) for at in (13, 14, 1, 15)}
    for at, each in jobs.items():
        made.add(each, at * MS)
    made.remove(jobs[1])
    assert take(made, 0, 14) == [(jobs[13], 13)]


def test_only_polls_within_the_planning_horizon_are_planned() -> None:
    made: Schedule[Job] = Schedule()
    soon, later = job(1, 1000), job(2, 1000)
    made.add(soon, 10 * MS)
    made.add(later, 500 * MS)
    assert take(made, 0, 100) == [(soon, 10)]


def test_polling_continues_with_the_following_poll_if_the_next_one_is_removed() -> None:
    first, second, third = job(1), job(2), job(3)
    made = schedule(first, second, third)
    assert take(made, 0, 1, 1) == [(first, 0)]
    made.remove(second)  # the job whose turn was next
    assert [each for each, _ in take(made, 5, 1, 1)] == [third]


def test_a_removed_drive_is_polled_like_a_new_drive_when_added_again() -> None:
    made = schedule(silent := job(1), job(2))
    fail(made, 1, 9, 0)
    made.remove(silent)
    made.back_off.forget(1)
    made.add(again := job(1), 0)
    assert again in [each for each, _ in take(made, 1, 20)]


def meet(*jobs: Job) -> Schedule[Job]:
    made = schedule(*jobs)
    for drive in {job.drive for job in jobs}:
        made.back_off.meet(drive)
    return made


def answer(made: Schedule[Job], asked: Job, now_ms: int) -> None:
    made.back_off.conclude(asked.drive)
    made.back_off.observe(asked.drive, 0, now_ms * MS, late_until_ns=0, cost_ns=0, has_answered=True)


def test_a_new_drive_gets_one_request_until_its_result_is_known() -> None:
    made = meet(one := job(1), two := job(1), job(2, period_ms=50), job(2))
    assert [asked.drive for asked, _ in take(made, 0, 1000)] == [2, 1]
    assert take(made, 10, 1000) == []
    assert made.cycle(10 * MS) == []
    # The request has ended without a valid reply, for example with a damaged one.
    made.back_off.conclude(one.drive)
    assert [asked for asked, _ in take(made, 20, 1000)] == [two]
    answer(made, two, 30)
    assert [asked for asked, _ in take(made, 30, 20)] == [one, two, one, two]


def test_no_poll_of_a_new_drive_is_lost_repeated_or_early() -> None:
    made = meet(fast := job(1, period_ms=20), slow := job(1, period_ms=50), job(2, period_ms=1000))
    assert {asked.drive for asked, _ in take(made, 0, 300, most=2)} == {1, 2}
    assert take(made, 1, 300) == []
    answer(made, fast, 2)
    slots = [(slow, 0), (fast, 20), (fast, 40), (slow, 50), (fast, 60), (fast, 80)]
    assert take(made, 2, 90) == slots
    assert (fast.skipped, slow.skipped) == (0, 0)


def test_a_silent_new_drive_gets_no_further_requests_for_a_while() -> None:
    made = meet(dead := job(1), living := job(2))
    assert [asked for asked, _ in take(made, 0, 100)] == [dead, living]
    answer(made, living, 1)
    made.back_off.conclude(dead.drive)
    made.back_off.observe(1, 1, 60 * MS, late_until_ns=0, cost_ns=450 * MS, has_answered=False)
    rest_ms = 30_000  # a request of 450 ms takes the share SILENT_SHARE, 1.5 %, of this pause
    assert {asked for asked, _ in take(made, 60, rest_ms)} == {living}
    assert made.unasked == [(dead, 60 * MS)]
    assert take(made, 60 + rest_ms, 1) == [(dead, 0)]
    assert made.cycle((60 + rest_ms) * MS) == []
    answer(made, dead, 60 + rest_ms)
    assert set(made.cycle((60 + rest_ms) * MS)) == {dead, living}


def test_silent_new_drives_are_retried_immediately_if_retries_are_quick() -> None:
    """The drives may exist, because their first request or reply may have been lost."""
    lost, living = job(1), job(2)
    for cost_ns, again in {400 * MS: {lost}, 400 * MS + 1: set()}.items():
        made = meet(lost, living)
        take(made, 0, 100)
        made.back_off.conclude(lost.drive)
        made.back_off.observe(1, 1, 60 * MS, late_until_ns=200 * MS, cost_ns=cost_ns, has_answered=False)
        # the result of the other drive's request is not known yet
        assert lost not in {asked for asked, _ in take(made, 70, 100)}
        answer(made, living, 90)
        assert lost not in {asked for asked, _ in take(made, 100, 90)}
        assert {asked for asked, _ in take(made, 200, 20)} - {living} == again
        # the result of this drive's request is not known yet
        assert lost not in {asked for asked, _ in take(made, 230, 20)}


def test_a_recovered_drive_shortens_the_pause_of_another_silent_drive() -> None:
    made = schedule(*(jobs := [job(drive) for drive in range(3)]))
    fail(made, 0, 2, 0, late_until_ms=300)
    fail(made, 1, 2, 100)
    fail(made, 2, 2, 0)
    answer(made, jobs[2], 200)
    assert {asked for asked, _ in take(made, 200, 50)} == {jobs[2]}  # a late reply may come until 300 ms
    assert {asked for asked, _ in take(made, 300, 50)} == {jobs[0], jobs[2]}


def test_a_recovered_drive_shortens_only_one_other_pause() -> None:
    made = schedule(*(jobs := [job(drive) for drive in range(4)]))
    for failures, drive in itertools.product((2, 3), (0, 1, 2)):
        made.back_off.observe(drive, failures, 0, late_until_ns=0, cost_ns=300 * MS)
    assert {asked for asked, _ in take(made, 1000, 50)} == {jobs[3]}
    made.back_off.observe(2, 0, 1100 * MS, late_until_ns=0, cost_ns=300 * MS)
    assert {asked for asked, _ in take(made, 1100, 400)} == {jobs[0], jobs[2], jobs[3]}
    made.back_off.observe(0, 4, 1500 * MS, late_until_ns=0, cost_ns=300 * MS)
    assert {asked for asked, _ in take(made, 1500, 1000)} == {jobs[2], jobs[3]}


# ---- planned requests (turns) that were not sent ----


def plans(made: Schedule[Job]) -> list[list[tuple[Job, int, int | None]]]:
    """Return the turns of two plans: until 12 ms, and from there until 60 ms."""
    return [[*made.take(at * MS, at * MS, until * MS, 9)] for at, until in ((0, 12), (12, 60))]


def test_unsent_requests_are_planned_again_in_the_same_order() -> None:
    made = schedule(job(1, 40), job(2), job(3, 60), job(4))
    before = plans(made)
    assert [len(plan) for plan in before] == [3, 9]
    made.put_back([turn for plan in before for turn in plan])
    assert plans(made) == before
    made.put_back(before[1])
    assert made.take(12 * MS, 12 * MS, 60 * MS, 9) == before[1]
    assert [each.skipped for each in made.jobs] == [0, 0, 0, 0]


def test_an_unsent_request_of_a_removed_poll_is_dropped() -> None:
    made = schedule(timed := job(1, 40), job(2))
    turns = made.take(0, 0, 4 * MS, 1)
    assert [turn.job for turn in turns] == [timed]
    made.remove(timed)
    made.put_back(turns)
    assert timed not in {each for each, _ in take(made, 0, 100)}


def test_a_new_drive_is_asked_again_if_its_request_was_not_sent() -> None:
    made = schedule(job(1, 40))
    made.back_off.meet(1)
    turns = made.take(0, 0, 4 * MS, 9)
    assert len(turns) == 1
    assert take(made, 50, 4) == []  # no second request before the first one has a result
    made.put_back(turns)
    assert [due for _, due in take(made, 50, 4)] == [40]
