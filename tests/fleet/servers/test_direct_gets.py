"""Direct gets in simulated time: the order of their requests, and which answer is used."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import pytest
from controlled_loop import run_controlled

from multidrop.fleet.errors import FleetError, NoRight, Unsure
from multidrop.fleet.servers.batch_client import DirectGet, DirectMessage, Request
from multidrop.fleet.servers.direct_gets import AGAIN_S, EARNED, MOST_SPARE, Spare, first_answer

NEVER = 1e9
REQUEST = Request("questions", b"")


class SlowWay:
    """A path that answers its requests after these delays in s, or fails."""

    def __init__(
        self, name: str, *delays: float, failure: FleetError | None = None, pause: float = 0
    ) -> None:
        self.name = name
        self.asked: list[float] = []
        self._delays = [*delays]
        self._failure = failure
        self._pause = pause  # in s, between messages
        self.under_way = 0

    async def gather(self, request: Request, get: DirectGet) -> None:
        self.asked.append(round(asyncio.get_running_loop().time() - 1000.0, 3))
        self.under_way += 1
        try:
            await asyncio.sleep(self._delays.pop(0) if self._delays else NEVER)
            for number in range(3):
                if self._failure:
                    raise self._failure
                get.messages.append(DirectMessage(self.name, number, b""))
                get.count += 1
                await asyncio.sleep(self._pause)
        finally:
            self.under_way -= 1


def answer(*ways: SlowWay) -> tuple[str, float]:
    """Return which path's answer was used, and after how many s. No request may stay in flight."""

    async def main() -> tuple[str, float]:
        found = await first_answer(ways, REQUEST, full())
        assert [message.sequence for message in found] == [0, 1, 2]
        return found[0].subject, asyncio.get_running_loop().time() - 1000.0

    name, took = run_controlled(main())
    assert [way.under_way for way in ways] == [0] * len(ways)
    return name, round(took, 3)


def full() -> Spare:
    """Return a full budget, as after some time without load."""
    spare = Spare()
    for _ in range(round(MOST_SPARE / EARNED)):
        spare.note(is_late=False)
        spare.learn(0.01)
    return spare


def asked(ways: Sequence[SlowWay]) -> list[list[float]]:
    return [way.asked for way in ways]


def test_a_prompt_answer_takes_one_request() -> None:
    ways = [SlowWay("a", 0.01), SlowWay("b", 0.01), SlowWay("c", 0.01)]
    assert answer(*ways) == ("a", 0.01)
    assert asked(ways) == [[0.0], [], []]


def test_an_unanswered_read_is_repeated_on_all_paths() -> None:
    """The server may have forwarded the request to a server that is cut off."""
    ways = [SlowWay("a"), SlowWay("b", NEVER, 0.01), SlowWay("c")]
    assert answer(*ways) == ("b", 0.21)
    assert asked(ways) == [[0.0, 0.2], [0.1, 0.2], [0.1, 0.2]]


def test_a_late_first_answer_is_used_even_after_a_repeat() -> None:
    ways = [SlowWay("a", 0.15), SlowWay("b")]
    assert answer(*ways) == ("a", 0.15)


def test_a_long_answer_is_not_requested_again_while_parts_arrive() -> None:
    ways = [SlowWay("a", 0.01, pause=0.09), SlowWay("b", 0.01)]
    assert answer(*ways) == ("a", 0.28)
    assert asked(ways) == [[0.0], []]


def test_a_failed_path_is_not_waited_for() -> None:
    ways = [SlowWay("a", 0.0, failure=Unsure("lost")), SlowWay("b", 0.01), SlowWay("c")]
    assert answer(*ways) == ("b", 0.01)


def test_a_failure_of_all_paths_is_raised_immediately() -> None:
    for number in (1, 2, 3):
        ways = [SlowWay("a", 0.01, failure=Unsure("it ended with 503")) for _ in range(number)]
        with pytest.raises(Unsure, match="503"):
            answer(*ways)
        assert asked(ways) == [[0.0], *[[0.01]] * (number - 1)]


def test_a_forbidden_read_is_not_repeated() -> None:
    ways = [SlowWay("a", 0.01, failure=NoRight("no")), SlowWay("b", 0.01)]
    with pytest.raises(NoRight):
        answer(*ways)
    assert asked(ways) == [[0.0], []]


def test_an_unanswered_read_raises_after_its_repeats() -> None:
    ways = [SlowWay("a"), SlowWay("b"), SlowWay("c")]

    async def main() -> float:
        with pytest.raises(Unsure, match="no answer to questions"):
            await first_answer(ways, REQUEST, full())
        return asyncio.get_running_loop().time() - 1000.0

    assert run_controlled(main()) == pytest.approx(sum(AGAIN_S))
    assert [len(way.asked) for way in ways] == [4, 4, 4]
    assert [way.under_way for way in ways] == [0, 0, 0]


class LateWay(SlowWay):
    """A path that always answers after `delay` seconds."""

    def __init__(self, delay: float) -> None:
        super().__init__("late")
        self.delay = delay

    async def gather(self, request: Request, get: DirectGet) -> None:
        self._delays = [self.delay]
        await super().gather(request, get)


def questions(reads: int, ways: Sequence[LateWay], spare: Spare) -> int:
    """Return how many requests are sent for this many reads, one after another."""
    before = sum(map(len, asked(ways)))

    async def main() -> None:
        for _ in range(reads):
            await first_answer(ways, REQUEST, spare)

    run_controlled(main())
    return sum(map(len, asked(ways))) - before


def test_reads_are_not_repeated_before_timely_answers_were_seen() -> None:
    """Many gateways that start together read a lot, and repeats would slow them down more."""
    assert questions(100, [LateWay(0.9) for _ in range(3)], Spare()) == 100


@pytest.mark.slow
def test_a_slow_cluster_gets_no_repeats() -> None:
    ways, spare = [LateWay(0.9) for _ in range(3)], full()
    assert 300 < questions(300, ways, spare) < 300 + MOST_SPARE
    assert questions(300, ways, spare) == 300


@pytest.mark.slow
@pytest.mark.parametrize("late", [2, 5, 20])
def test_reads_that_are_late_now_and_then_cause_few_repeats(late: int) -> None:
    ways, spare = [LateWay(0.9) for _ in range(3)], full()
    questions(300, ways, spare)
    count = 0
    for number in range(300):
        for way in ways:
            way.delay = 0.01 if number % late else 0.9
        count += questions(1, ways, spare)
    assert count < 300 * (1 + EARNED)


def test_timely_answers_earn_repeats() -> None:
    ways, spare = [LateWay(0.9) for _ in range(3)], full()
    questions(300, ways, spare)
    for way in ways:
        way.delay = 0.01
    assert questions(round(2 / EARNED), ways, spare) == 2 / EARNED
    ways[0].delay = NEVER  # this path no longer answers
    assert questions(1, ways, spare) == 3


def test_the_budget_lasts_until_a_dead_route_is_dropped() -> None:
    """A gateway reads about 100 times within these 3 s, and a third of its requests is lost."""
    ways, spare = [LateWay(0.01) for _ in range(3)], full()
    took = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        for number in range(120):
            ways[0].delay = 0.01 if number % 3 else NEVER
            begun = loop.time()
            await first_answer(ways, REQUEST, spare)
            took.append(loop.time() - begun)

    run_controlled(main())
    assert max(took) < 0.12


def test_a_failed_read_without_budget_raises() -> None:
    spare = Spare()
    ways = [SlowWay("a", 0.01, failure=Unsure("it ended with 503")), SlowWay("b", 0.01)]

    async def main() -> None:
        with pytest.raises(Unsure, match="503"):
            await first_answer(ways, REQUEST, spare)

    run_controlled(main())
    assert asked(ways) == [[0.0], []]


def test_slow_answers_delay_repeats() -> None:
    """After a slow answer, as when many gateways start together, later reads are repeated later."""
    way, others, spare = LateWay(0.2), [SlowWay("b"), SlowWay("c")], full()

    async def main() -> None:
        for _ in range(10):
            await first_answer([way, *others], REQUEST, spare)

    run_controlled(main())
    assert asked(others) == [[0.1], [0.1]]  # repeats of the first read only


def test_lost_reads_are_repeated_soon_once_answers_are_fast() -> None:
    ways, spare = [LateWay(0.3) for _ in range(3)], full()
    questions(10, ways, spare)
    for way in ways:
        way.delay = 0.01
    questions(100, ways, spare)
    ways[0].delay = NEVER

    async def main() -> float:
        loop = asyncio.get_running_loop()
        begun = loop.time()
        await first_answer(ways, REQUEST, spare)
        return loop.time() - begun

    assert run_controlled(main()) == pytest.approx(0.11)
