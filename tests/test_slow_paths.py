"""Stories of a path that holds everything up and keeps the order: a modem, a gateway, a stalled network.

No value is another register's, and values keep coming; on a world's clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from random import Random
from typing import Any

import pytest
from test_hostile_line import LINES, Story, of_all_variants, of_one_variant
from worlds import WorldWire

from multidrop.sim import Faults

pytestmark = pytest.mark.story

Delay = Callable[[float], float]  # in s, of what enters the path at a time in s

SECONDS = 150.0  # of a story: what is outstanding is remembered for 120 s
TAIL = 20.0  # s at its end, and TURNS times the delay, in which every drive must have answered
TURNS = 20


class PathWire(WorldWire):
    """A hostile wire at the far end of a path that delays what the drives say."""

    delay: Delay

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._path: deque[tuple[float, bytes]] = deque()

    def advance(self, now: float) -> bytes:
        said = super().advance(now)
        if said:
            before = self._path[-1][0] if self._path else 0.0
            self._path.append((max(before, now + self.delay(now)), said))
        heard = b""
        while self._path and self._path[0][0] <= now:
            heard += self._path.popleft()[1]
        return heard

    @property
    def wake(self) -> float | None:
        arrival = self._path[0][0] if self._path else None
        return min((time for time in (super().wake, arrival) if time is not None), default=None)


def constant(seconds: float) -> Delay:
    return lambda now: seconds


def jittering(seconds: float) -> Delay:
    random = Random(1)
    return lambda now: seconds * random.uniform(0.8, 1.2)


def stalling(longest: float) -> Delay:
    """Twelve stalls of up to so many seconds, in which everything waits for the end."""
    random = Random(2)
    begins = [random.uniform(2.0, SECONDS) for _ in range(12)]
    stalls = [(begin, begin + random.uniform(0.5, 1.0) * longest) for begin in begins]

    def delay(now: float) -> float:
        now -= 1000.0  # when a world begins
        return max((end - now for begin, end in stalls if begin <= now < end), default=0.0)

    return delay


class Path(Story):
    """A line behind such a path."""

    wires = PathWire

    def tell_of(self, delay: Delay, tail_s: float = TAIL) -> set[str]:
        """Judge every row; the drives of which values came in the end."""
        self.wire.delay = delay
        with self.world:
            self.run(SECONDS)
            tail = self.run(tail_s)
        self.judge_values()
        return {row.drive for row in tail if row.value is not None}


DELAYS = (0.0, 0.1, 0.3, 0.45, 0.6, 1.5, 4.0, 10.0)
STALLS = {f"stalls of {longest:g} s": longest for longest in (0.1, 0.3, 0.9, 3.0, 15.0, 60.0)}


@pytest.mark.parametrize("path", [constant, jittering])
@pytest.mark.parametrize("seconds", DELAYS)
@pytest.mark.parametrize("name", LINES)
def test_a_slow_path_costs_time_and_no_truth(
    name: str, seconds: float, path: Callable[[float], Delay]
) -> None:
    story = Path(of_one_variant(LINES[name]))
    answering = story.tell_of(path(seconds), TAIL + TURNS * seconds)
    assert answering == {drive.name for drive in story.drives}


@pytest.mark.parametrize("path", STALLS)
@pytest.mark.parametrize("name", LINES)
def test_a_stall_costs_time_and_no_truth(name: str, path: str) -> None:
    Path(of_one_variant(LINES[name])).tell_of(stalling(STALLS[path]))


@pytest.mark.parametrize("kind", ["drop", "flip", "split", "noise"])
def test_all_families_on_a_slow_path_that_is_rough_too(kind: str) -> None:
    story = Path(of_all_variants())
    story.wire.faults = Faults(**{kind: 0.1})
    story.tell_of(stalling(3.0))
