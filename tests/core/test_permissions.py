"""Mastership: a deadline on CLOCK_BOOTTIME. If the process is suspended beyond it, the kernel kills it.

The last tests suspend a master, and look for its bytes at the far ends of lines that another master took
over. `python -m bench.questions.safety.fence` repeats these tests 2,000 times.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from commands import BoundProcess
from fencing import Fence, Round
from tables import table

from multidrop.core import Mastership

if sys.platform != "linux":
    pytest.skip("masterships are Linux's", allow_module_level=True)

S = 1_000_000_000
KEEPER = """
import sys, time
from multidrop.core import Mastership
mastership = Mastership(guard_s=float(sys.argv[1]))
mastership.extend(time.clock_gettime_ns(time.CLOCK_BOOTTIME) + round(float(sys.argv[2]) * 1e9))
exec(sys.argv[3])
print(mastership.until_ns, flush=True)
sys.stdin.read()
"""


def now_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


@contextmanager
def keeper(guard_s: float, seconds: float, then: str = "pass") -> Iterator[subprocess.Popen[str]]:
    """Yield a process with a mastership of `seconds` s. It prints the deadline as its first line."""
    words = [sys.executable, "-c", KEEPER, str(guard_s), str(seconds), then]
    pipe = subprocess.PIPE
    with BoundProcess(words, stdin=pipe, stdout=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def until_of(process: subprocess.Popen[str]) -> int:
    assert process.stdout
    return int(process.stdout.readline())


def test_a_new_mastership_is_invalid_until_it_is_extended() -> None:
    mastership = Mastership()
    assert (mastership.until_ns, mastership.holds, mastership.guard_s) == (0, False, 0.7)
    assert repr(mastership) == "<Mastership not held, guard 0.7 s>"


def test_a_mastership_is_valid_until_its_deadline() -> None:
    mastership = Mastership(guard_s=100)
    until_ns = now_ns() + S // 20
    mastership.extend(until_ns)
    assert mastership.until_ns == until_ns
    assert mastership.holds or now_ns() >= until_ns
    while now_ns() < until_ns:
        time.sleep(0.001)
    assert not mastership.holds
    assert mastership.until_ns == until_ns
    mastership.end()
    assert (mastership.until_ns, mastership.holds) == (0, False)


def test_a_deadline_is_never_moved_to_an_earlier_time() -> None:
    mastership = Mastership()
    later = now_ns() + 200 * S
    mastership.extend(later)
    mastership.extend(later - 100 * S)
    assert mastership.until_ns == later
    mastership.extend(later + 1)
    assert mastership.until_ns == later + 1
    mastership.end()


def test_an_ended_mastership_can_be_extended() -> None:
    mastership = Mastership()
    mastership.extend(now_ns() + 200 * S)
    mastership.end()
    mastership.end()
    mastership.extend(sooner := now_ns() + 100 * S)
    assert mastership.until_ns == sooner
    mastership.end()


def test_concurrent_extensions_keep_the_latest_deadline() -> None:
    mastership = Mastership()
    first = now_ns() + 200 * S
    deadlines = [[first + 8 * n + thread for n in range(500)] for thread in range(8)]
    threads = [
        threading.Thread(target=lambda times=times: [*map(mastership.extend, times)]) for times in deadlines
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert mastership.until_ns == max(map(max, deadlines))
    mastership.end()


def test_past_mastership_deadline_raises_without_starting_the_kill_timer() -> None:
    """A kernel timer that is set to a past time would kill the process immediately."""
    mastership = Mastership(guard_s=1e-6)
    with pytest.raises(
        ValueError, match=r"^until_ns = \d+ is [1-9]\d*\.\d+ s in the past of CLOCK_BOOTTIME: "
    ):
        mastership.extend(now_ns() - S)
    mastership.extend(until_ns := now_ns() + 100 * S)
    with pytest.raises(ValueError, match="in the past"):
        mastership.extend(0)
    assert mastership.until_ns == until_ns
    mastership.end()


@table("wrong", [1.5, "now", None, True])
def test_a_deadline_that_is_not_a_whole_number_raises(wrong: object) -> None:
    with pytest.raises(TypeError, match=r"^until_ns must be a whole number of ns of CLOCK_BOOTTIME, not "):
        Mastership().extend(wrong)  # type: ignore[arg-type]


def test_a_deadline_beyond_the_range_of_the_clock_raises() -> None:
    with pytest.raises(ValueError, match="is beyond"):
        Mastership().extend(1 << 63)


@table("wrong", [0, -1, float("nan"), float("inf"), 3601])
def test_a_guard_time_out_of_range_raises(wrong: float) -> None:
    with pytest.raises(ValueError, match=r"^guard_s = .* must be above 0 and at most 3600, in s$"):
        Mastership(wrong)


def test_a_guard_time_that_is_not_a_number_raises() -> None:
    with pytest.raises(TypeError, match=r"^guard_s must be a number of seconds, not '1'$"):
        Mastership("1")  # type: ignore[arg-type]


@pytest.mark.slow
def test_kernel_kills_a_suspended_process_after_the_mastership_deadline() -> None:
    with keeper(0.4, 0.3) as process:
        until_ns = until_of(process)
        process.send_signal(signal.SIGSTOP)
        assert process.wait(60) == -signal.SIGKILL
        assert now_ns() >= until_ns + S // 5


@pytest.mark.slow
def test_process_is_not_killed_if_mastership_is_extended_in_time() -> None:
    then = (
        "for n in range(40):\n"
        " mastership.extend(time.clock_gettime_ns(time.CLOCK_BOOTTIME) + 4 * 10**9)\n"
        "time.sleep(1.5)"  # longer than the time until the first deadline, plus the guard time
    )
    with keeper(1.0, 0.3, then) as process:
        assert until_of(process)
        assert process.poll() is None


@pytest.mark.long
@pytest.mark.parametrize(
    "end", ["mastership.end()", "del mastership; import gc; gc.collect(); mastership = Mastership()"]
)
def test_process_is_not_killed_after_ending_its_mastership(end: str) -> None:
    with keeper(1.0, 0.2, f"{end}; time.sleep(1.5)") as process:
        assert until_of(process) == 0
        assert process.poll() is None


def test_a_forked_child_does_not_hold_its_parents_mastership() -> None:
    mastership = Mastership()
    mastership.extend(now_ns() + 100 * S)
    if (child := os.fork()) == 0:
        found = 1
        try:
            mastership.end()  # this does not disarm the parent's timer
            mastership.extend(now_ns() + 200 * S)
        except ValueError as refusal:
            held = mastership.holds or mastership.until_ns
            found = 0 if "create a new one" in str(refusal) and not held else 2
        finally:
            os._exit(found)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert mastership.holds
    mastership.end()


# ---- suspended masters ----


LINES, LEASE, GUARD = 10, 0.4, 0.3  # number of lines; lease and guard time in s
WATCHES_SUSPENSION = pytest.mark.skipif(
    not hasattr(os, "pidfd_open"),
    reason="this Python was built without pidfd_open, which the test watches by",
)


@contextmanager
def fence(**details: Any) -> Iterator[Fence]:
    made = Fence(LINES, LEASE, GUARD, **details)
    try:
        yield made
    finally:
        made.close()


def rounds(made: Fence, stops: int) -> list[Round]:
    chance = random.Random(15)
    return [made.stop_once(chance) for _ in range(stops)]


@WATCHES_SUSPENSION
@pytest.mark.long
@pytest.mark.slow
def test_a_suspended_master_sends_nothing_and_is_killed() -> None:
    with fence() as made:
        found = rounds(made, 10)
    assert [each.stale for each in found] == [0] * 10
    assert all(each.is_killed for each in found)


@WATCHES_SUSPENSION
@pytest.mark.long
@pytest.mark.slow
def test_a_suspended_master_sends_nothing_after_it_resumes() -> None:
    """The kernel's timer is hours away, so only the check of the clock prevents sending."""
    with fence(timer=3600) as made:
        found = rounds(made, 6)
    assert not any(each.is_killed for each in found)
    # once in a thousand suspensions, the master is suspended after the check and sends one request
    assert sum(each.stale for each in found) <= 1


@WATCHES_SUSPENSION
@pytest.mark.long
@pytest.mark.slow
def test_suspended_master_sends_if_its_deadline_is_too_late() -> None:
    """This shows that the tests above can fail: here the master's deadline is too late."""
    with fence(beyond=1000) as made:
        found = rounds(made, 4)
    # Only one master must have sent: on a busy computer, the others may resume too late even for this
    # deadline.
    assert any(each.stale > 0 for each in found)
    assert not any(each.is_killed for each in found)
