"""Every mistake in a drive class is reported when the class is defined."""

from __future__ import annotations

import math
from enum import IntEnum, IntFlag
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tables import table

from multidrop.core import Framing, NumberFormat
from multidrop.drive import Drive, Script, insist
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.register import COIL, HOLDING, INPUT, Option, Register, Table, command, reading, setting
from multidrop.drive.verbs import VERBS, verb
from multidrop.families import DelixiNative, InnovertIBD


class Run(IntEnum):
    STOP = 0
    GO = 1


def declare(**registers: Any) -> type[Drive]:
    return type("Fan", (Drive,), registers)


def mistakes_in(**registers: Any) -> tuple[str, ...]:
    """Return the mistakes in a drive class with these attributes and registers."""
    with pytest.raises(DeclarationError) as refusal:
        declare(**registers)
    assert str(refusal.value) == "\n".join(f"Fan.{mistake}" for mistake in refusal.value.mistakes)
    return refusal.value.mistakes


WRONG: dict[str, dict[str, Any]] = {
    "step = 0 is not a number, such as 0.1": {"step": 0},
    "step = '0.1' is not a number": {"step": "0.1"},
    "step = nan is not a number": {"step": float("nan")},
    "step = True is not a number": {"step": True},
    "number_format = 'f32' is not a NumberFormat: U16, I16, ": {"number_format": "f32"},
    "number_format = 7 is not a NumberFormat: ": {"number_format": 7},
    "number_format = NumberFormat.BIT does not fit a holding register": {"number_format": NumberFormat.BIT},
    "number_format = NumberFormat.F32 does not fit a coil": {
        "number_format": NumberFormat.F32,
        "table": COIL,
    },
    "number_format = U32_EITHER has no fixed word order, so the register cannot": {
        "number_format": NumberFormat.U32_EITHER
    },
    "offset = '-40' is not a number, such as -40": {"offset": "-40"},
    "offset = inf is not a number": {"offset": float("inf")},
    "order = 'DCAB' is not one of AB, BA, ABCD, CDAB, BADC, DCBA": {"order": "DCAB"},
    "order = 'BA' is for one word, not for 2: write CDAB, BADC or DCBA": {
        "order": "BA",
        "number_format": NumberFormat.U32,
    },
    "order is only for 16-bit registers, and not for a coil": {"order": "CDAB", "table": COIL},
    "invalid = '7FFF' is not a tuple of at most 4 raw counts, such as (0x7FFF,)": {"invalid": "7FFF"},
    "invalid = (1, 2, 3, 4, 5) is not a tuple of at most 4 raw counts": {"invalid": (1, 2, 3, 4, 5)},
    "invalid = 65536 is not a raw count of 16 bits": {"invalid": 65536},
    "invalid = inf is not a raw count of 16 bits": {"invalid": float("inf")},
    "invalid = 1.5 is not a raw count of 16 bits": {"invalid": 1.5},
    "invalid = nan is for floats, but the register holds a whole number": {"invalid": float("nan")},
    "a part of a word cannot be written, because other bits would change: declare a reading": {
        "part": (0, 3)
    },
    "a register with number_format = I8 cannot be written": {"number_format": NumberFormat.I8},
    "its scale register exponent is not declared": {"scale_register": "exponent"},
    "span = (60, 0) is not the smallest and the largest value, such as (0, 50)": {"span": (60, 0)},
    "span = 60 is not the smallest and the largest value": {"span": 60},
    "span = (0, inf) is not the smallest and the largest value": {"span": (0, float("inf"))},
    "an end of its span cannot be written: speed = 70000 does not fit: the register holds 0 to 65535 rpm": {
        "span": (0, 70000)
    },
    "default = 70 is outside its span of 0 to 60": {"span": (0, 60), "default": 70},
    "default = 'slow' is not a number": {"default": "slow"},
    "table = 'coil' is not a table": {"table": "coil"},
    "an input register cannot be written": {"table": INPUT},
    "kept = 'RAM' is not one of": {"kept": "RAM"},
    "harmless = <Run.STOP: 0> is not a tuple of raw counts": {"harmless": Run.STOP},
    "never = True is not a text": {"never": True},
    "titles = {'de': 'Strom'} is not texts by ('ru', 'zh')": {"titles": {"de": "Strom"}},
    "while_running = 'no' is neither True nor False": {"while_running": "no"},
    "its bound fastest is neither an option nor a register with a readable number": {"at_most": "fastest"},
    "function 15 cannot write a word: write 06H or 10H": {"table": Table("relay", 3, 0x0F)},
    "function 101 cannot read a word": {"table": Table("fifo", 101, 0x10)},
    "ram_address = 65536 is not an address from 0 to FFFFH": {"ram_address": 0x10000},
    "its ram_address must differ from its address, where writes wear": {"ram_address": 5},
}


@table("mistake", WRONG)
def test_a_mistake_in_a_register_is_reported_with_its_name(mistake: str) -> None:
    (sentence,) = mistakes_in(speed=setting(5, "rpm", **WRONG[mistake]))
    assert sentence.startswith(f"speed: {mistake}")


PARTS: dict[str, dict[str, Any]] = {
    "part = (7, 4) is not the lowest and the highest bit, such as (0, 7)": {"part": (7, 4)},
    "part = (-1, 4) is not the lowest and the highest bit": {"part": (-1, 4)},
    "part = 3 is not the lowest and the highest bit, such as (0, 7)": {"part": 3},
    "its part ends at bit 16, but its number has only bits 0 to 15": {"part": (0, 16)},
    "part is for whole numbers, not for number_format = F32": {
        "part": (0, 3),
        "number_format": NumberFormat.F32,
    },
    "FAR is bit 17, but its register has 0 to 15": {"what": IntFlag("Bits", {"FAR": 1 << 17})},
    "HIGH is bit 4, but its register has 0 to 3": {"what": IntFlag("Bits", {"HIGH": 16}), "part": (4, 7)},
    "LOW = -1 is not within 0 to 15, the raw counts of the register": {
        "what": IntEnum("Names", {"LOW": -1}),
        "part": (4, 7),
    },
    "part is only for 16-bit registers, and not for a coil": {"part": (0, 0), "table": COIL},
    "number_format = U32_EITHER has no fixed word order: remove order and": {
        "invalid": 1,
        "number_format": NumberFormat.U32_EITHER,
    },
    "number_format = U32_EITHER has no fixed word order: remove order and invalid": {
        "order": "CDAB",
        "number_format": NumberFormat.U32_EITHER,
    },
}


@table("mistake", PARTS)
def test_a_mistake_in_a_read_only_register_is_reported(mistake: str) -> None:
    details = dict(PARTS[mistake])
    (sentence,) = mistakes_in(level=reading(5, details.pop("what", ""), **details))
    assert sentence.startswith(f"level: {mistake}")


BITS = IntFlag("Bits", {"RUN": 1, "RESET": 8})
WRITTEN: dict[str, dict[str, Any]] = {
    "harmless = 65536 is not within 0 to 65535, the raw counts": {"harmless": (0, 65536)},
    "harmless = -1 is not within 0 to 65535, the raw counts": {"harmless": (-1,)},
    "broadcast = 40000 is not within -32768 to 32767, the raw counts": {
        "broadcast": (40000,),
        "number_format": NumberFormat.I16,
    },
    "broadcast = 2 is not within 0 to 1, the raw counts": {"broadcast": (2,), "table": COIL},
    "never_together = 0088H has no effect on bits without names: name": {"never_together": (0x88,)},
    "never_together = 0009H has no effect": {"what": Run, "never_together": (9,)},
    "never_together = 0H is not a mask of the register's bits": {"what": BITS, "never_together": (0,)},
    "never_together = 10009H is not a mask of the register's bits": {
        "what": BITS,
        "never_together": (0x10009,),
    },
    "its default is not valid: level = 70000 does not fit: the register holds 0 to 65535": {"default": 70000},
}


@table("mistake", WRITTEN)
def test_declared_raw_count_is_reported_if_no_write_can_send_it(mistake: str) -> None:
    details = dict(WRITTEN[mistake])
    (sentence,) = mistakes_in(level=setting(5, details.pop("what", ""), **details))
    assert sentence.startswith(f"level: {mistake}")


def test_declared_raw_counts_that_a_write_can_send_are_accepted() -> None:
    assert declare(
        level=setting(5, harmless=(-1, 0), number_format=NumberFormat.I16, default=-3),
        control=command(6, BITS, harmless=(0, 0x8000), never_together=(9,), broadcast=(0,)),
    )


SCALED: dict[str, dict[str, Register[Any]]] = {
    "its scale register power must be a readable I16, because it holds a power of ten": {
        "power": reading(12)
    },
    "its scale register power must be a plain count, because it holds a power of ten": {
        "power": reading(12, number_format=NumberFormat.I16, step=0.1)
    },
    "its scale register power must be in the same table, because one request reads both": {
        "power": reading(12, number_format=NumberFormat.I16, table=INPUT)
    },
    "address 000BH between it and its scale register power is not declared": {
        "power": reading(12, number_format=NumberFormat.I16)
    },
    "one request reads at most 125 registers, but these are 191 registers with its scale register power": {
        "power": reading(200, number_format=NumberFormat.I16)
    },
}


@table("mistake", SCALED)
def test_a_scale_register_too_far_away_for_one_request_is_reported(mistake: str) -> None:
    (sentence,) = mistakes_in(level=reading(10, scale_register="power"), **SCALED[mistake])
    assert sentence.startswith(f"level: {mistake}")


def test_register_with_a_scale_register_must_be_a_read_only_number() -> None:
    power = reading(6, number_format=NumberFormat.I16)
    (sentence,) = mistakes_in(level=setting(5, scale_register="power"), power=power)
    assert sentence.startswith("level: a register with a scale register cannot be written")
    (sentence,) = mistakes_in(
        level=reading(5, Run, scale_register="power"), power=reading(6, number_format=NumberFormat.I16)
    )
    assert sentence == "level: a register with a scale register cannot have names or an offset"


def test_the_limit_of_registers_in_one_read_includes_the_scale_register() -> None:
    registers = {
        "most_registers": {HOLDING: 2},
        "level": reading(5, scale_register="power"),
        "between": reading(6),
        "power": reading(7, number_format=NumberFormat.I16),
    }
    with pytest.raises(DeclarationError, match="one request reads at most 2 registers, but these are 3"):
        type("Fan", (Drive,), registers)


def test_a_subclass_that_replaces_a_scale_register_is_reported() -> None:
    first = declare(
        level=reading(5, scale_register="power"), power=reading(6, number_format=NumberFormat.I16)
    )
    with pytest.raises(DeclarationError, match="level: its scale register power was declared again"):
        type("Other", (first,), {"power": reading(4, number_format=NumberFormat.I16)})
    assert first.registers["level"].reach == range(5, 7)


def test_word_and_ranges_of_its_bits_may_share_an_address() -> None:
    fan = declare(
        status=setting(5), fault=reading(5, part=(0, 7)), runs=reading(5, part=(8, 8)), speed=reading(6)
    )
    assert [len(register.reach) for register in fan.registers.values()] == [1, 1, 1, 1]


def test_all_mistakes_in_a_drive_class_are_reported_together() -> None:
    mistakes = mistakes_in(
        speed=reading(1, "rpm", step=0),
        level=reading(0xFFFF, "m", number_format=NumberFormat.F32),
        start=setting(2),
        registers=setting(3),
        address=setting(4),
        perform=setting(5),
        lost=reading("6", "V"),  # type: ignore[call-overload]
        run=command(7, "GO", number_format="u16", span=(5, 1)),  # type: ignore[arg-type]
    )
    assert [mistake.partition(":")[0] for mistake in mistakes] == [
        *("speed", "level", "start", "registers", "address", "perform", "lost", "run", "run")
    ]
    assert mistakes[1] == "level: address FFFFH: its 2 words reach beyond FFFFH"
    assert (
        mistakes[2]
        == "start: reserved name: every drive has an attribute with this name; rename the register"
    )
    assert mistakes[6] == "lost: address = '6' is not an address from 0 to FFFFH"


@given(st.fixed_dictionaries({}, optional={key: st.just(value) for key, value in {
    "step": "0.1", "span": (2, 1), "number_format": "f32", "kept": "RAM", "table": "coil", "default": "x",
    "harmless": (1.5,), "broadcast": 3, "never": 1, "ram_address": -1, "at_least": "none", "moves": 7,
}.items()}))  # fmt: skip
def test_each_error_of_a_wrong_drive_class_fits_on_one_line(wrong: dict[str, Any]) -> None:
    register = setting(1, "V", **wrong)
    if wrong:
        assert mistakes_in(v=register)
        assert all(record.startswith("v: ") and "\n" not in record for record in mistakes_in(v=register))
    else:
        declare(v=register)


def test_different_writable_registers_at_one_address_are_reported() -> None:
    for other in (
        setting(8, "V", number_format=NumberFormat.I16),
        setting(8, "V", step=0.1),
        command(8, "V"),
        setting(7, number_format=NumberFormat.U32),
    ):
        (mistake,) = mistakes_in(volts=setting(8, "V"), other=other)
        assert mistake.startswith("other: volts is written at the same address with another format, step")
    several = Table("holding register, several", 0x03, 0x10)
    assert mistakes_in(volts=setting(8), other=setting(8, table=several, number_format=NumberFormat.U32))


def test_register_writing_to_a_motor_commands_address_is_reported() -> None:
    run = command(0x20, Run, harmless=(0,))
    assert mistakes_in(run=run, speed=setting(9, "rpm", ram_address=0x20)) == (
        "speed: its ram_address is that of run, which commands the motor",
    )
    wide = setting(9, "rpm", ram_address=0x1F, number_format=NumberFormat.U32)
    assert mistakes_in(run=run, speed=wide) == (
        "speed: its ram_address is that of run, which commands the motor",
    )
    assert mistakes_in(run=run, again=command(0x20, ram_address=0x20)) != ()
    (mistake,) = mistakes_in(run=run, again=command(0x20, harmless=(0, 1)))
    assert mistake.startswith("again: run is written at the same address with another format, step, access")
    assert declare(run=run, speed=setting(9, "rpm", ram_address=0x21)).registers


def test_two_registers_with_equal_declarations_may_share_an_address() -> None:
    family = declare(
        volts=setting(8, "V"),
        volts_again=setting(8, "V", span=(0, 5)),
        held=reading(8, "V", number_format=NumberFormat.I16),
        relay=setting(8, table=COIL),
        input=reading(8, table=INPUT),
        status=reading(0x20),
        control=command(0x20, Run, harmless=(0,)),
        alias=setting(9, ram_address=8),
    )
    assert len(family.registers) == 8
    assert DelixiNative.registers  # its parameters are declared for two function codes at the same address


def test_one_register_object_with_two_names_is_reported() -> None:
    speed = reading(1, "rpm")
    assert mistakes_in(speed=speed, rpm=speed) == (
        "rpm: this object is already the register speed; declare a new one",
    )

    class Base(Drive):
        """A family with two registers."""

        speed = reading(1, "rpm")
        torque = reading(2, "%")

    class Less(Base):
        """A subclass without one of the registers."""

        speed = None  # type: ignore[assignment]

    assert list(Less.registers) == ["torque"]
    assert list(Base.registers) == ["speed", "torque"]


def test_register_is_reported_if_its_table_forbids_the_access() -> None:
    blind = Table("output", None, 0x06)
    assert mistakes_in(v=reading(1, table=blind)) == (
        "v: an output cannot be read, so it cannot hold a reading",
    )
    assert mistakes_in(v=reading(1, harmless=(0,)))
    assert declare(v=command(1, table=blind, harmless=(0,)))
    assert declare(v=setting(1, table=INPUT, never="it is the maker's"))
    assert HOLDING.read == 3


WRONG_FACTS: list[tuple[str, Any, str]] = [
    ("silence", "x", "silence = 'x' is not a number of s from 0 to 1"),
    ("silence", 20, "silence = 20 is not a number of s from 0 to 1"),
    ("silence_characters", -1, "silence_characters = -1 is not a number of characters from 0 to 1000"),
    ("response_delay", math.nan, "response_delay = nan is not a number of s from 0 to 60"),
    ("response_delay_characters", True, "response_delay_characters = True is not a number of characters"),
    ("response_timeout", 300, "response_timeout = 300 is not a number of s above 0, up to 60"),
    ("response_timeout", 0, "response_timeout = 0 is not a number of s above 0, up to 60"),
    ("answering_time", None, "answering_time = None is not a number of s from 0 to 60"),
    ("turnaround_delay", math.inf, "turnaround_delay = inf is not a number of s from 0 to 60"),
    ("addresses", 5, "addresses = 5 is not a range of addresses, such as range(1, 248)"),
    ("addresses", range(1, 300), "addresses = range(1, 300) is not a range of addresses"),
    ("addresses", range(5, 5), "addresses = range(5, 5) is not a range of addresses"),
    ("baudrates", 9600, "baudrates = 9600 is not a tuple of baud rates, such as (9600, 19200)"),
    ("baudrates", (9.6e3,), "baudrates = (9600.0,) is not a tuple of baud rates"),
    ("framings", (), "framings = () is not a tuple of framings, such as (Framing.RTU,)"),
    ("framings", ("rtu",), "framings = ('rtu',) is not a tuple of framings"),
    ("formats", ("8N1",), "formats = ('8N1',) is not a mapping, such as {Framing.RTU: "),
    ("formats", {Framing.RTU: ("8X1",)}, "formats = {<Framing.RTU: 0>: ('8X1',)} is not a mapping"),
    ("formats", {Framing.ASCII: ("7N2",)}, "formats has no list for rtu, the first framing"),
    ("exceptions", {1: 2}, "exceptions = {1: 2} is not a mapping of codes"),
    ("exceptions", {256: "x"}, "exceptions = {256: 'x'} is not a mapping of codes"),
    ("damaged", 17, "damaged = 17 is not a set of codes, such as frozenset({6})"),
    ("later", {"6"}, "later = {'6'} is not a set of codes"),
    (
        "most_registers",
        {"holding": 16},
        "most_registers = {'holding': 16} is not a mapping, such as {HOLDING: 16}",
    ),
    ("readable_gaps", {HOLDING: 16}, "readable_gaps = "),
    ("broadcasts", "no", "broadcasts = 'no' is neither True nor False"),
    ("answers_every_read", 1, "answers_every_read = 1 is neither True nor False"),
    ("has_motor", None, "has_motor = None is neither True nor False"),
    ("watchdog", None, "watchdog = None is not a text"),
    ("setpoint_name", 5, "setpoint_name = 5 is not the name of a register"),
    ("options", ("stop_time",), "options = ('stop_time',) is not a mapping"),
    ("options", {"stop_time": 60}, "options['stop_time'] = 60 is not an option, such as Option("),
    ("options", {"stop_time": Option("s", (60, 1), "")}, "options['stop_time']: span = (60, 1) is not the"),
]


@table(("name", "value", "expected"), WRONG_FACTS)
def test_invalid_attribute_of_a_drive_class_is_reported(name: str, value: Any, expected: str) -> None:
    (mistake,) = mistakes_in(speed=reading(1), **{name: value})
    assert mistake.startswith(expected)


def test_mistakes_in_class_attributes_and_in_registers_are_reported_together() -> None:
    mistakes = mistakes_in(
        speed=reading(1, "rpm", step=0),
        volts=setting(8, "V"),
        amperes=setting(8, "A", step=0.1),
        response_timeout=300,
        model=setting(9),
        stop=lambda self: None,
    )
    assert [mistake.split()[0] for mistake in mistakes] == [
        *("response_timeout", "stop:", "speed:", "model:", "amperes:")
    ]


@table("name", [*VERBS, "identify"])
def test_verb_method_without_the_verb_decorator_is_reported(name: str) -> None:
    """Without the decorator, a call would only create a generator and send no request."""

    def script(self: Any) -> Script[None]:
        yield from insist(self.control, 0)

    script.__name__ = name
    control = command(2, harmless=(0,))
    (mistake,) = mistakes_in(control=control, **{name: script})
    assert mistake == f"{name}: without the decorator @verb a call would send nothing; write @verb above it"
    declare(control=control, **{name: verb(script)})


def test_a_mistake_in_a_subclass_of_a_built_in_family_is_reported() -> None:
    with pytest.raises(DeclarationError, match=r"^Ours\.stop: without the decorator @verb"):
        type("Ours", (InnovertIBD,), {"stop": lambda self: None})


def test_a_motor_command_is_refused_in_a_class_without_a_motor() -> None:
    (mistake,) = mistakes_in(reset=command(0x2000), has_motor=False)
    assert mistake == "has_motor = False, but a write to reset may move one: declare moves=False"
    assert not declare(reset=command(0x2000, moves=False), has_motor=False).has_motor
