"""Parse a port's baud rate and character format, set them, and read them back."""

from __future__ import annotations

from typing import NamedTuple

from multidrop._core import ffi, lib

REFUSALS = {
    lib.MD_REFUSED_BAUDRATE: "baud rate",
    lib.MD_REFUSED_DATABITS: "data bits",
    lib.MD_REFUSED_PARITY: "parity",
    lib.MD_REFUSED_STOPBITS: "stop bits",
}
NO_DIVISOR = int(lib.MD_REFUSED_DIVISOR)  # no whole divisor of the UART's clock gives the baud rate


class CharacterFormat(NamedTuple):
    """Data bits, parity and stop bits of a character."""

    databits: int
    parity: str
    stopbits: int

    @classmethod
    def parse(cls, text: str) -> CharacterFormat:
        """Parse a format such as "8N1"."""
        return cls(int(text[0]), text[1], int(text[2]))


def is_pseudo_terminal(device: str) -> bool:
    """Return True if the device's path is that of a pseudo-terminal."""
    return device.startswith(("/dev/pts/", "/dev/ttys"))


def must_take(device: str) -> int:
    """Return the mask (of REFUSALS) of the settings that a device must not refuse.

    A pseudo-terminal may refuse all settings except the baud rate.
    """
    return int(lib.MD_REFUSED_BAUDRATE) if is_pseudo_terminal(device) else sum(REFUSALS)


def refused_names(mask: int) -> str:
    """Return the names of the refused settings, as text."""
    return ", ".join(name for bit, name in REFUSALS.items() if mask & bit)


def possible_rates(fd: int, baudrate: int) -> tuple[int, int, int]:
    """Return the rate at which a UART would run instead of `baudrate`, and its nearest possible rates."""
    base = int(lib.md_port_baud_base(fd))
    divisor = (base + baudrate // 2) // baudrate
    return base // divisor, base // -(-base // baudrate), base // (base // baudrate)


def close_behind(fd: int, other: int, seconds: float) -> None:
    """Close the port behind descriptor `fd`, which then refers to the file of descriptor `other`.

    The port's driver may still send for `seconds` s; then it discards its unsent bytes.
    """
    lib.md_port_close(fd, other, round(seconds * 1e9))


def get_settings(fd: int) -> tuple[int, str]:
    """Return a port's present baud rate and format. Raises OSError if the port has no such settings."""
    settings = ffi.new("struct md_settings *")
    failure = lib.md_port_get(fd, settings)
    if failure:
        raise OSError(-failure, "no serial settings")
    return settings.baudrate, f"{settings.databits}{settings.parity.decode()}{settings.stopbits}"


def set_settings(fd: int, baudrate: int, format: str) -> int:
    """Put a port in raw mode with these settings; return the mask (of REFUSALS) of the refused settings.

    Raises OSError if the port has no settings.
    """
    refused = lib.md_port_set(fd, ffi.new("struct md_settings *", settings_to_c(baudrate, format)))
    if refused < 0:
        raise OSError(-refused, "no serial settings")
    return int(refused)


def settings_to_c(baudrate: int, format: str) -> dict[str, object]:
    """Return the fields of a struct md_settings."""
    bits = CharacterFormat.parse(format)
    return {"baudrate": baudrate, **bits._asdict(), "parity": bits.parity.encode()}
