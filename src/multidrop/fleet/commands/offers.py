"""Offers: what a line's master may be told to do, each once, within a second. In memory alone. Pure.

A restarted gateway knows none of its predecessor's, so nothing that was offered before is ever carried out.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from multidrop.fleet.commands.drive_commands import Prepared
from multidrop.fleet.commands.words import CommandAnswer, CommandOutcome, CommandRequest
from multidrop.fleet.leases.rules import SECOND
from multidrop.fleet.lines.held_lines import HeldLine

LIMIT_NS = 1 * SECOND  # from the offer until what it says may be sent
REMEMBERED = 10_000  # offers, of which the oldest are forgotten


@dataclass(eq=False)
class Offer:
    """One command that was offered for a line that was held then.

    `is_taken` once it was told to be done; `answer` once it is over, and then `over` is set.
    """

    token: str
    request: CommandRequest
    prepared: Prepared
    held: HeldLine
    made_ns: int
    is_taken: bool = False
    why_void: str = ""
    answer: CommandAnswer | None = None
    over: asyncio.Event = field(default_factory=asyncio.Event)

    def unsent(self, why: str) -> CommandAnswer:
        """Return the answer that it was not sent, for certain."""
        return CommandAnswer(CommandOutcome.NOT_SENT, f"{self.prepared.text} was not sent: {why}")


class Offers:
    """The offers of one run of a gateway; `clock` is its CLOCK_BOOTTIME in ns."""

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._by_token: dict[str, Offer] = {}
        self._by_request: dict[tuple[str, str], Offer] = {}

    def __len__(self) -> int:
        return len(self._by_token)

    def make(self, request: CommandRequest, prepared: Prepared, held: HeldLine) -> Offer:
        """Return a new offer, or for a copy of a request the one that was made for it."""
        known = self._by_request.get((held.name, request.id))
        if known is not None and known.request == request:
            return known
        offer = Offer(secrets.token_urlsafe(16), request, prepared, held, self._clock())
        self._by_token[offer.token] = self._by_request[held.name, request.id] = offer
        while len(self._by_token) > REMEMBERED:
            oldest = self._by_token.pop(next(iter(self._by_token)))
            self._by_request.pop((oldest.held.name, oldest.request.id), None)
        return offer

    def find(self, token: str) -> Offer | None:
        return self._by_token.get(token)

    def take(self, offer: Offer) -> bool:
        """Return True for the first who takes it, and who alone carries it out."""
        is_first = not offer.is_taken
        offer.is_taken = True
        return is_first

    def left_ns(self, offer: Offer) -> int:
        """Return for how long it may still be sent; 0 or less: not any more."""
        return offer.made_ns + LIMIT_NS - self._clock()

    def why_late(self, offer: Offer) -> str:
        """Return why it is too late for an offer, or an empty text."""
        left = self.left_ns(offer)
        if left > 0:
            return ""
        age_s = (LIMIT_NS - left) / SECOND
        return f"{age_s:.1f} s have passed since the offer, and {LIMIT_NS / SECOND:g} s is allowed"

    def void(self, line: str, drives: Collection[str] | None, why: str) -> None:
        """End what was offered for these drives of a line, or all with None, and was not sent yet."""
        for offer in self._by_token.values():
            is_one = offer.held.name == line and (drives is None or offer.request.drive in drives)
            if is_one and offer.answer is None:
                offer.why_void = offer.why_void or why

    def take_back(self, offer: Offer, why: str) -> None:
        """End an offer that nobody has taken: it will not be carried out."""
        if self.take(offer):
            self.end(
                offer, CommandAnswer(CommandOutcome.NOT_SENT, f"{offer.request.words} was not sent: {why}")
            )

    def end(self, offer: Offer, answer: CommandAnswer) -> None:
        """Note what became of it; copies of the message get the same answer from now on."""
        offer.answer = answer
        offer.over.set()
