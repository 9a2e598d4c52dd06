"""[[identify]]: registers by whose values a drive of the file's family is recognised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.script import Script, read
from multidrop.drive.verbs import Verb, verb
from multidrop.errors import WriteForbidden
from multidrop.toml_check import Key, TomlPlace

MOST_PROOFS = 20
PROOF_KEYS = {
    "register": Key(str, 'register = "device"', needed=True),
    "is": Key(list, "is = [0x010A]"),
    "above": Key((int, float), "above = 71.5"),
    "below": Key((int, float), "below = 76.5"),
}


@dataclass(frozen=True)
class Proof:
    """A register, and the values that it has in a drive of the family: some numbers, or a range."""

    register: str
    values: tuple[float, ...]  # empty: any value in the range
    above: float
    below: float

    @property
    def example(self) -> float:
        """A value that proves the family, such as a simulated drive has."""
        if self.values:
            return self.values[0]
        ends = [end for end in (self.above, self.below) if abs(end) < inf]
        return sum(ends) / 2 if len(ends) == 2 else ends[0] + (1 if self.below == inf else -1)

    def holds(self, value: float) -> bool:
        return self.above < value < self.below and (not self.values or value in self.values)


def proofs_of(section: Any, registers: Mapping[str, Register[Any]], place: TomlPlace) -> tuple[Proof, ...]:
    """Return the proofs that [[identify]] declares, without those that have a mistake."""
    tables = section if isinstance(section, list) else [section]
    if len(tables) > MOST_PROOFS:
        place.wrong(f"[[identify]] has {len(tables)} tables, at most {MOST_PROOFS} are allowed")
        return ()
    found = (_proof(table, registers, at) for table, at in place.inside("identify", tables))
    return tuple(proof for proof in found if proof is not None)


def _proof(table: Any, registers: Mapping[str, Register[Any]], place: TomlPlace) -> Proof | None:
    good = place.check(table, PROOF_KEYS)
    name, values = good.get("register"), good.get("is", [])
    if name is None:
        return None
    if name not in registers or not registers[name].readable:
        place.wrong(f"register = {name!r} is not a readable register of this file")
        return None
    if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        place.wrong(f"is = {values!r} is not right; write {PROOF_KEYS['is'].example}")
        return None
    if not good.keys() & {"is", "above", "below"}:
        place.wrong("says no value; add is = [0x010A], or above and below")
        return None
    return Proof(name, tuple(values), good.get("above", -inf), good.get("below", inf))


def identify_by(proofs: Sequence[Proof]) -> Verb[[], None]:
    """Return the method `identify` of a drive that has these proofs."""

    @verb
    def identify(self: Drive) -> Script[None]:
        """Check that the registers of [[identify]] have their values; raise WriteForbidden if one has not."""
        for proof in proofs:
            register = self.register(proof.register)
            value = yield from read(register)
            if not proof.holds(value):
                shown = f"{register.name} = {register.format(value)}"
                raise WriteForbidden(
                    f"{self.name} shows {shown}: it is no {self.title or type(self).__name__}"
                )

    return identify
