"""Findings about a port, its adapter and its line: one sentence each, with advice if there is any."""

from __future__ import annotations

import array
import errno
import struct
import sys
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from multidrop.cli.support.values import counted
from multidrop.core import RS485, Completion
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import Settings
from multidrop.transport.port_identity import of_name

LATENCY_MS = 1  # in ms: advise the user to lower the adapter's latency timer if it is longer
ROUNDS = 20
# in s: advise the user if the response delay exceeds the delay that is usual for the family by more than this
SLOW_S = 0.005


_LEVELS = {RS485.RTS_UP: "on", RS485.RTS_DOWN: "off"}


@dataclass(frozen=True)
class Finding:
    topic: str
    what: str
    advice: str = ""
    is_failure: bool = False  # True: the exit status of `doctor` is 1


def adapter_finding(adapter: Adapter, port: str, lasting: str) -> Finding:
    """Return a finding that describes the adapter.

    `lasting` is a device name that contains the adapter's serial number; without such a name, it is `port`.
    """
    advice = f"name it {lasting} in plant files: {port} is assigned in the order of plugging in"
    return Finding("adapter", str(adapter), advice if lasting != port else "")


def latency_finding(adapter: Adapter) -> Finding:
    milliseconds = adapter.latency_timer
    if milliseconds is None:
        return Finding("latency timer", "the driver shows none")
    if milliseconds <= LATENCY_MS:
        return Finding("latency timer", f"{milliseconds} ms: the shortest possible")
    return Finding(
        "latency timer",
        f"{milliseconds} ms: every reply may wait that long in the adapter",
        f"echo {LATENCY_MS} | sudo tee {adapter.latency_path} (permanently, by a udev rule: "
        f'ACTION=="add", SUBSYSTEM=="usb-serial", ATTR{{latency_timer}}="{LATENCY_MS}")',
    )


# Drivers that delay received bytes unless the low-latency flag is set. Other drivers ignore the flag.
HEEDING_LOW_LATENCY = ("", "ftdi_sio", "serial8250")  # "" is an unknown driver


def low_latency_finding(low: bool | None, driver: str = "") -> Finding:
    """Return a finding about a driver's low-latency flag; `low` is None if the driver has no such flag."""
    if driver not in HEEDING_LOW_LATENCY:
        return Finding("low latency", f"the driver {driver} does not delay received bytes: nothing to set")
    if low is None:
        return Finding("low latency", "the driver has no such flag")
    if low:
        return Finding("low latency", "the flag is set; multidrop sets it whenever it opens the port")
    return Finding(
        "low latency",
        "the flag is not set: the driver did not accept it from multidrop",
        "only root may be allowed to set it: setserial PORT low_latency",
    )


def rs485_finding(mode: RS485Mode | None, switch: RS485 = RS485.OFF, *, is_usb: bool = False) -> Finding:
    if switch in _LEVELS:
        doubled = "; the driver's own mode is on too" if mode and mode.enabled else ""
        if is_usb and not doubled:
            return Finding(
                "RS-485 mode",
                f"{switch}: multidrop turns RTS {_LEVELS[switch]} while a request leaves, and on USB for "
                "at least 2 ms longer: a drive that answers sooner is not heard",
                "use an adapter that switches by itself, or its own direction control (TXDEN of an FTDI)",
            )
        return Finding(
            "RS-485 mode",
            f"{switch}: multidrop turns RTS {_LEVELS[switch]} while a request leaves{doubled}",
            'both would switch the direction: set rs485 = "kernel", or remove it' if doubled else "",
        )
    if mode is None:
        return Finding(
            "RS-485 mode", "the driver has none: the adapter itself must switch between sending and receiving"
        )
    if not mode.enabled:
        return Finding(
            "RS-485 mode",
            "off; the driver supports it",
            'if RTS controls the transceiver, set rs485 = "kernel" in the plant file; '
            "an adapter that switches by itself needs no setting",
        )
    hears = (
        ", and the port receives its own requests: multidrop removes the echo" if mode.hears_itself else ""
    )
    return Finding("RS-485 mode", f"on: the driver switches the direction{hears}")


def echo_finding(found: Completion, sent: bytes, settings: Settings) -> Finding:
    """Return a finding: whether the adapter echoes a request to an unused address.

    `found` is the outcome of the request whose bytes are `sent`.
    """
    if found.result > 0:
        return _answered_finding(found, sent, settings)
    received = found.raw
    if not received:
        return Finding("echo", f"none at {settings}")
    if received == sent:
        return Finding("echo", f"the adapter receives its own requests at {settings}; multidrop removes them")
    return Finding(
        "echo",
        f"{counted(len(received), 'unexpected byte')} at {settings}: {received[:16].hex(' ').upper()}",
        "check whether another program or master uses this line, and whether its ends are terminated",
    )


def _answered_finding(found: Completion, sent: bytes, settings: Settings) -> Finding:
    """Return the finding for a valid reply from an address that should be unused."""
    reply = found.reply
    how = f"with exception {reply.exception:02X}" if reply.exception else "with a value"
    echo = "the adapter receives its own requests" if found.skipped == len(sent) else "none"
    return Finding(
        "echo",
        f"{echo} at {settings}; address {reply.address}, which should be unused, answers {how}",
        "either a drive has this address, or a server or gateway answers for missing drives: "
        "a missing drive then looks like one that refuses",
    )


def round_trip_finding(
    drive: Drive,
    delays: list[float],
    asked: int,
    wire: float = 0.0,
    refusals: Collection[int] = (),
    came: str = "",
) -> Finding:
    """Return a finding about the delays of the replies to `asked` requests.

    `delays` are sorted, in s. On a serial device, a delay is the time from the request's last bit to the
    reply's first bit, and `wire` is 0. On a network or pseudo-terminal, the times of bits are unknown. There,
    a delay is the time from the handover of the request to the reply's first byte. `wire` is the part of
    that time, in s, that the request and one character take on a wire. `refusals` are the codes of exception
    replies. A gateway's exception reply has a code but no delay. `came` describes the bytes that were
    received instead of valid replies.
    """
    codes = ", ".join(f"{code:02X}" for code in sorted(set(refusals)))
    if not delays:
        unreached = f": exception {codes}, as from a gateway that does not reach it" if refusals else ""
        silent = f"did not answer {counted(asked, 'request')}{unreached}"
        invalid = f"gave no valid reply to {counted(asked, 'request')}; received: {came}"
        return Finding(
            "round trip",
            f"{drive.name} {invalid if came and not refusals else silent}",
            "check its address, baud rate, format, wiring and power; `multidrop scan` searches for it",
            is_failure=True,
        )
    least, median, most = delays[0], delays[len(delays) // 2], delays[-1]
    figures = f"{median * 1e3:.1f} ms (median; {least * 1e3:.1f} to {most * 1e3:.1f} ms)"
    alone = f"a wire at {drive.settings} takes {wire * 1e3:.1f} ms of it"
    since = f" after its request was handed over ({alone})" if wire else ""
    lost = f"; {asked - len(delays)} of {asked} requests got no valid reply"
    what = f"{drive.name} answers in {figures}{since}{lost if len(delays) < asked else ''}"
    if refusals:
        what += f"; {counted(len(refusals), 'exception')}: {codes}"
    if came:
        what += f"; received instead: {came}"
    if len(delays) < asked:
        return Finding(
            "round trip",
            what,
            "check termination, bias, cable and signal ground, and whether there is another master; "
            "`multidrop poll` and `multidrop report` show when requests are lost",
            is_failure=True,
        )
    if median - wire - drive.response_delay > SLOW_S:
        rest = "the adapter or the network" if wire else "the adapter"
        return Finding(
            "round trip",
            what,
            f"its family usually takes {drive.response_delay * 1e3:.1f} ms: the rest comes from {rest}, "
            "or from the drive's response delay parameter",
        )
    return Finding("round trip", what)


class WakeLateness(NamedTuple):
    """How late a computer wakes a thread: the median, the 99th percentile and the greatest, in s."""

    p50: float
    p99: float
    most: float

    @classmethod
    def of(cls, late: Sequence[float]) -> WakeLateness:
        ordered = sorted(late)
        return cls(ordered[len(ordered) // 2], ordered[len(ordered) * 99 // 100], ordered[-1])

    def __str__(self) -> str:
        return f"{self.p50 * 1e3:.2f} ms late (p50), {self.p99 * 1e3:.2f} (p99), {self.most * 1e3:.2f} (max)"


def wake_finding(
    normal: WakeLateness,
    realtime: WakeLateness | str,
    settings: Settings,
    switch: RS485 = RS485.OFF,
    *,
    is_realtime: bool = False,
) -> Finding:
    """Return a finding: does this computer wake threads early enough for a line with these settings?

    `realtime` is the lateness under realtime scheduling, or the reason why the system refuses it.
    `is_realtime` is the plant file's key `realtime`. The 99th percentile of the lateness must be below t3.5,
    the silence before each request. If multidrop switches the RTS signal, even the greatest lateness must be
    below t3.5: a drive may answer after t3.5, and a later switch would cut off the start of its reply.
    """
    limit, kind = settings.t3_5, "max" if switch in _LEVELS else "p99"

    def is_in_time(late: WakeLateness) -> bool:
        return (late.most if kind == "max" else late.p99) < limit

    used = realtime if is_realtime and not isinstance(realtime, str) else normal
    what = (
        f"the core wakes {normal}; realtime: {'refused' if isinstance(realtime, str) else realtime}; "
        f"{'good enough' if is_in_time(used) else 'too late'} for {settings}: "
        f"{kind} must be below {limit * 1e3:.2f} ms, the silence between two frames"
    )
    if isinstance(realtime, str):
        advice = realtime if is_realtime or not is_in_time(used) else ""
    elif is_in_time(used):
        advice = ""
    elif used is normal and is_in_time(realtime):
        advice = "set realtime = true at the top of the plant file"
    else:
        advice = "stop other programs on this computer, or lower the baud rate"
    return Finding("wake-ups", what, advice)


SYSFS = Path("/sys")

# ioctl requests from linux/serial.h and asm-generic/ioctls.h
TIOCGSERIAL, TIOCGRS485, TIOCSRS485 = 0x541E, 0x542E, 0x542F
SERIAL_STRUCT = 72  # upper limit of the size of struct serial_struct, in bytes
FLAGS_AT = 4  # index of the field `flags`, if the struct is read as an array of ints
LOW_LATENCY = 1 << 13
RS485_STRUCT = struct.Struct("=III5I")
RS485_ENABLED, RS485_RX_DURING_TX = 1 << 0, 1 << 4

_LACKING = {errno.ENOTTY, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS, errno.EIO}


@dataclass(frozen=True)
class Adapter:
    """Facts about an adapter, read from sysfs. An unknown fact is empty or None."""

    name: str  # the terminal's name, such as ttyUSB0
    driver: str = ""
    product: str = ""
    usb_id: str = ""
    latency_timer: int | None = None  # in ms
    latency_path: Path | None = None

    def __str__(self) -> str:
        product = f"{self.product or 'a USB device'} ({self.usb_id})" if self.usb_id else "not on USB"
        return f"{product}; {f'driver {self.driver}' if self.driver else 'driver unknown'}"


@dataclass(frozen=True)
class RS485Mode:
    enabled: bool
    hears_itself: bool


def find_adapter(device: str, sysfs: Path = SYSFS) -> Adapter:
    """Find the adapter behind a device such as /dev/ttyUSB0, or behind a link to a device."""
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
    """Return Windows' description of a COM port's adapter; "" if Windows lists none."""
    with suppress(ImportError, AttributeError, OSError):  # not all these functions exist on Wine
        from serial.tools.list_ports import comports

        return next((found.description for found in comports() if of_name(found.device) == of_name(port)), "")
    return ""


def _usb_device(tty: Path) -> Path | None:
    """Return the USB device's directory: the nearest parent directory that names a product."""
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
    """Return the RS-485 mode that the driver reports; None if the driver has none.

    The mode is also written back as it was read, because a plain 8250 reports a mode but refuses to set one.
    """
    answer = _ask(fd, TIOCGRS485, bytes(RS485_STRUCT.size))
    if answer is None or _ask(fd, TIOCSRS485, answer) is None:
        return None
    return decoded_rs485(answer)


def decoded_rs485(answer: bytes) -> RS485Mode:
    """Return the mode in the bytes of a struct serial_rs485."""
    flags = RS485_STRUCT.unpack(answer)[0]
    return RS485Mode(bool(flags & RS485_ENABLED), bool(flags & RS485_RX_DURING_TX))


def low_latency(fd: int) -> bool | None:
    """Return the low-latency flag that the driver reports; None if the driver has none."""
    answer = _ask(fd, TIOCGSERIAL, bytes(SERIAL_STRUCT))
    return None if answer is None else bool(array.array("i", answer)[FLAGS_AT] & LOW_LATENCY)


def _ask(fd: int, request: int, data: bytes) -> bytes | None:
    """Return the driver's answer to an ioctl with this data; None if the driver does not know the request."""
    if sys.platform != "linux":
        return None
    import fcntl  # imported here, because Windows has no fcntl

    answer = bytearray(data)
    try:
        fcntl.ioctl(fd, request, answer)
    except OSError as failure:
        if failure.errno in _LACKING:
            return None
        raise
    return bytes(answer)
