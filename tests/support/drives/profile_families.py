"""Shipped families that command motors: their plant-file options, and control words that start motors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from multidrop.core import Message
from multidrop.drive import Drive
from multidrop.families.profiles import Profile
from multidrop.families.registry import SHIPPED, shipped_family

READ_ONLY = ("erman-er-g-220-03", "erman-er-g-220-05")
EXTENDED = {"erman-er-g-220-02": "erman-er-g-220", "innovert-idd-mini-plus": "innovert-ibd"}
COMMANDED = tuple(name for name in SHIPPED if name not in READ_ONLY)
OF_PROFILE = tuple(name for name in COMMANDED if name not in EXTENDED)


def shipped(name: str, address: int) -> Drive:
    """Return a drive of a shipped family with the options that its owner must set, such as `confirmed`."""
    family = shipped_family(name)
    is_percent = issubclass(family, Profile) and family.reference.unit == "%"
    options = {"maximum_frequency": 50} if is_percent else {}
    return family(address, confirmed=1, **options)


ALL: dict[str, Callable[[int], Drive]] = {name: partial(shipped, name) for name in OF_PROFILE}

# One family of each profile, for tests that run once per profile.
REPRESENTATIVES = (
    *("abb-acs355", "siemens-v20", "schneider-atv320", "danfoss-fc51", "delta-vfd-el", "invt-goodrive"),
    *("delixi-e", "powtran-pi130", "optidrive-e3", "yaskawa-a1000"),
)
MAKE = {name: ALL[name] for name in REPRESENTATIVES}

# Family classes that tests subclass.
Acs355: Any = shipped_family("abb-acs355")
Atv320: Any = shipped_family("schneider-atv320")
Fc51: Any = shipped_family("danfoss-fc51")
Goodrive: Any = shipped_family("invt-goodrive")
VfdEl: Any = shipped_family("delta-vfd-el")


def _word(request: Message) -> int:
    return int.from_bytes(request.data[:2])


def _at(address: int, starts: Callable[[int], bool]) -> Callable[[Message], bool]:
    return lambda each: each.start == address and starts(_word(each))


def _bit_1(word: int) -> bool:
    return bool(word & 0x02)


def _jog_or_run(word: int) -> bool:
    return word in (1, 2, 3, 4)


# Writes (address, control word) that start the motor, typed from the manuals.
STARTS: dict[str, Callable[[Message], bool]] = {
    "abb-acs355": _at(0, lambda word: word & 0x09 == 0x09),
    "siemens-v20": _at(99, lambda word: word & 0x09 == 0x09),
    "schneider-atv320": _at(8501, lambda word: word & 0x0F == 0x0F),
    "danfoss-fc51": _at(49999, lambda word: bool(word & 0x0140)),
    "delta-vfd-el": _at(0x2000, _bit_1),
    "delta-ms300": _at(0x2000, _bit_1),
    "delta-cp2000": _at(0x2000, _bit_1),
    "invt-goodrive": _at(0x2000, _jog_or_run),
    "invt-chf100a": _at(0x1000, _jog_or_run),
    "fuling-dzb": _at(0x1000, _jog_or_run),
    "delixi-e": _at(0xA000, _jog_or_run),
    "powtran-pi130": _at(0x2000, _jog_or_run),
    "optidrive-e3": _at(0, lambda word: bool(word & 0x01)),
    "yaskawa-a1000": _at(1, lambda word: bool(word & 0x03)),
    "yaskawa-v1000": _at(1, lambda word: bool(word & 0x03)),
}
