"""Line settings: port names, baud rate and character format, and the durations of characters and silences."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from urllib.parse import SplitResult, urlsplit

from multidrop.core import Framing
from multidrop.errors import NoSuchPort
from multidrop.printable import is_number, masked

BAUDRATES = (50, 4_000_000)  # lowest and highest baud rate
FORMAT = "[78][NEO][12]"


@dataclass(frozen=True)
class Settings:
    """Baud rate and character format of a line, such as 9600 and "8N1"."""

    baudrate: int
    format: str

    def __post_init__(self) -> None:
        if not isinstance(self.baudrate, int) or not (BAUDRATES[0] <= self.baudrate <= BAUDRATES[1]):
            raise ValueError(f"baud rate {self.baudrate!r} is outside {BAUDRATES[0]} to {BAUDRATES[1]}")
        if not re.fullmatch(FORMAT, self.format):
            raise ValueError(
                f"format {self.format!r} is not data bits, parity and stop bits, such as 8N1, 8E1 or 7N2"
            )

    @property
    def databits(self) -> int:
        return int(self.format[0])

    @property
    def parity(self) -> str:
        return self.format[1]

    @property
    def stopbits(self) -> int:
        return int(self.format[2])

    @cached_property
    def character(self) -> float:
        """Seconds of one character: start bit, data bits, parity bit if any, stop bits."""
        bits = 1 + self.databits + (self.parity != "N") + self.stopbits
        return bits / self.baudrate

    @cached_property
    def t3_5(self) -> float:
        """Least silence between RTU frames in s: 3.5 characters, or a fixed time above 19200 baud.

        See the serial-line guide V1.02, 2.5.1.1.
        """
        return 1.75e-3 if self.baudrate > 19200 else 3.5 * self.character

    @property
    def bit(self) -> float:
        return 1 / self.baudrate

    def __str__(self) -> str:
        return f"{self.baudrate} {self.format}"


MODBUS_PORT = 502  # the default port number of tcp:// URLs
SCHEMES = ("tcp", "socket", "rfc2217")  # pyserial has more schemes, but spy:// would overwrite any file
URLS = "tcp://10.0.0.7, socket://10.0.0.7:4001 or rfc2217://10.0.0.7:4001"


def check_port(port: str) -> str:
    """Return `port` unchanged if it is a valid port name.

    Raises NoSuchPort for a URL with an unknown scheme, with a user or a password, or without its host or port
    number.
    """
    scheme, is_url, _ = port.partition("://")
    if is_url and scheme.lower() not in SCHEMES:
        raise NoSuchPort(masked(port), f"the scheme {scheme}:// is not supported; write a URL such as {URLS}")
    if is_url and url_of(port).username is not None:
        raise NoSuchPort(masked(port), "a port takes no user name and no password: remove them from the URL")
    url_of(port)
    return port


def speaks_tcp(port: str) -> bool:
    """Return True for a Modbus TCP port."""
    return port.partition("://")[0].lower() == "tcp"


def url_of(port: str) -> SplitResult:
    """Return the parts of a port's name.

    Raises NoSuchPort for a URL without a host, or without a port number if it needs one.
    """
    try:
        url = urlsplit(port)
        host, number = url.hostname, url.port
    except ValueError as mistake:
        raise NoSuchPort(port, str(mistake)) from mistake
    if url.scheme == "tcp" and (not host or number == 0):
        raise NoSuchPort(
            port, f"the URL needs a host, such as tcp://10.0.0.7 or tcp://10.0.0.7:{MODBUS_PORT}"
        )
    if url.scheme in ("socket", "rfc2217") and not (host and number):
        raise NoSuchPort(
            port, f"the URL needs a host and a port number, such as {url.scheme}://10.0.0.7:4001"
        )
    return url


MOST_SETTLE = 10.0  # limit of `settle` in s, because an exiting process may have to wait as long


def check_settle(settle: float) -> None:
    """Raise ValueError unless `settle` is a valid wait in s after a port is opened."""
    if not (is_number(settle) and 0 <= settle <= MOST_SETTLE):
        raise ValueError(f"settle = {settle!r} is not a number of seconds from 0 to {MOST_SETTLE:g}")


# ---- framing and silence of one drive ----

LONGEST_SILENCE = 1.0  # s
SERIAL_ADDRESSES = range(1, 248)  # 0 is the broadcast address


def framing_on(
    port: str, declared: Framing | None, default: Framing, address: int, *, family: str, speaks_modbus: bool
) -> Framing:
    """Return the framing of a drive on this port: TCP on tcp:// ports, else `declared`, else `default`.

    Raises ValueError if the drive cannot be used on the port.
    """
    wanted = default if declared is None else declared
    if speaks_tcp(port):
        if declared not in (None, Framing.TCP):
            raise ValueError(
                f"framing {wanted} is for serial lines, but {port} speaks Modbus TCP. Remove the framing, or "
                "write socket:// instead of tcp:// if the server forwards serial bytes"
            )
        if not speaks_modbus:
            raise ValueError(
                f"{family} does not speak Modbus, but the port {port} carries only Modbus TCP. Write "
                "socket:// instead of tcp://, and set the server to forward serial bytes"
            )
        return Framing.TCP
    if wanted is Framing.TCP:
        raise ValueError(f"framing tcp is for tcp:// ports, such as tcp://10.0.0.7:502, not for {port}")
    if address not in SERIAL_ADDRESSES:
        raise ValueError(
            f"address {address} is valid only on Modbus TCP; on {port} an address must be "
            f"{SERIAL_ADDRESSES[0]} to {SERIAL_ADDRESSES[-1]}"
        )
    return wanted


def first_given(*choices: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the first value at each place that is not None; None if there is none."""
    return tuple(next((one for one in each if one is not None), None) for each in zip(*choices, strict=True))


def supported(what: str, value: Any, allowed: Sequence[Any], family: str) -> Any:
    """Return `value`. Raises ValueError if it is not among the values that a family allows."""
    # True and 1.0 equal 1 in Python, but are not valid here
    if value in allowed and not isinstance(value, bool | float):
        return value
    choices = f"{allowed[0]} to {allowed[-1]}" if isinstance(allowed, range) else ", ".join(map(str, allowed))
    raise ValueError(f"{what} {value!r} is not supported by {family}; choose {choices}")


def check_agreed_silence(agreed: float, settings: Settings, own: float | None) -> None:
    """Raise ValueError unless `agreed`, a line's silence in s, is valid.

    `own` is the silence in s that an RTU drive's document requires; None for other framings. The longer of
    the two must last at least 1.5 characters, because an RTU frame may contain shorter pauses.
    """
    if not (is_number(agreed) and 0 <= agreed <= LONGEST_SILENCE):
        raise ValueError(f"silence {agreed!r} is not a time from 0 to {LONGEST_SILENCE:g} s")
    least = 1.5 * settings.character
    if own is not None and max(agreed, own) < least:
        raise ValueError(
            f"silence {agreed * 1e6:g} us is too short at {settings}: write {math.ceil(least * 1e6)} us or "
            "more, because a frame may contain pauses of 1.5 characters"
        )
