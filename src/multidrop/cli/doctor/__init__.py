"""`multidrop doctor`: what stands between this computer and its drives, and what should be changed."""

from __future__ import annotations

import argparse
import json
import os
import textwrap
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from multidrop.bus import Bus
from multidrop.cli.doctor.adapter import find_adapter, low_latency, rs485_mode
from multidrop.cli.doctor.findings import (
    ROUNDS,
    Finding,
    adapter_finding,
    echo_finding,
    latency_finding,
    low_latency_finding,
    round_trip_finding,
    rs485_finding,
)
from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.saying import say
from multidrop.core import Completion, Exchange, Framing, Message, Peer, build_request
from multidrop.drive.family import Drive
from multidrop.drive.timing import Settings
from multidrop.drives.registry import find_model
from multidrop.errors import LineError
from multidrop.planning.blocks import blocks
from multidrop.transport.exchange import LEAST_TIMEOUT, make_exchange
from multidrop.transport.line import Line

WIDTH = 80
MOST_S = 5.0  # that the rounds take, where the drive is slow or silent
LOOK_S = 0.05  # between attempts to send what is held back
_PSEUDO = "/dev/pts/"
NOBODY = 247  # the address that the echo's request goes to
SETTING_UP = (
    "while it has the port, multidrop locks it against programs that heed such locks, makes it raw, sets "
    "each drive's baud rate and format, reads them back, and asks the driver for low latency"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", metavar="PORT", help="device such as /dev/ttyUSB0, or pyserial URL")
    parser.add_argument("--model", help="of a drive that answers there: the round trip is measured with it")
    parser.add_argument("--address", type=int, metavar="N", help="its address")
    parser.add_argument(
        "--baudrate", type=int, metavar="N", help="of the line; the family's default, or 9600, without it"
    )
    parser.add_argument("--format", metavar="8N1", help="data bits, parity and stop bits; the same, or 8N1")
    parser.add_argument("--framing", metavar="rtu", help="of the drive, where the family has several")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    drive = _drive(arguments)
    settings = drive.settings if drive else _line_settings(arguments)
    findings = list(_findings(arguments.port, drive, settings))
    if arguments.json:
        say(json.dumps({"port": arguments.port, "findings": [asdict(it) for it in findings]}, indent=2))
    else:
        say("\n".join(_text(findings)))
    return 1 if any(it.is_failure for it in findings) else 0


def _drive(arguments: argparse.Namespace) -> Drive | None:
    if (arguments.model is None) != (arguments.address is None):
        raise ValueError("--model and --address belong together: both name the drive to measure with")
    if arguments.model is None:
        if arguments.framing is not None:
            raise ValueError("--framing is how a drive is asked: name the drive with --model and --address")
        return None
    return find_model(arguments.model)(
        arguments.address, framing=arguments.framing, baudrate=arguments.baudrate, format=arguments.format
    )


def _line_settings(arguments: argparse.Namespace) -> Settings:
    """What an echo is looked for with where no drive is named."""
    return Settings(
        9600 if arguments.baudrate is None else arguments.baudrate,
        "8N1" if arguments.format is None else arguments.format,
    )


def _findings(port: str, drive: Drive | None, settings: Settings) -> Iterator[Finding]:
    if "://" in port:
        yield from _remote(port)
    else:
        yield from _local(port)
    yield _echo(port, settings)
    yield _round_trip(port, drive)


# ---- the port ----


def _remote(port: str) -> Iterator[Finding]:
    kind = port.partition("://")[0]
    if kind == "socket":
        yield Finding("port", f"{port} is a TCP connection; small packets are sent at once (TCP_NODELAY)")
    else:
        yield Finding("port", f"{port} is a pyserial {kind} port, which is copied to by two threads")
    yield Finding(
        "adapter",
        "it is at the far end: its driver, latency timer and RS-485 mode cannot be seen from here",
        "set baud rate, format and the shortest packing delay in the serial server itself",
    )


def _local(port: str) -> Iterator[Finding]:
    line = Line(port)  # what keeps it from being opened is told in a sentence
    try:
        yield from _opened(port, str(Path(port).resolve()))
    finally:
        line.close()


def _opened(port: str, device: str) -> Iterator[Finding]:
    """What there is to be said of a port that multidrop has open."""
    link = f", which is {device}" if device != port else ""
    if device.startswith(_PSEUDO):
        yield Finding("port", f"{port} is a pseudo-terminal{link}: a program is at its other end")
        yield Finding("set here", SETTING_UP)
        yield Finding(
            "adapter", "there is none, and so no driver, latency timer, RS-485 mode or low-latency flag"
        )
        return
    yield Finding("port", f"{port} is a serial port{link}")
    yield Finding("set here", SETTING_UP)
    adapter = find_adapter(device)
    yield adapter_finding(adapter)
    fd = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield low_latency_finding(low_latency(fd))
        yield latency_finding(adapter)
        yield rs485_finding(rs485_mode(fd))
    finally:
        os.close(fd)


# ---- the line ----


def _echo(port: str, settings: Settings) -> Finding:
    """A read from an address that nobody should have: nothing must come back, or the request itself."""
    request = Message(NOBODY, 0x03, 0, 1)
    peer = Peer(least_timeout=4 * LEAST_TIMEOUT, most_timeout=4 * LEAST_TIMEOUT)
    asked = Exchange(
        Framing.RTU,
        request,
        peer,
        baudrate=settings.baudrate,
        format=settings.format,
        character=settings.character,
        silence=max(settings.t3_5, LEAST_TIMEOUT),
    )
    line = Line(port)
    try:
        found = line.carry_out(asked)
    except LineError as failure:
        return Finding("echo", f"not tried: {failure.reason}")
    finally:
        line.close()
    return echo_finding(found, build_request(Framing.RTU, request), settings)


def _round_trip(port: str, drive: Drive | None) -> Finding:
    if drive is None:
        return Finding(
            "round trip",
            "not measured: a drive must answer",
            "name one with --model and --address; `multidrop scan` finds those that are there",
        )
    register = next(iter(drive.readings()))
    (block,) = blocks(drive, [register])
    with Bus(port) as bus:
        bus.attach(drive)
        made = make_exchange(drive, block.request, bus.peer(drive))
        asked = list(_asked(bus.line, made))
    # Request and first character: on a network and on a pseudo-terminal nobody knows how long they take.
    wire = (len(build_request(drive.framing, made.request)) + 1) * drive.settings.character
    tells_bits = "://" not in port and not str(Path(port).resolve()).startswith(_PSEUDO)
    seen = [(it.first_ns - it.sent_ns) / 1e9 for it in asked if it.result > 0]
    delays = sorted(max(0.0, it - wire) if tells_bits else it for it in seen)
    return round_trip_finding(drive, delays, len(asked), 0.0 if tells_bits else wire)


def _asked(line: Line, made: Exchange) -> Iterator[Completion]:
    """What became of ROUNDS requests, or of those that could be sent within MOST_S.

    What was held back, because the answer to an earlier one may still come, was never sent.
    """
    end = time.monotonic() + MOST_S
    count = 0
    while count < ROUNDS and (time.monotonic() < end or not count):
        found = line.carry_out(made)
        if found.sent_ns:
            count += 1
            yield found
        else:
            time.sleep(LOOK_S)


def _text(findings: list[Finding]) -> Iterator[str]:
    width = max(len(it.topic) for it in findings) + 2
    for it in findings:
        yield from textwrap.wrap(
            it.what, WIDTH, initial_indent=f"{it.topic:<{width}}", subsequent_indent=" " * width
        )
        if it.advice:
            yield from textwrap.wrap(
                it.advice,
                WIDTH,
                initial_indent=" " * width + "-> ",
                subsequent_indent=" " * (width + 3),
                break_long_words=False,
                break_on_hyphens=False,
            )
