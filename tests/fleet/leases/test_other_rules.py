"""Gateways with an incompatible ownership protocol: which they are, and when they are gone."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from fleets import HandClock, MemoryBucket, RecordingMastership

from multidrop.fleet.leases import rules as lease_rules
from multidrop.fleet.leases.lease import Lease
from multidrop.fleet.leases.member import OtherRules
from multidrop.fleet.leases.observer import Observer
from multidrop.fleet.leases.rules import RULES, USUAL

SENTENCE = "incompatible version of multidrop in this fleet: no line is taken until {} is stopped"


class Story:
    """A gateway called "me" that watches others, whose sessions are in memory."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = HandClock()
        self.buckets: list[Any] = [MemoryBucket(f"lease_{path}") for path in range(3)]
        self.observer = Observer("me", self.buckets, USUAL, self.clock)
        self.other_rules = OtherRules("me", self.observer)
        self._monkeypatch = monkeypatch

    def begin(self, name: str, rules: int) -> Lease:
        """Start the session of a gateway with these rules."""
        lease = Lease(name, self.buckets, RecordingMastership(self.clock), clock=self.clock)
        with self._monkeypatch.context() as patch:
            patch.setattr(lease_rules, "RULES", rules)
            assert asyncio.run(lease.try_to_begin())
        return lease

    @property
    def trouble(self) -> str:
        """Return the sentence after a read of all paths."""
        for path in range(3):
            asyncio.run(self.observer.look(path))
        self.other_rules.look(self.observer.sessions())
        return self.other_rules.trouble


@pytest.fixture
def story(monkeypatch: pytest.MonkeyPatch) -> Story:
    return Story(monkeypatch)


def test_an_incompatible_gateway_is_named_until_it_ends(story: Story) -> None:
    story.begin("alike", RULES)
    older, newer = story.begin("older", RULES - 1), story.begin("newer", RULES + 1)
    assert story.trouble == SENTENCE.format("newer, older")
    asyncio.run(newer.end())
    assert story.trouble == SENTENCE.format("older")
    asyncio.run(older.end())
    assert story.trouble == ""


def test_a_record_without_a_version_is_incompatible(story: Story) -> None:
    story.begin("first", RULES)
    for bucket in story.buckets:
        bucket.store(
            "first", {key: one for key, one in bucket.records["first"].value.items() if key != "rules"}
        )
    assert story.trouble == SENTENCE.format("first")


def test_a_killed_gateway_is_waited_for_at_most_its_lease(story: Story) -> None:
    story.begin("older", RULES - 1)
    assert story.trouble
    story.clock.now += USUAL.lease - 1
    assert story.trouble
    story.clock.now += 1
    assert story.trouble == ""


def test_our_own_earlier_session_is_not_an_incompatible_gateway(story: Story) -> None:
    story.begin("me", RULES - 1)
    assert story.trouble == ""
