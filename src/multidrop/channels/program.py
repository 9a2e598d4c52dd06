"""Programs: expressions that were checked against a plant's registers and channels, and compute values."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import Any, NamedTuple

from multidrop.channels.functions import AS, FUNCTIONS, MEMORIES, NAMES, TABLE, Curve, StatefulFunction, Value
from multidrop.channels.grammar import (
    CallStep,
    ExpressionError,
    NumberStep,
    ReferenceStep,
    Step,
    TextStep,
    parse,
)
from multidrop.channels.units import ValueUnit, misspelled_unit, unit_of
from multidrop.core.columns import NumberFormat
from multidrop.drive.register import Access, Register
from multidrop.drive.register import Table as AddressTable
from multidrop.printable import did_you_mean

# placeholder for the address table of a channel, which has no address
COMPUTED = AddressTable("computed channel", None, None)


@dataclass(frozen=True)
class Channel:
    """A value computed from polled registers, such as `Channel("energy", "integral(output_power)", "kWh")`.

    Its rows have the name of its drive, and `name` in place of a register. `value` is an expression whose
    results are converted to `unit`. With `is_kept`, its totals continue after a restart.
    """

    name: str
    value: str
    unit: str = ""
    is_kept: bool = True

    @cached_property
    def register(self) -> Register[float]:
        """A register with the channel's name and unit, which is never read."""
        register = Register[float](
            0,
            Access.READING,
            unit=self.unit,
            number_format=NumberFormat.F32,
            table=COMPUTED,
            note=f"computed: {self.value}",
        )
        object.__setattr__(register, "name", self.name)
        return register


class DriveSeries(NamedTuple):
    """A drive's channels, and its polled registers with unit and the time in s for which a value is valid."""

    name: str
    polled: Mapping[str, tuple[str, float]]
    known: Collection[str]  # names of all registers of the drive's family, polled or not
    channels: Sequence[Channel]


class _Operand(NamedTuple):
    """An operand of an expression: its unit, and the registers and channels in it."""

    column: int
    unit: ValueUnit | None
    slots: frozenset[int]
    text: str | None = None  # the text, if the operand is a text in quotes
    number: float | None = None  # the number, if the operand is a number


class _Memorised(NamedTuple):
    """An instruction to call a stateful function, such as an integral.

    `slots` are the indexes of the registers and channels in its operand.
    """

    memory: StatefulFunction
    slots: frozenset[int]


class _Applied(NamedTuple):
    """An instruction to call a stateless function, such as a sum.

    Before the call, each operand is multiplied by its factor. `factors` is empty if all factors are 1.
    """

    value: Any
    arity: int
    factors: tuple[float, ...]
    takes_unknown: bool = False  # True if the function may be called with None for an unknown operand


class _Load(NamedTuple):
    """An instruction to load the newest value of a register or channel."""

    slot: int


_Instruction = float | _Load | _Applied | _Memorised


class SeriesTable:
    """The registers and channels of a plant: their index, unit, and the time for which a value is valid."""

    def __init__(self, drives: Iterable[DriveSeries]) -> None:
        self.drives = {drive.name: drive for drive in drives}
        self.slots: dict[tuple[str, str], int] = {}
        self.units: list[ValueUnit] = []
        self.holds_s: list[float] = []
        for drive in self.drives.values():
            for name, (unit, hold_s) in drive.polled.items():
                self.add(drive.name, name, unit_of(unit), hold_s)

    def add(self, drive: str, name: str, unit: ValueUnit, hold_s: float) -> int:
        slot = self.slots[drive, name] = len(self.units)
        self.units.append(unit)
        self.holds_s.append(hold_s)
        return slot

    def find(self, reference: ReferenceStep, own: str) -> int:
        """Return the index of the register or channel that an expression of the drive `own` names.

        Raises ExpressionError if there is none.
        """
        drive = reference.drive or own
        if (drive, reference.name) in self.slots:
            return self.slots[drive, reference.name]
        column, name = reference.column, reference.name
        if not drive:
            raise ExpressionError(column, f"the name {name} needs a drive, such as pump-1.{name}")
        if drive not in self.drives:
            hint = did_you_mean(drive, self.drives, "write spaces around a minus sign")
            raise ExpressionError(column, f"there is no drive {drive!r}; {hint}")
        there = self.drives[drive]
        if name in [channel.name for channel in there.channels]:
            raise ExpressionError(column, f"the channel {drive}.{name} is declared later; move it above")
        if name in there.known:
            raise ExpressionError(column, f'{drive}.{name} is not polled; add "{name}" to poll of {drive}')
        hint = did_you_mean(name, there.known, "see `multidrop models`")
        raise ExpressionError(column, f"{drive} has no register {name!r}; {hint}")


class Program:
    """A checked and compiled expression. Raises ExpressionError for a mistake in the expression."""

    def __init__(self, text: str, own: str, series: SeriesTable, unit: str = "") -> None:
        self.memories: list[StatefulFunction] = []
        self.units: list[str] = []  # unit of the result of each function in `memories`
        self._instructions: list[_Instruction] = []
        self._own, self._series = own, series
        stack: list[_Operand] = []
        for step in parse(text):
            try:
                self._check(step, stack)
            except ExpressionError:
                raise
            except ValueError as mistake:
                raise ExpressionError(step.column, str(mistake)) from None
        (result,) = stack
        if result.text is not None:
            raise ExpressionError(result.column, "a number is needed here, not a text")
        if not result.slots:
            raise ExpressionError(1, "the value never changes; use a register, such as output_current")
        self.slots = result.slots
        self.hold_s = max((series.holds_s[slot] for slot in self.slots), default=0.0)
        for memory in self.memories:
            memory.hold_ns = round(self.hold_s * 1e9)
        self._factor = self._factor_to(unit, result)

    def _factor_to(self, unit: str, result: _Operand) -> float:
        """Return the factor that converts the expression's result to the channel's declared unit."""
        wanted = unit_of(unit)
        if result.unit is None:
            _check_spelling(unit)
            return 1.0
        if not wanted.is_like(result.unit):
            if unit:
                why = f"the value is in {result.unit}, which cannot be converted to {unit}"
                hint = misspelled_unit(unit) or misspelled_unit(result.unit.text)
                raise ExpressionError(1, f"{why}; {hint}" if hint else why)
            raise ExpressionError(1, f'the value is in {result.unit}; add unit = "{result.unit.text}"')
        return result.unit.factor / wanted.factor

    def _check(self, step: Step, stack: list[_Operand]) -> None:
        if isinstance(step, NumberStep):
            stack.append(_Operand(step.column, None, frozenset(), number=step.value))
            self._instructions.append(step.value)
        elif isinstance(step, TextStep):
            stack.append(_Operand(step.column, None, frozenset(), step.text))
        elif isinstance(step, ReferenceStep):
            slot = self._series.find(step, self._own)
            stack.append(_Operand(step.column, self._series.units[slot], frozenset({slot})))
            self._instructions.append(_Load(slot))
        else:
            operands = stack[-step.arity :]
            del stack[-step.arity :]
            unit = self._call(step, operands)
            stack.append(_Operand(step.column, unit, frozenset().union(*(one.slots for one in operands))))

    def _call(self, call: CallStep, operands: list[_Operand]) -> ValueUnit | None:
        """Append the instruction for a call. Return the unit of the result, or None for a plain number."""
        if call.name == TABLE:
            return self._table(operands)
        if call.name == AS:
            return self._as(operands)
        for operand in operands:
            if operand.text is not None:
                raise ExpressionError(operand.column, "a number is needed here, not a text")
        units = [operand.unit for operand in operands]
        if call.name in MEMORIES:
            _check_arity(call, range(1, 2))
            if not operands[0].slots:
                raise ValueError(f"{call.name} needs a value that changes, such as a register")
            memory = MEMORIES[call.name]()
            self.memories.append(memory)
            self._instructions.append(_Memorised(memory, operands[0].slots))
            unit = memory.typed(units).unit
            self.units.append(str(unit))
            return unit
        if call.name not in FUNCTIONS:
            raise ValueError(f"there is no function {call.name!r}; {did_you_mean(call.name, NAMES)}")
        function = FUNCTIONS[call.name]
        _check_arity(call, function.arities)
        typed = function.typed(units)
        factors = typed.factors if any(factor != 1.0 for factor in typed.factors) else ()
        self._instructions.append(_Applied(function.value, call.arity, factors, function.takes_unknown))
        return typed.unit

    def _table(self, operands: list[_Operand]) -> ValueUnit:
        """Append the instruction for a call of `table`; return the unit of its result."""
        if len(operands) < 2 or operands[0].text is not None or operands[1].text is None:
            raise ValueError('table() takes a position, a unit and points: table(x, "m3/h", x1, y1, x2, y2)')
        points = operands[2:]
        for point in points:
            if point.number is None:
                raise ExpressionError(point.column, "the points of a table must be numbers")
        if points:  # the curve contains the points, so no instructions load them
            del self._instructions[-len(points) :]
        curve = Curve([point.number for point in points if point.number is not None])
        self._instructions.append(_Applied(curve, 1, ()))
        _check_spelling(operands[1].text)
        return unit_of(operands[1].text)

    def _as(self, operands: list[_Operand]) -> ValueUnit:
        if len(operands) != 2 or operands[1].text is None or operands[0].text is not None:
            raise ValueError('as() takes a value and a unit: as(x, "kW")')
        _check_spelling(operands[1].text)
        return unit_of(operands[1].text)

    @property
    def totals(self) -> list[StatefulFunction]:
        """The functions in `memories` that are kept over restarts."""
        return [memory for memory in self.memories if memory.is_total]

    def interrupt(self, slots: Collection[int]) -> None:
        """Exclude the time until the next value from integrals etc. of the given registers and channels."""
        for step in self._instructions:
            if isinstance(step, _Memorised) and not step.slots.isdisjoint(slots):
                step.memory.is_interrupted = True

    def note_sleep(self, slept_ns: int) -> None:
        """Add the computer's sleep to the time since the newest value of each stateful function."""
        for memory in self.memories:
            memory.note_sleep(slept_ns)

    def run(self, values: Sequence[Value], fresh: Collection[int], now_ns: int) -> Value:
        """Return the value in the declared unit, computed from the newest values of registers and channels.

        Return None if the value is unknown. `now_ns` is the monotonic time of a request. `fresh` has the
        indexes of the registers and channels with a row from that request.
        """
        stack: list[Value] = []
        for step in self._instructions:
            if isinstance(step, float):
                stack.append(step)
            elif isinstance(step, _Load):
                stack.append(values[step.slot])
            elif isinstance(step, _Memorised):
                value = stack.pop()
                if value is not None and isfinite(value) and not step.slots.isdisjoint(fresh):
                    step.memory.take(value, now_ns)
                stack.append(step.memory.result)
            else:
                operands = stack[-step.arity :]
                del stack[-step.arity :]
                stack.append(_applied(step, operands))
        (result,) = stack
        result = None if result is None else result * self._factor
        return result if result is not None and isfinite(result) else None


def _applied(step: _Applied, operands: list[Value]) -> Value:
    if not step.takes_unknown and None in operands:
        return None
    if step.factors:
        pairs = zip(operands, step.factors, strict=True)
        operands = [None if value is None else value * factor for value, factor in pairs]
    result: Value = step.value(*operands)
    return result


def _check_spelling(unit: str) -> None:
    if hint := misspelled_unit(unit):
        raise ValueError(hint)


def _check_arity(call: CallStep, arities: range) -> None:
    if call.arity not in arities:
        most = arities[-1]
        wanted = f"{most} value{'s' * (most > 1)}" if len(arities) == 1 else f"{arities[0]} values or more"
        raise ValueError(f"{call.name} takes {wanted}, not {call.arity}")
