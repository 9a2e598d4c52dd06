"""All possible orders of the steps in which gateways claim and release a line, by the rules in the code."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import pytest
from tables import table

from multidrop.fleet.lines import rules as lease_rules
from multidrop.fleet.lines.rules import (
    NEEDED,
    NOBODY,
    LineRecords,
    Owner,
    SeenRevision,
    Terms,
    claim_of,
    owner_value,
)
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import NONE_YET, Record

BUCKETS = 3


class Stored(NamedTuple):
    """The ownership record of the line in one bucket."""

    owner: str = NOBODY
    votes: int = 0
    revision: int = NONE_YET


class Write(NamedTuple):
    """An ownership record on its way to a bucket. It replaces only a record of the revision `after`."""

    writer: str
    bucket: int
    owner: str
    votes: int
    after: int


Records = tuple[Stored, ...]


class Session(NamedTuple):
    """The ownership records that a gateway's session has read, and in `given` those that it is releasing."""

    known: Records = (Stored(),) * BUCKETS
    given: frozenset[tuple[int, int]] = frozenset()
    is_over: bool = False


class State(NamedTuple):
    records: Records
    sessions: tuple[Session, ...]
    writes: frozenset[Write]


def owner_called(name: str) -> Owner:
    return (name, 1) if name else (NOBODY, 0)


@lru_cache(1 << 16)
def as_read(records: Records) -> LineRecords:
    """Return the records in the form that the tested code reads. The turn, which is only shown, is 1."""
    return {
        f"bucket {at}": Record(
            "line",
            one.revision,
            owner_value(owner_called(one.owner), 1, 0, one.votes) if one.revision else None,
        )
        for at, one in enumerate(records)
    }


@dataclass(frozen=True)
class Model:
    """Sessions that claim and release one line by the records that they have read, and end at any time.

    Writes are stored late, in any order, or never. A session learns the outcome of a write when it reads the
    record. At most `most` records are stored. Every session knows which sessions have ended. If it did not,
    it would claim nothing, as an idle session does.
    """

    sessions: str = "ab"
    most: int = 5
    needed: int = NEEDED
    has_cas: bool = True
    gives_up_first: bool = True  # a session counts the line as lost before it sends the line's release
    looks_home: bool = True  # a session reads the record in the line's first bucket before it writes others
    minds_two_votes: bool = True
    minds_who_lives: bool = True

    def search(self) -> tuple[int, State | None]:
        """Try all orders of steps; return the number of states, and one with two masters or a lost line."""
        nothing = (Stored(),) * BUCKETS
        first = State(nothing, (Session(),) * len(self.sessions), frozenset())
        known, layer = {first}, [first]
        while layer:
            following = []
            for state in layer:
                for after in self.steps(state):
                    if after not in known:
                        known.add(after)
                        following.append(after)
                        having = [at for at, one in enumerate(after.sessions) if self.is_mine(at, one)]
                        if len(having) > 1 or any(map(self.is_lost, self.survivors(after))):
                            return len(known), after
            layer = following
        return len(known), None

    def is_mine(self, at: int, session: Session) -> bool:
        if session.is_over:
            return False
        name, votes = self.sessions[at], 0
        for bucket, one in enumerate(session.known):
            if one.owner == name and (bucket, one.revision) not in session.given:
                votes += one.votes
        return votes >= self.needed

    def survivors(self, state: State) -> Iterator[tuple[int, Session]]:
        """Yield each living session as if it had read all records, and all other sessions had ended."""
        for at, session in enumerate(state.sessions):
            if not session.is_over:
                for bucket, record in enumerate(state.records):
                    session = read(session, bucket, record)
                yield at, session

    def is_lost(self, survivor: tuple[int, Session]) -> bool:
        """Return True if the session is not the line's master, and cannot become it with one bucket down."""
        at, session = survivor
        if self.is_mine(at, session) or not session.known[0].revision:
            return False
        me, over = self.sessions[at], frozenset(self.sessions) - {self.sessions[at]}
        doubted = [
            bucket for bucket, one in enumerate(session.known) if (bucket, one.revision) in session.given
        ]
        claims = self.claims(me, session.known, over, tuple(doubted))
        votes = sum(
            one.votes for bucket, one in enumerate(session.known) if one.owner == me and bucket not in doubted
        )
        free = {bucket for bucket, _ in claims[-1]} if claims else set()
        return any(votes + len(free - {dead}) < self.needed for dead in range(BUCKETS))

    def steps(self, state: State) -> Iterator[State]:
        over = {name for name, one in zip(self.sessions, state.sessions, strict=True) if one.is_over}
        for at, session in enumerate(state.sessions):
            if not session.is_over:
                yield self.with_session(state, at, Session(is_over=True))
                for bucket, record in enumerate(state.records):
                    yield self.with_session(state, at, read(session, bucket, record))
                for after, writes in self.acts(self.sessions[at], session, over):
                    new = self.with_session(state, at, after)
                    yield new._replace(writes=state.writes | self.still_possible(state, writes))
        if sum(one.revision for one in state.records) < self.most:
            yield from (self.with_write(state, write) for write in state.writes)

    def with_session(self, state: State, at: int, session: Session) -> State:
        sessions = list(state.sessions)
        sessions[at] = session
        return state._replace(sessions=tuple(sessions))

    def with_write(self, state: State, write: Write) -> State:
        """Return the state after this write is stored. Other writes to the same revision then fail."""
        revision = state.records[write.bucket].revision + 1
        records = list(state.records)
        records[write.bucket] = Stored(write.owner, write.votes, revision)
        left = {one for one in state.writes if one.bucket != write.bucket or not self.has_cas} - {write}
        return state._replace(records=tuple(records), writes=frozenset(left))

    def still_possible(self, state: State, writes: frozenset[Write]) -> frozenset[Write]:
        return frozenset(
            one for one in writes if one.after == state.records[one.bucket].revision or not self.has_cas
        )

    def acts(self, name: str, session: Session, over: set[str]) -> Iterator[tuple[Session, frozenset[Write]]]:
        """Yield each action that a session may start: its knowledge after the action, and its writes."""
        ours = [bucket for bucket, one in enumerate(session.known) if one.owner == name]
        if ours:
            given = frozenset((bucket, session.known[bucket].revision) for bucket in ours)
            after = session._replace(given=session.given | given) if self.gives_up_first else session
            yield (
                after,
                frozenset(
                    Write(name, bucket, NOBODY, session.known[bucket].votes, session.known[bucket].revision)
                    for bucket in ours
                ),
            )
        doubted = tuple(at for at, one in enumerate(session.known) if (at, one.revision) in session.given)
        claims = self.claims(name, session.known, frozenset(over), doubted)
        for some in claims:
            yield (
                session,
                frozenset(
                    Write(name, bucket, name, votes, session.known[bucket].revision) for bucket, votes in some
                ),
            )

    def claims(
        self, name: str, known: Records, over: frozenset[str], doubted: tuple[int, ...]
    ) -> list[tuple[tuple[int, int], ...]]:
        """Return the sets of (bucket, votes) that a claim may write, with and without the spare buckets."""
        records = as_read(known)
        buckets = list(records)
        if not self.looks_home and not known[0].revision:
            return [tuple((at, 1) for at in range(1, BUCKETS)), ((0, NEEDED),)]
        if not self.minds_two_votes:
            records = {
                bucket: record and record._replace(value=record.value and {**record.value, "votes": 1})
                for bucket, record in records.items()
            }
        claim = claim_of(
            owner_called(name),
            records,
            lambda other, _: other in over or not self.minds_who_lives,
            [buckets[at] for at in doubted],
        )
        if claim is None:
            return []
        first = tuple((buckets.index(bucket), claim.votes) for bucket in claim.first)
        spare = tuple((buckets.index(bucket), claim.votes) for bucket in claim.spare)
        return [first, first + spare] if spare else [first]


def read(session: Session, bucket: int, record: Stored) -> Session:
    """Return the session after it has read this record; ignore a record older than the known one."""
    if session.known[bucket].revision >= record.revision:
        return session
    known = list(session.known)
    known[bucket] = record
    given = frozenset(one for one in session.given if one != (bucket, session.known[bucket].revision))
    return session._replace(known=tuple(known), given=given)


@pytest.mark.long
@table("sessions, most, least", [("ab", 4, 50_000), ("abc", 2, 10_000)])
def test_no_order_of_claims_and_releases_gives_two_masters(sessions: str, most: int, least: int) -> None:
    """Two sessions with five records, and three with three records, were also checked: 553,000 states."""
    states, wrong = Model(sessions, most).search()
    assert wrong is None
    assert states > least


MUTATIONS = {
    "one vote is enough": Model(needed=1),
    "without CAS": Model(has_cas=False),
    "ours until the giving away is stored": Model(gives_up_first=False),
    "the others written without having seen home": Model(looks_home=False),
    "a record with two votes taken for one": Model(minds_two_votes=False),
    "records of the living replaced": Model(minds_who_lives=False),
}


@pytest.mark.slow
@table("mutation", MUTATIONS)
def test_the_model_finds_a_fault_if_an_ownership_rule_is_changed(mutation: str) -> None:
    _, wrong = MUTATIONS[mutation].search()
    assert wrong is not None


# ---- all orders of the steps of a lease's holder and of a gateway that takes its lines over ----


SMALL = Terms(lease=1, guard=2)
WHOLE = Terms(lease=2, guard=2)


def killed_at(until: int, terms: Terms) -> int:
    """Return when the kernel kills a lease's holder that keeps its lines open (csrc/mastership.c)."""
    return until + terms.guard // 2


class PathState(NamedTuple):
    """One lease record, the messages in flight to it, and what its holder and the taker know about it.

    The taker is the gateway that takes over. Times are ages, in ticks of the model.
    """

    ended: int | None = None  # how long ago the taker ended this record; None: not ended
    request: int | None = None  # age of the renewal that is on its way to the server
    ack: int | None = None  # age of the renewal whose acknowledgement is on its way back
    renewed: int | None = 0  # age of the newest renewal whose success the holder knows
    # The revision that the other gateway has read: True if it is still the newest one, and the time since the
    # gateway first read it.
    seen: tuple[bool, int] | None = None
    # The other gateway's write that ends the session, on its way to the server. False: the server will refuse
    # it, because the record has a newer revision.
    ending: bool | None = None


@dataclass(frozen=True)
class LeaseModel:
    """A lease's holder, a gateway that takes over (the taker), and a network that delays and loses messages.

    The holder may be suspended at any point. The taker sends requests to drives once it has ended enough
    lease records, and the guard time has passed since then.
    """

    terms: Terms
    paths: int = 3
    counts_from_ack: bool = False
    has_cas: bool = True
    has_timer: bool = True
    waits: bool = True
    listens: bool = True  # the gateway that takes over sends nothing during the guard time
    lateness: int = 0  # delay of the kernel's timer, in ticks

    def path_steps(self, path: PathState) -> Iterator[PathState]:
        """Yield all possible next states of one lease record."""
        if path.request is None and path.ack is None:
            yield path._replace(request=0)
        if path.ack is not None:
            yield path._replace(ack=None, renewed=0 if self.counts_from_ack else path.ack)
            yield path._replace(ack=None)  # the acknowledgement is lost
        if path.request is not None:
            yield path._replace(request=None)  # the renewal is lost, or refused because the record was ended
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
        """Return the state of a lease record one tick later."""

        def older(age: int | None, most: int) -> int | None:
            return None if age is None else min(age + 1, most)

        terms = self.terms
        oldest = terms.lease + terms.guard // 2 + self.lateness + 1  # all greater ages have the same effect
        return path._replace(
            request=older(path.request, oldest),
            ack=older(path.ack, oldest),
            renewed=older(path.renewed, oldest),
            seen=path.seen and (path.seen[0], min(path.seen[1] + 1, terms.lease)),
            ended=older(path.ended, terms.guard),
        )

    def normal(self, path: PathState) -> PathState:
        """Return a representative of all states with the same future."""
        if not self.has_cas:
            return path
        # an outdated reading counts as none, because the server would refuse a write that is based on it
        seen = path.seen if path.seen and path.seen[0] else None
        request = path.request if path.ended is None else None
        return path._replace(seen=seen, request=request, ending=path.ending or None)

    def deadline(self, renewed: Iterable[int | None]) -> int:
        """Return until when the holder may send, relative to now. `renewed` has the ages of its renewals."""
        sent = [None if age is None else -age for age in renewed]
        return lease_rules.deadline(sent, self.terms)

    def search(self, most: int | None = None) -> tuple[int, tuple[PathState, ...] | None]:
        """Try all orders of steps until two masters could write.

        Return the number of reachable states, and a state with two masters (or None). A state has a flag and
        its sorted lease records. The flag is True after the holder has checked the clock and before it
        writes. States in which the holder is dead are left out.
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
            # the master, which has checked the clock, sends a request to a drive
            yield (False, *numbers)
        elif lease_rules.may_send(0, table.deadline(numbers)):
            yield (True, *numbers)
        for place, number in enumerate(numbers):
            if number in numbers[:place]:
                continue  # a lease record in the same state was already handled
            others = numbers[:place] + numbers[place + 1 :]
            for after in table.steps[number]:
                yield (has_looked, *sorted([*others, after]))

    def is_killed(self, table: _PathTable, numbers: list[int]) -> bool:
        return self.has_timer and killed_at(table.deadline(numbers), self.terms) + self.lateness < 0


class _PathTable:
    """Numbers all states that a lease record may have, and stores the possible next states of each."""

    def __init__(self, model: LeaseModel) -> None:
        self.paths: list[PathState] = []
        self._numbers: dict[PathState, int] = {}
        self._model = model
        self.steps: list[list[int]] = []
        self.later: list[int] = []
        # deadlines by the ages of the newest renewals
        self._deadlines: dict[tuple[int | None, ...], int] = {}
        self.number(PathState())
        for path in self.paths:  # the loop itself makes this list longer
            after = {self.number(following) for following in model.path_steps(path)}
            self.steps.append(sorted(after - {self.number(path)}))
            self.later.append(self.number(model.grown_older(path)))

    def deadline(self, numbers: list[int]) -> int:
        """Return until when the holder may send. `numbers` are the numbers of its lease records' states."""
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

LEASE_MUTATIONS = {
    "deadline from the acknowledgement": LeaseModel(SMALL, counts_from_ack=True),
    "takeover without CAS": LeaseModel(ONE_PATH, paths=1, has_cas=False),
    "no timer": LeaseModel(SMALL, has_timer=False),
    "no wait": LeaseModel(SMALL, waits=False),
    "no guard": LeaseModel(SMALL, listens=False),
    "guard shorter than the timer's lateness": LeaseModel(SMALL, lateness=3),
    "needs 1, ends 2": LeaseModel(SMALL._replace(needed=1)),
    "needs 2, ends 1": LeaseModel(SMALL._replace(ended=1)),
}


@pytest.mark.parametrize(
    ("terms", "least"),
    [
        pytest.param(SMALL, 100_000, marks=pytest.mark.long),
        pytest.param(WHOLE, 500_000, marks=pytest.mark.nightly),
    ],
)
def test_no_order_of_renewals_and_takeovers_gives_two_masters(terms: Terms, least: int) -> None:
    states, wrong = LeaseModel(terms).search()
    assert wrong is None
    assert states > least


LARGE = ("deadline from the acknowledgement", "guard shorter than the timer's lateness", "needs 1, ends 2")


@pytest.mark.slow
@pytest.mark.parametrize(
    "mutation",
    [pytest.param(name, marks=pytest.mark.long if name in LARGE else ()) for name in LEASE_MUTATIONS],
)
def test_the_state_model_finds_two_masters_if_a_lease_rule_is_changed(mutation: str) -> None:
    _, wrong = LEASE_MUTATIONS[mutation].search(most=500_000)
    assert wrong is not None


def test_the_default_lease_terms_allow_only_one_master() -> None:
    """Two quorums always share a lease record, and the kernel kills the holder before the guard time ends."""
    terms = Terms()
    assert terms.needed + terms.ended > len(names.LEASES)
    assert killed_at(0, terms) < terms.guard
