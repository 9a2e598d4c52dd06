"""Findings of a scan: drives, addresses and settings with problems, and its progress."""

from __future__ import annotations

from dataclasses import dataclass

from multidrop.core import Framing
from multidrop.drive.line_settings import Settings

GUESS = "it only reads like one: look at its name plate"


@dataclass(frozen=True)
class Found:
    """A drive that answers: `models` fit equally well; it is empty if no family fits.

    The settings are the first ones that it answered. Its number of stop bits may differ, because a drive
    answers requests with another number, too.
    """

    address: int
    settings: Settings
    framing: Framing
    models: tuple[str, ...]
    response_delay: float  # s
    doubt: str = ""


@dataclass(frozen=True)
class Crowd:
    """An address whose answers never match the request.

    Probably several drives have this address. If `reply` is not empty, a frame with a valid checksum came,
    and `reply` says why it does not match.
    """

    address: int
    settings: Settings
    framing: Framing
    reply: str = ""


@dataclass(frozen=True)
class Noise:
    """A setting with invalid bytes at so many addresses that they must be noise."""

    settings: Settings
    framing: Framing
    garbled: int
    asked: int


@dataclass(frozen=True)
class Untried:
    """A setting that the port does not support: no request was sent."""

    settings: Settings
    framing: Framing
    reason: str


@dataclass(frozen=True)
class Progress:
    """One more address is done. `left` is the remaining time in s if no further drive answers."""

    settings: Settings
    framing: Framing
    address: int
    left: float


Finding = Found | Crowd | Noise | Untried | Progress
