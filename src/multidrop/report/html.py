"""Write a recording as one self-contained HTML page with tables and pictures."""

from __future__ import annotations

import base64
import html
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from multidrop.printable import printable
from multidrop.recording.series import Array
from multidrop.report.health import (
    DelaySeries,
    LineUse,
    delays,
    draw_delays,
    draw_miss_shares,
    draw_rates,
    draw_utilisation,
    line_uses,
    reasons_of,
)
from multidrop.report.load import Recording, Series, StepSpan
from multidrop.report.style import MOST_DRIVES, png
from multidrop.report.value_plot import FAULTS, plot

SHORT = 32  # a table cell with at most this many characters is not wrapped

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; }
body { max-width: 1100px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0; }
h2 { font-size: 1.15em; margin: 2em 0 .4em; border-bottom: 1px solid #ddd; }
p.about { color: #555; margin-top: .2em; }
table { border-collapse: collapse; }
th, td { padding: .2em .9em .2em 0; text-align: left; vertical-align: top; border-bottom: 1px solid #eee; }
th { font-weight: 600; color: #555; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
td.short { white-space: nowrap; }
img { width: 100%; height: auto; }
div.wide { overflow-x: auto; }
"""


def plot_page(recording: Recording, figure: Figure) -> str:
    return _page(f"{recording.path.name}", [_about(recording), _image(figure, "values over time")])


def report_page(recording: Recording) -> str:
    """Return the report as HTML: use of the lines, rates, missed values, delays, faults and values."""
    parts = [
        _about(recording),
        *_drives(recording),
        *_steps(recording),
        *_utilisation(line_uses(recording), recording),
        "<h2>Rates and misses</h2>",
    ]
    parts += [_image(draw_rates(recording), "values and misses a second"), *_misses(recording)]
    shares = draw_miss_shares(recording)
    if shares:
        parts.append("<h2>Misses against output frequency</h2>")
        parts.append("<p>Noise that comes with the motor's speed shows as a slope to the right.</p>")
        parts.append(_image(shares, "misses against output frequency"))
    parts += [*_delays(delays(recording)), *_faults(recording), *_events(recording)]
    parts += ["<h2>Values</h2>", *_values(recording)]
    return _page(f"Report on {recording.path.name}", parts)


def _page(title: str, parts: Sequence[str]) -> str:
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_escape(title)}</title><style>{_STYLE}</style></head><body>\n"
        f"<h1>{_escape(title)}</h1>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def _about(recording: Recording) -> str:
    plant = recording.metadata.get("plant")
    values, misses = _counts(recording.series)
    text = (
        f"From {_utc(recording.begin)} UTC, {_duration(recording.seconds)}; "
        f"{_count(len(recording.drives), 'drive')}; "
        f"{_count(values, 'value')}, {_count(misses, 'miss', 'misses')}"
    )
    of_plant = _escape(f"; plant {plant}") if plant else ""
    return f'<p class="about">{text}{of_plant}</p>'


def _utc(time_ns: int) -> str:
    return f"{datetime.fromtimestamp(time_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S}"


def _counts(series: Sequence[Series]) -> tuple[int, int]:
    misses = sum(int(one.missed.sum()) for one in series)
    return sum(len(one.time) for one in series) - misses, misses


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number:,} {one if number == 1 else many or one + 's'}".replace(",", "\u202f")


def _duration(seconds: float) -> str:
    hours, rest = divmod(round(seconds), 3600)
    minutes, rest = divmod(rest, 60)
    if hours:
        return f"{hours} h {minutes:02} min"
    return f"{minutes} min {rest:02} s" if minutes else f"{seconds:.1f} s"


def _drives(recording: Recording) -> Iterator[str]:
    yield "<h2>What was polled</h2>"
    rows = []
    for drive in recording.drives:
        about = recording.about(drive)
        series = recording.of(drive)
        values, misses = _counts(series)
        rows.append(
            [
                drive,
                str(about.get("line", "")),
                str(about.get("model", "")),
                str(about.get("address", "")),
                f"{about.get('settings', '')} {about.get('framing', '')}",
                ", ".join(one.register for one in series),
                f"{values / max(recording.seconds, 1e-9):.1f}",
                str(values),
                str(misses),
                f"{misses / max(values + misses, 1):.2%}",
            ]
        )
    heads = ["Drive", "Line", "Model", "Address", "Settings", "Registers"]
    yield _table([*heads, "#Values/s", "#Values", "#Misses", "#Missed"], rows)
    if len(rows) > MOST_DRIVES:
        yield f"<p>The pictures show the first {MOST_DRIVES} of these drives; the tables have all.</p>"


def _utilisation(uses: Sequence[LineUse], recording: Recording) -> Iterator[str]:
    yield "<h2>Utilisation against plan</h2>"
    if not uses:
        yield "<p>The recording does not carry a plan: it was not made by polling a plant file.</p>"
        return
    yield (
        "<p>The share of the line's time that the answered exchanges needed for silence, request, "
        "response delay and reply. Other traffic, such as commands, is not recorded. The plan uses the "
        "response delays that the drives' documents state.</p>"
    )
    yield _image(draw_utilisation(uses, recording), "utilisation over time")
    rows = []
    for use in uses:
        planned = use.planned
        rows.append([use.line, "utilisation, %", _percent(planned["utilisation"]), _percent(use.utilisation)])
        if use.cycle is not None:
            rows.append(["", "bus cycle, ms", f"{planned['cycle_ms']:.1f}", f"{use.cycle * 1e3:.1f}"])
        rows += [
            ["", f"{name}, exchanges/s", f"{drive['exchanges_per_second']:.1f}", f"{use.rate(name):.1f}"]
            for name, drive in planned["drives"].items()
        ]
    yield _table(["Line", "What", "#Planned", "#Measured"], rows)


def _steps(recording: Recording) -> Iterator[str]:
    if not recording.steps:
        return
    yield "<h2>Steps of the test</h2>"
    yield (
        "<p>A value has settled when it stays near the mean of the step's last fifth, within 2 % of its "
        "change. The settling time counts from the start of the step. The slope is that of a straight "
        "line, fitted by least squares.</p>"
    )
    heads = ["Drive", "Register", "Unit", "#Values", "#Mean", "#Least", "#Greatest"]
    heads += ["#Settling, s", "#Slope, 1/s", "#Energy, kWh"]
    for number, step in enumerate(recording.steps, 1):
        found = values_of(recording, step)
        begin, length = (step.begin - recording.begin) / 1e9, (step.end - step.begin) / 1e9
        yield f"<h3>{number}. {_escape(step.what)}, from {begin:.1f} s, for {length:.1f} s</h3>"
        if found:
            yield _table(heads, [_step_row(values) for values in found])
        else:
            yield "<p>No value was read.</p>"


def _step_row(values: StepValues) -> list[str]:
    numbers = (values.mean, values.least, values.greatest, values.settling, values.slope, values.energy)
    shown = ("" if number is None else f"{number:.6g}" for number in numbers)
    return [values.drive, values.register, values.unit, str(values.values), *shown]


def _percent(part: float) -> str:
    return f"{part * 100:.1f}"


def _misses(recording: Recording) -> Iterator[str]:
    by_drive = {drive: reasons_of(recording, drive) for drive in recording.drives}
    reasons = sum(by_drive.values(), Counter())
    if not reasons:
        return
    order = [reason for reason, _ in reasons.most_common()]
    rows = [
        [drive, *(str(counts[reason] or "") for reason in order), str(counts.total())]
        for drive, counts in by_drive.items()
    ]
    yield _table(["Drive", *(f"#{reason}" for reason in order), "#All misses"], rows)


def _delays(found: Sequence[DelaySeries]) -> Iterator[str]:
    yield "<h2>Response delays</h2>"
    if not found:
        yield "<p>No drive ever answered.</p>"
        return
    yield "<p>From the request's last bit to the reply's first. A value was taken within this time.</p>"
    yield _image(draw_delays(found), "response delays by drive")
    parts = {"least": 0.0, "median": 0.5, "95 %": 0.95, "99 %": 0.99, "longest": 1.0}
    rows = [
        [
            delay.drive + ("" if delay.exact else " (with the request)"),
            str(len(delay.seconds)),
            *(f"{delay.quantile(part) * 1e3:.1f}" for part in parts.values()),
        ]
        for delay in found
    ]
    yield _table(["Drive", "#Replies", *(f"#{name}, ms" for name in parts)], rows)


def _faults(recording: Recording) -> Iterator[str]:
    yield "<h2>Faults</h2>"
    polled = [series for series in recording.series if series.register == FAULTS]
    rows = [
        [series.drive, span.what, _utc(span.begin), _duration((span.end - span.begin) / 1e9)]
        for series in polled
        for span in series.faults()
    ]
    if rows:
        yield _table(["Drive", "Fault", "From, UTC", "#For"], rows)
    elif polled:
        yield "<p>None was seen.</p>"
    else:
        yield "<p>No register called fault was polled.</p>"


def _events(recording: Recording) -> Iterator[str]:
    if recording.events:
        yield "<h2>Events</h2>"
        rows = [[_utc(event.time), event.kind, event.text] for event in recording.events]
        yield _table(["Time, UTC", "Kind", "Text"], rows)


def _values(recording: Recording) -> Iterator[str]:
    if not any(series.has_values for series in recording.series):
        yield "<p>There is none.</p>"
        return
    figure, left = plot(recording)
    if left:
        names = _escape("; ".join(left))
        yield f"<p>Not shown: {names}. <code>multidrop plot</code> with --drive or --register shows each.</p>"
    yield _image(figure, "values over time")


def _escape(text: str) -> str:
    return html.escape(printable(text))


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return an HTML table. A column whose head starts with # has numbers, which are aligned to the right."""
    kinds = [f' class="{_kind(column)}"' for column in zip(heads, *rows, strict=True)]
    head = "".join(
        f"<th{kind}>{_escape(text.removeprefix('#'))}</th>" for kind, text in zip(kinds, heads, strict=True)
    )
    body = "\n".join(
        "<tr>"
        + "".join(f"<td{kind}>{_escape(cell)}</td>" for kind, cell in zip(kinds, row, strict=True))
        + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><tr>{head}</tr>\n{body}</table></div>'


def _kind(column: Sequence[str]) -> str:
    if column[0].startswith("#"):
        return "number"
    return "short" if max(map(len, column)) <= SHORT else "long"


def _image(figure: Figure, what: str) -> str:
    data = base64.b64encode(png(figure)).decode()
    return f'<img alt="{_escape(what)}" src="data:image/png;base64,{data}">'


# ---- figures of a test run's steps ----

# All durations are by CLOCK_MONOTONIC, because UTC may be set during a run.
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
