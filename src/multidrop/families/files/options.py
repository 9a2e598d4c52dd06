"""Options of a family's file: [option] NAME = { unit, span, meaning }."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from multidrop.drive.options import Option
from multidrop.families.files.names import unusable
from multidrop.families.files.register_keys import shown
from multidrop.toml_check import Key, TomlPlace

_OPTION_KEYS = {
    "unit": Key(str, 'unit = "Hz"'),
    "span": Key(list, "span = [1, 600]", needed=True),
    "meaning": Key(str, 'meaning = "parameter 1105, of which 20000 is 100 %"', needed=True),
}
# What a drive in a plant file, and its class, have for something else.
_NOT_OPTIONS = frozenset(
    {"name", "model", "address", "framing", "baudrate", "format", "silence", "ram", "every", "poll"}
    | {"confirmed"}
)


def options_of(table: Any, registers: Collection[str], place: TomlPlace) -> dict[str, Option]:
    """Return the options of this table; its mistakes are reported at `place`."""
    if not isinstance(table, dict):
        place.wrong("[option] is no table; write [option] and NAME = { unit, span, meaning }")
        return {}
    options = {}
    for name, given in table.items():
        at = place.within(f"[option] {name[:60]}")
        why = unusable(name)
        if why or name in _NOT_OPTIONS:
            at.wrong(
                f"{shown(name)} cannot be an option's name: {why or 'every drive has it for something else'}"
            )
        if name in registers:
            at.wrong("a register has this name too; call one of the two otherwise")
        good = at.check(given, _OPTION_KEYS)
        span = good.get("span", [])
        if span and (len(span) != 2 or not all(map(_is_number, span)) or span[0] > span[1]):
            at.wrong(f"span = {shown(span)} is not right; write the least and the most, span = [1, 600]")
        elif span and "meaning" in good:
            options[name] = Option(good.get("unit", ""), (span[0], span[1]), good["meaning"])
    return options


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < float("inf")
