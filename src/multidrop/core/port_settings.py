"""A port's baud rate and format, set and read back."""

from __future__ import annotations

from multidrop._core import ffi, lib

REFUSALS = {
    lib.MD_REFUSED_BAUDRATE: "baud rate",
    lib.MD_REFUSED_DATABITS: "data bits",
    lib.MD_REFUSED_PARITY: "parity",
    lib.MD_REFUSED_STOPBITS: "stop bits",
}


def get_settings(fd: int) -> tuple[int, str]:
    """Baud rate and format in force on a port; OSError where it has none."""
    settings = ffi.new("struct md_settings *")
    failure = lib.md_port_get(fd, settings)
    if failure:
        raise OSError(-failure, "no serial settings")
    return settings.baudrate, f"{settings.databits}{settings.parity.decode()}{settings.stopbits}"


def set_settings(fd: int, baudrate: int, format: str) -> int:
    """Make a port raw with these settings; the mask of what it did not take. OSError where it has none."""
    refused = lib.md_port_set(fd, ffi.new("struct md_settings *", settings_to_c(baudrate, format)))
    if refused < 0:
        raise OSError(-refused, "no serial settings")
    return int(refused)


def settings_to_c(baudrate: int, format: str) -> dict[str, object]:
    return {
        "baudrate": baudrate,
        "databits": int(format[0]),
        "parity": format[1].encode(),
        "stopbits": int(format[2]),
    }
