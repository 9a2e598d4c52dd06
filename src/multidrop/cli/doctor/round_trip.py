"""Measure how soon a drive begins to answer, for `doctor`."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from multidrop.bus import Bus
from multidrop.cli.doctor.findings import ROUNDS, Finding, round_trip_finding
from multidrop.core import (
    RS485,
    STATUSES,
    Completion,
    Exchange,
    Failure,
    Framing,
    Message,
    build_request,
    characters_on_wire,
    is_pseudo_terminal,
    parse_reply,
)
from multidrop.drive.family import Drive
from multidrop.planning.blocks import first_block
from multidrop.transport.line import Line
from multidrop.transport.prepared import make_exchange

UNANSWERED = 5  # requests to a drive that has answered none
MOST_S = 5.0  # that all rounds take, where the drive is slow or silent
LOOK_S = 0.05  # between attempts to send a request that was held back
OF_GATEWAYS = (0x0A, 0x0B)  # no path, and no response from the device (application protocol V1.1b3, 7)


def measure(port: str, rs485: RS485, settle: float, drive: Drive | None) -> tuple[Finding, bool]:
    """Return the finding, and True where the far end has answered anything in the port's framing."""
    if drive is None:
        return Finding(
            "round trip",
            "not measured: a drive must answer",
            "name one with --model and --address, or one of a plant file; `multidrop scan` finds those "
            "that are there",
        ), False
    block = first_block(drive)
    if block is None:
        return Finding("round trip", f"not measured: nothing of it can be read ({drive.name})"), False
    with Bus(port, rs485=rs485, settle=settle) as bus:
        bus.attach(drive)
        poll = make_exchange(drive, block.request, bus.peer(drive))
        completions = list(_repeat(bus.line, poll))
    # Time of the request and the reply's first character: unknown on a network and on a pseudo-terminal.
    sent = characters_on_wire(drive.framing, len(build_request(drive.framing, poll.request)))
    wire = (sent + 1) * drive.settings.character
    shows_bits = "://" not in port and not is_pseudo_terminal(str(Path(port).resolve()))
    its_own = [done for done in completions if done.result > 0 and not _is_gateway_s(drive, done)]
    seen = [(done.first_ns - done.sent_ns) / 1e9 for done in its_own]
    delays = sorted(max(0.0, delay - wire) if shows_bits else delay for delay in seen)
    refusals = [code for done in completions if (code := _exception(drive.framing, poll.request, done))]
    wire = 0.0 if shows_bits else wire
    finding = round_trip_finding(drive, delays, len(completions), wire, refusals, _what_came(completions))
    return finding, bool(delays or refusals)


def _what_came(completions: Sequence[Completion]) -> str:
    """Return the most frequent reason why bytes were no good reply, with an example; "" without one."""
    bad = [done for done in completions if done.result < 0 and done.raw and done.result != Failure.NO_REPLY]
    if not bad:
        return ""
    (result, _), *_ = Counter(done.result for done in bad).most_common(1)
    example = next(done.raw for done in bad if done.result == result)
    return f"{STATUSES[-result]} (received {example.hex(' ').upper()})"


def _exception(framing: Framing, request: Message, done: Completion) -> int:
    """Return the code of a reply that is an exception, also of a gateway's; else 0."""
    if done.result > 0:
        return done.reply.exception
    if framing is not Framing.TCP:
        return 0
    _, taken_for_silence = parse_reply(framing, done.raw, request)  # the core does so with a gateway's
    return taken_for_silence.exception if taken_for_silence else 0


def _is_gateway_s(drive: Drive, done: Completion) -> bool:
    """Return True for the exception that a gateway sends where it does not reach its device."""
    return done.reply.exception in OF_GATEWAYS and done.reply.exception not in drive.exceptions


def _repeat(line: Line, poll: Exchange) -> Iterator[Completion]:
    """Send ROUNDS requests, or those that fit into MOST_S, and return what became of each.

    A request that is held back, because an earlier answer may still come, does not count. A drive that is
    silent from the start gets UNANSWERED requests.
    """
    end = time.monotonic() + MOST_S
    count, is_silent = 0, True
    while count < (UNANSWERED if is_silent else ROUNDS) and (time.monotonic() < end or not count):
        found = line.carry_out(poll)
        if found.sent_ns:
            count += 1
            is_silent &= not found.raw
            yield found
        else:
            time.sleep(LOOK_S)
