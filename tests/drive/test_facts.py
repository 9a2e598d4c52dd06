"""Facts of a class, of its line, its manual and its verbs: each mistake is told when the class is made."""

from __future__ import annotations

import math
from typing import Any

import pytest
from tables import table

from multidrop.core import Framing
from multidrop.drive import Drive, Script, insist
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.declare import command, reading, setting
from multidrop.drive.options import Option
from multidrop.drive.table import HOLDING
from multidrop.drive.verbs import VERBS, verb
from multidrop.families import InnovertIBD

WRONG: list[tuple[str, Any, str]] = [
    ("silence", "x", "silence = 'x' is no number of s from 0 to 1"),
    ("silence", 20, "silence = 20 is no number of s from 0 to 1"),
    ("silence_characters", -1, "silence_characters = -1 is no number of characters from 0 to 1000"),
    ("response_delay", math.nan, "response_delay = nan is no number of s from 0 to 60"),
    ("response_delay_characters", True, "response_delay_characters = True is no number of characters"),
    ("response_timeout", 300, "response_timeout = 300 is no number of s above 0, up to 60"),
    ("response_timeout", 0, "response_timeout = 0 is no number of s above 0, up to 60"),
    ("answering_time", None, "answering_time = None is no number of s from 0 to 60"),
    ("turnaround_delay", math.inf, "turnaround_delay = inf is no number of s from 0 to 60"),
    ("addresses", 5, "addresses = 5 is no range of addresses, such as range(1, 248)"),
    ("addresses", range(1, 300), "addresses = range(1, 300) is no range of addresses"),
    ("addresses", range(5, 5), "addresses = range(5, 5) is no range of addresses"),
    ("baudrates", 9600, "baudrates = 9600 is no tuple of baud rates, such as (9600, 19200)"),
    ("baudrates", (9.6e3,), "baudrates = (9600.0,) is no tuple of baud rates"),
    ("framings", (), "framings = () is no tuple of framings, such as (Framing.RTU,)"),
    ("framings", ("rtu",), "framings = ('rtu',) is no tuple of framings"),
    ("formats", ("8N1",), "formats = ('8N1',) is no mapping, such as {Framing.RTU: "),
    ("formats", {Framing.RTU: ("8X1",)}, "formats = {<Framing.RTU: 0>: ('8X1',)} is no mapping"),
    ("formats", {Framing.ASCII: ("7N2",)}, "formats has none for rtu, its first framing"),
    ("exceptions", {1: 2}, "exceptions = {1: 2} is no mapping of codes"),
    ("exceptions", {256: "x"}, "exceptions = {256: 'x'} is no mapping of codes"),
    ("damaged", 17, "damaged = 17 is no set of codes, such as frozenset({6})"),
    ("later", {"6"}, "later = {'6'} is no set of codes"),
    (
        "most_registers",
        {"holding": 16},
        "most_registers = {'holding': 16} is no mapping, such as {HOLDING: 16}",
    ),
    ("readable_gaps", {HOLDING: 16}, "readable_gaps = "),
    ("broadcasts", "no", "broadcasts = 'no' is neither True nor False"),
    ("answers_every_read", 1, "answers_every_read = 1 is neither True nor False"),
    ("watchdog", None, "watchdog = None is no text"),
    ("setpoint_name", 5, "setpoint_name = 5 is no name of a register"),
    ("options", ("stop_time",), "options = ('stop_time',) is no mapping"),
    ("options", {"stop_time": 60}, "options['stop_time'] = 60 is no option, such as Option("),
    ("options", {"stop_time": Option("s", (60, 1), "")}, "options['stop_time']: span = (60, 1) is not the"),
]


def made(**attributes: Any) -> type[Drive]:
    return type("Blower", (Drive,), {"speed": reading(1, "rpm"), **attributes})


def mistakes_of(**attributes: Any) -> tuple[str, ...]:
    with pytest.raises(DeclarationError) as refusal:
        made(**attributes)
    return refusal.value.mistakes


@table(("name", "value", "told"), WRONG)
def test_a_fact_that_is_none_is_told(name: str, value: Any, told: str) -> None:
    (mistake,) = mistakes_of(**{name: value})
    assert mistake.startswith(told)


def test_facts_and_registers_are_told_together() -> None:
    mistakes = mistakes_of(
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


@pytest.mark.parametrize("name", [*VERBS, "identify"])
def test_a_method_in_a_verb_s_place_is_told(name: str) -> None:
    """A call of it would make a generator, and send nothing."""

    def script(self: Any) -> Script[None]:
        yield from insist(self.control, 0)

    script.__name__ = name
    control = command(2, harmless=(0,))
    (mistake,) = mistakes_of(control=control, **{name: script})
    assert mistake == f"{name}: it is no verb, and a call of it would send nothing: write @verb above it"
    made(control=control, **{name: verb(script)})


def test_what_a_subclass_says_is_told_too() -> None:
    with pytest.raises(DeclarationError, match=r"^Ours\.stop: it is no verb"):
        type("Ours", (InnovertIBD,), {"stop": lambda self: None})
