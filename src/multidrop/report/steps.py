"""Compute figures of a test run's steps: means, extremes, settling times, slopes and energies.

All durations are by CLOCK_MONOTONIC, because UTC may be set during a run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multidrop.recording.series import Array
from multidrop.report.load import Recording, Series, StepSpan

BAND = 0.02  # largest distance of a settled value from the final value, as a fraction of the step's change
LAST = 0.2  # the final value is the mean over this last fraction of a step
KILOWATTS = {"kW": 1.0, "W": 1e-3}  # units of power, as multiples of 1 kW; their integral is an energy


class StepValues(NamedTuple):
    """Figures of one register in one step of a test run. Times are in s; `slope` is in the unit per s.

    `settling` is the time from the start of the step until the value stays near its final value. The final
    value is the mean of the step's last fifth. "Near" means within 2 % of the value's change, or within the
    register's resolution if that is more. `settling` is None if the value has not settled by the end. `slope`
    is the slope of a straight line fitted by least squares; None for fewer than two times. `energy` in kWh is
    the integral of a power by the trapezoidal rule, without the times of missed values. It is None for a
    register that is not a power.
    """

    drive: str
    register: str
    unit: str
    values: int
    mean: float
    least: float
    greatest: float
    settling: float | None
    slope: float | None
    energy: float | None


def values_of(recording: Recording, step: StepSpan) -> list[StepValues]:
    """Return the figures of this step for each register that has numbers, not names."""
    found = (_values_of(series, step) for series in recording.series if not series.names)
    return [values for values in found if values is not None]


def _values_of(series: Series, step: StepSpan) -> StepValues | None:
    in_order = np.argsort(series.monotonic, kind="stable")
    times, values = series.monotonic[in_order], series.value[in_order]
    begin, end = np.searchsorted(times, [step.monotonic_begin, step.monotonic_end])
    seconds = (times[begin:end] - step.monotonic_begin) / 1e9
    known = ~np.isnan(values)
    time, value = seconds[known[begin:end]], values[begin:end][known[begin:end]]
    if not len(value):
        return None
    before = values[:begin][known[:begin]]
    first = float(before[-1]) if len(before) else float(value[0])
    return StepValues(
        series.drive,
        series.register,
        series.unit,
        len(value),
        float(value.mean()),
        float(value.min()),
        float(value.max()),
        _settling(time, value, first, float(series.metadata.get("step") or 0.0)),
        _slope(time, value),
        _energy(series.unit, seconds, values[begin:end]),
    )


def _settling(time: Array, value: Array, first: float, resolution: float) -> float | None:
    """Return the time from which the value stays settled; None if it has not settled by the end.

    `first` is the value before the step.
    """
    last = float(value[time >= time[-1] * (1 - LAST)].mean())
    outside = np.flatnonzero(np.abs(value - last) > max(BAND * abs(last - first), resolution))
    if not len(outside):
        return 0.0
    return float(time[outside[-1] + 1]) if outside[-1] + 1 < len(value) else None


def _slope(time: Array, value: Array) -> float | None:
    from_mean = time - time.mean()
    spread = float((from_mean**2).sum())
    return float((from_mean * (value - value.mean())).sum()) / spread if spread else None


def _energy(unit: str, seconds: Array, values: Array) -> float | None:
    if unit not in KILOWATTS:
        return None
    power = values * KILOWATTS[unit]
    return float(np.nansum(np.diff(seconds) / 3600 * (power[1:] + power[:-1]) / 2))
