"""Drive names as people give them: keyboards and programs spell one letter in several ways."""

from __future__ import annotations

from collections.abc import Iterable
from unicodedata import normalize


def drive_meant(name: str, names: Iterable[str]) -> str:
    """Return which of the names is meant: this one, else the only one of the same normal form; else `name`.

    For stops and looks alone: what moves a motor names it exactly.
    """
    names = [*names]
    if name in names:
        return name
    alike = [one for one in names if normalize("NFC", one) == normalize("NFC", name)]
    return alike[0] if len(alike) == 1 else name
