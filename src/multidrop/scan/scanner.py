"""Scan a serial line: carry out sweeps one after another, find drives by their replies, and identify them.

The caller passes the function that carries out exchanges. This module reads no clock: times come from the
completions of exchanges. A drive's family is identified by the registers that each family's document
requires; if a family has no `identify` script, by the family's first readings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, Protocol, TypeVar

from multidrop.core import (
    STATUSES,
    Completion,
    Exchange,
    Failure,
    FrameFault,
    Framing,
    Message,
    Peer,
    build_request,
    crc16,
    find_replies,
    reply_length,
)
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.drive.verbs import Read, Script, Step, carry_out
from multidrop.errors import BusError, LineError, NoValue, WriteForbidden
from multidrop.planning.blocks import blocks, text_blocks
from multidrop.scan.findings import GUESS, Crowd, Finding, Found, Noise, Progress, Untried, candidate
from multidrop.scan.sweep import Sweep
from multidrop.transport.drive_records import LEAST_TIMEOUT
from multidrop.transport.exchange import good_reply

R = TypeVar("R")
Ask = Callable[[Drive, Message], Message]  # sends a request; raises BusError unless a valid reply comes

MOST_READINGS = 3  # number of readings that a drive must answer if its family has no `identify` script
# Invalid bytes count as noise if they are received at more than a third of a sweep's addresses, and at least
# at four addresses.
NOISY = 1 / 3
LEAST_NOISY = 4
BEGUN = 2  # number of received characters after which a reply counts as started
LATE = 8  # a late reply is matched to one of this many earlier requests
MOST_TIMEOUT = 1.0  # limit of the timeout in s for an address at which a drive has answered
TRIES = 3
LATE_NS = 500_000_000  # longest wait for late replies, in ns
SHORTEST_REPLY = 5  # size of an exception reply in bytes; fewer bytes are noise

SILENT = (Failure.NO_REPLY, Failure.STALLED)  # results of exchanges in which no byte was received
# results for a frame that answers another request
_MISDIRECTED = (FrameFault.BAD_ADDRESS, FrameFault.BAD_FUNCTION, FrameFault.BAD_LENGTH)


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
        self._peers: list[Peer] = []  # keeps the objects alive while the C core uses them
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
        # Addresses with invalid replies. The text describes a valid frame that answers another request; it is
        # "" if no such frame was received.
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
            for suspect in late:  # an address to which the C core has matched a late reply
                del peers[suspect]
            late += _late(sweep, earlier, completion)
            for suspect in late + [address] * came:
                probe = _Probe(self, sweep, suspect)
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
        """Return a Peer with a timeout that is long enough for the first characters of a reply.

        They suffice to find an address that answers. The scan then repeats the request with more time.
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
    """Return what identifies a found drive: its address, framing and baud rate.

    The format is left out, because a drive may answer in several formats. A drive behind a Modbus TCP gateway
    has no baud rate here, because the scan cannot change it.
    """
    return address, sweep.framing, sweep.settings.baudrate if sweep.framing is not Framing.TCP else 0


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


def is_whole(framing: Framing, received: bytes) -> bool:
    """Return True if the received bytes look like one whole frame. Only for RTU is the checksum checked."""
    if framing is Framing.RTU:
        return len(received) >= SHORTEST_REPLY and crc16(received, len(received)) == 0
    return framing is Framing.TCP or (received[:1] == b":" and received[-2:] == b"\r\n")


# ---- one address ----


class _Probe:
    """Finds out whether one or several drives answer at an address, and their family."""

    def __init__(self, scan: _Scan, sweep: Sweep, address: int) -> None:
        self._scan = scan
        self._sweep = sweep
        self._address = address
        self._peer = scan.peer(LEAST_TIMEOUT, MOST_TIMEOUT)
        self.answers = self.damaged = self.followed = 0
        # a frame with a valid checksum that did not match the request, and why not; "" if there was none
        self.whole_frame = ""
        self.excess = 0.0
        self._answered = False  # whether the last request was answered
        self._has_missed = False  # whether any request was not answered
        self._asked_ns = 0
        for _ in range(TRIES):
            self._ask(sweep.request.to(address))
        self.response_delay = self._peer.response_delay

    def _ask(self, request: Message) -> Completion:
        completion = self._scan.ask(self._sweep, request, self._peer)
        self.followed += self._answered and completion.stale > 0
        self._answered = completion.result > 0
        self.answers += self._answered
        self.damaged += not self._answered and completion.result not in SILENT
        self._has_missed |= not self._answered
        if completion.result in _MISDIRECTED and is_whole(self._sweep.framing, completion.raw):
            self.whole_frame = f"{STATUSES[-completion.result]} (received {completion.raw.hex(' ').upper()})"
        self._asked_ns = completion.begun_ns
        return completion

    def found(self, families: Sequence[type[Drive]]) -> Found:
        """Identify the drive's family, as far as reads show it."""
        # The drive's response delay is known, so a short timeout is enough.
        known = max(LEAST_TIMEOUT, 4 * self.response_delay)
        drives, guess = self._identify(families, LEAST_TIMEOUT, known)
        # after a missed reply, the drive or this computer may be slower than assumed
        if self._has_missed and not self._is_in_step():
            drives, guess = self._identify(families, MOST_TIMEOUT, MOST_TIMEOUT)
        documented = max((drive.response_delay for drive in drives), default=LEAST_TIMEOUT)
        self.excess = self.response_delay - documented
        return Found(
            self._address,
            drives[0].settings if drives else self._sweep.settings,
            self._sweep.framing,
            tuple(drive.model or type(drive).__name__ for drive in drives),
            self.response_delay,
            "; ".join(filter(None, (guess, self._doubt()))),
        )

    def _identify(
        self, families: Sequence[type[Drive]], least_timeout: float, most_timeout: float
    ) -> tuple[list[Drive], str]:
        self._peer = self._scan.peer(least_timeout, most_timeout)
        self._answered = self._has_missed = False
        return identify(self._sweep, self._address, families, self._reply)

    def _is_in_step(self) -> bool:
        """Return False if a reply was late, and was perhaps mistaken for the reply to another request."""
        request, peer = self._sweep.request.to(self._address), self._scan.peer(MOST_TIMEOUT, MOST_TIMEOUT)
        found = self._scan.ask(self._sweep, request, peer, self._asked_ns + LATE_NS)
        return found.result > 0 and found.stale < SHORTEST_REPLY

    def _reply(self, drive: Drive, request: Message) -> Message:
        for _ in range(TRIES):
            completion = self._ask(request)
            if completion.result > 0:
                break
        return good_reply(drive, completion)

    def _doubt(self) -> str:
        if self.damaged:
            asked = self.answers + self.damaged
            return f"{self.damaged} of {asked} replies were damaged: noise, or a second drive at this address"
        if self.followed > 1:
            return "more bytes came after its replies: perhaps a second drive at this address"
        return ""


# ---- the family of a drive that answers ----


def identify(
    sweep: Sweep, address: int, families: Sequence[type[Drive]], ask: Ask
) -> tuple[list[Drive], str]:
    """Return a drive object for each best-fitting family, and a sentence about the remaining doubt or "".

    Several families may fit equally well; the list is empty if none fits.
    """
    found = [candidate(family, sweep.settings, sweep.framing, address) for family in families]
    drives = [drive for drive in found if drive is not None]
    scores: list[tuple[int, Drive]] = []
    for drive in drives:
        with suppress(BusError, ValueError):  # the drive lacks a register of this family
            scores.append((_score(drive, ask), drive))
    if scores:
        best = max(score for score, _ in scores)
        return [drive for score, drive in scores if score == best], ""
    alike = [drive for drive in drives if _resembles(drive, ask)]
    return alike, GUESS if alike else ""


def _score(drive: Drive, ask: Ask) -> int:
    """Return how many identity checks the drive passes. Raises BusError or ValueError if one fails."""
    score = 0
    if type(drive).identify is not Drive.identify:
        _run(drive, drive.identify.script(), ask)
        score += 1
    else:
        for register in drive.readings()[:MOST_READINGS]:
            _read(drive, register, ask)
    setting = drive.registers.get("address_setting")
    if setting is not None and setting.readable:
        try:
            held = _read(drive, setting, ask)
        except BusError:
            return score  # the failure is ignored, because not every firmware has this register
        if held != drive.address:
            raise WriteForbidden(
                f"{drive.name} answers at address {drive.address}, but its address register holds {held:g}"
            )
        score += 1
    return score


def _resembles(drive: Drive, ask: Ask) -> bool:
    with suppress(BusError, ValueError):
        return bool(_run(drive, drive.resembles(), ask))
    return False


def _run(drive: Drive, script: Script[R], ask: Ask) -> R:
    """Run a script that only reads; return its result.

    Raises WriteForbidden if the script's next step is not a read.
    """

    def do(step: Step) -> Any:
        if not isinstance(step, Read):
            raise WriteForbidden(f"`identify` of {drive.title} tried to write, but may only read")
        return _read(drive, step.register, ask)

    return carry_out(script, do)


def _read(drive: Drive, register: Register[Any] | Text, ask: Ask) -> Any:
    if isinstance(register, Text):
        found = text_blocks(drive, register)
        return register.decode(b"".join(ask(drive, block.request).data for block in found))
    (block,) = blocks(drive, [register])
    reply = ask(drive, block.request)
    value = register.value_in(reply.data, block.offset(register))
    if value is None:
        raise NoValue(drive.name, register.name)
    return value
