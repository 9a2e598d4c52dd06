"""Texts of a family's file: read on demand and for identification, never polled."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from multidrop.drive.family import TAKEN_NAMES
from multidrop.drive.text import Text, text
from multidrop.families.files.addresses import TABLES, Counting
from multidrop.families.files.names import unusable
from multidrop.families.files.register_keys import converted, shown
from multidrop.toml_check import Key, TomlPlace

MOST_TEXTS = 100
TEXT_KEYS = {
    "at": Key((int, str), 'at = 0xFC00, 8192, "2000H" or "40001"', needed=True),
    "length": Key(int, "length = 8, registers of two characters", needed=True),
    "table": Key(str, 'table = "input"'),
    "order": Key(str, 'order = "BA", where the second character comes first'),
    "place": Key(str, 'place = "table 9"'),
}


def texts_of(
    section: Any, counting: Counting, registers: Mapping[str, TomlPlace], place: TomlPlace
) -> dict[str, Text]:
    """Return the texts of [text] by name; each mistake is a sentence."""
    if not isinstance(section, dict):
        place.wrong("[text] is no table; write [text] and NAME = { at = 0xFC00, length = 8 }")
        return {}
    if len(section) > MOST_TEXTS:
        place.wrong(f"[text] has {len(section)} texts, and {MOST_TEXTS} are the most")
        return {}
    found: dict[str, Text] = {}
    for name, given in section.items():
        at = place.within(f"[text] {name[:60]}")
        why = unusable(name)
        if why:
            at.wrong(f"{shown(name)} cannot be a text's name: {why}")
        elif name in TAKEN_NAMES:
            at.wrong("every drive has this name for something else; call it otherwise")
        elif name in registers:
            at.wrong("a register has this name too; call one of the two otherwise")
        declared = _text(at.check(given, TEXT_KEYS), counting, at)
        if declared is not None and not why and name not in TAKEN_NAMES:
            found[name] = declared
    return found


def _text(good: dict[str, Any], counting: Counting, place: TomlPlace) -> Text | None:
    if not {"at", "length"} <= good.keys():
        return None
    given = place.attempt(converted, "table", good["table"]) if "table" in good else None
    address = place.attempt(counting.address, good["at"], given, "holding")
    if address is None:
        return None
    details = {key: good[key] for key in ("order", "place") if key in good}

    def make() -> Text:
        return text(address[0], good["length"], table=TABLES[address[1]], **details)

    return place.attempt(make)
