"""Role: a register that a profile's state machine uses by name, and whose address a family declares.

A family says where a role is and in which manual; the profile says what its bits mean, and which of its
counts are harmless.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag
from typing import Any, cast

from multidrop.drive.number_format import NumberFormat
from multidrop.drive.register import Access, Carrier, Register

_CODED = "what the profile itself says; leave it out"


@dataclass(frozen=True)
class Role:
    """One register of a state machine; `values` and `harmless` are the profile's, and no family's.

    `needed` is False for a register without which the state machine does less. `extra` names bits that a
    family may add to `values`, because makes differ in them.
    """

    access: tuple[Access, ...]
    values: type[IntEnum | IntFlag] | None = None
    harmless: tuple[int, ...] | None = None
    never_together: tuple[int, ...] = ()
    moves: bool | None = None
    units: tuple[str, ...] = ()  # any where there are none
    extra: tuple[str, ...] = ()
    needed: bool = True

    @property
    def is_word(self) -> bool:
        """True where the state machine looks at bits or words rather than at a quantity."""
        return self.values is not None


READING = Role((Access.READING,))
OPTIONAL = Role((Access.READING,), needed=False)
PROOFS = ("station", "signature")  # roles that only tell the family
COMMON: Mapping[str, Role] = {  # of all profiles, besides `control` and `status`
    "reference": Role((Access.SETTING, Access.COMMAND), moves=False, units=("Hz", "%")),
    "output_frequency": READING,
    "fault": OPTIONAL,
    "reference_in_force": Role((Access.READING,), units=("Hz", "%"), needed=False),
    **dict.fromkeys(PROOFS, OPTIONAL),
}


def own_errors(
    name: str, register: Register[Any], roles: Mapping[str, Role], taken: Collection[str]
) -> Iterator[str]:
    """Find what is wrong with a family's register; `taken` are names that a profile has already."""
    if name in roles:
        yield from role_errors(name, roles[name], register)
    elif name in taken:
        yield f"{name}: this is a name that every profile has for something else; call it otherwise"
    elif register.harmless:
        yield f"{name}: harmless counts are those of its control, which the profile says; leave it out"
    if name == "reference" and register.span is not None and register.span[0] < 0:
        yield f"{name}: a reference below 0 may turn the motor the other way; its span begins at 0"
    if name == "reference" and ((register.step or 0) < 0 or register.offset):
        yield f"{name}: a greater count is more of it: its step is above 0, and it has no offset"
    if name == "output_frequency" and (register.part or register.offset or register.scale_register):
        yield f"{name}: it is 0 where the motor stands alone: it has no part, offset and scale_register"


def errors_together(roles: Mapping[str, Role], found: Mapping[str, Any]) -> Iterator[str]:
    """Find roles that are missing, and those that do not fit each other."""
    for name, role in roles.items():
        if role.needed and not isinstance(found[name], Register):
            yield f"{name}: this profile needs a register of this name, which is not declared"
    reference, shown = found.get("reference"), found.get("reference_in_force")
    if reference is not None and shown is not None and reference.unit != shown.unit:
        yield f"reference_in_force: its unit is not that of reference, {reference.unit!r}"
    signature = found.get("signature")
    if signature is not None and signature.values is None:
        yield "signature: it needs names for the values that tell the family"


def role_errors(name: str, role: Role, register: Register[Any]) -> Iterator[str]:
    """Find what a family says of a role that it may not say, or must say differently."""
    if register.access not in role.access:
        wanted = " or a ".join(access.value for access in role.access)
        yield f"{name}: in this profile it is a {wanted}, and not a {register.access.value}"
    for fact in ("harmless", "never_together", "moves", "never"):
        if getattr(register, fact) not in (None, ()) and getattr(register, fact) != "":
            yield f"{name}: {fact} is {_CODED}"
    if role.is_word:
        yield from _word_errors(name, role, register)
    elif role.units and register.unit not in role.units:
        units = " or ".join(repr(unit) for unit in role.units)
        yield f"{name}: its unit is {register.unit!r}; this profile takes {units}"
    if role.units and register.step is None:
        yield f"{name}: its step is not stated, so nothing can be computed with it"
    if register.broadcast and role.harmless is not None and not {*register.broadcast} <= {*role.harmless}:
        yield f"{name}: broadcast has counts that are not harmless in this profile"


def _word_errors(name: str, role: Role, register: Register[Any]) -> Iterator[str]:
    is_plain = register.number_format is NumberFormat.U16 and register.step == 1 and not register.unit
    if not is_plain or register.table.carrier is not Carrier.WORD:
        yield f"{name}: it is one word of bits, without a unit and a step"
    for fact in ("offset", "part", "invalid", "scale_register"):
        if getattr(register, fact, None):
            yield f"{name}: it is a whole word, and takes no {fact}"
    if register.values is None:
        return
    known = ", ".join(role.extra)
    if not role.extra:
        yield f"{name}: its values are {_CODED}"
    elif unknown := [member.name for member in register.values if member.name.lower() not in role.extra]:
        yield f"{name}: bits may only add {known}, and not {', '.join(unknown)}"
    else:
        yield from _extra_errors(name, role, register.values)


def _extra_errors(name: str, role: Role, extra: type[Any]) -> Iterator[str]:
    assert role.values is not None
    taken = {int(member): member.name for member in role.values}
    for member in extra:
        if int(member).bit_count() != 1:
            yield f"{name}: {member.name} is not one bit"
        elif int(member) in taken:
            yield f"{name}: bit {int(member).bit_length() - 1} is {taken[int(member)]} in this profile"


def completed(role: Role, register: Register[Any]) -> Register[Any]:
    """Return the family's declaration with what the profile says of this role."""
    facts: dict[str, Any] = {"moves": role.moves}
    if role.values is not None:
        facts["values"] = _with_extra(role.values, register.values)
    if role.harmless is not None:
        facts["harmless"] = role.harmless
        facts["never_together"] = role.never_together
    return replace(register, **facts)


def _with_extra(values: type[IntEnum | IntFlag], extra: type[Any] | None) -> type[Any]:
    if extra is None:
        return values
    members = {str(member.name): int(member) for one in (values, extra) for member in one}
    make: Any = IntFlag  # its call makes a class, which type checkers know of literals alone
    return cast(type[Any], make(values.__name__, {name.upper(): bits for name, bits in members.items()}))
