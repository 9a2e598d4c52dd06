"""Expressions of computed channels: their values and units, and one sentence for each mistake."""

from __future__ import annotations

import math
import os
import random
import re
import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any

import pytest
from tables import table

from multidrop.channels import Channel, DriveSeries
from multidrop.channels.grammar import MOST_CHARACTERS, ExpressionError, parse
from multidrop.channels.program import Program, SeriesTable
from multidrop.channels.units import unit_of

POLLED = {
    "frequency": ("Hz", 1.0),
    "current": ("A", 1.0),
    "voltage": ("V", 1.0),
    "power": ("kW", 1.0),
    "torque": ("Nm", 1.0),
    "speed": ("rpm", 1.0),
    "pressure": ("bar", 1.0),
    "load": ("%", 1.0),
    "status": ("", 1.0),
}
NOW = {
    **{"frequency": 50.0, "current": 4.0, "voltage": 400.0, "power": 1.5, "torque": 10.0},
    **{"speed": 1450.0, "pressure": 2.0, "load": 80.0, "status": 3.0},
}
MANY = int(os.environ.get("EXPRESSIONS", "20000"))
PUMPS = [
    DriveSeries("pump-1", POLLED, {*POLLED, "temperature"}, ()),
    DriveSeries("pump 2", {"power": ("W", 1.0)}, {"power"}, (Channel("later", "power"),)),
]


def value_of(text: str, unit: str = "") -> float | None:
    """Return the value of an expression of pump-1 in this unit. The power of pump-2 is 700 W."""
    series = SeriesTable(PUMPS)
    values: list[float | None] = [
        NOW.get(name) if drive == "pump-1" else 700.0 for drive, name in series.slots
    ]
    return Program(text, "pump-1", series, unit).run(values, set(range(len(values))), 0)


@table(
    "expression, unit, value",
    [
        ("current", "A", 4.0),
        ("2 + 3 * current", "A", 14.0),
        ("(2 + 3) * current", "A", 20.0),
        ("-current - -1", "A", -3.0),
        ("10 - 4 - 3 + 0 * current", "A", 3.0),
        ("current / 2 / 2", "A", 1.0),
        ("current * voltage", "kW", 1.6),
        ('power + "pump 2".power', "W", 2200.0),
        ("power + 'pump 2'.power", "kW", 2.2),
        ("pump-1.power-pump-1.power / 3", "kW", 1.0),
        ('as(torque * speed * 0.10471975511965977, "W")', "kW", 1.5184364492350664),
        ("current > 3 and not status == 2", "", 1.0),
        ("current < 3 or voltage >= 400", "", 1.0),
        ('power == 1.5 and power != "pump 2".power', "", 1.0),
        ('"pump 2".power < power', "", 1.0),
        ('min(power, "pump 2".power, 9)', "kW", 0.7),
        ("max(abs(-current), 1)", "A", 4.0),
        ("if(status == 3, pressure, 0)", "mbar", 2000.0),
        # a quotient by zero that does not matter
        ("if(status == 3, 7, current / (status - 3))", "A", 7.0),
        ("if(status > 3, current / (status - 3), current)", "A", 4.0),
        ("status > 3 and current / (status - 3) > 1", "", 0.0),
        ("current / (status - 3) > 1 and status > 3", "", 0.0),
        ("current / (status - 3) > 1 or status == 3", "", 1.0),
        ("sqrt(current * current)", "A", 4.0),
        ("load * 2", "%", 160.0),
        ("load", "", 0.8),
        ('table(frequency, "m3/h", 0, 0, 40, 8, 60, 10)', "l/min", 150.0),
        ('table(-frequency, "bar", -10, 3, 5, 4)', "bar", 3.0),
        ("frequency", "kHz", 0.05),
        ("status * .5e1", "", 15.0),
    ],
)
def test_a_channel_expression_has_the_expected_value(expression: str, unit: str, value: float) -> None:
    assert value_of(expression, unit) == pytest.approx(value, rel=1e-12)


@table(
    "expression",
    [
        *("current / (status - 3)", "sqrt(status - 4)", "1e300 * 1e300 * status"),
        *("if(status / (status - 3), 1, 2)", "if(status == 3, current / (status - 3), 0)"),
        *("status == 3 and current / (status - 3) > 1", "not status / (status - 3)"),
        "current / (status - 3) > 1 or status > 3",
    ],
)
def test_channel_has_no_value_if_the_result_is_not_finite(expression: str) -> None:
    assert value_of(expression, "A" if "current" in expression and ">" not in expression else "") is None


MISTAKES = {
    "": "column 1: a number, a name or ( is missing before the end",
    "current +": "column 10: a number, a name or ( is missing before the end",
    "current $ 2": "column 9: '$' is neither a number, a name nor an operator",
    "current = 2": "column 9: '=' is neither a number, a name nor an operator; write ==",
    "status && 1": "column 8: '&' is neither a number, a name nor an operator; write and",
    "current 2": "column 9: an operator is missing before '2'",
    "(current": "column 9: ')' is missing before the end",
    "1 < current < 3": "column 13: comparisons cannot be chained; write (a < b) and (b < c)",
    "power + current": "column 7: A cannot be combined with kW; both need the same kind of unit",
    "if(current > 1, power, voltage)": "column 1: V cannot be combined with kW; both need the same kind",
    "speed + frequency": "column 7: Hz cannot be combined with rpm; both need the same kind of unit",
    "current and status": "column 9: a condition such as x > 0 is needed here, not a value in A",
    "current * voltage": 'column 1: the value is in A*V; add unit = "A*V"',
    "curent": "column 1: pump-1 has no register 'curent'; did you mean current?",
    "temperature": 'column 1: pump-1.temperature is not polled; add "temperature" to poll of pump-1',
    "current-pump-1.current": "column 1: there is no drive 'current-pump-1'; did you mean pump-1?",
    '"pump 2".later': "column 1: the channel pump 2.later is declared later; move it above",
    "power(1)": "column 1: there is no function 'power'; there are ",
    "sqrt(1, 2)": "column 1: sqrt takes 1 value, not 2",
    "sqrt(current)": 'column 1: A has no square root; use as(x, "1") to leave the unit out',
    "min(current)": "column 1: min takes 2 values or more, not 1",
    'current + "A"': "column 11: a number is needed here, not a text",
    "1 + 2": "column 1: the value never changes; use a register, such as output_current",
    "integral(2) + current": "column 1: integral needs a value that changes, such as a register",
    "table(current, 1, 2, 3, 4)": 'column 1: table() takes a position, a unit and points: table(x, "m3/h", ',
    'table(current, "V", 1, 2, 1, 4)': "column 1: the positions of a table must ascend: 1, 1",
    'table(current, "V", 1, 2, status, 4)': "column 27: the points of a table must be numbers",
    'table(current, "V", 1, 2)': 'column 1: a table has two or more points: table(x, "unit", x1, y1, x2, y2)',
    "as(current)": 'column 1: as() takes a value and a unit: as(x, "kW")',
    f'as(current, "{"*".join(17 * ["km3"])}")': "column 1: the unit km*km*",
    '"A"': "column 1: a number is needed here, not a text",
    f"min({130 * '1,'}1)": "column 265: the call has more than 130 arguments",
    "1e999 * current": "column 1: the number 1e999 is too large",
    "(" * 60 + "current" + ")" * 60: "column 41: the expression has more than 40 nested levels; split it",
    "current"
    + " " * MOST_CHARACTERS: f"column 1000: the expression has more than {MOST_CHARACTERS} characters",
}


@table("expression", MISTAKES)
def test_a_mistake_in_a_channel_expression_is_reported_with_its_column(expression: str) -> None:
    with pytest.raises(ExpressionError) as mistake:
        value_of(expression)
    assert str(mistake.value).startswith(MISTAKES[expression])
    assert "\n" not in str(mistake.value)


@table(
    "expression, unit, hint",
    [
        ('as(current * 400, "KW")', "KW", 'the unit KW is not known; did you mean "kW"?'),
        ('table(current, "L/Min", 0, 0, 1, 2)', "l/min", 'the unit Min is not known; did you mean "min"?'),
        ("if(current > 1, 5, 3)", "KW", 'the unit KW is not known; did you mean "kW"?'),
        ("integral(power)", "KWh", 'the unit KWh is not known; did you mean "kWh"?'),
        ("power / 1000", "Mw", 'the unit Mw is not known; did you mean "MW"?'),
        ('as(current, "mpa")', "mpa", 'the unit mpa is not known; did you mean "MPa"?'),
    ],
)
def test_error_for_a_unit_in_wrong_case_suggests_the_right_unit(
    expression: str, unit: str, hint: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(hint)):
        value_of(expression, unit)


@pytest.mark.parametrize("unit", ["mW", "nm", "S", "mS/cm", "uS/cm", "mM", "M3/h"])
def test_a_unit_that_resembles_a_known_unit_by_chance_is_accepted(unit: str) -> None:
    assert value_of(f'as(current, "{unit}")', unit) is not None


@table(
    ("expression", "unit", "value"),
    [
        ("current / (voltage * frequency)", "A/V/Hz", 4 / 400 / 50),
        ("current / (voltage / frequency)", "A/V*Hz", 4 / 400 * 50),
        ("sqrt(power * power / (frequency * frequency))", "kg*m*m/s/s", 1.5e3 / 50),
        ("sqrt(1 / (current * current))", "1/A", 0.25),
    ],
)
def test_a_unit_suggested_by_the_error_is_accepted(expression: str, unit: str, value: float) -> None:
    with pytest.raises(ExpressionError, match=f'add unit = "{re.escape(unit)}"$'):
        value_of(expression)
    assert value_of(expression, unit) == pytest.approx(value)


@table(
    "one, other, factor",
    [
        ("kWh", "J", 3.6e6),
        ("m3/h", "l/min", 16.666666666666668),
        ("N*m", "Nm", 1.0),
        ("kg*m2/s2", "J", 1.0),
        ("V*A", "W", 1.0),
        ("%", "", 0.01),
        ("pulses/s", "pulses/min", 60.0),
        ("W/m²", "kW/m2", 0.001),
    ],
)
def test_unit_conversion_uses_the_expected_factor(one: str, other: str, factor: float) -> None:
    assert unit_of(one).is_like(unit_of(other))
    assert unit_of(one).factor / unit_of(other).factor == pytest.approx(factor, rel=1e-12)


WORDS = (
    *(
        "pump-1.current",
        "'pump 2'.power",
        "current",
        "voltage",
        "status",
        "speed",
        "load",
        "1",
        "0",
        "2.5",
        "1e300",
    ),
    *(
        "+",
        "-",
        "*",
        "/",
        "<",
        "==",
        "and",
        "or",
        "not",
        "(",
        ")",
        ",",
        '"m3/h"',
        "'",
        '"',
        ".",
        "$",
        "é",
        "\n",
    ),
    *("min(", "if(", "integral(", "derivative(", "count(", "changed(", "table(", "as(", "sqrt(", "abs("),
)


def valid(random_: random.Random, depth: int) -> str:
    """Return a random expression that the grammar allows."""
    if depth == 0 or random_.random() < 0.2:
        return random_.choice(WORDS[:11])
    one, two, three = (valid(random_, depth - 1) for _ in range(3))
    pattern = random_.choice(
        (
            *("{0} + {1}", "{0} - {1}", "{0} * {1}", "{0} / {1}", "({0})", "-{0}", "{0} < {1}", "not {0}"),
            *("{0} and {1}", "min({0}, {1})", "if({0} > 1, {1}, {2})", "integral({0})", "derivative({0})"),
            *("count({0})", "changed({0})", 'table({0}, "m3/h", 0, 1, 2, 3)', 'as({0}, "1")', "sqrt({0})"),
        )
    )
    return str(pattern.format(one, two, three))


def texts(seed: int, count: int) -> Iterator[str]:
    random_ = random.Random(seed)
    for _ in range(count):
        if random_.random() < 0.5:
            yield valid(random_, random_.randint(1, 4))
        else:
            yield " ".join(random_.choices(WORDS, k=random_.randint(1, 30)))


@pytest.mark.parametrize("count", [500, pytest.param(MANY, marks=pytest.mark.long)])
def test_any_text_as_an_expression_is_computed_or_refused(count: int) -> None:
    """Check that each text is computed or refused, and that the work is bounded by the text's length."""
    series = SeriesTable(PUMPS)
    values: list[float | None] = [NOW.get(name, 700.0) for _, name in series.slots]
    fresh = set(range(len(values)))
    computed = 0
    for text in texts(1, count):
        try:
            assert len(parse(text)) <= len(text)
            program = Program(f"as(1 * ({text}), '')", "pump-1", series)
        except ExpressionError:
            continue
        for now_s in range(3):
            value = program.run(values, fresh, now_s * 10**9)
            assert value is None or math.isfinite(value)
        computed += 1
    assert computed > count / 20


LONGEST = {  # near the limits of length and depth
    "sum": "power" + "+power" * 160,
    "depth": "abs(" * 15 + "power" + ")" * 15,
    "arguments": f"max({', '.join(['power'] * 130)})",
    "table": f'table(frequency, "kW"{"".join(f", {at}, 2" for at in range(64))})',
}


@pytest.mark.parametrize("kind", LONGEST)
def test_work_of_an_evaluation_is_limited_by_expression_length(kind: str) -> None:
    """Count the lines of Python code that one evaluation executes, instead of its time."""
    text = LONGEST[kind]
    series = SeriesTable(PUMPS)
    program = Program(text, "pump-1", series, "kW")
    values: list[float | None] = [NOW.get(name, 700.0) for _, name in series.slots]
    lines = 0

    def counted(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal lines
        lines += event == "line"
        return counted

    before = sys.gettrace()
    sys.settrace(counted)
    try:
        value = program.run(values, set(range(len(values))), 0)
    finally:
        sys.settrace(before)
    assert value is not None
    assert lines <= 5 * len(text)
