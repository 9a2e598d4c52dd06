"""All interleavings of a lease's holder and a gateway that takes over, with the code's own rules."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import pytest

from multidrop.fleet.leases import rules as lease_rules
from multidrop.fleet.leases.rules import SeenRevision, Terms

SMALL = Terms(lease=1, guard=2)
WHOLE = Terms(lease=2, guard=2)


def killed_at(until: int, terms: Terms) -> int:
    """Return when the kernel's timer kills a holder that did not close its lines (csrc/mastership.c)."""
    return until + terms.guard // 2


class PathState(NamedTuple):
    """The state of one path: the record, the messages in flight, and what both sides know.

    Times are ages, in ticks of the model.
    """

    ended: int | None = None  # time since which renewal is impossible; None: not ended
    request: int | None = None  # a renewal on its way to the server: when it was sent
    ack: int | None = None  # the server's acknowledgement on its way back: when that renewal was sent
    renewed: int | None = 0  # the newest renewal that the holder counts
    seen: tuple[bool, int] | None = None  # record read by the taker: is it the newest, and since when
    ending: bool | None = None  # the taker's write in flight: whether it replaces the present revision


@dataclass(frozen=True)
class Model:
    """A holder that may be suspended at any point, a taker, and a network that delays and loses messages.

    The taker starts to write when enough paths have been ended for the time of the guard.
    """

    terms: Terms
    paths: int = 3
    counts_from_ack: bool = False
    has_cas: bool = True
    has_timer: bool = True
    waits: bool = True
    listens: bool = True  # the taker listens for the time of the guard before it writes
    lateness: int = 0  # delay of the kernel's timer, in ticks

    # ---- one path ----

    def path_steps(self, path: PathState) -> Iterator[PathState]:
        """Yield all possible next states of one path."""
        if path.request is None and path.ack is None:
            yield path._replace(request=0)
        if path.ack is not None:
            yield path._replace(ack=None, renewed=0 if self.counts_from_ack else path.ack)
            yield path._replace(ack=None)  # the acknowledgement is lost
        if path.request is not None:
            yield path._replace(request=None)  # the renewal is lost, or refused because the path was ended
            if path.ended is None:
                seen = None if path.seen is None else (False, path.seen[1])
                ending = None if path.ending is None else False
                yield path._replace(request=None, ack=path.request, seen=seen, ending=ending)
        if path.ended is not None:
            return
        yield path._replace(seen=(True, 0) if path.seen is None or not path.seen[0] else path.seen)
        if path.seen and path.ending is None and self.may_end(path.seen):
            yield path._replace(ending=path.seen[0])
        if path.ending is not None:
            is_done = path.ending or not self.has_cas
            yield path._replace(
                ending=None, ended=0 if is_done else None, seen=None if is_done else path.seen
            )

    def may_end(self, seen: tuple[bool, int]) -> bool:
        return not self.waits or lease_rules.is_stale(SeenRevision(1, -seen[1]), 0, self.terms)

    def grown_older(self, path: PathState) -> PathState:
        """Return the path's state one tick later."""

        def older(age: int | None, most: int) -> int | None:
            return None if age is None else min(age + 1, most)

        terms = self.terms
        oldest = terms.lease + terms.guard // 2 + self.lateness + 1  # no rule depends on a greater age
        return path._replace(
            request=older(path.request, oldest),
            ack=older(path.ack, oldest),
            renewed=older(path.renewed, oldest),
            seen=path.seen and (path.seen[0], min(path.seen[1] + 1, terms.lease)),
            ended=older(path.ended, terms.guard),
        )

    def normal(self, path: PathState) -> PathState:
        """Return the representative of all path states that have the same future."""
        if not self.has_cas:
            return path
        seen = (
            path.seen if path.seen and path.seen[0] else None
        )  # the observed revision was replaced, so the taker cannot end it
        request = path.request if path.ended is None else None
        return path._replace(seen=seen, request=request, ending=path.ending or None)

    # ---- all interleavings ----

    def deadline(self, renewed: Iterable[int | None]) -> int:
        """Return until when the holder may send, relative to now, from the newest renewal of each path."""
        sent = [None if age is None else -age for age in renewed]
        return lease_rules.deadline(sent, self.terms)

    def search(self, most: int | None = None) -> tuple[int, tuple[PathState, ...] | None]:
        """Return the number of reachable states, and one in which two masters could write, if there is one.

        A state has a flag and its sorted paths. The flag is True between the holder's check of the clock and
        its write. States of a dead holder are left out.
        """
        table = _PathTable(self)
        first = (False, *(table.number(PathState()),) * self.paths)
        known, layer = {first}, [first]
        while layer:
            following: list[tuple[int, ...]] = []
            for state in layer:
                for after in self.steps(state, table):
                    if after in known:
                        continue
                    known.add(after)
                    following.append(after)
                    paths = tuple(table.paths[number] for number in after[1:])
                    if after[0] and self.taker_may_write(paths):
                        return len(known), paths
            layer = following
            assert most is None or len(known) < most, "not found early"
        return len(known), None

    def taker_may_write(self, paths: tuple[PathState, ...]) -> bool:
        guard = self.terms.guard if self.listens else 0
        over = sum(path.ended is not None and path.ended >= guard for path in paths)
        return lease_rules.is_over(over, self.terms)

    def steps(self, state: tuple[int, ...], table: _PathTable) -> Iterator[tuple[int, ...]]:
        has_looked, *numbers = state
        later = sorted(table.later[number] for number in numbers)
        if not self.is_killed(table, later):
            yield (has_looked, *later)
        if has_looked:
            yield (False, *numbers)  # the holder has written
        elif lease_rules.may_send(0, table.deadline(numbers)):
            yield (True, *numbers)
        for place, number in enumerate(numbers):
            if number in numbers[:place]:
                continue  # an equivalent state follows
            others = numbers[:place] + numbers[place + 1 :]
            for after in table.steps[number]:
                yield (has_looked, *sorted([*others, after]))

    def is_killed(self, table: _PathTable, numbers: list[int]) -> bool:
        return self.has_timer and killed_at(table.deadline(numbers), self.terms) + self.lateness < 0


class _PathTable:
    """All states of one path, numbered, with the next states of each."""

    def __init__(self, model: Model) -> None:
        self.paths: list[PathState] = []
        self._numbers: dict[PathState, int] = {}
        self._model = model
        self.steps: list[list[int]] = []
        self.later: list[int] = []
        self._deadlines: dict[tuple[int | None, ...], int] = {}  # deadlines by the newest renewals
        self.number(PathState())
        for path in self.paths:  # this list grows during the loop
            after = {self.number(following) for following in model.path_steps(path)}
            self.steps.append(sorted(after - {self.number(path)}))
            self.later.append(self.number(model.grown_older(path)))

    def deadline(self, numbers: list[int]) -> int:
        """Return the holder's deadline if its paths are in these states."""
        renewed = tuple([self.paths[number].renewed for number in numbers])
        if renewed not in self._deadlines:
            self._deadlines[renewed] = self._model.deadline(renewed)
        return self._deadlines[renewed]

    def number(self, path: PathState) -> int:
        path = self._model.normal(path)
        if path not in self._numbers:
            self._numbers[path] = len(self.paths)
            self.paths.append(path)
        return self._numbers[path]


ONE_PATH = Terms(lease=1, guard=2, needed=1, ended=1)

MUTATIONS = {
    "deadline from the acknowledgement": Model(SMALL, counts_from_ack=True),
    "takeover without CAS": Model(ONE_PATH, paths=1, has_cas=False),
    "no timer": Model(SMALL, has_timer=False),
    "no wait": Model(SMALL, waits=False),
    "no guard": Model(SMALL, listens=False),
    "guard shorter than the timer's lateness": Model(SMALL, lateness=3),
    "needs 1, ends 2": Model(SMALL._replace(needed=1)),
    "needs 2, ends 1": Model(SMALL._replace(ended=1)),
}


@pytest.mark.long
def test_no_interleaving_has_two_masters() -> None:
    states, wrong = Model(SMALL).search()
    assert wrong is None
    assert states > 100_000


@pytest.mark.long
def test_no_interleaving_has_two_masters_with_a_longer_lease() -> None:
    states, wrong = Model(WHOLE).search()
    assert wrong is None
    assert states > 500_000


LARGE = ("deadline from the acknowledgement", "guard shorter than the timer's lateness", "needs 1, ends 2")


@pytest.mark.slow
@pytest.mark.parametrize(
    "mutation",
    [pytest.param(name, marks=pytest.mark.long if name in LARGE else ()) for name in MUTATIONS],
)
def test_each_mutation_of_the_rules_allows_two_masters(mutation: str) -> None:
    _, wrong = MUTATIONS[mutation].search(most=500_000)
    assert wrong is not None


def test_the_rules_in_use_are_those_of_the_model() -> None:
    """Both quorums are more than half of the paths, and the kernel's timer fires before the guard is over."""
    terms = Terms()
    assert terms.needed + terms.ended > lease_rules.PATHS
    assert killed_at(0, terms) < terms.guard
