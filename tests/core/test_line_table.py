"""The transition table of a line: its content, its use by random exchanges, and its diagram in the docs."""

from __future__ import annotations

import random
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from frames import words
from line_driver import MS, LineDriver
from multidrop._core import ffi, lib
from tables import table

from multidrop.core import Exchange, Framing, Message, Peer, build_reply

DRAWING = Path(__file__).parents[2] / "docs" / "diagrams" / "line_states.py"
READ, WRITE, BROADCAST = Message(1, 3, 0, 2), Message(1, 6, 2, data=words(7)), Message(0, 6, 2, data=words(7))
MOST_EVENTS = 2  # events in one call: for example, a broadcast is sent and ends


def numbers(kind: str) -> dict[str, int]:
    """Return the members of a C enum by name, without the last member, which is the count of the others."""
    elements = ffi.typeof(f"enum {kind}").relements
    return {name: number for name, number in elements.items() if number < len(elements) - 1}


STATES, EVENTS = numbers("md_line_state"), numbers("md_line_event")
TABLE = {
    (state, event): following
    for state in STATES.values()
    for event in EVENTS.values()
    if (following := lib.md_line_follows[state][event]) >= 0
}


def after(states: set[int]) -> set[int]:
    return {TABLE[state, event] for state in states for event in EVENTS.values() if (state, event) in TABLE}


def reachable(begin: int) -> set[int]:
    found: set[int] = {begin}
    while not after(found) <= found:
        found |= after(found)
    return found


def test_every_state_can_be_reached_from_every_state() -> None:
    for state in STATES.values():
        assert reachable(state) == set(STATES.values())


def test_every_event_is_in_the_table_and_leads_to_a_known_state() -> None:
    assert {event for _, event in TABLE} == set(EVENTS.values())
    assert set(TABLE.values()) <= set(STATES.values())


def test_an_exchange_can_end_in_every_state_except_idle() -> None:
    ending = {state for state, event in TABLE if event == EVENTS["MD_ENDED"]}
    assert ending == set(STATES.values()) - {STATES["MD_IDLE"]}
    assert all(TABLE[state, EVENTS["MD_ENDED"]] == STATES["MD_IDLE"] for state in ending)


def test_the_request_is_written_only_after_a_check_for_silence() -> None:
    before = {state for (state, _), following in TABLE.items() if following == STATES["MD_READY"]}
    assert before == {STATES["MD_CHECK"]}
    leaving = {state for state, event in TABLE if event in (EVENTS["MD_PART_LEFT"], EVENTS["MD_ALL_LEFT"])}
    assert leaving == {STATES["MD_READY"], STATES["MD_WRITING"]}


class Walk:
    """A line of the C core on which random events happen in random order."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)
        self.line = LineDriver()
        self.peer = Peer(least_timeout=0.02, most_timeout=0.3)
        self.rest = b""  # second piece of a reply, not yet received
        often = [self.begin, self.want, self.want, self.take, self.answer, self.wait]
        self.steps = [*often * (1 + seed % 2 * 9), self.noise, self.abandon]  # noise is rarer with odd seeds

    def run(self, steps: int) -> Iterator[tuple[int, int]]:
        """Yield the state before and after each step."""
        for _ in range(steps):
            before = self.line.state
            self.chance.choice(self.steps)()
            yield before, self.line.state

    def begin(self) -> None:
        if self.line.state == STATES["MD_IDLE"]:
            asked = self.chance.choices([READ, WRITE, BROADCAST], [9, 1, 1])[0]
            details: dict[str, Any] = {
                "baudrate": 9600,
                "format": "8N1",
                "character": 0.001,
                "silence": 0.004,
            }
            self.rest = b""
            self.line.begin(Exchange(Framing.RTU, asked, self.peer, **details))

    def want(self) -> None:
        self.line.want  # noqa: B018

    def take(self) -> None:
        self.line.take(self.chance.choice([1, 513, 513]))

    def noise(self) -> None:
        self.line.receive(bytes(self.chance.choices(range(256), k=self.chance.choice([1, 9, 600]))))

    def answer(self) -> None:
        """Reply in one piece or in two. The second piece may come late or never."""
        self.rest = self.rest or build_reply(Framing.RTU, Message(1, 3, data=words(1, 2)))
        piece = self.chance.choice([3, len(self.rest)])
        self.line.receive(self.rest[:piece])
        self.rest = self.rest[piece:]

    def wait(self) -> None:
        soon = self.line.wake - self.line.now
        self.line.now += max(0, self.chance.choice([soon, 1 * MS, 40 * MS, 400 * MS]))

    def abandon(self) -> None:
        if self.chance.random() < 0.2:
            self.line.lose(5)


@pytest.mark.slow
@table("seed", range(5))
def test_random_events_cause_only_transitions_of_the_table(seed: int) -> None:
    ways = {state: {state} | after({state}) for state in STATES.values()}
    for _ in range(MOST_EVENTS - 1):
        ways = {state: reach | after(reach) for state, reach in ways.items()}
    for before, now in Walk(seed).run(4000):
        assert now in ways[before]


@pytest.mark.long
def test_random_events_cause_every_transition_of_the_table() -> None:
    seen = {pair for seed in range(10) for pair in Walk(seed).run(4000)}
    assert {(state, following) for (state, _), following in TABLE.items()} <= seen


def test_the_documented_state_diagram_equals_the_table() -> None:
    drawing = runpy.run_path(str(DRAWING))
    assert drawing["PICTURE"].read_text() == drawing["picture"]()
