"""Findings of a scan: drives, addresses and settings with problems, and its progress."""

from __future__ import annotations

from dataclasses import dataclass

from multidrop.core import Framing
from multidrop.drive.line_settings import Settings

GUESS = "it only reads like one: look at its name plate"


@dataclass(frozen=True)
class Found:
    """A drive that answers: `models` fit equally well; it is empty if no family fits.

    The settings are the first ones of its families that it answered: a drive with another number of stop
    bits answers too.
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

    Several drives seem to have it, unless `reply` says why a whole frame with a good checksum is none.
    """

    address: int
    settings: Settings
    framing: Framing
    reply: str = ""


@dataclass(frozen=True)
class Noise:
    """A setting with garbage at so many addresses that it cannot come from drives."""

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
    """One more address is done; `left` is the time in s until the end if the rest stays silent."""

    settings: Settings
    framing: Framing
    address: int
    left: float


Finding = Found | Crowd | Noise | Untried | Progress
