"""Checks of the rules for writing a register.

A write that breaks a rule raises `WriteForbidden` with the register, the rule and the place in the manual.
"""

from __future__ import annotations

from typing import Any, TypeVar

from multidrop.drive.family import Drive
from multidrop.drive.link import check_own
from multidrop.drive.register import Access, Carrier, Kept, Register
from multidrop.drive.verbs import VERBS, Condition, Script, read
from multidrop.errors import Advice, Unsupported, WriteForbidden

T = TypeVar("T", bound=float)


def refused(drive: Drive, register: Register[Any], rule: str, advice: Advice | None = None) -> WriteForbidden:
    """Return the error for a write that breaks this rule."""
    return _refusal(register, rule, f"{register.name} of {drive.name} is not written: {rule}", advice)


def _refusal(
    register: Register[Any], rule: str, sentence: str, advice: Advice | None = None
) -> WriteForbidden:
    place = "; ".join(filter(None, (register.place, register.outside)))
    where = f" (manual: {place})" if place else ""
    return WriteForbidden(sentence + where, register=register.name, rule=rule, place=place, advice=advice)


def raw_count(drive: Drive, register: Register[T], value: T) -> float:
    """Return the raw count to send for `value`.

    Raises WriteForbidden if the register or the value cannot be written, and TypeError if the value has the
    wrong type.
    """
    check_own(drive, register)
    if register.never:
        raise refused(drive, register, register.never)
    if not register.writable:
        raise refused(drive, register, f"it is a {register.access.value}")
    try:
        return register.encode(value)
    except ValueError as mistake:
        raise _refusal(register, str(mistake), f"{drive.name}: {mistake}") from mistake


def check_known(drive: Drive, register: Register[Any], raw: float) -> None:
    """Raise WriteForbidden if this write needs the drive's option `confirmed` and the option is not set.

    A stop never needs the option. Writes that may command the motor need it. If the drive's class is from a
    family file, all writes except stops need it.
    """
    is_unproven = bool(drive.declared_in) and "confirmed" in drive.options  # the family file may be wrong
    if is_harmless(register, raw):
        if is_unproven and not is_stop(drive, register, raw):
            drive.check_confirmed(register.name)
    elif register.access is Access.COMMAND or register.commands or is_unproven:
        drive.check_confirmed(register.name)


def check_plain(drive: Drive, register: Register[Any], raw: float) -> None:
    """Raise WriteForbidden for a write that may move the motor: only verbs such as `start` may send it.

    Any other write is checked by `check_known`.
    """
    if is_harmless(register, raw) or not register.commands:
        check_known(drive, register, raw)
        return
    verbs = [name for name in VERBS if name in _MOVING and _has(drive, name)]
    advice = Advice(
        ", ".join(f"{name}()" for name in verbs),
        ", ".join(f"`multidrop {name.replace('_', '-')}`" for name in verbs),
    )
    value = register.format(register.decode(raw))
    way = f"which only verbs may do: use {advice.program}"
    if not verbs:
        way = "and its class does not declare it harmless: add harmless = (…), moves = False, or a verb"
    raise refused(drive, register, f"{value} commands the motor, {way}", advice if verbs else None)


_MOVING = ("start", "stop", "jog", "reset_fault")


def _has(drive: Drive, name: str) -> bool:
    return getattr(type(drive), name) is not getattr(Drive, name)


def check_broadcast(drive: Drive, register: Register[Any], raw: float) -> None:
    """Raise WriteForbidden if the drive needs the option `confirmed` and lacks it. A stop never needs it."""
    if not is_stop(drive, register, raw):
        drive.check_confirmed(register.name)


def is_stop(drive: Drive, register: Register[Any], raw: float) -> bool:
    """Return True if this raw count is harmless at any time and the family has a verb `stop`."""
    return is_harmless(register, raw) and _has(drive, "stop")


def is_harmless(register: Register[Any], raw: float) -> bool:
    """Return True if this raw count may be sent at any time, like a stop, even to a silent drive."""
    return register.harmless is not None and raw in register.harmless


def conditions(drive: Drive, register: Register[T], value: T) -> Script[None]:
    """Read the register's limits from the drive, and check that `value` may be written now.

    Raises WriteForbidden if `value` is beyond a limit, or if the motor must be at rest and is not.
    """
    for name, sign, word in ((register.at_least, 1, "below"), (register.at_most, -1, "above")):
        bound = (yield from _bound(drive, name)) if name else None
        if bound is not None and (value - bound) * sign < 0:
            given, limit = register.format(value), f"{bound:g} {register.unit}".strip()
            raise _not_now(drive, register, f"{given} is {word} {name}, which is {limit}")
    if register.while_running is False:
        yield from _must_stand(drive, register)


def _bound(drive: Drive, name: str) -> Script[float | None]:
    """Return the value of the option or register of this name; None for an option that was not given."""
    if name in drive.options:
        return drive.option.get(name)
    register: Register[float] = drive.register(name)
    return (yield from read(register))


def _must_stand(drive: Drive, register: Register[Any]) -> Script[None]:
    try:
        state = yield from drive.state.script()
    except Unsupported:
        raise _not_now(
            drive, register, "it can be written only at standstill, which the family cannot report"
        ) from None
    if state.condition not in (Condition.STOPPED, Condition.FAULT):
        raise _not_now(drive, register, f"it can be written only at standstill; state: {state}")


def _not_now(drive: Drive, register: Register[Any], rule: str) -> WriteForbidden:
    """Return the error for a rule that depends on the drive's state.

    The manual may not contain the rule, so the error cites it only for the register.
    """
    where = f" (in the manual, {register.name} is {register.place})" if register.place else ""
    sentence = f"{register.name} of {drive.name} is not written: {rule}{where}"
    return WriteForbidden(sentence, register=register.name, rule=rule, place=register.place)


def wears(drive: Drive, register: Register[Any]) -> Kept:
    """Return where the drive keeps a value written to this register: RAM, EEPROM or unknown.

    Callers treat an unknown place like EEPROM, which each write wears.
    """
    if register.ram_address is not None or register.name in drive.ram or register.kept is Kept.RAM:
        return Kept.RAM
    is_bit = register.table.carrier is Carrier.BIT
    if register.kept is Kept.UNKNOWN and (register.access is Access.COMMAND or is_bit):
        return Kept.RAM  # commands and coils are not parameters, and a drive keeps only parameters
    return register.kept
