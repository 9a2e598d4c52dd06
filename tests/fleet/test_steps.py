"""When a gateway takes its steps: on a loop whose time is its own, without a server."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from itertools import pairwise

import pytest
from controlled_loop import run_controlled
from fleets import Hall, NotedMastership
from peers import require_module

require_module("nats")

from multidrop.fleet.lease import Held, boottime_ns  # noqa: E402
from multidrop.fleet.member import Member  # noqa: E402
from multidrop.fleet.servers import paths_of  # noqa: E402


def steps(wake: Callable[[Member], object]) -> list[float]:
    """Return when steps were taken (s) from the first to 0.12 s on; after 0.06 s `wake` is called."""

    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        mastership = NotedMastership(boottime_ns)
        lines = Hall().add("a", mastership)
        member = Member("a", paths_of(["nats://nowhere.invalid:4222"]), lines, mastership)
        member.lease.session, member.lease.held = 1, [Held(1, 0)] * 3
        taken: list[float] = []

        async def step() -> None:
            taken.append(round(loop.time() - 1000.0, 3))

        member.step = step  # type: ignore[method-assign]
        living = asyncio.create_task(member._live())
        loop.call_later(0.06, wake, member)
        await asyncio.sleep(0.12)
        living.cancel()
        return taken

    return run_controlled(main())


def test_steps_are_taken_again_and_again() -> None:
    assert steps(lambda member: None) == pytest.approx([0.0, 0.05, 0.1])


@pytest.mark.parametrize("times", [1, 100])
def test_a_step_is_taken_at_once_where_records_have_changed(times: int) -> None:
    def wake(member: Member) -> None:
        for _ in range(times):
            member.records._on_change()

    assert steps(wake) == pytest.approx([0.0, 0.05, 0.06, 0.11])


def test_steps_are_never_taken_without_a_pause() -> None:
    def wake(member: Member) -> None:
        member.records._on_change()
        if len(asyncio.all_tasks()) > 1:
            asyncio.get_running_loop().call_later(0.001, wake, member)

    taken = steps(wake)
    assert min(after - before for before, after in pairwise(taken)) == pytest.approx(0.01, abs=0.001)
    assert len(taken) > 6
