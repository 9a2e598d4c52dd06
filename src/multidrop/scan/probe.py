"""Probe one address from which bytes came."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from multidrop.core import STATUSES, Completion, Failure, FrameFault, Framing, Message, Peer, crc16
from multidrop.drive.family import Drive
from multidrop.scan.identify import identify
from multidrop.scan.results import Found
from multidrop.scan.sweep import Sweep
from multidrop.transport.peers import LEAST_TIMEOUT
from multidrop.transport.replies import good_reply

MOST_TIMEOUT = 1.0  # s: for a drive of which only the address is known
TRIES = 3
LATE_NS = 500_000_000  # for which late replies are waited for
SHORTEST_REPLY = 5  # bytes, of an exception; less is noise


# Results for frames that answer another request.
_MISDIRECTED = (FrameFault.BAD_ADDRESS, FrameFault.BAD_FUNCTION, FrameFault.BAD_LENGTH)


def is_whole(framing: Framing, received: bytes) -> bool:
    """Tell whether one frame with a good checksum is all that came."""
    if framing is Framing.RTU:
        return len(received) >= SHORTEST_REPLY and crc16(received, len(received)) == 0
    return framing is Framing.TCP or (received[:1] == b":" and received[-2:] == b"\r\n")


class Scan(Protocol):
    """The part of a scan that a probe needs."""

    def ask(self, sweep: Sweep, request: Message, peer: Peer, not_before_ns: int = 0) -> Completion: ...

    def peer(self, least: float, most: float) -> Peer: ...


class Probe:
    """Find out whether a drive answers at an address, which one, and whether it is alone."""

    def __init__(self, scan: Scan, sweep: Sweep, address: int) -> None:
        self._scan = scan
        self._sweep = sweep
        self._address = address
        self._peer = scan.peer(LEAST_TIMEOUT, MOST_TIMEOUT)
        self.answers = self.damaged = self.followed = 0
        self.whole_frame = ""  # why a frame with a good checksum was no reply to the request, and the frame
        self.excess = 0.0
        self._answered = False  # the last request
        self._has_missed = False  # some request
        self._asked_ns = 0
        for _ in range(TRIES):
            self._ask(sweep.request.to(address))
        self.response_delay = self._peer.response_delay

    def _ask(self, request: Message) -> Completion:
        completion = self._scan.ask(self._sweep, request, self._peer)
        self.followed += self._answered and completion.stale > 0
        self._answered = completion.result > 0
        self.answers += self._answered
        self.damaged += not self._answered and completion.result != Failure.NO_REPLY
        self._has_missed |= not self._answered
        if completion.result in _MISDIRECTED and is_whole(self._sweep.framing, completion.raw):
            self.whole_frame = f"{STATUSES[-completion.result]} (received {completion.raw.hex(' ').upper()})"
        self._asked_ns = completion.begun_ns
        return completion

    def found(self, families: Sequence[type[Drive]]) -> Found:
        """Identify the drive, as far as reading can."""
        # Its response delay is known by now: a short time-out shows what it does not answer.
        known = max(LEAST_TIMEOUT, 4 * self.response_delay)
        drives, guess = self._identify(families, LEAST_TIMEOUT, known)
        if self._has_missed and not self._is_in_step():  # it became slower, or this computer did
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
        """Say whether no reply is late: one may have been taken for that to another question."""
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
