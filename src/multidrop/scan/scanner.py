"""The scan itself: sweeps one after another, and what the answers say.

The line is an argument, and no clock is read: times are in what became of the exchanges.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

from multidrop.core import (
    Completion,
    Exchange,
    Failure,
    Framing,
    Message,
    Peer,
    build_request,
    parse_reply,
    reply_length,
)
from multidrop.drive.family import Drive
from multidrop.errors import LineError
from multidrop.scan.probe import MOST_TIMEOUT, TRIES, Probe
from multidrop.scan.results import Crowd, Finding, Noise, Progress, Untried
from multidrop.scan.sweep import Sweep

NOISY = 1 / 3  # of a sweep's addresses: if more bring garbage, it is no drives' doing
LEAST_NOISY = 4  # such addresses
BEGUN = 2  # characters: by then a reply that comes in time can be seen to come
LATE = 8  # addresses back: so many time-outs an answer may be late and still be recognised


class CarryOut(Protocol):
    """What the scan needs of a line: raises LineError."""

    def __call__(self, exchange: Exchange, /, *, not_before_ns: int = 0) -> Completion: ...


def scan(carry_out: CarryOut, sweeps: Sequence[Sweep], families: Sequence[type[Drive]]) -> Iterator[Finding]:
    """Ask what the sweeps say, and tell what is found as soon as it is, and progress in between.

    Time-outs grow with the response delays that are seen. Raises LineError when the port is lost,
    or takes no setting at all.
    """
    yield from _Scan(carry_out, families).run(sweeps)


class _Scan:
    def __init__(self, carry_out: CarryOut, families: Sequence[type[Drive]]) -> None:
        self._carry_out = carry_out
        self._families = families
        self._peers: list[Peer] = []  # the line holds on to them
        self._found: set[tuple[int, Framing, int]] = set()
        self._told: set[tuple[int, Framing, int]] = set()  # crowds
        self._excess = 0.0  # s that answers took longer than is usual in their families
        self._refusals: list[LineError] = []

    def run(self, sweeps: Sequence[Sweep]) -> Iterator[Finding]:
        for number, sweep in enumerate(sweeps, 1):
            left = sum(self._learned(it).needed for it in sweeps[number:])
            yield from self._sweep(self._learned(sweep), left)
        if len(self._refusals) == len(sweeps):
            raise self._refusals[-1]

    def _learned(self, sweep: Sweep) -> Sweep:
        """With more patience where an adapter or a long way has been seen to take its time."""
        return replace(sweep, patience=sweep.patience + min(2 * self._excess, MOST_TIMEOUT))

    # ---- one sweep ----

    def _sweep(self, sweep: Sweep, left_after: float) -> Iterator[Finding]:
        addresses = [it for it in sweep.addresses if _key(sweep, it) not in self._found]
        garbled: list[int] = []
        listeners: dict[int, Peer] = {}
        for number, address in enumerate(addresses, 1):
            listeners[address] = self._listener(sweep)
            try:
                completion = self.ask(sweep, sweep.question.to(address), listeners[address])
            except LineError as refusal:
                if number > 1:
                    raise
                self._refusals.append(refusal)
                yield Untried(sweep.settings, sweep.framing, refusal.reason)
                return
            came = completion.result != Failure.NO_REPLY
            earlier = addresses[max(0, number - 1 - LATE) : number - 1]
            late = [it for it in earlier if it in listeners and listeners[it].late]
            for suspect in late:  # the core knew its answer as a late one
                del listeners[suspect]
            late += _late(sweep, earlier, completion)
            for suspect in late + [address] * came:
                closer = Probe(self, sweep, suspect)
                if closer.answers and _key(sweep, suspect) not in self._found:
                    self._found.add(_key(sweep, suspect))
                    yield closer.found(self._families)
                    self._excess = max(self._excess, closer.excess)
                elif not closer.answers and closer.damaged == TRIES:
                    garbled.append(suspect)
            left = left_after + (len(addresses) - number) * sweep.each
            yield Progress(sweep.settings, sweep.framing, address, left)
        yield from self._explain(sweep, garbled, len(addresses))

    def _explain(self, sweep: Sweep, garbled: list[int], asked: int) -> Iterator[Finding]:
        if len(garbled) >= LEAST_NOISY and len(garbled) > NOISY * asked:
            yield Noise(sweep.settings, sweep.framing, len(garbled), asked)
            return
        for address in garbled:
            if _key(sweep, address) not in self._told:
                self._told.add(_key(sweep, address))
                yield Crowd(address, sweep.settings, sweep.framing)

    # ---- exchanges ----

    def ask(self, sweep: Sweep, request: Message, peer: Peer) -> Completion:
        """One exchange; what only echoes the request is no reply."""
        completion = self._once(sweep, sweep.framing, request, peer)
        if completion.raw == build_request(sweep.framing, request):
            # Where a reply may be a copy of its request, the core learns of an echo from another framing.
            other = Framing.ASCII if sweep.framing is Framing.RTU else Framing.RTU
            self._once(sweep, other, Message(request.address, 0x03, 0, 1), self._listener(sweep))
            completion = self._once(sweep, sweep.framing, request, peer)
            if completion.raw == build_request(sweep.framing, request):
                return replace(completion, result=Failure.NO_REPLY, raw=b"")
        return completion

    def _once(self, sweep: Sweep, framing: Framing, request: Message, peer: Peer) -> Completion:
        settings = sweep.settings
        exchange = Exchange(
            framing,
            request,
            peer,
            baudrate=settings.baudrate,
            format=settings.format,
            character=settings.character,
            silence=sweep.silence,
        )
        completion = self._carry_out(exchange)
        if completion.result == Failure.LATE_ANSWER_DUE:
            completion = self._carry_out(exchange, not_before_ns=peer.late_until_ns)
        return completion

    def _listener(self, sweep: Sweep) -> Peer:
        """Who waits for the beginning of a reply only: what then goes on to come is looked at closer."""
        settings = sweep.settings
        length = reply_length(sweep.framing, sweep.question.to(sweep.addresses[0]))
        window = sweep.patience + (BEGUN - length) * settings.character
        return self.peer(max(window, settings.character), max(window, settings.character))

    def peer(self, least: float, most: float) -> Peer:
        self._peers.append(Peer(least_timeout=least, most_timeout=most))
        return self._peers[-1]


def _key(sweep: Sweep, address: int) -> tuple[int, Framing, int]:
    """Formats often hear each other: who was found in one is not looked for in the next."""
    return address, sweep.framing, sweep.settings.baudrate


def _late(sweep: Sweep, earlier: Sequence[int], completion: Completion) -> list[int]:
    """Whose answer came after its time-out, in the place of another's."""
    if completion.result > 0 or not completion.raw:
        return []
    found = []
    for address in earlier:
        request = sweep.question.to(address)
        frame = build_request(sweep.framing, request)
        for at in range(len(completion.raw)):
            used, _ = parse_reply(sweep.framing, completion.raw[at:], request)
            if used > 0 and completion.raw[at : at + used] != frame:
                found.append(address)
                break
    return found
