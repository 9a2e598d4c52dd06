"""Check that the steps of a test are not too fast for the bus cycles of its lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from multidrop.planning.prediction import Prediction, duration_text, predict, suggest
from multidrop.plant.model import PlantLine, planned_on
from multidrop.runs.model import PlannedStep, RunPlan, timeline

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
    """Return the longest planned time in s between two values that the test needs.

    It needs any value of each of its drives, a value of each register in a condition, and each fault code.
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
    """Return a sentence for each part of the test that is too fast for its line, with a value that fits."""
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
