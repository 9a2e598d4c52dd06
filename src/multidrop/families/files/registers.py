"""Registers of a family's file: each entry becomes a declaration, or sentences on its mistakes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from multidrop.drive.family import TAKEN_NAMES
from multidrop.drive.register import HOLDING_MULTIPLE, Access, Carrier, Register, command, reading, setting
from multidrop.families.files.addresses import TABLES, Counting
from multidrop.families.files.names import enumeration, flags, unusable
from multidrop.families.files.register_keys import DEFAULT_KEYS, NOT_DETAILS, REGISTER_KEYS, converted, shown
from multidrop.toml_check import TomlPlace

MOST_REGISTERS = 2000
SECTIONS = tuple(access.value for access in Access)
_DECLARE: Mapping[Access, Callable[..., Register[Any]]] = {
    Access.READING: reading,
    Access.SETTING: setting,
    Access.COMMAND: command,
}
_WITHOUT_BITS = ("number_format", "order", "invalid", "step", "unit")  # defaults that a bit does not take

ReadAddress = Callable[[Any, str | None, str], tuple[int, str]]


@dataclass
class Declared:
    """The registers of a file so far, and where each name was given."""

    counting: Counting
    defaults: Mapping[str, Any]
    write: str
    registers: dict[str, Register[Any]] = field(default_factory=dict)
    places: dict[str, TomlPlace] = field(default_factory=dict)

    def section(self, access: Access, table: Any, place: TomlPlace) -> None:
        """Declare the registers of [reading], [setting] or [command]."""
        if not isinstance(table, dict):
            place.wrong(f"[{access.value}] is no table; write [{access.value}] and NAME = {{ at = 0x0010 }}")
            return
        for name, given in table.items():
            at = place.within(f"[{access.value}] {name[:60]}")
            if not isinstance(given, dict):
                at.wrong(f'{shown(given)} is no register; write {{ at = 0x0010, unit = "Hz" }}')
                self._reserve(name, at)
                continue
            self.add(name, access, given, at, self.counting.address)

    def add(
        self, name: str, access: Access, given: Mapping[str, Any], place: TomlPlace, read: ReadAddress
    ) -> None:
        """Declare one register; `read` reads its addresses."""
        known = self._reserve(name, place)
        good = self._converted(given, place)
        address = self._addresses(given, good, place, read)
        what = self._meaning(name, good, place)
        if not known or address is None:
            return
        details, table = self._details(access, good, address[1])
        if "ram_address" in good:
            details["ram_address"] = good["ram_address"]
        register = place.attempt(_made, access, address[0], what, {**details, "table": table})
        if register is not None:
            register.__set_name__(type(self), name)
            self.registers[name] = register

    def _reserve(self, name: str, place: TomlPlace) -> bool:
        """Note the name's place; False where it cannot be used."""
        if why := unusable(name):
            place.wrong(f"{shown(name)} cannot be a register's name: {why}")
            return False
        if name in TAKEN_NAMES:  # a verb of the file would take its place without a word
            place.wrong("this is a name that every drive has for something else; call it otherwise")
            return False
        if name in self.places:
            first = self.places[name]
            where = (
                ", ".join(first.labels) if first.path == place.path else f"{first.path}, {first.labels[0]}"
            )
            place.wrong(f"{name} is declared twice, first in {where}; every register has its own name")
            return False
        self.places[name] = place
        return True

    def _converted(self, given: Mapping[str, Any], place: TomlPlace) -> dict[str, Any]:
        meant = place.unknown(given, REGISTER_KEYS) if given.keys() - REGISTER_KEYS.keys() else set()
        if "at" not in given and "at" not in meant:
            place.wrong(f"its address is missing; add {REGISTER_KEYS['at'].example}")
        good = {}
        for key, value in given.items():
            if key in REGISTER_KEYS:
                try:
                    good[key] = converted(key, value)
                except ValueError as mistake:
                    place.wrong(mistake)
        return good

    def _addresses(
        self, given: Mapping[str, Any], good: dict[str, Any], place: TomlPlace, read: ReadAddress
    ) -> tuple[int, str] | None:
        """Return the address on the wire and the table; `good` gets its ram_address."""
        if "at" not in given or ("table" in given and "table" not in good):
            good.pop("ram_address", None)
            return None
        found = self._address("at", given, good.get("table"), place, read)
        if "ram_address" in good:
            table = found[1] if found else good.get("table")
            alias = self._address("ram_address", given, table, place, read)
            good.pop("ram_address")
            if alias is not None:
                good["ram_address"] = alias[0]
        return found

    def _address(
        self,
        key: str,
        given: Mapping[str, Any],
        table: str | None,
        place: TomlPlace,
        read: ReadAddress,
    ) -> tuple[int, str] | None:
        try:
            return read(given[key], table, self.defaults.get("table", "holding"))
        except ValueError as mistake:
            place.wrong(f"{key}: {mistake}")
        return None

    def _meaning(self, name: str, good: Mapping[str, Any], place: TomlPlace) -> Any:
        """Return the register's unit, or the enumeration of its values."""
        named = [key for key in ("values", "bits") if key in good]
        if len(named) == 2 or (named and good.get("unit")):
            other = "bits" if len(named) == 2 else "unit"
            place.wrong(f"{named[0]} and {other} are both given; a register has one of unit, values and bits")
        if not named:
            return good.get("unit", self.defaults.get("unit", ""))
        make = enumeration if named[0] == "values" else flags
        return place.attempt(make, name.title().replace("_", ""), good[named[0]]) or ""

    def _details(self, access: Access, good: Mapping[str, Any], table: str) -> tuple[dict[str, Any], Any]:
        space = TABLES[table]
        defaults = {key: value for key, value in self.defaults.items() if key not in NOT_DETAILS}
        if "number_format" in good:
            defaults.pop("invalid", None)  # which are counts of the default format
        if space.carrier is Carrier.BIT:
            defaults = {key: value for key, value in defaults.items() if key not in _WITHOUT_BITS}
        if access is Access.READING:
            defaults.pop("kept", None)
        details = {**defaults, **{key: value for key, value in good.items() if key not in NOT_DETAILS}}
        if table == "holding" and good.get("write", self.defaults.get("write", self.write)) == "multiple":
            space = HOLDING_MULTIPLE
        return details, space


def _made(access: Access, address: int, what: Any, details: dict[str, Any]) -> Register[Any]:
    return _DECLARE[access](address, what, **details)


def defaults_of(table: Any, place: TomlPlace) -> dict[str, Any]:
    """Return what holds for the registers that say nothing else."""
    if not isinstance(table, dict):
        place.wrong('is no table; write [default] and table = "input"')
        return {}
    keys = {key: REGISTER_KEYS[key] for key in DEFAULT_KEYS}
    if table.keys() - keys.keys():
        place.unknown(table, keys)
    good = {}
    for key in [key for key in table if key in keys]:
        try:
            good[key] = converted(key, table[key])
        except ValueError as mistake:
            place.wrong(mistake)
    return good
