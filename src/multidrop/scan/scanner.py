"""Scan a serial line: carry out sweeps one after another, and find drives by their replies.

The caller passes the function that carries out exchanges. This module reads no clock: times come from
the completions of exchanges.
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
    find_replies,
    reply_length,
)
from multidrop.drive.family import Drive
from multidrop.errors import LineError
from multidrop.scan.identify import MOST_TIMEOUT, SILENT, TRIES, Probe, is_whole
from multidrop.scan.results import Crowd, Finding, Noise, Progress, Untried
from multidrop.scan.sweep import Sweep

NOISY = 1 / 3  # invalid bytes count as noise if more than this share of a sweep's addresses has them
LEAST_NOISY = 4  # if fewer addresses than this have invalid bytes, the bytes never count as noise
BEGUN = 2  # number of received characters after which a reply counts as started
LATE = 8  # for this many later requests, a late reply is still matched to its request


class CarryOut(Protocol):
    """A function that carries out an exchange on the line. Raises LineError."""

    def __call__(self, exchange: Exchange, /, *, not_before_ns: int = 0) -> Completion: ...


def scan(carry_out: CarryOut, sweeps: Sequence[Sweep], families: Sequence[type[Drive]]) -> Iterator[Finding]:
    """Carry out the sweeps; yield findings as soon as they are made, and progress in between.

    Timeouts grow with the measured response delays. Raises LineError if the port is lost or supports none of
    the settings.
    """
    yield from _Scan(carry_out, families).run(sweeps)


class _Scan:
    def __init__(self, carry_out: CarryOut, families: Sequence[type[Drive]]) -> None:
        self._carry_out = carry_out
        self._families = families
        self._peers: list[Peer] = []  # keeps the peers alive while the C core uses them
        self._found: set[tuple[int, Framing, int]] = set()
        self._crowded: set[tuple[int, Framing, int]] = set()
        # the largest excess, in s, of a drive's response delay over its family's usual delay
        self._excess = 0.0
        self._refusals: list[LineError] = []

    def run(self, sweeps: Sequence[Sweep]) -> Iterator[Finding]:
        for number, sweep in enumerate(sweeps, 1):
            left = sum(self._learned(later).needed for later in sweeps[number:])
            yield from self._sweep(self._learned(sweep), left)
        if len(self._refusals) == len(sweeps):
            raise self._refusals[-1]

    def _learned(self, sweep: Sweep) -> Sweep:
        """Return the sweep, with a longer timeout if the adapter or network has delayed earlier replies."""
        return replace(sweep, patience=sweep.patience + min(2 * self._excess, MOST_TIMEOUT))

    def _sweep(self, sweep: Sweep, left_after: float) -> Iterator[Finding]:
        addresses = [address for address in sweep.addresses if _key(sweep, address) not in self._found]
        # Maps an address with invalid replies to a whole frame that did not match the request, with the
        # reason; to "" if no frame was whole.
        garbled: dict[int, str] = {}
        peers: dict[int, Peer] = {}
        for number, address in enumerate(addresses, 1):
            peers[address] = self._sweep_peer(sweep)
            try:
                completion = self.ask(sweep, sweep.request.to(address), peers[address])
            except LineError as refusal:
                if number > 1:
                    raise
                self._refusals.append(refusal)
                yield Untried(sweep.settings, sweep.framing, refusal.reason)
                return
            came = completion.result not in SILENT
            earlier = addresses[max(0, number - 1 - LATE) : number - 1]
            late = [before for before in earlier if before in peers and peers[before].late]
            for suspect in late:  # the C core has matched a late reply to this address
                del peers[suspect]
            late += _late(sweep, earlier, completion)
            for suspect in late + [address] * came:
                probe = Probe(self, sweep, suspect)
                if probe.answers and _key(sweep, suspect) not in self._found:
                    self._found.add(_key(sweep, suspect))
                    yield probe.found(self._families)
                    self._excess = max(self._excess, probe.excess)
                elif not probe.answers and probe.damaged == TRIES:
                    garbled[suspect] = probe.whole_frame
            left = left_after + (len(addresses) - number) * sweep.each
            yield Progress(sweep.settings, sweep.framing, address, left)
        yield from self._explain(sweep, garbled, len(addresses))

    def _explain(self, sweep: Sweep, garbled: dict[int, str], asked: int) -> Iterator[Finding]:
        if len(garbled) >= LEAST_NOISY and len(garbled) > NOISY * asked:
            yield Noise(sweep.settings, sweep.framing, len(garbled), asked)
            return
        for address, whole_frame in garbled.items():
            if _key(sweep, address) not in self._crowded:
                self._crowded.add(_key(sweep, address))
                yield Crowd(address, sweep.settings, sweep.framing, whole_frame)

    def ask(self, sweep: Sweep, request: Message, peer: Peer, not_before_ns: int = 0) -> Completion:
        """Carry out an exchange; return its completion. An echo of the request does not count as a reply."""
        completion = self._once(sweep, sweep.framing, request, peer, not_before_ns)
        if sweep.framing is not Framing.TCP and completion.raw == build_request(sweep.framing, request):
            # A valid reply may equal this request. A request in another framing, which drives ignore, shows
            # whether the adapter echoes.
            other = Framing.ASCII if sweep.framing is Framing.RTU else Framing.RTU
            self._once(sweep, other, Message(request.address, 0x03, 0, 1), self._sweep_peer(sweep))
            completion = self._once(sweep, sweep.framing, request, peer)
            if completion.raw == build_request(sweep.framing, request):
                return completion.unanswered()
        return completion

    def _once(
        self, sweep: Sweep, framing: Framing, request: Message, peer: Peer, not_before_ns: int = 0
    ) -> Completion:
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
        completion = self._carry_out(exchange, not_before_ns=not_before_ns)
        if completion.result == Failure.LATE_ANSWER_DUE:
            completion = self._carry_out(exchange, not_before_ns=max(not_before_ns, peer.late_until_ns))
        return completion

    def _sweep_peer(self, sweep: Sweep) -> Peer:
        """Return a peer with a timeout that is too short for a whole reply, but not for its first characters.

        These suffice to find an address that answers. The scan then repeats the request with more time.
        """
        settings = sweep.settings
        length = reply_length(sweep.framing, sweep.request.to(sweep.addresses[0]))
        window = sweep.patience + (BEGUN - length) * settings.character
        timeout = max(window, settings.character)
        return self.peer(timeout, timeout)

    def peer(self, least: float, most: float) -> Peer:
        self._peers.append(Peer(least_timeout=least, most_timeout=most))
        return self._peers[-1]


def _key(sweep: Sweep, address: int) -> tuple[int, Framing, int]:
    """Return the key by which the scan recognises a drive.

    It lacks the serial format, so that a drive that answers in several formats is reported once.
    """
    return address, sweep.framing, sweep.settings.baudrate


def _late(sweep: Sweep, earlier: Sequence[int], completion: Completion) -> list[int]:
    """Return the `earlier` addresses whose late replies came during this exchange."""
    if completion.result > 0 or not completion.raw:
        return []
    found = []
    for address in earlier:
        request = sweep.request.to(address)
        replies = find_replies(sweep.framing, completion.raw, request)
        is_its_own = sweep.framing is Framing.RTU and completion.raw[0] == address
        if any(reply != build_request(sweep.framing, request) for reply in replies) or (
            is_its_own and is_whole(Framing.RTU, completion.raw)
        ):
            found.append(address)
    return found
