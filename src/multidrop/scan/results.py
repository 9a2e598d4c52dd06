"""What a scan tells: drives, addresses and settings where something is amiss, and how far it is."""

from __future__ import annotations

from dataclasses import dataclass

from multidrop.core import Framing
from multidrop.drive.timing import Settings

GUESS = "it only reads like one: look at its name plate"


@dataclass(frozen=True)
class Found:
    """A drive that answers: `models` fit alike, and there is none where no family fits.

    The settings are those of the first of these families that were heard: a drive with another
    number of stop bits answers too.
    """

    address: int
    settings: Settings
    framing: Framing
    models: tuple[str, ...]
    response_delay: float  # s
    doubt: str = ""


@dataclass(frozen=True)
class Crowd:
    """An address from which garbage came again and again, where others bring a reply or nothing."""

    address: int
    settings: Settings
    framing: Framing


@dataclass(frozen=True)
class Noise:
    """A setting at which so many addresses bring garbage that it says nothing of drives."""

    settings: Settings
    framing: Framing
    garbled: int
    asked: int


@dataclass(frozen=True)
class Untried:
    """A setting at which nothing was asked: the port did not take it."""

    settings: Settings
    framing: Framing
    reason: str


@dataclass(frozen=True)
class Progress:
    """One more address was asked; `left` is in s, where nobody answers any more."""

    settings: Settings
    framing: Framing
    address: int
    left: float


Finding = Found | Crowd | Noise | Untried | Progress
