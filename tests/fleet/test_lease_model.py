"""All interleavings of a lease's holder and a gateway that takes it over, with the code's own rules."""

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
    """Return when the kernel's timer ends a holder that did not let go in time (csrc/mastership.c)."""
    return until + terms.guard // 2


class PathState(NamedTuple):
    """One path: the record, messages under way, and what both sides know. Times are ages in ticks."""

    ended: int | None = None  # since when renewal is impossible
    request: int | None = None  # a renewal on its way to the server, by when it was sent
    ack: int | None = None  # its acknowledgement on its way back
    renewed: int | None = 0  # the newest renewal that the holder counts
    seen: tuple[bool, int] | None = None  # the taker: is it the present revision, and since when
    ending: bool | None = None  # the taker's write under way: is it of the present revision


@dataclass(frozen=True)
class Model:
    """A holder that may be suspended at any point, a taker, and a network that delays and loses.

    The taker writes once enough paths have been ended for as long as the guard.
    """

    terms: Terms
    paths: int = 3
    counts_from_ack: bool = False
    has_cas: bool = True
    has_timer: bool = True
    waits: bool = True
    listens: bool = True  # for the guard
    lateness: int = 0  # of the timer

    # ---- one path ----

    def path_steps(self, path: PathState) -> Iterator[PathState]:
        """Yield all that may happen next on one path."""
        if path.request is None and path.ack is None:
            yield path._replace(request=0)
        if path.ack is not None:
            yield path._replace(ack=None, renewed=0 if self.counts_from_ack else path.ack)
            yield path._replace(ack=None)  # lost
        if path.request is not None:
            yield path._replace(request=None)  # lost, or refused on an ended path
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
        """Return the path one tick later."""

        def older(age: int | None, most: int) -> int | None:
            return None if age is None else min(age + 1, most)

        terms = self.terms
        oldest = terms.lease + terms.guard // 2 + self.lateness + 1  # from here on no rule depends on it
        return path._replace(
            request=older(path.request, oldest),
            ack=older(path.ack, oldest),
            renewed=older(path.renewed, oldest),
            seen=path.seen and (path.seen[0], min(path.seen[1] + 1, terms.lease)),
            ended=older(path.ended, terms.guard),
        )

    def normal(self, path: PathState) -> PathState:
        """Return the representative of all path states with the same future."""
        if not self.has_cas:
            return path
        seen = (
            path.seen if path.seen and path.seen[0] else None
        )  # the watched revision is gone: it cannot end it
        request = path.request if path.ended is None else None
        return path._replace(seen=seen, request=request, ending=path.ending or None)

    # ---- all interleavings ----

    def deadline(self, renewed: Iterable[int | None]) -> int:
        """Return until when the holder may send, relative to now, by the newest renewal of each path."""
        sent = [None if age is None else -age for age in renewed]
        return lease_rules.deadline(sent, self.terms)

    def search(self, most: int | None = None) -> tuple[int, tuple[PathState, ...] | None]:
        """Return how many states there are, and one in which two masters could write, if there is one.

        A state has a flag, True between the holder's check of the clock and its write, and its sorted paths.
        States of a dead holder are left out.
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
            yield (False, *numbers)  # written
        elif lease_rules.may_send(0, table.deadline(numbers)):
            yield (True, *numbers)
        for place, number in enumerate(numbers):
            if number in numbers[:place]:
                continue  # the same follows
            others = numbers[:place] + numbers[place + 1 :]
            for after in table.steps[number]:
                yield (has_looked, *sorted([*others, after]))

    def is_killed(self, table: _PathTable, numbers: list[int]) -> bool:
        return self.has_timer and killed_at(table.deadline(numbers), self.terms) + self.lateness < 0


class _PathTable:
    """All states of one path, numbered, with what follows each."""

    def __init__(self, model: Model) -> None:
        self.paths: list[PathState] = []
        self._numbers: dict[PathState, int] = {}
        self._model = model
        self.steps: list[list[int]] = []
        self.later: list[int] = []
        self._deadlines: dict[tuple[int | None, ...], int] = {}  # by the newest renewals
        self.number(PathState())
        for path in self.paths:  # it grows in the meantime
            after = {self.number(following) for following in model.path_steps(path)}
            self.steps.append(sorted(after - {self.number(path)}))
            self.later.append(self.number(model.grown_older(path)))

    def deadline(self, numbers: list[int]) -> int:
        """Return the holder's deadline with its paths in these states."""
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
def test_no_two_masters_in_any_interleaving() -> None:
    states, wrong = Model(SMALL).search()
    assert wrong is None
    assert states > 100_000


@pytest.mark.long
def test_no_two_masters_in_any_interleaving_of_a_longer_lease() -> None:
    states, wrong = Model(WHOLE).search()
    assert wrong is None
    assert states > 500_000


LARGE = ("deadline from the acknowledgement", "guard shorter than the timer's lateness", "needs 1, ends 2")


@pytest.mark.slow
@pytest.mark.parametrize(
    "mutation",
    [pytest.param(name, marks=pytest.mark.long if name in LARGE else ()) for name in MUTATIONS],
)
def test_each_mutation_has_two_masters(mutation: str) -> None:
    _, wrong = MUTATIONS[mutation].search(most=500_000)
    assert wrong is not None


def test_the_rules_in_use_are_those_of_the_model() -> None:
    """Both quorums are more than half, and the timer fires before the guard is over."""
    terms = Terms()
    assert terms.needed + terms.ended > lease_rules.PATHS
    assert killed_at(0, terms) < terms.guard
