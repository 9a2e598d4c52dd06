"""The picture of a recording's values: a panel a quantity, states as lanes, faults and misses marked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from multidrop.report.lanes import draw_lanes, lanes_inches, lanes_of, name_bar
from multidrop.report.load import RAW, Array, Selection, Series
from multidrop.report.style import FAULT, GRID, TEXT, day, days, label, line_style, new_figure, tell_time

FIRST = (  # shown before others when there are more than fit
    "output_frequency",
    "output_current",
    "motor_speed",
    "output_torque",
    "output_power",
    "dc_bus_voltage",
    "output_voltage",
    "heatsink_temperature",
)
MOST_PANELS = 8
MOST_POINTS = 4000  # of a line: more cannot be seen
FEW_POINTS = 200  # each has a dot of its own
FAULTS = "fault"

CURVES_INCHES = 1.9
Panel = tuple[str, str, bool]  # register, unit, and whether its counts are states, which have names


def plot(
    look: Selection, drives: Sequence[str] = (), registers: Sequence[str] = ()
) -> tuple[Figure, list[str]]:
    """The picture, and the registers that had no room in it.

    Raises ValueError for unknown names, and where all that was to be drawn is missing.
    """
    _check("drive", drives, look.drives)
    chosen = [it for it in look.series if not drives or it.drive in drives]
    _check("register", registers, tuple(dict.fromkeys(it.register for it in chosen)))
    if not any(it.has_values for it in chosen if not registers or it.register in registers):
        raise ValueError(
            f"there is no value to draw, only misses: {_told(chosen)}; `multidrop report` tells more"
        )
    panels = _panels([it for it in chosen if it.register != FAULTS], registers)
    shown, left = panels[:MOST_PANELS], panels[MOST_PANELS:]
    if registers:
        shown, left = panels, []
    told = [it for it in chosen if it.register == FAULTS]
    faults = [it for it in told if it.faults()] or ([] if shown else told)
    strip = [0.35 + 0.22 * len(faults)] if faults else []
    contents = [[it for it in chosen if _panel(it) == panel] for panel in shown]
    lanes_by_panel = [
        lanes_of(series) if panel[2] else ([], 0) for panel, series in zip(shown, contents, strict=True)
    ]
    heights = [lanes_inches(lanes) if lanes else CURVES_INCHES for lanes, _ in lanes_by_panel]
    figure, axes = new_figure([*strip, *heights], sharex=True)
    spans = [(it, span) for it in faults for span in it.faults()]
    if faults:
        _draw_faults(axes[0], faults, look)
    for panel, series, (lanes, hidden), one in zip(
        shown, contents, lanes_by_panel, axes[len(strip) :], strict=True
    ):
        if panel[2]:
            note = f" ({hidden} more lanes: choose with --drive)" if hidden else ""
            one.set_title(f"{label(_title(panel))}{note}", loc="left", fontsize=10)
            draw_lanes(one, lanes, look)
        else:
            _draw_panel(one, panel, series, look)
        for _, span in spans:
            one.axvspan(day(span.begin), day(span.end), color=FAULT, alpha=0.08, lw=0)
    tell_time(axes[-1])
    axes[-1].set_xlim(day(look.begin), day(max(look.end, look.begin + 1_000_000)))
    curves = {
        it.drive for panel, series in zip(shown, contents, strict=True) for it in series if not panel[2]
    }
    handles = [
        Line2D([], [], label=label(name), **line_style(number))
        for number, name in enumerate(look.drives)
        if name in curves
    ]
    if any(it.missed.any() for it in chosen):
        handles.append(Line2D([], [], color=TEXT, marker="|", linestyle="", label="missed"))
    figure.legend(
        handles=handles, loc="outside upper left", ncols=min(6, max(1, len(handles))), frameon=False
    )
    return figure, [_title(panel) for panel in left]


def _panel(series: Series) -> Panel:
    return series.register, series.unit, bool(series.names)


def _check(what: str, given: Sequence[str], known: Sequence[str]) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"the recording has no {what} {name!r}; it has {', '.join(known)}")


def _told(series: Sequence[Series]) -> str:
    reasons = sum((it.reasons() for it in series), Counter[str]())
    return ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())


def _panels(chosen: Sequence[Series], registers: Sequence[str]) -> list[Panel]:
    """One for each register and unit: amperes and per cent do not share an axis."""
    found = dict.fromkeys(_panel(it) for it in chosen if not registers or it.register in registers)
    order = {name: at for at, name in enumerate(registers or FIRST)}
    return sorted(found, key=lambda panel: (order.get(panel[0], len(order)), panel[1] == RAW))


def _title(panel: Panel) -> str:
    return f"{panel[0]}, {panel[1]}" if panel[1] else panel[0]


def _draw_panel(axes: Axes, panel: Panel, series: Sequence[Series], look: Selection) -> None:
    too_large = sum(int((np.isnan(it.drawable) & ~it.missed).sum()) for it in series)
    note = f" ({too_large} values of 1e150 and more are not drawn)" if too_large else ""
    axes.set_title(f"{label(_title(panel))}{note}", loc="left", fontsize=10)
    for it in series:
        time, value = thinned(it.time, it.drawable)
        style = line_style(look.drives.index(it.drive))
        marker = "." if len(time) < FEW_POINTS else ""
        axes.plot(days(time), value, linewidth=1.3, marker=marker, markersize=3, **style)
    _mark_misses(axes, series, look)
    _fit(axes, series)


def _fit(axes: Axes, series: Sequence[Series]) -> None:
    """Counts stand at whole numbers; a value that never changes is no tiny span; 0 is there if it is near."""
    drawn = np.concatenate([it.drawable for it in series])
    seen = drawn[~np.isnan(drawn)]
    if not len(seen):
        axes.set_yticks([])
        axes.text(0.5, 0.5, "no value", transform=axes.transAxes, ha="center", va="center", color=TEXT)
        return
    if all(it.unit in ("", RAW) for it in series):
        axes.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    if seen.min() == seen.max():
        low, high = min(0.0, 1.2 * seen.min()), max(1.0, 1.2 * seen.max())
        axes.set_ylim(low - 0.05 * (high - low), high)
    low, high = axes.get_ylim()
    if 0 < low < 0.6 * high:
        axes.set_ylim(bottom=0)


def _mark_misses(axes: Axes, series: Sequence[Series], look: Selection) -> None:
    """A tick at the foot of the panel, in the drive's colour, for every value that was due and missed."""
    for it in series:
        time = it.time[it.missed]
        if len(time):
            apart = max(1, (time[-1] - time[0]) // MOST_POINTS)
            time = np.unique(time // apart) * apart  # ticks that would lie on each other are one
            foot = np.full(len(time), 0.025)
            axes.plot(
                days(time),
                foot,
                "|",
                color=line_style(look.drives.index(it.drive))["color"],
                markersize=7,
                markeredgewidth=1.2,
                transform=axes.get_xaxis_transform(),
            )


def _draw_faults(axes: Axes, series: Sequence[Series], look: Selection) -> None:
    """A row for each drive; a bar with its name while there is one."""
    axes.set_title("faults" if any(it.faults() for it in series) else "faults: none", loc="left", fontsize=10)
    for row, it in enumerate(series):
        for span in it.faults():
            begin, end = day(span.begin), day(span.end)
            axes.barh(row, end - begin, left=begin, height=0.7, color=FAULT, alpha=0.85)
            name_bar(axes, label(span.what).lower(), begin, row)
    axes.set_yticks(range(len(series)), [label(it.drive) for it in series], fontsize=8)
    axes.set_ylim(len(series) - 0.5, -0.5)
    axes.grid(visible=True, axis="x", color=GRID, linewidth=0.6)


def thinned(time: Array, value: Array) -> tuple[Array, Array]:
    """At most MOST_POINTS points: of each stretch the smallest and the largest, and whether one is missed."""
    pieces = MOST_POINTS // 2
    if len(time) <= MOST_POINTS:
        return time, value
    length = len(time) // pieces
    whole = length * pieces
    rows = value[:whole].reshape(pieces, length)
    lows = np.where(np.isnan(rows), np.inf, rows).argmin(axis=1)
    highs = np.where(np.isnan(rows), -np.inf, rows).argmax(axis=1)
    at = np.sort(np.stack([lows, highs], axis=1), axis=1) + np.arange(pieces)[:, None] * length
    kept = np.unique(np.concatenate([at.ravel(), np.arange(whole, len(time))]))
    return time[kept], value[kept]
