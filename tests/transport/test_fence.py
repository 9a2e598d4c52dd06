"""A suspended master sends no byte on lines that another took over, judged by their far end.

`python -m bench.questions.fence` does the same 2,000 times.
"""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fencing import Fence, Round

if sys.platform != "linux":
    pytest.skip("masterships are Linux's", allow_module_level=True)
if not hasattr(os, "pidfd_open"):
    pytest.skip(
        "this Python was built without pidfd_open, which the test watches by", allow_module_level=True
    )

LINES, LEASE, GUARD = 10, 0.4, 0.3  # s


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


@pytest.mark.long
@pytest.mark.slow
def test_a_suspended_master_sends_nothing_and_is_killed() -> None:
    with fence() as made:
        found = rounds(made, 10)
    assert [each.stale for each in found] == [0] * 10
    assert all(each.is_killed for each in found)


@pytest.mark.long
@pytest.mark.slow
def test_a_suspended_master_sends_nothing_after_it_resumes() -> None:
    """Without the kernel's timer, which is hours away: only the check of the clock holds it back."""
    with fence(timer=3600) as made:
        found = rounds(made, 6)
    assert not any(each.is_killed for each in found)
    # a stop between look and write lets one request through, once in a thousand stops
    assert sum(each.stale for each in found) <= 1


@pytest.mark.long
@pytest.mark.slow
def test_a_master_without_the_deadline_check_does_send() -> None:
    """So the tests above can fail: the master believes that it may send for longer than others know."""
    with fence(beyond=1000) as made:
        found = rounds(made, 4)
    assert any(each.stale > 0 for each in found)  # a busy machine may not let it go on while it is watched
    assert not any(each.is_killed for each in found)
