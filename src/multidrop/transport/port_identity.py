"""Find a port's identity, a text that is the same for all its names; mark simulated ports by it."""

from __future__ import annotations

import os
import re
import socket
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, urlsplit

from multidrop.core import is_pseudo_terminal
from multidrop.drive.line_settings import MODBUS_PORT, speaks_tcp

TTYS = Path("/sys/class/tty")
DEVICES = Path("/dev")
_INTERFACE = re.compile(r"[\d.-]+:(\d+\.\d+)")  # 1-4.2:1.0 is an interface of the device at 1-4.2


@dataclass(frozen=True)
class USBAdapter:
    """One port of a USB adapter: the USB socket (`place`), and the serial number or "".

    With `has_twin`, another adapter has the same serial number. Then only an adapter in the same socket is
    the same one.
    """

    place: str
    serial: str
    has_twin: bool = False

    def is_same(self, other: USBAdapter) -> bool:
        is_here = self.place == other.place
        if self.serial and other.serial:
            return self.serial == other.serial and (is_here or not self.has_twin)
        return is_here

    def __str__(self) -> str:
        return self.serial or f"at {self.place}"


def adapter_of(device: str) -> USBAdapter | None:
    """Return the USB adapter behind this device name; None if no adapter is known there."""
    found = (TTYS / Path(device).name / "device").resolve()
    for part in (found, *found.parents):
        if interface := _INTERFACE.fullmatch(part.name):
            # such as "1.0.0": port 0 of the USB interface 1.0
            number = f"{interface[1]}.{_text(found / 'port_number') or 0}"
            serial = _text(part.parent / "serial")
            return USBAdapter(f"{part.parent.name}:{number}", serial and f"{serial}:{number}")
    return None


def device_of(adapter: USBAdapter) -> str | None:
    """Return this adapter's present device name; None if the adapter has left its USB socket.

    An adapter in another socket may be a different one: serial numbers are not unique.
    """
    here = [name for name, one in _adapters().items() if one.place == adapter.place and adapter.is_same(one)]
    return str(DEVICES / here[0]) if len(here) == 1 else None


def has_twin(adapter: USBAdapter) -> bool:
    """Return True if an adapter in another USB socket has the same serial number."""
    others = [one for one in _adapters().values() if one.place != adapter.place]
    return bool(adapter.serial) and any(one.serial == adapter.serial for one in others)


def _adapters() -> dict[str, USBAdapter]:
    return {tty.name: one for tty in TTYS.iterdir() if (one := adapter_of(tty.name))}


# Drivers of plain 8250 UARTs, which divide their clock by a whole number. Others may use fractions.
_DIVIDERS = ("serial8250", "serial")


def has_divisor(device: str) -> bool:
    """Return True if the device is a UART whose true baud rate follows from its clock and a whole divisor."""
    found = (TTYS / Path(device).name / "device").resolve()
    return any((part / "driver").resolve().name in _DIVIDERS for part in (found, *found.parents))


def _text(file: Path) -> str:
    try:
        return file.read_text("ascii", errors="replace").strip()
    except OSError:
        return ""


@dataclass(frozen=True)
class PseudoTerminal:
    """A pseudo-terminal, and the links that lead to it.

    After the end of a pseudo-terminal, the system reuses its number.
    """

    device: str
    changed_ns: int  # ns; a later terminal with the same number has a later time
    links: tuple[tuple[int, int], ...]  # inode and time of each link, which change if the link is replaced

    def is_replaced_by(self, other: PseudoTerminal) -> bool:
        """Return True if the same links now lead to another terminal."""
        return (self.device, self.links) == (other.device, other.links) and self != other


def pseudo_terminal_of(name: str) -> PseudoTerminal | None:
    """Return the pseudo-terminal with this name; None if the name is not that of a pseudo-terminal."""
    path = Path(name)
    links: list[tuple[int, int]] = []
    try:
        while path.is_symlink() and len(links) < MOST_LINKS:
            link = path.lstat()
            links.append((link.st_ino, link.st_mtime_ns))
            path = path.parent / path.readlink()
        if is_pseudo_terminal(str(path)):
            return PseudoTerminal(str(path), path.stat().st_ctime_ns, tuple(links))
    except OSError:
        pass
    return None


MOST_LINKS = 40
BY_ID = Path("/dev/serial/by-id")  # links that udev makes, with each adapter's serial number
_PEER = re.compile(r"(\[[^\]]+\]|[\w.-]+):\d+")


def com_name(name: str) -> str:
    r"""Return a COM port's name as Windows lists it: COM5 for com5, and for \\.\COM5."""
    return name.removeprefix("\\\\.\\").upper()


def of_device(path: str) -> str:
    """Return the link in BY_ID to this device; if there is none, return the path with its links resolved."""
    if sys.platform == "win32":
        return com_name(path)
    device = os.path.realpath(path)
    try:
        links = sorted(BY_ID.iterdir())
    except OSError:
        links = []
    return next((str(link) for link in links if os.path.realpath(link) == device), device)


def lasting_name(port: str) -> str:
    """Return the port's device name that contains the adapter's serial number, or else the given name."""
    if "://" in port or Path(port).is_symlink():
        return port
    adapter = adapter_of(port)
    return of_device(port) if adapter and adapter.serial else port


def of_connection(connection: socket.socket) -> str:
    """Return the address and port of the far end, such as 10.0.0.7:4001."""
    return of_address(connection.getpeername())


def of_address(address: tuple[str | int, ...]) -> str:
    """Return a socket's address as one text, an IPv6 one in brackets."""
    host, port, *_ = address
    return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"


def of_name(name: str) -> str:
    """Return the identity of a port. `name` is a path, a URL, or already an identity."""
    if "://" in name:
        try:
            url = urlsplit(name)
            host, port = url.hostname, url.port or (MODBUS_PORT if speaks_tcp(name) else None)
        except ValueError:
            return name
        return of_address((host, port)) if host and port else name
    if _PEER.fullmatch(name) and not Path(name).exists():
        return name
    return of_device(name)


# ---- marks of simulated ports ----
#
# A client does not count writes to a marked port as EEPROM wear. On Linux, a simulator binds a name for each
# of its ports (an abstract Unix address, see unix(7)). The kernel removes the name when the process ends,
# even by SIGKILL. Other systems have no such names, so those writes are counted there.


_HAS_NAMES = sys.platform == "linux"


def _name(identity: str) -> bytes:
    return b"\0multidrop/simulated/%d/%s" % (os.getuid(), identity.encode()[-60:])


def ledger_of(identity: str, directory: Path) -> Path:
    """Return the path of the file that counts writes to the EEPROMs of the drives on a simulated port.

    The file exists only while the port's simulator runs.
    """
    return directory / "simulated" / f"{quote(identity, safe='')}.sqlite"


class SimulatedPort:
    """Marks a port as simulated until `close`; `is_simulated` finds this mark from any process of the user.

    The port's counts of EEPROM writes (see `ledger_of`) are deleted when the mark is set, and again when it
    is removed.
    """

    def __init__(self, identity: str, directory: Path) -> None:
        self._ledger = ledger_of(identity, directory)
        self._holder: socket.socket | None = None
        self._forget_writes()
        if _HAS_NAMES:
            self._holder = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            with suppress(OSError):  # another simulator has marked a port of the same name
                self._holder.bind(_name(identity))

    def _forget_writes(self) -> None:
        with suppress(OSError):
            self._ledger.unlink(missing_ok=True)

    def close(self) -> None:
        if self._holder is not None:
            self._holder.close()
        self._forget_writes()


def is_simulated(identity: str) -> bool:
    """Return True while a simulator of this user has marked this port."""
    if not _HAS_NAMES:
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking:
        try:
            asking.connect(_name(identity))
        except OSError:
            return False
    return True
