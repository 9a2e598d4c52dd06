"""The steps of a gateway's state machine and their order, in simulated time, without a server."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from itertools import pairwise

import pytest
from controlled_loop import run_controlled
from fleets import Hall, HandClock, RecordingMastership

from multidrop.fleet.leases.lease import Held, boottime_ns
from multidrop.fleet.leases.member import Member
from multidrop.fleet.leases.rules import SECOND
from multidrop.fleet.servers.connections import paths_of


def a_member() -> Member:
    """Return a gateway with a session, and without a server."""
    mastership = RecordingMastership(boottime_ns)
    lines = Hall().add("a", mastership)
    member = Member("a", paths_of(["nats://nowhere.invalid:4222"]), lines, mastership)
    member.lease.session, member.lease.held = 1, [Held(1, 0)] * 3
    return member


def steps(wake: Callable[[Member], object]) -> list[float]:
    """Return the times of the steps in s, during 0.12 s from the first one; `wake` is called at 0.06 s."""

    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        member = a_member()
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


def test_steps_are_taken_periodically() -> None:
    assert steps(lambda member: None) == pytest.approx([0.0, 0.05, 0.1])


@pytest.mark.parametrize("times", [1, 100])
def test_changed_records_cause_an_immediate_step(times: int) -> None:
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


@pytest.mark.parametrize(("left_s", "ends"), [(2.0, True), (0.9, False), (-1.0, False)])
def test_a_gateway_with_an_expiring_lease_ends_no_other_session(left_s: float, ends: bool) -> None:
    """The servers may be failing for all gateways: an ended session could not continue afterwards."""

    async def main() -> bool:
        member = a_member()
        clock = HandClock()
        member.lease.clock = clock
        member.lease.until = clock.now + 2 * SECOND
        await member.step()  # the waiting times of earlier observations restart
        asked: list[object] = []

        async def note(present: object) -> bool:
            asked.append(present)
            return False

        member.records.observer.end_the_dead = note  # type: ignore[method-assign, assignment]
        member.lease.until = clock.now + round(left_s * SECOND)
        await member.step()
        return bool(asked)

    assert asyncio.run(main()) is ends
