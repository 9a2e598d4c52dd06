"""Identify the family of a drive that answers: check the registers that each family's document requires.

Only reads are sent. If a family has no `identify` script, the drive must answer the family's first readings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Protocol, TypeVar

from multidrop.core import STATUSES, Completion, Failure, FrameFault, Framing, Message, Peer, crc16
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import Settings
from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.drive.verbs import Read, Script, Step, carry_out
from multidrop.errors import BusError, NoValue, WriteForbidden
from multidrop.planning.blocks import blocks, text_blocks
from multidrop.scan.results import GUESS, Found
from multidrop.scan.sweep import Sweep
from multidrop.transport.exchange import good_reply
from multidrop.transport.peers import LEAST_TIMEOUT

R = TypeVar("R")
Ask = Callable[[Drive, Message], Message]  # sends a request; raises BusError unless a valid reply comes

MOST_READINGS = 3  # number of readings that a drive must answer if its family has no `identify` script


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


def candidate(family: type[Drive], settings: Settings, framing: Framing, address: int) -> Drive | None:
    """Return a drive object of the family with these settings; None if its manual does not allow them.

    A drive can answer in the sweep's serial format although its own format has other stop bits (on a
    pseudo-terminal: another parity). If the family does not allow the sweep's format, the drive object gets
    the family's usual format.
    """
    if not family.speaks(framing) or address not in family.addresses:
        return None
    if framing is Framing.TCP:  # only the gateway knows the serial settings
        return family(address, framing=framing)
    if settings.baudrate not in family.baudrates:
        return None
    format = settings.format if settings.format in family.formats_in(framing) else None
    return family(address, framing=framing, baudrate=settings.baudrate, format=format)


def _score(drive: Drive, ask: Ask) -> int:
    """Return the number of checks that the drive passes. Raises BusError or ValueError on a misfit."""
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
            raise WriteForbidden(f"the identification of {drive.title} may only read")
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


MOST_TIMEOUT = 1.0  # limit of the timeout in s, used only for an address at which a drive has answered
TRIES = 3
LATE_NS = 500_000_000  # maximum wait for late replies
SHORTEST_REPLY = 5  # size of an exception reply in bytes; fewer bytes are noise

SILENT = (Failure.NO_REPLY, Failure.STALLED)  # results of exchanges in which no byte was received
# Results that mean that a frame answers another request.
_MISDIRECTED = (FrameFault.BAD_ADDRESS, FrameFault.BAD_FUNCTION, FrameFault.BAD_LENGTH)


def is_whole(framing: Framing, received: bytes) -> bool:
    """Return True if the received bytes are exactly one frame with a valid checksum."""
    if framing is Framing.RTU:
        return len(received) >= SHORTEST_REPLY and crc16(received, len(received)) == 0
    return framing is Framing.TCP or (received[:1] == b":" and received[-2:] == b"\r\n")


class Scan(Protocol):
    """The methods of a scan that a probe uses."""

    def ask(self, sweep: Sweep, request: Message, peer: Peer, not_before_ns: int = 0) -> Completion: ...

    def peer(self, least: float, most: float) -> Peer: ...


class Probe:
    """Finds out whether a drive answers at an address, and its family.

    Also finds out whether a second drive answers at the same address.
    """

    def __init__(self, scan: Scan, sweep: Sweep, address: int) -> None:
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
        """Identify the drive's family, as far as reads can."""
        # The drive's response delay is known, so a short timeout is enough.
        known = max(LEAST_TIMEOUT, 4 * self.response_delay)
        drives, guess = self._identify(families, LEAST_TIMEOUT, known)
        # a missed reply shows that the drive or this computer became slower
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
