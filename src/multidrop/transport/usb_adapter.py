"""USBAdapter: which one has a device's name, by what Linux tells of it; other systems tell nothing.

A name such as /dev/ttyUSB0 is given anew when adapters come back, and perhaps to another one, on whose line
the same address is another drive's.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

TTYS = Path("/sys/class/tty")
_INTERFACE = re.compile(r"[\d.-]+:(\d+\.\d+)")  # 1-4.2:1.0: of what is plugged in at 1-4.2


@dataclass(frozen=True)
class USBAdapter:
    """One port of an adapter: where that is plugged in, and its serial number, if it has one."""

    place: str
    serial: str

    def is_same(self, other: USBAdapter) -> bool:
        if self.serial and other.serial:
            return self.serial == other.serial
        return self.place == other.place

    def __str__(self) -> str:
        return self.serial or f"at {self.place}"


def adapter_of(device: str) -> USBAdapter | None:
    """Return the adapter that has this device's name now; None where there is none, or nothing is told."""
    found = (TTYS / Path(device).name / "device").resolve()
    for part in (found, *found.parents):
        if interface := _INTERFACE.fullmatch(part.name):
            number = f"{interface[1]}.{_text(found / 'port_number') or 0}"  # of the adapter's ports
            serial = _text(part.parent / "serial")
            return USBAdapter(f"{part.parent.name}:{number}", serial and f"{serial}:{number}")
    return None


def _text(file: Path) -> str:
    try:
        return file.read_text("ascii", errors="replace").strip()
    except OSError:
        return ""
