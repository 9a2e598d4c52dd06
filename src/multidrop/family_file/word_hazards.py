"""Hazards of the words that verbs write: those that start or reset are never taken for harmless ones.

The words of `stop` are the measure. A start or a reset adds bits to them; what adds such a bit is not
harmless, and nothing adds the bits of both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Any

from multidrop.core import NumberFormat
from multidrop.drive.register import Access, Register
from multidrop.drive.table import Carrier, Kept, Table
from multidrop.drive.verbs import STOPPING
from multidrop.family_file.declared import DeclaredVerbs
from multidrop.family_file.hazards import STARTING
from multidrop.family_file.steps import Insists, Writes, every_step
from multidrop.family_file.words import is_bits, shown
from multidrop.toml_check import TomlPlace

Registers = Mapping[str, Register[Any]]
_ALSO_WRITTEN_BY = {0x05: 0x0F, 0x06: 0x10}
_PLAIN = {"offset": 0, "part": None, "scale_register": "", "ram_address": None}  # of a control register


def check_words(declared: DeclaredVerbs, registers: Registers, place: TomlPlace) -> None:
    """Tell each hazard in the registers that verbs write, and in what is said to be harmless."""
    controls = [name for name in registers if name in _controls(declared)]
    for name in controls:
        at = place.within(name)
        for wrong in chain(
            _kind(name, registers[name]), _aliases(name, registers), _words(declared, registers, name)
        ):
            at.wrong(wrong)
    for name, register in registers.items():
        for wrong in _said_to_be_harmless(declared, name, register):
            place.within(name).wrong(wrong)
    if declared.setpoint is not None and declared.setpoint.register in controls:
        place.within("[set_frequency]").wrong(
            f"{declared.setpoint.register} also runs and stops the motor: a setpoint is another register"
        )


def _controls(declared: DeclaredVerbs) -> set[str]:
    return {
        step.register
        for steps in declared.steps.values()
        for step in every_step(steps)
        if isinstance(step, Writes)
    }


def words_of(declared: DeclaredVerbs, verbs: tuple[str, ...], name: str, *, insisted: bool) -> list[int]:
    """Return the words that these verbs write to a register once, or insist on, in their order."""
    return [
        word
        for verb in verbs
        for step in every_step(declared.steps.get(verb, ()))
        if isinstance(step, Writes) and step.register == name and isinstance(step, Insists) is insisted
        for word in step.words.all
    ]


# ---- the register ----


def _kind(name: str, register: Register[Any]) -> Iterator[str]:
    if register.access is not Access.COMMAND:
        yield f"a verb writes it, and it is a {register.access.value}: declare it under [command]"
    elif not register.commands:
        yield "a verb writes it, and moves = false lets anyone write any word to it: leave moves out"
    if not is_bits(register) and register.values is None:
        yield "a verb writes it, and its words have no names: declare its bits or its values"
    if register.words != 1 or register.number_format not in (NumberFormat.U16, NumberFormat.BIT):
        yield f"a verb writes it, and it is no single word or bit but {register.number_format.name}"
    for key, plain in _PLAIN.items():
        if getattr(register, key, plain) not in (plain, None):
            yield f"a verb writes it: leave out {key}, with which another word or address would be sent"
    if register.kept is Kept.EEPROM:
        yield 'a verb writes it, and every stop would wear its EEPROM: write kept = "ram" or "unknown"'


def _aliases(name: str, registers: Registers) -> Iterator[str]:
    """Find other registers through which a plain write would reach the word that runs the motor."""
    own = _reached(registers[name])
    for other, register in registers.items():
        if other != name and register.access is not Access.READING and own & _reached(register):
            yield f"{other} is written at the same address, past the verbs: leave {other} out"


def _reached(register: Register[Any]) -> set[tuple[object, int]]:
    """Return all places that a write to the register changes, also those of its alias in RAM."""
    if register.table.write is None:
        return set()
    space, words = _space(register.table), range(register.words)
    starts = [register.address, register.ram_address]
    return {(space, start + at) for start in starts if start is not None for at in words}


def _space(table: Table) -> object:
    if table.carrier in (Carrier.BIT, Carrier.WORD):
        return table.carrier, _ALSO_WRITTEN_BY.get(table.write or 0, table.write)
    return table


# ---- its words ----


def _words(declared: DeclaredVerbs, registers: Registers, name: str) -> Iterator[str]:
    register = registers[name]
    starts = words_of(declared, STARTING, name, insisted=False)
    resets = words_of(declared, ("reset_fault",), name, insisted=False)
    stop = [
        step.words.all[0]
        for step in declared.steps.get("stop", ())
        if isinstance(step, Insists) and step.register == name and step.when is None
    ]
    if starts and not stop:
        yield "a start writes it, and stop does not insist on a word of it without `when`"
        return
    yield from _jogs(declared, register, name, stop[0] if stop else 0)
    for word in starts:
        if word in resets:
            yield f"{shown(register, word)} starts the motor and resets a fault: these never go together"
    if is_bits(register):
        yield from _bits(register, stop[0] if stop else 0, starts, resets)


def _jogs(declared: DeclaredVerbs, register: Register[Any], name: str, stop: int) -> Iterator[str]:
    """Find words of a jog that start: it asks for no setpoint."""
    written = [
        step
        for step in declared.steps.get("start", ())
        if isinstance(step, Writes) and not isinstance(step, Insists) and step.register == name
    ]
    for word in words_of(declared, ("jog",), name, insisted=False):
        for started in written[-1].words.all if written else ():
            added = started & ~stop
            if word == started or (is_bits(register) and added and word & added == added):
                yield f"jog word {shown(register, word)} starts the motor, as {shown(register, started)} does"


def _bits(register: Register[Any], stop: int, starts: list[int], resets: list[int]) -> Iterator[str]:
    started, reset = 0, 0
    for word in starts:
        started |= word & ~stop
        if not word & ~stop:
            yield f"start word {shown(register, word)} adds no bit to the stop word {shown(register, stop)}"
    for word in resets:
        reset |= word & ~stop
        if not word & ~stop:
            yield f"reset word {shown(register, word)} adds no bit to the stop word {shown(register, stop)}"
    for word in resets:
        if word & started:
            bits = shown(register, word & started)
            yield f"reset word {shown(register, word)} has bits {bits} of a start: it would start the motor"
    for word in starts:
        if word & reset:
            yield f"start word {shown(register, word)} has bits {shown(register, word & reset)} of a reset"
    for word in register.harmless or ():
        if word & started:
            bits = shown(register, word & started)
            yield f"harmless {shown(register, word)} has bits {bits} of a start or a jog"
        elif word & reset:
            yield f"harmless {shown(register, word)} has bits {shown(register, word & reset)} of a reset"


def _said_to_be_harmless(declared: DeclaredVerbs, name: str, register: Register[Any]) -> Iterator[str]:
    if register.access is Access.READING:
        return
    stopping = words_of(declared, STOPPING, name, insisted=True)
    for word in register.harmless or ():
        if word not in stopping:
            yield f"harmless {_print(register, word)} is sent by no stop or coast: leave it out"
    is_setpoint = declared.setpoint is not None and declared.setpoint.register == name
    stop = [0] if is_setpoint else words_of(declared, ("stop",), name, insisted=True)
    for word in register.broadcast:
        if word not in stop:
            yield f"broadcast {_print(register, word)} is no word of stop: nothing else is sent to all drives"


def _print(register: Register[Any], word: object) -> str:
    return shown(register, word) if isinstance(word, int) else repr(word)
