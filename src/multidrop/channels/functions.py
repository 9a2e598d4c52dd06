"""The operators and functions of channel expressions, with the units and values of their results.

A value that is not known is None. Pure functions then return None, unless the result does not depend on that
value. Stateful functions, such as `integral`, get each value with the time of its request, and note outages:
times without a known value.
"""

from __future__ import annotations

import operator
from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import inf, isfinite, sqrt
from typing import Any, NamedTuple

from multidrop.channels.units import NUMBER, SECOND, ValueUnit, unit_of

Value = float | None
# units of the operands; None for a plain number, which fits every unit
Units = Sequence[ValueUnit | None]


class Typed(NamedTuple):
    """The unit of a function's result, and the factors that convert its operands before the call."""

    unit: ValueUnit | None
    factors: tuple[float, ...]


# ---- units of results ----


def _alike(units: Units, what: str) -> Typed:
    """Convert all operands to the first unit. Raises ValueError if one cannot be converted."""
    first = next((unit for unit in units if unit is not None), None)
    for unit in units:
        if first is not None and unit is not None and not unit.is_like(first):
            raise ValueError(what.format(first=first, other=unit))
    factors = (1.0 if unit is None or first is None else unit.factor / first.factor for unit in units)
    return Typed(first, tuple(factors))


def _as_first(units: Units) -> Typed:
    return _alike(units, "{other} cannot be combined with {first}; both need the same kind of unit")


def _compared(units: Units) -> Typed:
    return _as_first(units)._replace(unit=NUMBER)


def _product(units: Units) -> Typed:
    one, other = units
    return Typed(other if one is None else one if other is None else one.times(other), (1.0, 1.0))


def _quotient(units: Units) -> Typed:
    one, other = units
    if other is None:
        return Typed(one, (1.0, 1.0))
    return Typed((one or NUMBER).per(other), (1.0, 1.0))


def _truth(units: Units) -> Typed:
    for unit in units:
        if unit is not None and unit.dimensions:
            raise ValueError(f"a condition such as x > 0 is needed here, not a value in {unit}")
    return Typed(NUMBER, (1.0,) * len(units))


def _same(units: Units) -> Typed:
    return Typed(units[0], (1.0,) * len(units))


def _number(units: Units) -> Typed:
    return Typed(NUMBER, (1.0,) * len(units))


def _root(units: Units) -> Typed:
    (unit,) = units
    if unit is None or not unit.dimensions:
        return Typed(unit and NUMBER, (unit.factor if unit else 1.0,))
    if any(exponent % 2 for _, exponent in unit.dimensions):
        raise ValueError(f'{unit} has no square root; use as(x, "1") to leave the unit out')
    root = NUMBER
    for base, exponent in unit.dimensions:
        for _ in range(abs(exponent) // 2):
            root = root.times(unit_of(base)) if exponent > 0 else root.per(unit_of(base))
    # the operand is converted to base units before its root is computed
    return Typed(root, (unit.factor,))


def _choice(units: Units) -> Typed:
    _truth(units[:1])
    typed = _as_first(units[1:])
    return Typed(typed.unit, (1.0, *typed.factors))


def _per_second(units: Units) -> Typed:
    return Typed((units[0] or NUMBER).per(SECOND), (1.0,))


def _times_second(units: Units) -> Typed:
    return Typed((units[0] or NUMBER).times(SECOND), (1.0,))


# ---- pure functions ----


def _quotient_of(one: float, other: float) -> Value:
    return one / other if other else None


def _root_of(value: float) -> Value:
    return sqrt(value) if value >= 0 else None


def _chosen(condition: Value, then: Value, otherwise: Value) -> Value:
    """Return `then` or `otherwise`; None if the condition is unknown. The unused value may be unknown."""
    return None if condition is None else then if condition else otherwise


def _both(one: Value, other: Value) -> Value:
    if 0.0 in (one, other):  # false, whatever the other one is
        return 0.0
    return None if None in (one, other) else 1.0


def _either(one: Value, other: Value) -> Value:
    if one or other:  # true, whatever the other one is
        return 1.0
    return None if None in (one, other) else 0.0


def _is(compare: Callable[[Any, Any], bool]) -> Callable[[float, float], float]:
    return lambda one, other: float(compare(one, other))


class Function(NamedTuple):
    """A stateless function: its number of operands, and functions that compute its unit and value."""

    arities: range
    typed: Callable[[Units], Typed]
    value: Callable[..., Value]
    takes_unknown: bool = False  # True if `value` may be called with None for an unknown operand


FUNCTIONS: dict[str, Function] = {
    **{name: Function(range(2, 3), _as_first, do) for name, do in (("+", operator.add), ("-", operator.sub))},
    "*": Function(range(2, 3), _product, operator.mul),
    "/": Function(range(2, 3), _quotient, _quotient_of),
    "-1": Function(range(1, 2), _same, operator.neg),
    **{
        name: Function(range(2, 3), _compared, _is(compare))
        for name, compare in (
            *(("<", operator.lt), ("<=", operator.le), (">", operator.gt)),
            *((">=", operator.ge), ("==", operator.eq), ("!=", operator.ne)),
        )
    },
    "and": Function(range(2, 3), _truth, _both, takes_unknown=True),
    "or": Function(range(2, 3), _truth, _either, takes_unknown=True),
    "not": Function(range(1, 2), _truth, lambda value: float(not value)),
    "abs": Function(range(1, 2), _same, abs),
    "sqrt": Function(range(1, 2), _root, _root_of),
    "min": Function(range(2, 131), _as_first, min),
    "max": Function(range(2, 131), _as_first, max),
    "if": Function(range(3, 4), _choice, _chosen, takes_unknown=True),
}


class Curve:
    """A table with linear interpolation. A position beyond either end gets the value at that end.

    Raises ValueError unless the numbers are two or more points (position, value) with ascending positions.
    """

    def __init__(self, numbers: Sequence[float]) -> None:
        self._at, self._values = numbers[0::2], numbers[1::2]
        if len(numbers) % 2 or len(numbers) < 4:
            raise ValueError('a table has two or more points: table(x, "unit", x1, y1, x2, y2)')
        if any(later <= before for before, later in pairwise(self._at)):
            shown = ", ".join(f"{position:g}" for position in self._at)
            raise ValueError(f"the positions of a table must ascend: {shown}")

    def __call__(self, position: float) -> Value:
        """Return the value at this position, interpolated between the points of the table."""
        place = bisect_right(self._at, position)
        if place == 0 or place == len(self._at):
            return self._values[place - 1 if place else 0]
        before, after = self._at[place - 1], self._at[place]
        part = (position - before) / (after - before)
        return self._values[place - 1] * (1.0 - part) + self._values[place] * part


# ---- stateful functions ----


class StatefulFunction:
    """A function of all values so far, such as an integral. Call `take` once for each known value.

    `kept` has the numbers to store in a file. The time between two values is an outage if it is longer than
    `hold_ns`, or if `is_interrupted` was set in between.
    """

    is_total = True  # True if `kept` is stored over restarts
    typed: Callable[[Units], Typed]

    def __init__(self) -> None:
        self.hold_ns = 0
        self.is_interrupted = False  # True if an outage of any length precedes the next value
        self.result: Value = None
        self.outage_s = 0.0  # total s of the outages since the caller last set this to 0
        self._last_ns: int | None = None
        self._last = 0.0

    def take(self, value: float, now_ns: int) -> None:
        """Process a value. Its request was sent at `now_ns` (monotonic); older values are ignored."""
        if self._last_ns is None:
            self._first(value)
        # older value: rows of several lines may be out of order
        elif now_ns <= self._last_ns:
            return
        else:
            step_ns = now_ns - self._last_ns
            if step_ns > self.hold_ns or self.is_interrupted:
                self.outage_s += step_ns / 1e9
                self._after_outage(value)
            else:
                self._step(value, step_ns / 1e9)
        self._last_ns, self._last, self.is_interrupted = now_ns, value, False

    def note_sleep(self, slept_ns: int) -> None:
        if self._last_ns is not None:
            self._last_ns -= slept_ns

    def take_over(self, before: StatefulFunction) -> None:
        """Continue from the state of `before`, the same function before the plant was changed."""
        vars(self).update(vars(before) | {"hold_ns": self.hold_ns})

    def _first(self, value: float) -> None: ...

    def _after_outage(self, value: float) -> None:
        self._first(value)

    def _step(self, value: float, seconds: float) -> None: ...

    @property
    def kept(self) -> list[float]:
        return []

    @kept.setter
    def kept(self, numbers: Sequence[float]) -> None: ...


class Integral(StatefulFunction):
    """The integral over time, in the operand's unit times seconds, by the trapezoidal rule."""

    typed = staticmethod(_times_second)

    def __init__(self) -> None:
        super().__init__()
        self.result = 0.0

    def _step(self, value: float, seconds: float) -> None:
        total = (self.result or 0.0) + (self._last + value) / 2 * seconds
        if isfinite(total):  # one absurdly large value must not destroy the total
            self.result = total

    @property
    def kept(self) -> list[float]:
        return [self.result or 0.0]

    @kept.setter
    def kept(self, numbers: Sequence[float]) -> None:
        self.result = numbers[0]


class EdgeCount(StatefulFunction):
    """The number of times that a condition became true."""

    typed = staticmethod(_truth)

    def __init__(self) -> None:
        super().__init__()
        self.result = 0.0
        # the previous value; None before the first one, which is not counted
        self._was: float | None = None

    def _first(self, value: float) -> None:
        self._step(value, 0.0)

    def _step(self, value: float, seconds: float) -> None:
        now = float(bool(value))
        if now and self._was == 0.0:
            self.result = (self.result or 0.0) + 1
        self._was = now

    @property
    def kept(self) -> list[float]:
        return [self.result or 0.0, *([] if self._was is None else [self._was])]

    @kept.setter
    def kept(self, numbers: Sequence[float]) -> None:
        self.result, *was = numbers
        self._was = was[0] if was else None


class Derivative(StatefulFunction):
    """The change per second from the previous value to the newest; None after an outage."""

    is_total = False
    typed = staticmethod(_per_second)

    def _first(self, value: float) -> None:
        self.result = None

    def _step(self, value: float, seconds: float) -> None:
        self.result = (value - self._last) / seconds


class Changed(StatefulFunction):
    """1 for a value that differs from the previous value, else 0."""

    is_total = False
    typed = staticmethod(_number)

    def _first(self, value: float) -> None:
        self.result = 0.0

    def _after_outage(self, value: float) -> None:
        self._step(value, inf)

    def _step(self, value: float, seconds: float) -> None:
        self.result = float(value != self._last)


MEMORIES: dict[str, type[StatefulFunction]] = {
    "integral": Integral,
    "derivative": Derivative,
    "count": EdgeCount,
    "changed": Changed,
}
TABLE, AS = "table", "as"  # functions with a unit among their arguments
NAMES = (*(name for name in FUNCTIONS if name.isalpha()), *MEMORIES, TABLE, AS)
