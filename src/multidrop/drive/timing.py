"""Line settings, and the time in seconds that characters and silences take with them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class Settings:
    """Baud rate and character format of a line, such as 9600 and "8N1"."""

    baudrate: int
    format: str

    def __post_init__(self) -> None:
        if not isinstance(self.baudrate, int) or not 50 <= self.baudrate <= 4_000_000:
            raise ValueError(f"baud rate {self.baudrate!r} is outside 50 to 4000000")
        if not re.fullmatch("[78][NEO][12]", self.format):
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
        """Silence between RTU frames, s: 3.5 characters, fixed above 19200 (serial-line guide 2.5.1.1)."""
        return 1.75e-3 if self.baudrate > 19200 else 3.5 * self.character

    @property
    def bit(self) -> float:
        return 1 / self.baudrate

    def __str__(self) -> str:
        return f"{self.baudrate} {self.format}"
