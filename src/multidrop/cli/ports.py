"""`multidrop ports`: lists the serial ports, their adapters, and whether the user may open them."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from multidrop.cli.doctor_findings import SYSFS, find_adapter
from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.output import print_text
from multidrop.cli.support.values import wrapped
from multidrop.transport.port_identity import of_device

NO_PORTS = "no serial port found; plug the adapter in" + (
    ", then see `sudo dmesg | tail`" if sys.platform == "linux" else ""
)


@dataclass(frozen=True)
class SerialPort:
    """A serial port. If its adapter has a serial number, `name` is the device name that contains it."""

    name: str
    device: str
    adapter: str
    may_open: bool
    advice: str = ""  # how the user gets the permission to open it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    found = sorted(_linux_ports() if sys.platform == "linux" else _other_ports(), key=lambda port: port.name)
    if arguments.json:
        print_text(json.dumps([asdict(port) for port in found], indent=2))
    else:
        print_text("\n".join(line for port in found for line in _text(port)) or NO_PORTS)
    return 0 if found else 1


def _text(port: SerialPort) -> Iterator[str]:
    yield port.name
    now = f"{port.device}: " if port.device != port.name else ""
    yield from wrapped(f"{now}{port.adapter}", "  ", "    ")
    opening = "you may open it" if port.may_open else f"you may not open it: {port.advice}"
    yield from wrapped(opening, "  ", "    ", breaks_words=False)


def _linux_ports(sysfs: Path = SYSFS, devices: Path = Path("/dev")) -> Iterator[SerialPort]:
    """Yield the terminal devices that have hardware. For an absent UART, the kernel reports type 0."""
    for tty in sorted((sysfs / "class/tty").glob("*")):
        device, uart = devices / tty.name, tty / "type"
        if not (tty / "device").exists() or (uart.exists() and uart.read_text("ascii").strip() == "0"):
            continue
        adapter = find_adapter(str(device), sysfs)
        if not adapter.driver or not device.exists():
            continue
        advice = "" if os.access(device, os.R_OK | os.W_OK) else _permission_advice(device)
        yield SerialPort(of_device(str(device)), str(device), str(adapter), not advice, advice)


def _permission_advice(device: Path) -> str:
    """Return how this user gets the permission to open a device."""
    import grp
    import pwd

    about = device.stat()
    try:
        owner, user = (pwd.getpwuid(number).pw_name for number in (about.st_uid, os.getuid()))
        group = grp.getgrgid(about.st_gid)
    except KeyError:  # in a container, numbers may have no names
        return f"start this program, or its container, in group {about.st_gid}"
    if about.st_mode & 0o060 != 0o060 or not about.st_gid:
        return f"only {owner} may; a udev rule can give it to a group"
    if user in group.gr_mem:
        return f"you were added to its group {group.gr_name} after this login: log out and in again"
    return f"sudo usermod -aG {group.gr_name} {user}, then log out and in again"


def _other_ports() -> Iterator[SerialPort]:
    """Yield the ports that pyserial finds on Windows or macOS, where every user may open them."""
    from serial.tools.list_ports import comports

    for port in comports():
        yield SerialPort(port.device, port.device, port.description or "unknown adapter", may_open=True)
