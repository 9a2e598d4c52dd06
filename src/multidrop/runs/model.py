"""RunPlan: the steps and limits of a test, as plain data."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from pathlib import Path
from typing import Any

from multidrop.drive.known_state import FAULT
from multidrop.drive.verbs import Direction
from multidrop.plant.model import Plant, PolledDrive
from multidrop.printable import plain_number

_SIGNS: Mapping[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}
_CONDITION = re.compile(rf"\s*(\S.*)\.(\w+)\s*({'|'.join(_SIGNS)})\s*(\S.*)")
EXAMPLE = "pump-1.output_current > 30"


def polled_drive(plant: Plant, name: str) -> PolledDrive:
    """Return the polled drive of this name. Raises ValueError with similar names if there is none."""
    line, drive = plant.find_drive(name)
    return next(polled for polled in line.drives if polled.drive is drive)


@dataclass(frozen=True)
class ReadingCondition:
    """A comparison of a polled register or channel with a number in its unit, or with the name of a value."""

    text: str
    drive: str
    register: str
    sign: str
    number: float

    @classmethod
    def parse(cls, text: str, plant: Plant) -> ReadingCondition:
        """Return the condition of a text such as "pump-1.output_current > 30".

        Raises ValueError for another form, and for a register that the plant does not poll.
        """
        match = _CONDITION.fullmatch(text)
        if not match:
            raise ValueError(f'{text!r} is not a condition such as "{EXAMPLE}"')
        name, word, sign, value = match.groups()
        polled = polled_drive(plant, name)
        register = polled.find_register(word)
        if register not in [poll.register for poll in polled.series]:
            raise ValueError(f"{name}.{word} is not polled: add it to `poll` of {name} in {plant.path}")
        try:
            number = plain_number(value.strip())
        except ValueError:
            number = float(register.parse(value.strip()))
        if not isfinite(number):  # a comparison with nan or inf would always have the same result
            raise ValueError(f"{value.strip()!r} in {text!r} is not a finite number")
        return cls(text.strip(), name, word, sign, number)

    def holds(self, value: float) -> bool:
        return _SIGNS[self.sign](value, self.number)


@dataclass(frozen=True)
class AbortLimits:
    """The limits that abort a run, besides faults and failed commands.

    `silence` is the longest allowed time in s without a value of a drive, or of a register that is compared
    with a limit. None means the default. `duration` is the longest allowed time in s of the whole run; None
    means no limit.
    """

    conditions: tuple[ReadingCondition, ...] = ()
    silence: float | None = None
    duration: float | None = None


@dataclass(frozen=True)
class RunStep:
    """Commands that are sent to some drives at the same time, and the duration of the step.

    A drive is either stopped, or it gets its register writes, its frequency in Hz and its start command, in
    this order. With `rate`, in Hz/s, the frequencies are changed by ramps. After the ramps, the step
    continues for `dwell` s. Then it waits for the condition `until`, for at most `within` s.
    """

    name: str  # the phase's name, followed by the step's number if the phase has several steps
    frequency: Mapping[str, float] = field(default_factory=dict)
    rate: float | None = None
    write: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    start: tuple[str, ...] = ()
    direction: Direction | None = None
    stop: tuple[str, ...] = ()
    dwell: float = 0.0
    until: ReadingCondition | None = None
    within: float = 0.0

    def __post_init__(self) -> None:
        # an infinite time would never end the step
        if not (0 <= self.dwell < inf and 0 <= self.within < inf):
            raise ValueError(f"{self.name}: `dwell` and `within` must be finite times of 0 s or more")

    @property
    def drives(self) -> tuple[str, ...]:
        """The names of the drives that the step commands."""
        return tuple(dict.fromkeys([*self.stop, *self.write, *self.frequency, *self.start]))

    def __str__(self) -> str:
        """Return the commands in words, such as "pump-1 20 Hz, start pump-1"."""
        ramps = f" at {self.rate:g} Hz/s" if self.rate else ""
        parts = [f"stop {name}" for name in self.stop]
        parts += [
            f"{drive}.{register} = {value}"
            for drive, values in self.write.items()
            for register, value in values.items()
        ]
        parts += [f"{name} to {hz:g} Hz{ramps}" for name, hz in self.frequency.items()]
        way = f" {self.direction.value}" if self.direction else ""
        parts += [f"start {name}{way}" for name in self.start]
        return ", ".join([*parts, *([f"until {self.until.text}"] if self.until else [])]) or "wait"


@dataclass(frozen=True)
class RunPlan:
    """A test: its plant, its steps in their order, and its limits."""

    plant: Plant
    steps: Sequence[RunStep]
    limits: AbortLimits = AbortLimits()
    path: Path = Path("test")  # the test file

    @property
    def commanded(self) -> tuple[str, ...]:
        """The names of the drives that the test commands."""
        return tuple(dict.fromkeys(name for step in self.steps for name in step.drives))

    @property
    def conditions(self) -> tuple[ReadingCondition, ...]:
        """All conditions of the test, both those that abort the run and those that end a step."""
        return (*self.limits.conditions, *(step.until for step in self.steps if step.until))

    @property
    def drives(self) -> tuple[str, ...]:
        """The names of the drives that get commands or have a register in a condition."""
        compared = (condition.drive for condition in self.conditions)
        return tuple(dict.fromkeys([*self.commanded, *compared]))

    @property
    def faults(self) -> tuple[tuple[str, str], ...]:
        """The (drive, register) of each polled fault code of the drives in `drives`."""
        polls = ((name, poll) for name in self.drives for poll in polled_drive(self.plant, name).polls)
        return tuple((name, FAULT) for name, poll in polls if poll.register.name == FAULT)

    def with_plant(self, plant: Plant) -> RunPlan:
        """Return the same test on another plant with the same drives, such as a simulated one."""
        return replace(self, plant=plant)


@dataclass(frozen=True)
class PlannedStep:
    """A step with its planned start, in s after the run's start, and its length in s.

    The length does not include the time until the step's condition `until` holds. If an earlier step waits
    for a condition, `begin` is the latest possible start, and `is_latest` is True.
    """

    step: RunStep
    begin: float
    seconds: float
    is_latest: bool


def timeline(steps: Iterable[RunStep]) -> list[PlannedStep]:
    """Return the steps with their planned times.

    Raises ValueError for a ramp of a drive whose frequency no earlier step has set.
    """
    found: list[PlannedStep] = []
    known: dict[str, float] = {}
    at, is_latest = 0.0, False
    for step in steps:
        ramps = [0.0]
        for name, hz in step.frequency.items():
            if step.rate:
                if name not in known:
                    raise ValueError(
                        f"{step.name}: the ramp of {name} needs a frequency to start from; set one in an "
                        "earlier step"
                    )
                ramps.append(abs(hz - known[name]) / step.rate)
            known[name] = hz
        seconds = max(ramps) + step.dwell
        found.append(PlannedStep(step, at, seconds, is_latest))
        at += seconds + step.within
        is_latest |= step.until is not None
    return found


def length(planned: Sequence[PlannedStep]) -> float:
    """Return the longest time in s that the steps can take. The time for starts and stops is not included."""
    return planned[-1].begin + planned[-1].seconds + planned[-1].step.within if planned else 0.0
