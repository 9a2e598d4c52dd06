"""Settings of the line that another program's table states: port, baud rate and format of a byte."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from multidrop.drive.family import Drive

UNKNOWN_HOST = "HOST"
_HOST = re.compile(r"[A-Za-z0-9_.:-]{1,200}|\[[0-9A-Fa-f:.]{1,100}\]")
_PORT = re.compile(r"[^!${}\s][^${}]*")  # no tag, and no variable that is substituted elsewhere
_PARITIES = {"n": "N", "none": "N", "e": "E", "even": "E", "o": "O", "odd": "O"}
# What a family takes that says nothing of its formats; an ASCII frame may have 7 bits.
_FORMATS = {"rtu": ("8N1", "8E1", "8O1", "8N2"), "ascii": ("7E1", "7O1", "7N2", "8N1", "8E1", "8O1", "8N2")}


@dataclass(frozen=True)
class LineSettings:
    """A line, as far as it is stated: an empty port, a baud rate of 0 and an empty format are not known."""

    port: str = ""
    baudrate: int = 0
    format: str = ""
    framing: str = "rtu"

    def drive_keys(self) -> dict[str, Any]:
        """Return the keys of a drive in a plant file; a network's line has none but its framing."""
        found: dict[str, Any] = {"framing": self.framing} if self.framing != "rtu" else {}
        if self.is_network:
            return found
        if self.baudrate in Drive.baudrates:
            found["baudrate"] = self.baudrate
        if self.format in _FORMATS[self.framing]:
            found["format"] = self.format
        return found

    def __str__(self) -> str:
        stated = [str(self.baudrate)] * bool(self.baudrate) + [self.format] * bool(self.format)
        return "" if self.is_network else ", ".join(stated)

    @property
    def is_network(self) -> bool:
        return "://" in self.port


UNKNOWN_LINE = LineSettings()


def serial_settings(given: Mapping[str, Any], *, port: Any = "", framing: Any = "rtu") -> LineSettings:
    """Return a serial line's settings of `baudrate`, `bits`, `parity` and `stop`, each where it is stated."""
    parity = _PARITIES.get(str(given.get("parity", "")).lower(), "")
    bits, stop = _whole(given.get("bits")) or 8, _whole(given.get("stop")) or 1
    return LineSettings(
        port[:200] if isinstance(port, str) and _PORT.fullmatch(port) else "",
        _whole(given.get("baudrate")),
        f"{bits}{parity}{stop}" if parity else "",
        "ascii" if str(framing).lower() == "ascii" else "rtu",
    )


def network_settings(
    host: Any, port: Any, *, is_serial_frames: bool = False, framing: str = "rtu"
) -> LineSettings:
    """Return the line of a host: Modbus TCP, or frames of a serial line over a socket.

    A host that is not known is HOST, and a port that is none 502: never a serial port.
    """
    number = _whole(port)
    known = host if isinstance(host, str) and _HOST.fullmatch(host) else UNKNOWN_HOST
    known = f"[{known}]" if ":" in known and not known.startswith("[") else known
    place = f"{known}:{number if 0 < number < 1 << 16 else 502}"
    return LineSettings(f"{'socket' if is_serial_frames else 'tcp'}://{place}", framing=framing)


def _whole(given: Any) -> int:
    """Return a whole number that may be text; 0 for what is none."""
    if isinstance(given, str) and re.fullmatch(r"[0-9]{1,9}", given.strip()):
        given = int(given)
    return given if isinstance(given, int) and not isinstance(given, bool) and 0 < given < 10**9 else 0
