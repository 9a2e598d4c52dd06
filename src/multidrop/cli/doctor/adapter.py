"""What the system says of a serial port's adapter: sysfs, and what the driver answers."""

from __future__ import annotations

import array
import errno
import fcntl
import struct
import sys
from dataclasses import dataclass
from pathlib import Path

SYSFS = Path("/sys")

# linux/serial.h, asm-generic/ioctls.h
TIOCGSERIAL, TIOCGRS485 = 0x541E, 0x542E
SERIAL_STRUCT = 72  # bytes that struct serial_struct takes at most
FLAGS_AT = 4  # of its ints
LOW_LATENCY = 1 << 13
RS485_STRUCT = struct.Struct("=III5I")
RS485_ENABLED, RS485_RX_DURING_TX = 1 << 0, 1 << 4

_LACKING = {errno.ENOTTY, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS, errno.EIO}


@dataclass(frozen=True)
class Adapter:
    """What is known without opening the port; what is not known is empty or None."""

    name: str  # of the tty, such as ttyUSB0
    driver: str = ""
    product: str = ""
    usb_id: str = ""
    latency_timer: int | None = None  # ms
    latency_path: Path | None = None


@dataclass(frozen=True)
class RS485Mode:
    """How the driver switches the direction, where it does."""

    enabled: bool
    hears_itself: bool


def find_adapter(device: str, sysfs: Path = SYSFS) -> Adapter:
    """The adapter behind a device such as /dev/ttyUSB0, or a link to it."""
    name = Path(device).resolve().name
    tty = sysfs / "class/tty" / name / "device"
    driver = tty / "driver"
    usb = _usb_device(tty)
    timer = sysfs / "bus/usb-serial/devices" / name / "latency_timer"
    return Adapter(
        name,
        driver.resolve().name if driver.exists() else "",
        " ".join(filter(None, (_text(usb / "manufacturer"), _text(usb / "product")))) if usb else "",
        f"{_text(usb / 'idVendor')}:{_text(usb / 'idProduct')}" if usb else "",
        int(_text(timer)) if _text(timer).isdigit() else None,
        timer if timer.exists() else None,
    )


def _usb_device(tty: Path) -> Path | None:
    """The nearest one above that says which product it is."""
    if not tty.exists():
        return None
    above = tty.resolve()
    return next((it for it in (above, *above.parents) if (it / "idVendor").exists()), None)


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def rs485_mode(fd: int) -> RS485Mode | None:
    """None where the driver has none."""
    if sys.platform != "linux":
        return None
    answer = bytearray(RS485_STRUCT.size)
    try:
        fcntl.ioctl(fd, TIOCGRS485, answer)
    except OSError as failure:
        if failure.errno in _LACKING:
            return None
        raise
    return decoded_rs485(bytes(answer))


def decoded_rs485(answer: bytes) -> RS485Mode:
    """What a struct serial_rs485 says."""
    flags = RS485_STRUCT.unpack(answer)[0]
    return RS485Mode(bool(flags & RS485_ENABLED), bool(flags & RS485_RX_DURING_TX))


def low_latency(fd: int) -> bool | None:
    """Whether the driver hands over at once what comes; None where it has no such flag."""
    if sys.platform != "linux":
        return None
    known = array.array("i", [0] * (SERIAL_STRUCT // 4))
    try:
        fcntl.ioctl(fd, TIOCGSERIAL, known)
    except OSError as failure:
        if failure.errno in _LACKING:
            return None
        raise
    return bool(known[FLAGS_AT] & LOW_LATENCY)
