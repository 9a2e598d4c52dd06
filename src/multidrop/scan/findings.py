"""The findings of a scan: drives, problems and progress."""

from __future__ import annotations

from dataclasses import dataclass

from multidrop.core import Framing
from multidrop.drive.line_settings import Settings

GUESS = "only its registers look like this model: check its name plate"


def line_setting(settings: Settings, framing: Framing) -> str:
    """Return a line setting as text, without a baud rate for Modbus TCP."""
    return "Modbus TCP" if framing is Framing.TCP else f"{settings} {framing}"


@dataclass(frozen=True)
class Found:
    """A drive that answers; `models` are the equally likely families, empty if no family fits.

    The settings are the first at which the drive answered. The drive's own number of stop bits may differ,
    because a drive also answers requests with another number of stop bits.
    """

    address: int
    settings: Settings
    framing: Framing
    models: tuple[str, ...]
    response_delay: float  # in s
    doubt: str = ""


@dataclass(frozen=True)
class Crowd:
    """An address whose replies never match the request; probably several drives have this address.

    If a reply had a valid checksum, `reply` says why it does not match; else `reply` is empty.
    """

    address: int
    settings: Settings
    framing: Framing
    reply: str = ""


@dataclass(frozen=True)
class Noise:
    """A line setting at which so many addresses gave invalid bytes that these are probably noise."""

    settings: Settings
    framing: Framing
    garbled: int
    asked: int


@dataclass(frozen=True)
class Untried:
    """A line setting that was skipped because the port does not support it."""

    settings: Settings
    framing: Framing
    reason: str


@dataclass(frozen=True)
class Progress:
    """A report after each address. `left` is the scan's remaining time in s if no further drive answers."""

    settings: Settings
    framing: Framing
    address: int
    left: float


Finding = Found | Crowd | Noise | Untried | Progress
