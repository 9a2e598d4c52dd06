"""`multidrop doctor`: what stands between this computer and its drives, and what should be changed."""

from __future__ import annotations

import argparse
import json
import os
import textwrap
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from multidrop.bus import LEAST_TIMEOUT, Bus, exchange
from multidrop.cli.adapter import Adapter, RS485Mode, find_adapter, low_latency, rs485_mode
from multidrop.cli.target import add_json_argument
from multidrop.core import Exchange, Framing, Message, Respondent, build_request
from multidrop.drive import Drive
from multidrop.errors import LineError
from multidrop.line import Line
from multidrop.models import find_model
from multidrop.plan import blocks
from multidrop.timing import Settings

WIDTH = 80
LATENCY_MS = 1  # a larger latency timer is worth changing
NOBODY = 247  # the address that the echo's request goes to
ROUNDS = 20
SLOW_S = 0.005  # more than this on top of a drive's usual response delay is worth a word


@dataclass(frozen=True)
class Finding:
    """What was found, and what the user should do about it, if anything."""

    topic: str
    what: str
    advice: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", metavar="PORT", help="device such as /dev/ttyUSB0, or pyserial URL")
    parser.add_argument("--model", help="of a drive that answers there: the round trip is measured with it")
    parser.add_argument("--address", type=int, metavar="N", help="its address")
    parser.add_argument("--baudrate", type=int, metavar="N", help="where it is not the family's default")
    parser.add_argument("--format", metavar="8N1", help="data bits, parity and stop bits")
    parser.add_argument("--framing", metavar="rtu", help="where the family has several")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    drive = _drive(arguments)
    findings = list(_findings(arguments.port, drive))
    if arguments.json:
        print(json.dumps({"port": arguments.port, "findings": [asdict(it) for it in findings]}, indent=2))
    else:
        print("\n".join(_text(findings)))
    return 0


def _drive(arguments: argparse.Namespace) -> Drive | None:
    if (arguments.model is None) != (arguments.address is None):
        raise ValueError("--model and --address belong together: both name the drive to measure with")
    if arguments.model is None:
        return None
    return find_model(arguments.model)(
        arguments.address, framing=arguments.framing, baudrate=arguments.baudrate, format=arguments.format
    )


def _findings(port: str, drive: Drive | None) -> Iterator[Finding]:
    if "://" in port:
        yield from _remote(port)
    else:
        yield from _local(port)
    settings = drive.settings if drive else Settings(9600, "8N1")
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
    if device.startswith("/dev/pts/"):
        yield Finding("port", f"{port} is a pseudo-terminal{link}: a program is at its other end")
        yield Finding(
            "adapter", "there is none, and so no driver, latency timer, RS-485 mode or low-latency flag"
        )
        return
    yield Finding("port", f"{port} is a serial port{link}")
    adapter = find_adapter(device)
    yield adapter_finding(adapter)
    fd = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield low_latency_finding(low_latency(fd))
        yield latency_finding(adapter)
        yield rs485_finding(rs485_mode(fd))
    finally:
        os.close(fd)


def adapter_finding(adapter: Adapter) -> Finding:
    product = f"{adapter.product or 'a USB device'} ({adapter.usb_id})" if adapter.usb_id else "not on USB"
    driver = f"its driver is {adapter.driver}" if adapter.driver else "the system names no driver for it"
    return Finding("adapter", f"{product}; {driver}")


def latency_finding(adapter: Adapter) -> Finding:
    milliseconds = adapter.latency_timer
    if milliseconds is None:
        return Finding("latency timer", "the driver has none that can be seen")
    if milliseconds <= LATENCY_MS:
        return Finding("latency timer", f"{milliseconds} ms: the shortest there is")
    return Finding(
        "latency timer",
        f"{milliseconds} ms: every reply may wait for so long in the adapter",
        f"echo {LATENCY_MS} | sudo tee {adapter.latency_path} (for good, a udev rule: "
        f'ACTION=="add", SUBSYSTEM=="usb-serial", ATTR{{latency_timer}}="{LATENCY_MS}")',
    )


def low_latency_finding(low: bool | None) -> Finding:
    if low is None:
        return Finding("low latency", "the driver has no such flag")
    if low:
        return Finding("low latency", "the flag is set: multidrop sets it whenever it opens the port")
    return Finding(
        "low latency",
        "the flag is not set: the driver did not take it from multidrop",
        "it may be root's to set: setserial PORT low_latency",
    )


def rs485_finding(mode: RS485Mode | None) -> Finding:
    if mode is None:
        return Finding(
            "RS-485 mode", "the driver has none: the adapter itself must switch between sending and receiving"
        )
    if not mode.enabled:
        return Finding(
            "RS-485 mode",
            "the driver has it, and it is off",
            "if the transceiver hangs on RTS, switch it on in the device tree or with an RS-485 tool; "
            "an adapter that switches by itself needs nothing",
        )
    hears = ", and hears what it sends: multidrop takes the echo out" if mode.hears_itself else ""
    return Finding("RS-485 mode", f"on: the driver switches the direction{hears}")


# ---- the line ----


def _echo(port: str, settings: Settings) -> Finding:
    """A read from an address that nobody should have: nothing must come back, or the request itself."""
    request = Message(NOBODY, 0x03, 0, 1)
    respondent = Respondent(least_timeout=4 * LEAST_TIMEOUT, most_timeout=4 * LEAST_TIMEOUT)
    asked = Exchange(
        Framing.RTU,
        request,
        respondent,
        baudrate=settings.baudrate,
        format=settings.format,
        character=settings.character,
        silence=max(settings.t3_5, LEAST_TIMEOUT),
    )
    line = Line(port)
    try:
        heard = line.carry_out(asked).raw
    except LineError as failure:
        return Finding("echo", f"not tried: {failure.reason}")
    finally:
        line.close()
    return echo_finding(heard, build_request(Framing.RTU, request), settings)


def echo_finding(heard: bytes, sent: bytes, settings: Settings) -> Finding:
    if not heard:
        return Finding("echo", f"none at {settings}: nothing came back of what was sent")
    if heard == sent:
        return Finding("echo", f"the adapter hears what it sends at {settings}; multidrop takes it out")
    return Finding(
        "echo",
        f"{len(heard)} bytes came unasked at {settings}: {heard[:16].hex(' ').upper()}",
        "see whether another program or master talks on this line, and whether its ends are terminated",
    )


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
        made = exchange(drive, block.request(drive.address), bus.respondent(drive))
        completions = [bus.line.carry_out(made) for _ in range(ROUNDS)]
    request = len(build_request(drive.framing, made.request)) * drive.settings.character
    delays = sorted(
        (it.first_ns - it.sent_ns) / 1e9 - request - drive.settings.character
        for it in completions
        if it.result > 0
    )
    return round_trip_finding(drive, delays)


def round_trip_finding(drive: Drive, delays: list[float]) -> Finding:
    """`delays` are sorted, in s, from the request's last bit to the reply's first, as seen from here."""
    if not delays:
        return Finding(
            "round trip",
            f"{drive.name} did not answer once in {ROUNDS} requests",
            "check its address, baud rate, format, wiring and power; `multidrop scan` looks for it",
        )
    least, median, most = delays[0], delays[len(delays) // 2], delays[-1]
    figures = f"{least * 1e3:.1f} ms at least, {median * 1e3:.1f} in the middle, {most * 1e3:.1f} at most"
    lost = f"; {ROUNDS - len(delays)} of {ROUNDS} requests stayed without a good reply"
    what = f"{drive.name} begins to answer after {figures}{lost if len(delays) < ROUNDS else ''}"
    if median - drive.response_delay > SLOW_S:
        return Finding(
            "round trip",
            what,
            f"its family usually takes {drive.response_delay * 1e3:.1f} ms: the rest is the adapter's, "
            "or the drive's own parameter for the response delay",
        )
    return Finding("round trip", what)


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
