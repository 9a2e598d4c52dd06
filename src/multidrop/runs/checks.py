"""Check a test before it runs: its commands against the rules, and its steps against the bus cycles.

No check needs an open port.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

from multidrop.control.ramp import check_worn
from multidrop.control.rules import check_plain, conditions, raw_count, refused, wears
from multidrop.drive.family import Drive
from multidrop.drive.register import Kept
from multidrop.drive.verbs import Direction, Write
from multidrop.errors import Unsupported
from multidrop.planning.prediction import Prediction, duration_text, predict, suggest
from multidrop.plant.model import Plant, PlantLine, planned_on
from multidrop.runs.model import PlannedStep, RunPlan, RunStep, timeline

# ---- commands ----


def contradictions(step: RunStep, frequency: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield key and error sentence of each command that contradicts another one to the same drive.

    `frequency` has the names of the drives whose frequency the step sets.
    """
    for name in dict.fromkeys(step.stop):
        if name in (*frequency, *step.write, *step.start):
            yield "stop", f"{name} is stopped and also commanded in this step; write two steps"
    for name in step.start:
        if step.rate and name in frequency:
            yield "start", f"{name} cannot be started by a ramp; start it in a step before"


def check_step(step: RunStep, plant: Plant) -> None:
    """Raise ValueError for a command that a rule forbids, such as a write that wears EEPROM."""
    for _, sentence in contradictions(step, step.frequency):
        raise ValueError(f"{step.name}: {sentence}")
    for name in step.drives:
        _, drive = plant.find_drive(name)
        if name in step.stop:
            check_stop(drive)
        for register, value in step.write.get(name, {}).items():
            check_write(drive, register, value)
        if name in step.frequency:
            check_frequency(drive, step.frequency[name])
        if name in step.start:
            check_start(drive, step.direction)


def _rehearse(script: Any, *arguments: Any) -> Any:
    """Return the first step of a command's script, such as a write, without sending it.

    Raises ValueError if the drive does not have this command, or if it may not be sent.
    """
    try:
        return next(script(*arguments))
    except Unsupported as lacking:
        raise ValueError(str(lacking)) from lacking


def check_stop(drive: Drive) -> None:
    """Raise ValueError if the drive has no stop command."""
    _rehearse(drive.stop.script)


def check_start(drive: Drive, direction: Direction | None) -> None:
    """Raise ValueError if the drive may not be started."""
    drive.check_confirmed("start")
    _rehearse(drive.start.script, direction)


def check_frequency(drive: Drive, hz: float) -> None:
    """Raise ValueError for a frequency that a step may not set on this drive."""
    drive.check_confirmed("set_frequency")
    first = _rehearse(drive.set_frequency.script, hz)
    check_worn(drive, "steps")
    if isinstance(first, Write):
        value = first.register.decode(raw_count(drive, first.register, first.value))
        # Rules that need reads from the drive are not checked here, but by the run itself.
        next(conditions(drive, first.register, value), None)


def check_write(drive: Drive, name: str, value: Any) -> None:
    """Raise ValueError if a step may not write this value (a number or a value's name) to this register."""
    register = drive.register(name)
    if isinstance(value, str):
        value = register.parse(value)
    check_plain(drive, register, raw_count(drive, register, value))
    if wears(drive, register) is not Kept.RAM:
        rule = "it may be kept in EEPROM, which steps would wear out"
        raise refused(drive, register, f'{rule}; declare ram = ["{name}"] if this drive keeps it in RAM')


# ---- bus time ----


RAMP_EVERY_S = 0.5  # pause between two setpoints of a ramp, in s
EXCHANGES = 2  # number of exchanges of a write: the write itself, and the read that verifies it
MOST_SHARE = 0.5  # largest part of a line's time for the setpoints of ramps
CYCLES = 2  # least length of a step and of `silence`, in bus cycles
# `silence` is by default LEAST_SILENCE_S s, or SILENT_CYCLES times `longest_pause` if that is longer.
LEAST_SILENCE_S, SILENT_CYCLES = 5.0, 3


@dataclass(frozen=True)
class _LineTime:
    """A line that a test uses, with its predicted bus times in s."""

    line: PlantLine
    prediction: Prediction

    @property
    def exchange(self) -> float:
        """The mean time of an exchange, in s."""
        return self.prediction.cycle / sum(rate.requests for rate in self.prediction.rates)

    @property
    def names(self) -> set[str]:
        return {polled.drive.name for polled in self.line.drives}


def _lines(plan: RunPlan) -> list[_LineTime]:
    """Return the lines that have at least one drive of the test."""
    found = [
        _LineTime(line, predict(planned_on(line), switching=line.switching)) for line in plan.plant.lines
    ]
    return [one for one in found if one.names & {*plan.drives}]


def longest_pause(plan: RunPlan) -> float:
    """Return the longest planned time in s between two values of a register that the test needs.

    These are the registers in conditions, the fault codes, and at least one register of each drive.
    """
    compared = {*plan.faults, *((condition.drive, condition.register) for condition in plan.conditions)}
    pauses = [one.prediction.cycle for one in _lines(plan)]
    for line in plan.plant.lines:
        for polled in line.drives:
            every = {poll.register.name: poll.every or 0.0 for poll in polled.series}
            if polled.drive.name in plan.drives and every:
                pauses.append(min(every.values()))
            pauses += [every[register] for drive, register in compared if drive == polled.drive.name]
    return max(pauses, default=0.0)


def silence_of(plan: RunPlan) -> float:
    """Return the time in s without a value after which the run is aborted."""
    return plan.limits.silence or max(LEAST_SILENCE_S, SILENT_CYCLES * longest_pause(plan))


def misfits(plan: RunPlan) -> list[str]:
    """Return a sentence for each part of the test for which a line is too slow, with a possible value."""
    found = list(dict.fromkeys(_misfits(plan)))
    least = CYCLES * longest_pause(plan)
    if silence_of(plan) < least:
        found.append(
            f"silence = {duration_text(silence_of(plan))} is shorter than {CYCLES} reads: it would fit "
            f"with {duration_text(_rounded(least))}"
        )
    return found


def _misfits(plan: RunPlan) -> Iterator[str]:
    planned = timeline(plan.steps)
    for one in _lines(plan):
        if not one.prediction.fits:
            suggestions = suggest(planned_on(one.line), one.prediction, one.line.switching)
            yield f"line {one.line.name} does not reach its polling rates; {suggestions}"
        for step in planned:
            yield from _step_misfits(step, one)


def _step_misfits(planned: PlannedStep, of: _LineTime) -> Iterator[str]:
    step = planned.step
    written = of.names & {*step.frequency, *step.write}
    count = sum(len(step.write.get(name, ())) + (name in step.frequency) for name in written)
    writes = EXCHANGES * of.exchange * count
    least = max(CYCLES * of.prediction.cycle, writes)
    is_short = planned.seconds < least and not step.until and (step.dwell or written - {*step.start})
    if is_short and of.names & {*step.drives}:
        yield (
            f"{step.name} lasts {duration_text(planned.seconds)}, less than {CYCLES} bus cycles of line "
            f"{of.line.name}: it would fit with {duration_text(_rounded(least))}"
        )
    most = int(MOST_SHARE * RAMP_EVERY_S / (EXCHANGES * of.exchange))
    if step.rate and len(written) > most:
        yield (
            f"{step.name} ramps {len(written)} drives of line {of.line.name} at once: it would fit with "
            f"{most}, or with a higher baud rate"
        )


def _rounded(seconds: float) -> float:
    """Return the time rounded up to 10 ms."""
    return -(-seconds // 0.01) / 100
