"""Offers: commands that a gateway has checked, and carries out if their sender confirms within a second.

A gateway offers commands only for its HeldLines: the lines that it polls, until it hands them over. Each
offer is carried out at most once. Offers are kept only in memory, so a restarted gateway never carries out an
offer that it made before the restart.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any, NamedTuple

from multidrop import Bus, Drive, WriteForbidden
from multidrop.control import CommandOutcome, CommandResult
from multidrop.control.commands import carry_out_verb, stop_drive, typed_value, write_register
from multidrop.drive import verb_arguments, verbs_of
from multidrop.fleet.commands.messages import CommandAnswer, CommandRequest
from multidrop.fleet.lines.rules import SECOND

LIMIT_NS = 1 * SECOND  # time limit from the check of a command until its first frame is sent
REMEMBERED = 10_000  # limit of remembered commands; the oldest are forgotten
LISTS = ("write", "verbs")  # the two lists in the plant file's table [fleet.may]
_MOVING = ("start", "jog", "reset_fault", "set_frequency")


# ---- lines ----


class HeldLine:
    """A line that this gateway polls. `number` is new each time this gateway becomes the line's master."""

    _numbers = count(1)

    def __init__(self, name: str, bus: Bus, may: Mapping[str, frozenset[str]]) -> None:
        self.number = next(self._numbers)
        self.is_leaving = False
        self.name = name
        self.bus = bus
        self.may = may

    @property
    def drives(self) -> dict[str, Drive]:
        return {drive.name: drive for drive in self.bus.drives}

    def drive(self, name: str) -> Drive:
        """Return the drive of this name. Raises ValueError if the line has no such drive."""
        drives = self.drives
        if name not in drives:
            raise ValueError(f"line {self.name} has no drive {name!r}; it has {', '.join(drives) or 'none'}")
        return drives[name]


class HeldLines:
    """The lines for which this gateway accepts commands and stops.

    `bus` returns the bus of a polled line. `may_stop` returns True while this gateway is the line's master.
    `may_command` returns True once no frame of the previous master can still be on the line. A stop that
    collides with such a frame is repeated, but a command would be lost.
    """

    def __init__(
        self,
        bus: Callable[[str], Bus],
        *,
        may_command: Callable[[str], bool],
        may_stop: Callable[[str], bool],
    ) -> None:
        self._bus = bus
        self._may_command = may_command
        self._may_stop = may_stop
        self._held: dict[str, HeldLine] = {}

    def open(self, line: str, description: Mapping[str, Any]) -> None:
        """Accept commands and stops for a line from now on."""
        self._held[line] = HeldLine(line, self._bus(line), _lists_of(description))

    def leave(self, line: str) -> None:
        """Accept only stops for the line from now on."""
        if held := self._held.get(line):
            held.is_leaving = True

    def shut(self, line: str) -> None:
        """Accept neither commands nor stops for the line from now on."""
        self._held.pop(line, None)

    def for_command(self, line: str) -> HeldLine | None:
        """Return the line if a command may be sent on it now, else None."""
        held = self._held.get(line)
        return held if held and not held.is_leaving and self._may_command(line) else None

    def for_stop(self, line: str) -> HeldLine | None:
        """Return the line if a stop may be sent on it now, else None."""
        return self._held.get(line) if self._may_stop(line) else None


def _lists_of(description: Mapping[str, Any]) -> dict[str, frozenset[str]]:
    """Return the registers and verbs that a line's record allows; an invalid list counts as empty."""
    may = description.get("may")
    given = may if isinstance(may, dict) else {}
    return {key: _entries(given.get(key)) for key in LISTS}


def _entries(given: object) -> frozenset[str]:
    return frozenset(one for one in given if isinstance(one, str)) if isinstance(given, list) else frozenset()


# ---- checking a request ----


class Prepared(NamedTuple):
    """A checked command: `text` describes it for users, `work` carries it out."""

    text: str
    work: Callable[[], CommandResult]


def prepare(drive: Drive, request: CommandRequest) -> Prepared:
    """Check a request, and return its command without sending it.

    Raises ValueError, TypeError or Unsupported if the command must not be sent. WriteForbidden is a
    ValueError.
    """
    return _prepare_write(drive, request) if request.register else _prepare_verb(drive, request)


def _prepare_verb(drive: Drive, request: CommandRequest) -> Prepared:
    verb = request.verb
    known = [one for one in verbs_of(drive) if one != "stop"]  # stops are sent without a check
    if verb not in known:
        raise ValueError(f"{drive.name} has no verb {verb!r}; it has {', '.join(known) or 'none'}")
    arguments = verb_arguments(verb, request.options)
    if verb in _MOVING:
        drive.check_confirmed(verb)
    # the script's first step raises an error if the drive's family does not allow the verb
    next(getattr(drive, verb).script(**arguments), None)
    options = "".join(f", {name} = {getattr(value, 'value', value)}" for name, value in arguments.items())
    text = f"{drive.name}: {verb}{options}"
    if verb not in _MOVING:
        return Prepared(text, lambda: stop_drive(drive, None, verb)[drive.name])
    return Prepared(text, partial(carry_out_verb, drive, verb, arguments))


def _prepare_write(drive: Drive, request: CommandRequest) -> Prepared:
    register = drive.register(request.register)
    if not register.writable:
        why = register.never or "the register can only be read"
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
        """Return the offer of a checked command. A copy of a command's message gets the same offer."""
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
        """Mark a command as confirmed; return True only at the first call, so that it is sent once."""
        is_first = not offer.is_taken
        offer.is_taken = True
        return is_first

    def left_ns(self, offer: Offer) -> int:
        """Return how many ns remain for sending the command; 0 or less if it is too late."""
        return offer.made_ns + LIMIT_NS - self._clock()

    def why_late(self, offer: Offer) -> str:
        """Return why it is too late to send an offered command; "" if it may still be sent."""
        left = self.left_ns(offer)
        if left > 0:
            return ""
        age_s = (LIMIT_NS - left) / SECOND
        return f"the command was checked {age_s:.1f} s ago, and the limit is {LIMIT_NS / SECOND:g} s"

    def void(self, line: str, drives: Collection[str] | None, why: str) -> None:
        """Cancel the offered commands for these drives of a line, or for all its drives if `drives` is None.

        Commands that have ended keep their result.
        """
        for offer in self._by_token.values():
            is_one = offer.held.name == line and (drives is None or offer.request.drive in drives)
            if is_one and offer.answer is None:
                offer.why_void = offer.why_void or why

    def withdraw(self, offer: Offer, why: str) -> None:
        """Cancel a command that waits for confirmation, unless it has started already."""
        if self.take(offer):
            self.end(
                offer, CommandAnswer(CommandOutcome.NOT_SENT, f"{offer.request.words} was not sent: {why}")
            )

    def end(self, offer: Offer, answer: CommandAnswer) -> None:
        """Set the result of an offered command. Copies of its message get this result too."""
        offer.answer = answer
        offer.has_ended.set()
