"""A serial port's adapter, as sysfs describes it and its driver answers."""

from __future__ import annotations

import array
import errno
import struct
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from multidrop.transport.port_identity import of_name

SYSFS = Path("/sys")

# linux/serial.h, asm-generic/ioctls.h
TIOCGSERIAL, TIOCGRS485 = 0x541E, 0x542E
SERIAL_STRUCT = 72  # bytes of struct serial_struct, at most
FLAGS_AT = 4  # index among its ints
LOW_LATENCY = 1 << 13
RS485_STRUCT = struct.Struct("=III5I")
RS485_ENABLED, RS485_RX_DURING_TX = 1 << 0, 1 << 4

_LACKING = {errno.ENOTTY, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS, errno.EIO}


@dataclass(frozen=True)
class Adapter:
    """Facts from sysfs; those that are not known are empty or None."""

    name: str  # of the tty, such as ttyUSB0
    driver: str = ""
    product: str = ""
    usb_id: str = ""
    latency_timer: int | None = None  # ms
    latency_path: Path | None = None


@dataclass(frozen=True)
class RS485Mode:
    enabled: bool
    hears_itself: bool


def find_adapter(device: str, sysfs: Path = SYSFS) -> Adapter:
    """Find the adapter behind a device such as /dev/ttyUSB0, or a link to it."""
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


def com_description(port: str) -> str:
    """Return what Windows calls the adapter of a COM port, "" where it lists none."""
    with suppress(ImportError, AttributeError, OSError):  # Wine has not all that is asked here
        from serial.tools.list_ports import comports

        return next((found.description for found in comports() if of_name(found.device) == of_name(port)), "")
    return ""


def _usb_device(tty: Path) -> Path | None:
    """Return the nearest directory above that names a USB product."""
    if not tty.exists():
        return None
    above = tty.resolve()
    return next((path for path in (above, *above.parents) if (path / "idVendor").exists()), None)


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace").strip()
    except OSError:
        return ""


def rs485_mode(fd: int) -> RS485Mode | None:
    """Ask the driver for its RS-485 mode; None where it has none."""
    answer = _ask(fd, TIOCGRS485, RS485_STRUCT.size)
    return None if answer is None else decoded_rs485(answer)


def decoded_rs485(answer: bytes) -> RS485Mode:
    """Decode a struct serial_rs485."""
    flags = RS485_STRUCT.unpack(answer)[0]
    return RS485Mode(bool(flags & RS485_ENABLED), bool(flags & RS485_RX_DURING_TX))


def low_latency(fd: int) -> bool | None:
    """Ask the driver for its low-latency flag; None where it has none."""
    answer = _ask(fd, TIOCGSERIAL, SERIAL_STRUCT)
    return None if answer is None else bool(array.array("i", answer)[FLAGS_AT] & LOW_LATENCY)


def _ask(fd: int, request: int, size: int) -> bytes | None:
    """Return the driver's answer to an ioctl; None where it does not know the request."""
    if sys.platform != "linux":
        return None
    import fcntl  # which Windows lacks

    answer = bytearray(size)
    try:
        fcntl.ioctl(fd, request, answer)
    except OSError as failure:
        if failure.errno in _LACKING:
            return None
        raise
    return bytes(answer)
