"""Gateways with an incompatible ownership protocol: which they are, and when they no longer count."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from fleets import HandClock, MemoryBucket, RecordingMastership

from multidrop.fleet.leases import rules as lease_rules
from multidrop.fleet.leases.lease import Lease
from multidrop.fleet.leases.member import IncompatibleGateways
from multidrop.fleet.leases.observer import Observer
from multidrop.fleet.leases.rules import RULES, USUAL

SENTENCE = "incompatible version of multidrop in this fleet: no line is taken until {} is stopped"


class Trial:
    """A gateway called "me" that watches other gateways, whose sessions are in memory."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = HandClock()
        self.buckets: list[Any] = [MemoryBucket(f"lease_{path}") for path in range(3)]
        self.observer = Observer("me", self.buckets, USUAL, self.clock)
        self.incompatible = IncompatibleGateways("me", self.observer)
        self._monkeypatch = monkeypatch

    def begin(self, name: str, rules: int) -> Lease:
        """Start a session of a gateway with this version of the rules."""
        lease = Lease(name, self.buckets, RecordingMastership(self.clock), clock=self.clock)
        with self._monkeypatch.context() as patch:
            patch.setattr(lease_rules, "RULES", rules)
            assert asyncio.run(lease.try_to_begin())
        return lease

    @property
    def trouble(self) -> str:
        """Read all paths, and return the sentence about incompatible gateways."""
        for path in range(3):
            asyncio.run(self.observer.look(path))
        self.incompatible.look(self.observer.sessions())
        return self.incompatible.trouble


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch) -> Trial:
    return Trial(monkeypatch)


def test_an_incompatible_gateway_is_named_until_it_ends(trial: Trial) -> None:
    trial.begin("alike", RULES)
    older, newer = trial.begin("older", RULES - 1), trial.begin("newer", RULES + 1)
    assert trial.trouble == SENTENCE.format("newer, older")
    asyncio.run(newer.end())
    assert trial.trouble == SENTENCE.format("older")
    asyncio.run(older.end())
    assert trial.trouble == ""


def test_a_record_without_a_rules_version_is_incompatible(trial: Trial) -> None:
    trial.begin("first", RULES)
    for bucket in trial.buckets:
        bucket.store(
            "first", {key: one for key, one in bucket.records["first"].value.items() if key != "rules"}
        )
    assert trial.trouble == SENTENCE.format("first")


def test_a_killed_incompatible_gateway_counts_for_at_most_its_lease(trial: Trial) -> None:
    trial.begin("older", RULES - 1)
    assert trial.trouble
    trial.clock.now += USUAL.lease - 1
    assert trial.trouble
    trial.clock.now += 1
    assert trial.trouble == ""


def test_our_own_earlier_session_is_never_incompatible(trial: Trial) -> None:
    trial.begin("me", RULES - 1)
    assert trial.trouble == ""
