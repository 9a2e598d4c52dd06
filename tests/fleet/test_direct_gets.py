"""Direct gets: whom they ask when, and which answer counts; on a loop whose time is its own."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import pytest
from controlled_loop import run_controlled
from peers import require_module

require_module("nats")

from multidrop.fleet.batch_client import DirectGet, DirectMessage, Request  # noqa: E402
from multidrop.fleet.direct_gets import AGAIN_S, first_answer  # noqa: E402
from multidrop.fleet.errors import FleetError, NoRight, Unsure  # noqa: E402

NEVER = 1e9
REQUEST = Request("questions", b"")


class SlowWay:
    """A path that answers each time it is asked after so long, or fails."""

    def __init__(
        self, name: str, *delays: float, failure: FleetError | None = None, pause: float = 0
    ) -> None:
        self.name = name
        self.asked: list[float] = []
        self._delays = [*delays]
        self._failure = failure
        self._pause = pause  # between messages
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
    """Return whose answer counts, and after how long (s) it has come. Nothing is left under way."""

    async def main() -> tuple[str, float]:
        found = await first_answer(ways, REQUEST)
        assert [message.sequence for message in found] == [0, 1, 2]
        return found[0].subject, asyncio.get_running_loop().time() - 1000.0

    name, took = run_controlled(main())
    assert [way.under_way for way in ways] == [0] * len(ways)
    return name, round(took, 3)


def asked(ways: Sequence[SlowWay]) -> list[list[float]]:
    return [way.asked for way in ways]


def test_at_rest_one_way_is_asked_once() -> None:
    ways = [SlowWay("a", 0.01), SlowWay("b", 0.01), SlowWay("c", 0.01)]
    assert answer(*ways) == ("a", 0.01)
    assert asked(ways) == [[0.0], [], []]


def test_a_question_that_a_server_without_a_network_got_goes_to_the_others_too() -> None:
    """By chance a server passes it on to the one that is cut off."""
    ways = [SlowWay("a"), SlowWay("b", NEVER, 0.01), SlowWay("c")]
    assert answer(*ways) == ("b", 0.21)
    assert asked(ways) == [[0.0, 0.2], [0.1, 0.2], [0.1, 0.2]]


def test_an_answer_to_the_first_question_counts_though_it_was_asked_again() -> None:
    ways = [SlowWay("a", 0.15), SlowWay("b")]
    assert answer(*ways) == ("a", 0.15)


def test_a_long_answer_is_not_asked_for_again_while_its_messages_come() -> None:
    ways = [SlowWay("a", 0.01, pause=0.09), SlowWay("b", 0.01)]
    assert answer(*ways) == ("a", 0.28)
    assert asked(ways) == [[0.0], []]


def test_a_way_that_fails_is_not_waited_for() -> None:
    ways = [SlowWay("a", 0.0, failure=Unsure("lost")), SlowWay("b", 0.01), SlowWay("c")]
    assert answer(*ways) == ("b", 0.01)


def test_a_failure_of_all_ways_is_told_at_once() -> None:
    for number in (1, 2, 3):
        ways = [SlowWay("a", 0.01, failure=Unsure("it ended with 503")) for _ in range(number)]
        with pytest.raises(Unsure, match="503"):
            answer(*ways)
        assert asked(ways) == [[0.0], *[[0.01]] * (number - 1)]


def test_what_may_not_be_asked_is_asked_once() -> None:
    ways = [SlowWay("a", 0.01, failure=NoRight("no")), SlowWay("b", 0.01)]
    with pytest.raises(NoRight):
        answer(*ways)
    assert asked(ways) == [[0.0], []]


def test_a_question_that_nobody_answers_comes_to_an_end() -> None:
    ways = [SlowWay("a"), SlowWay("b"), SlowWay("c")]

    async def main() -> float:
        with pytest.raises(Unsure, match="nothing came to questions"):
            await first_answer(ways, REQUEST)
        return asyncio.get_running_loop().time() - 1000.0

    assert run_controlled(main()) == pytest.approx(sum(AGAIN_S))
    assert [len(way.asked) for way in ways] == [4, 4, 4]
    assert [way.under_way for way in ways] == [0, 0, 0]
