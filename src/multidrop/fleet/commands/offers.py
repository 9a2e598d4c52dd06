"""Offers: commands that a gateway has checked, and carries out if their sender confirms within a second.

Each offer is carried out at most once. Offers are kept only in memory, so a restarted gateway never carries
out an offer that it made before the restart.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

from multidrop import Drive, WriteForbidden
from multidrop.control import CommandOutcome, CommandResult
from multidrop.control.commands import carry_out_verb, stop_drive_by, typed_value, write_register
from multidrop.drive import verb_arguments, verbs_of
from multidrop.fleet.commands.held_lines import HeldLine
from multidrop.fleet.commands.messages import CommandAnswer, CommandRequest
from multidrop.fleet.lines.rules import SECOND

LIMIT_NS = 1 * SECOND  # time limit from the offer until the command's first frame is sent
REMEMBERED = 10_000  # limit of remembered offers; the oldest are forgotten
_MOVING = ("start", "jog", "reset_fault", "set_frequency")


# ---- checking a request ----


class Prepared(NamedTuple):
    """A checked command: `text` describes it for users, `work` carries it out."""

    text: str
    work: Callable[[], CommandResult]


def commands_of(drive: Drive) -> list[str]:
    """Return the drive's verbs that can be commanded through the fleet. Stops are sent without an offer."""
    return [verb for verb in verbs_of(drive) if verb != "stop"]


def prepare(drive: Drive, request: CommandRequest) -> Prepared:
    """Check a request, and return its command without sending it.

    Raises ValueError, TypeError or Unsupported if the command must not be sent. WriteForbidden is a
    ValueError.
    """
    return _prepare_write(drive, request) if request.register else _prepare_verb(drive, request)


def _prepare_verb(drive: Drive, request: CommandRequest) -> Prepared:
    verb = request.verb
    if verb not in commands_of(drive):
        known = ", ".join(commands_of(drive)) or "none"
        raise ValueError(f"{drive.name} has no verb {verb!r}; it has {known}")
    arguments = verb_arguments(verb, request.options)
    if verb in _MOVING:
        drive.check_confirmed(verb)
    # the script's first step raises an error if the drive's family does not allow the verb
    next(getattr(drive, verb).script(**arguments), None)
    options = "".join(f", {name} = {getattr(value, 'value', value)}" for name, value in arguments.items())
    text = f"{drive.name}: {verb}{options}"
    if verb not in _MOVING:
        return Prepared(text, lambda: stop_drive_by(verb, drive, None)[drive.name])
    return Prepared(text, partial(carry_out_verb, drive, verb, arguments))


def _prepare_write(drive: Drive, request: CommandRequest) -> Prepared:
    register = drive.register(request.register)
    if not register.writable:
        why = register.never or "it can only be read"
        raise WriteForbidden(f"{request.entry} is never written: {why}", register=register.name)
    value = register.decode(register.encode(typed_value(register, request.value)))
    text = f"{drive.name}: {register.name} = {register.format(value)}"
    return Prepared(text, partial(write_register, drive, register.name, request.value))


# ---- offers ----


@dataclass(eq=False)
class Offer:
    """A command that a gateway has checked and has offered to carry out.

    The client that sent the command confirms it by sending `token` to the gateway; then `is_taken` becomes
    True. When the command has ended, `answer` and the event `has_ended` are set.
    """

    token: str
    request: CommandRequest
    prepared: Prepared
    held: HeldLine
    made_ns: int
    is_taken: bool = False
    why_void: str = ""
    answer: CommandAnswer | None = None
    has_ended: asyncio.Event = field(default_factory=asyncio.Event)

    def unsent(self, why: str) -> CommandAnswer:
        """Return the answer for a command that was certainly not sent."""
        return CommandAnswer(CommandOutcome.NOT_SENT, f"{self.prepared.text} was not sent: {why}")


class Offers:
    """The commands that this process has offered to carry out. `clock` returns CLOCK_BOOTTIME in ns."""

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._by_token: dict[str, Offer] = {}
        self._by_request: dict[tuple[str, str], Offer] = {}

    def __len__(self) -> int:
        return len(self._by_token)

    def make(self, request: CommandRequest, prepared: Prepared, held: HeldLine) -> Offer:
        """Return an offer for a checked request. A copy of a request gets the same offer."""
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
        """Mark the offer as taken; return True only at the first call, so that it is carried out once."""
        is_first = not offer.is_taken
        offer.is_taken = True
        return is_first

    def left_ns(self, offer: Offer) -> int:
        """Return how many ns remain for sending the command; 0 or less if it is too late."""
        return offer.made_ns + LIMIT_NS - self._clock()

    def why_late(self, offer: Offer) -> str:
        """Return why it is too late to carry out an offer; "" if there is time."""
        left = self.left_ns(offer)
        if left > 0:
            return ""
        age_s = (LIMIT_NS - left) / SECOND
        return f"{age_s:.1f} s have passed since the offer, and {LIMIT_NS / SECOND:g} s is allowed"

    def void(self, line: str, drives: Collection[str] | None, why: str) -> None:
        """Cancel the offered commands for these drives of a line, or for all its drives if `drives` is None.

        Commands that have ended keep their result.
        """
        for offer in self._by_token.values():
            is_one = offer.held.name == line and (drives is None or offer.request.drive in drives)
            if is_one and offer.answer is None:
                offer.why_void = offer.why_void or why

    def withdraw(self, offer: Offer, why: str) -> None:
        """Cancel an offer, unless its command has started already."""
        if self.take(offer):
            self.end(
                offer, CommandAnswer(CommandOutcome.NOT_SENT, f"{offer.request.words} was not sent: {why}")
            )

    def end(self, offer: Offer, answer: CommandAnswer) -> None:
        """Set the result of an offered command. Copies of its message get this result too."""
        offer.answer = answer
        offer.has_ended.set()
