"""A suspended master sends no byte on lines that another master took over, as seen at their far ends.

`python -m bench.questions.safety.fence` repeats this test 2,000 times.
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
    """The kernel's timer is hours away, so only the check of the clock prevents sending."""
    with fence(timer=3600) as made:
        found = rounds(made, 6)
    assert not any(each.is_killed for each in found)
    # once in a thousand suspensions, the master is suspended after the check and sends one request
    assert sum(each.stale for each in found) <= 1


@pytest.mark.long
@pytest.mark.slow
def test_a_suspended_master_with_a_deadline_that_is_too_late_does_send() -> None:
    """This shows that the tests above can fail: here the master's deadline is too late."""
    with fence(beyond=1000) as made:
        found = rounds(made, 4)
    assert any(each.stale > 0 for each in found)  # on a busy computer, some masters resume too late to send
    assert not any(each.is_killed for each in found)
