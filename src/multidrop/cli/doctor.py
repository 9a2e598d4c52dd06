"""`multidrop doctor`: examines a port and its adapter, and advises what to change."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

from multidrop.bus import Bus
from multidrop.cli.doctor_findings import (
    ROUNDS,
    Finding,
    WakeLateness,
    adapter_finding,
    com_description,
    echo_finding,
    find_adapter,
    latency_finding,
    low_latency,
    low_latency_finding,
    round_trip_finding,
    rs485_finding,
    rs485_mode,
    wake_finding,
)
from multidrop.cli.support.arguments import (
    add_json_argument,
    add_line_arguments,
    add_opening_arguments,
    opening_of,
    plant_at,
    usual_settings,
    whole,
)
from multidrop.cli.support.output import print_json, print_text
from multidrop.cli.support.values import wrapped
from multidrop.core import (
    RS485,
    STATUSES,
    Completion,
    Exchange,
    Failure,
    Framing,
    Message,
    Peer,
    build_request,
    characters_on_wire,
    is_pseudo_terminal,
    parse_reply,
    wake_lateness,
    why_not_realtime,
)
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import Settings, speaks_tcp
from multidrop.errors import LineError
from multidrop.families.registry import find_model
from multidrop.planning.blocks import first_block
from multidrop.plant.model import Plant
from multidrop.transport.drive_reads import make_exchange
from multidrop.transport.drive_records import LEAST_TIMEOUT
from multidrop.transport.line import Line
from multidrop.transport.network_port import mixed_up, other_port, spoken_on
from multidrop.transport.port_identity import lasting_name

WAKE_S = 5.0  # how long to measure this computer's wake-ups, in s
NOBODY = 247  # address at which no drive is expected: only an echo of the request may come back
SETTING_UP_COM = "while the port is open, multidrop makes it raw and sets each drive's baud rate and format"
SETTING_UP = (
    "while the port is open, multidrop locks it against programs that respect such locks, makes it raw, sets "
    "each drive's baud rate and format, reads them back, and asks the driver for low latency"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_line_arguments(parser, name="NAME", kind="line or drive")
    parser.add_argument("--model", help="family of a drive to measure the round trip with")
    parser.add_argument("--address", type=whole, metavar="N", help="its address")
    parser.add_argument("--baudrate", type=whole, metavar="N", help="default: the family's, or 9600")
    parser.add_argument(
        "--format", metavar="8N1", help="data bits, parity and stop bits; default: the family's, or 8N1"
    )
    parser.add_argument("--framing", metavar="rtu", help="default: the family's first")
    add_opening_arguments(parser)
    add_json_argument(parser)


@dataclass(frozen=True)
class _Target:
    """A port to examine, the drives to measure with, and the settings of the echo test."""

    port: str
    drives: Sequence[Drive]
    settings: Settings
    rs485: RS485
    settle: float
    line: str = ""  # the line's name in the plant file
    is_realtime: bool = False


def run(arguments: argparse.Namespace) -> int:
    plant = plant_at(arguments)
    targets = list(_of_plant(plant, arguments)) if plant else [_by_hand(arguments)]
    found = [(target, list(_examined(target, is_alone=len(targets) == 1))) for target in targets]
    _add_wake_findings(found)
    if arguments.json:
        records = [
            {"port": target.port, "findings": [asdict(finding) for finding in findings]}
            | ({"line": target.line} if target.line else {})
            for target, findings in found
        ]
        print_json(records[0] if len(records) == 1 else {"lines": records})
    else:
        heads = [f"{target.line}: {target.port}\n" if len(found) > 1 else "" for target, _ in found]
        texts = ("\n".join(_text(findings)) for _, findings in found)
        print_text("\n\n".join(map(str.__add__, heads, texts)))
    return 1 if any(finding.is_failure for _, findings in found for finding in findings) else 0


def _of_plant(plant: Plant, arguments: argparse.Namespace) -> Iterator[_Target]:
    """Yield the named line with all its drives, or the named drive. Without a name, yield every line.

    Raises ValueError for options that are allowed only for a port without a plant file.
    """
    for name in ("model", "address", "baudrate", "format", "framing"):
        if getattr(arguments, name) is not None:
            raise ValueError(f"--{name} cannot be used with a plant file. Write key {name!r} in {plant.path}")
    for line in plant.lines:
        opening = opening_of(arguments, line)
        if arguments.name in (None, line.name):
            drives = [polled.drive for polled in line.drives]
            yield _Target(line.port, drives, usual_settings(line), *opening, line.name, plant.realtime)
    if arguments.name not in {None, *(line.name for line in plant.lines)}:
        line, drive = plant.find_drive(arguments.name)
        yield _Target(
            line.port, [drive], drive.settings, *opening_of(arguments, line), line.name, plant.realtime
        )


def _by_hand(arguments: argparse.Namespace) -> _Target:
    drive = _drive(arguments)
    baudrate = 9600 if arguments.baudrate is None else arguments.baudrate
    settings = (
        drive.settings
        if drive
        else Settings(baudrate, "8N1" if arguments.format is None else arguments.format)
    )
    return _Target(arguments.port, [drive] if drive else [], settings, *opening_of(arguments, None))


def _examined(target: _Target, *, is_alone: bool) -> Iterator[Finding]:
    """Yield the findings about a port. Raises LineError if it is the only port and cannot be opened."""
    try:
        yield from _findings(target)
    except LineError as failure:
        if is_alone:
            raise
        yield Finding("port", str(failure), is_failure=True)


def _add_wake_findings(found: list[tuple[_Target, list[Finding]]]) -> None:
    """Measure how late this computer wakes a thread; add a finding to each open port except Modbus TCP."""
    if all(speaks_tcp(target.port) for target, _ in found):
        return
    # both kinds of scheduling are measured at the same time, under the same load
    with ThreadPoolExecutor(2) as threads:
        normal = threads.submit(wake_lateness, WAKE_S, realtime=False)
        realtime = threads.submit(wake_lateness, WAKE_S, realtime=True)
    usual = WakeLateness.of(normal.result())
    try:
        best: WakeLateness | str = WakeLateness.of(realtime.result())
    except OSError as failure:
        best = why_not_realtime(failure)
    for target, findings in found:
        is_open = not any(one.topic == "port" and one.is_failure for one in findings)
        if is_open and not speaks_tcp(target.port):
            is_realtime = target.is_realtime
            findings.append(wake_finding(usual, best, target.settings, target.rs485, is_realtime=is_realtime))


def _drive(arguments: argparse.Namespace) -> Drive | None:
    if (arguments.model is None) != (arguments.address is None):
        raise ValueError("--model and --address belong together: give both, or neither")
    if arguments.model is None:
        if arguments.framing is not None:
            raise ValueError("--framing needs a drive: add --model and --address")
        return None
    return find_model(arguments.model)(
        arguments.address, framing=arguments.framing, baudrate=arguments.baudrate, format=arguments.format
    )


def _findings(target: _Target) -> Iterator[Finding]:
    port, settings = target.port, target.settings
    if "://" in port:
        yield from _remote(port)
    else:
        yield from _local(port, target.rs485)
    nobody = Message(NOBODY, 0x03, 0, 1)
    yield unit_finding(port, nobody, settings) if speaks_tcp(port) else _echo(port, target.rs485, settings)
    speaks = False
    drives: Sequence[Drive | None] = target.drives or [None]
    for drive in drives:
        measured, answers = measure(port, target.rs485, target.settle, drive)
        speaks |= answers
        yield measured
    if not other_port(port) or speaks:
        return
    block = first_block(target.drives[0]) if target.drives else None
    if block:
        yield other_way_finding(port, block.request, settings)
    # No drive is named. Of the possible far ends, only a Modbus TCP gateway would answer this request.
    elif not speaks_tcp(port):
        yield other_way_finding(port, nobody, settings)


# ---- the port ----


def _remote(port: str) -> Iterator[Finding]:
    kind = port.partition("://")[0]
    if speaks_tcp(port):
        what = "a Modbus TCP connection; small packets are sent at once (TCP_NODELAY)"
        yield Finding("port", f"{port} is {what}")
    elif kind == "socket":
        yield Finding("port", f"{port} is a TCP connection; small packets are sent at once (TCP_NODELAY)")
    else:
        yield Finding("port", f"{port} is a pyserial {kind} port; two threads copy its bytes")
    yield Finding(
        "adapter",
        "at the far end: its driver, latency timer and RS-485 mode are not visible from here",
        "set baud rate, format and the shortest packing delay in the serial server or gateway itself",
    )


def _local(port: str, rs485: RS485) -> Iterator[Finding]:
    line = Line(port, rs485=rs485).open()  # raises LineError with the reason if the port cannot be opened
    try:
        yield from _opened_com(port) if sys.platform == "win32" else _opened(port, rs485)
    finally:
        line.close()


def _opened_com(port: str) -> Iterator[Finding]:
    yield Finding("port", f"{port} is a serial port")
    yield Finding("set here", SETTING_UP_COM)
    yield Finding("adapter", com_description(port) or "the system lists none")
    yield Finding(
        "latency timer",
        "not readable on Windows; an FTDI adapter may delay every reply by 16 ms",
        "set it to 1 ms in the device manager: Ports, the port's properties, Port Settings, Advanced",
    )


def _opened(port: str, rs485: RS485) -> Iterator[Finding]:
    """Yield findings about a device; open the device if it is not a pseudo-terminal."""
    device = str(Path(port).resolve())
    link = f", which is {device}" if device != port else ""
    if is_pseudo_terminal(device):
        yield Finding("port", f"{port} is a pseudo-terminal{link}: a program is at its other end")
        yield Finding("set here", SETTING_UP)
        yield Finding(
            "adapter", "none, and therefore no driver, latency timer, RS-485 mode or low-latency flag"
        )
        return
    yield Finding("port", f"{port} is a serial port{link}")
    yield Finding("set here", SETTING_UP)
    adapter = find_adapter(device)
    yield adapter_finding(adapter, port, lasting_name(port))
    fd = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield low_latency_finding(low_latency(fd), adapter.driver)
        yield latency_finding(adapter)
        yield rs485_finding(rs485_mode(fd), rs485, is_usb=bool(adapter.usb_id))
    finally:
        os.close(fd)


# ---- the line ----


def _echo(port: str, rs485: RS485, settings: Settings) -> Finding:
    """Read from an unused address, where only an echo of the request may come back. Return a finding."""
    request = Message(NOBODY, 0x03, 0, 1)
    try:
        found = ask_once(port, request, settings, rs485, 4 * LEAST_TIMEOUT)
    except LineError as failure:
        return Finding("echo", f"not tested: {failure.reason}")
    return echo_finding(found, build_request(Framing.RTU, request), settings)


def _text(findings: list[Finding]) -> Iterator[str]:
    width = max(len(finding.topic) for finding in findings) + 2
    for finding in findings:
        yield from wrapped(finding.what, f"{finding.topic:<{width}}", " " * width)
        if finding.advice:  # do not break words, because the advice may contain a command to copy
            indent = " " * width
            yield from wrapped(finding.advice, f"{indent}-> ", f"{indent}   ", breaks_words=False)


# ---- the round trip ----


UNANSWERED = 5  # a drive gets no further requests after this many without a single reply
MOST_S = 5.0  # time limit, in s, for all requests to a slow or silent drive
RETRY_S = 0.05  # pause, in s, before a request is tried again because a late reply may still come
OF_GATEWAYS = (0x0A, 0x0B)  # exception codes: no path; device does not respond (Modbus protocol, section 7)


def measure(port: str, rs485: RS485, settle: float, drive: Drive | None) -> tuple[Finding, bool]:
    """Measure a drive's response delay.

    Return the finding, and True if a drive or a gateway answered in the port's framing.
    """
    if drive is None:
        return Finding(
            "round trip",
            "not measured: it needs a drive",
            "name one with --model and --address, or a plant file; `multidrop scan` finds drives",
        ), False
    block = first_block(drive)
    if block is None:
        return Finding("round trip", f"not measured: {drive.name} has no readable register"), False
    with Bus(port, rs485=rs485, settle=settle) as bus:
        bus.attach(drive)
        poll = make_exchange(drive, block.request, bus.peer(drive))
        completions = list(_repeat(bus.line, poll))
    # `wire` is the time in s that the request and the reply's first character take on the wire. It is unknown
    # on a network and on a pseudo-terminal.
    sent = characters_on_wire(drive.framing, len(build_request(drive.framing, poll.request)))
    wire = (sent + 1) * drive.settings.character
    shows_bits = "://" not in port and not is_pseudo_terminal(str(Path(port).resolve()))
    its_own = [done for done in completions if done.result > 0 and not _is_from_gateway(drive, done)]
    seen = [(done.first_ns - done.sent_ns) / 1e9 for done in its_own]
    delays = sorted(max(0.0, delay - wire) if shows_bits else delay for delay in seen)
    refusals = [code for done in completions if (code := _exception(drive.framing, poll.request, done))]
    wire = 0.0 if shows_bits else wire
    finding = round_trip_finding(drive, delays, len(completions), wire, refusals, _bad_bytes(completions))
    return finding, bool(delays or refusals)


def _bad_bytes(completions: Sequence[Completion]) -> str:
    """Return the most frequent reason for invalid replies, with an example; "" without invalid replies."""
    bad = [done for done in completions if done.result < 0 and done.raw and done.result != Failure.NO_REPLY]
    if not bad:
        return ""
    (result, _), *_ = Counter(done.result for done in bad).most_common(1)
    example = next(done.raw for done in bad if done.result == result)
    return f"{STATUSES[-result]} (received {example.hex(' ').upper()})"


def _exception(framing: Framing, request: Message, done: Completion) -> int:
    """Return the code of an exception reply, from the drive or from a gateway; 0 for any other reply."""
    if done.result > 0:
        return done.reply.exception
    if framing is not Framing.TCP:
        return 0
    # parsed here, because the core reports a gateway's exception as no reply
    _, reply = parse_reply(framing, done.raw, request)
    return reply.exception if reply else 0


def _is_from_gateway(drive: Drive, done: Completion) -> bool:
    """Return True if the reply is a gateway's exception: the gateway does not reach the device."""
    return done.reply.exception in OF_GATEWAYS and done.reply.exception not in drive.exceptions


def _repeat(line: Line, poll: Exchange) -> Iterator[Completion]:
    """Send up to ROUNDS requests within MOST_S; yield their outcomes.

    The line does not send a request while a late reply to an earlier request may come. Only sent requests
    count. If the drive does not reply at all, stop after `UNANSWERED` requests.
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
            time.sleep(RETRY_S)


# ---- the other framing: Modbus TCP instead of RTU, or the reverse ----


TIMEOUT = 2.0  # in s: long enough for a gateway that waits for its drives


def ask_once(
    port: str, request: Message, settings: Settings, rs485: RS485 = RS485.OFF, timeout: float = TIMEOUT
) -> Completion:
    """Send one read in the framing that the port's URL implies; return its outcome. Raises LineError."""
    is_tcp = speaks_tcp(port)
    exchange = Exchange(
        Framing.TCP if is_tcp else Framing.RTU,
        request,
        Peer(least_timeout=timeout, most_timeout=timeout),
        baudrate=settings.baudrate,
        format=settings.format,
        character=settings.character,
        silence=0.0 if is_tcp else max(settings.t3_5, LEAST_TIMEOUT),
    )
    line = Line(port, rs485=rs485).open()
    try:
        return line.carry_out(exchange)
    finally:
        line.close()


def other_way_finding(port: str, request: Message, settings: Settings) -> Finding:
    """Send the request in the other framing (TCP or RTU); return a finding about the far end's answer."""
    other = other_port(port)
    way = spoken_on(other)
    try:
        found = ask_once(other, request, settings)
    except LineError as failure:
        return Finding("other framing", f"{way} was not tested: {failure.reason}")
    if found.result > 0 or mixed_up(port, found.raw):  # other received bytes do not prove the framing
        return Finding(
            "other framing",
            f"the far end speaks {way}, not {spoken_on(port)}",
            f"use the port {other} instead of {port}, or set the far end to {spoken_on(port)}",
            is_failure=True,
        )
    return Finding("other framing", f"{way} got no answer either")


def unit_finding(port: str, request: Message, settings: Settings) -> Finding:
    """Send a request to an unused unit id of a Modbus TCP port; return a finding about the answer."""
    try:
        found = ask_once(port, request, settings)
    except LineError as failure:
        return Finding("Modbus TCP", f"not spoken here: {failure.reason}", is_failure=True)
    unit = f"unit {request.address}, which should be unused"
    if found.result > 0:
        reply = found.reply
        how = f"exception {reply.exception:02X}" if reply.exception else "a value"
        return Finding(
            "Modbus TCP",
            f"{unit}, answers with {how}",
            "the device may answer for every unit: a wrong address then goes unnoticed",
        )
    if found.raw:
        return Finding("Modbus TCP", f"the gateway reports no answer from {unit}: correct")
    return Finding("Modbus TCP", f"{unit}, is silent: from a gateway or from a device without Modbus TCP")
