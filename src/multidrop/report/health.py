"""Pictures of how well the line did: rates, misses over time and against frequency, response delays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from multidrop.core import UNASKED, Framing, Message, build_request
from multidrop.drive.timing import Settings
from multidrop.report.load import Array, Selection, Series
from multidrop.report.style import COLOURS, TEXT, days, label, line_style, new_figure, tell_time, time_edges

MOST_REASONS = 6  # in a picture; the rest are one
LEAST_IN_BIN = 20  # values, before a share of misses means something
BINS = 12  # of the output frequency
FREQUENCY = "output_frequency"
ROOM = 2.0  # times the longest delay but one of a hundred: so much a picture shows
SHORTEST_AXIS = 0.001  # s


@dataclass(frozen=True)
class DelaySeries:
    """How long a drive took from the request's last bit to its reply's first, in s."""

    drive: str
    seconds: Array
    exact: bool  # the request's length is known; else it is still in there

    def quantile(self, part: float) -> float:
        return float(np.quantile(self.seconds, part))


def delays(look: Selection) -> list[DelaySeries]:
    """Of every drive that ever answered."""
    found = []
    for drive in look.drives:
        request = _request_seconds(look, drive)
        taken = [it.uncertainty[~it.missed] for it in look.of(drive)]
        # One exchange answers for several registers: its stamps count once.
        times = [it.time[~it.missed] for it in look.of(drive)]
        stamps, firsts = np.unique(np.concatenate(times), return_index=True)
        if len(stamps):
            seconds = np.concatenate(taken)[firsts] / 1e9 - (request or 0.0)
            found.append(DelaySeries(drive, np.maximum(seconds, 0.0), request is not None))
    return found


def _request_seconds(look: Selection, drive: str) -> float | None:
    """A read's request and the reply's first character on the wire; None where nothing tells the settings."""
    about = look.about(drive)
    try:
        baudrate, format = about["settings"].split()
        framing = {str(it): it for it in Framing}[about["framing"]]
        character = Settings(int(baudrate), format).character
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
        return None
    message = Message(1, 7, data=bytes(4)) if framing is Framing.DELIXI else Message(1, 3, 0, 1)
    return (len(build_request(framing, message)) + 1) * character


def draw_delays(found: Sequence[DelaySeries]) -> Figure:
    """A row a drive: a box from the first to the third quarter, whiskers to 1 % and 99 %."""
    figure, (axes,) = new_figure([0.8 + 0.32 * len(found)])
    axes.boxplot(
        [it.seconds * 1e3 for it in found],
        orientation="horizontal",
        whis=(1, 99),
        widths=0.6,
        patch_artist=True,
        tick_labels=[label(it.drive) for it in found],
        boxprops={"facecolor": "#CFE3F1", "edgecolor": COLOURS[0]},
        medianprops={"color": COLOURS[1], "linewidth": 1.6},
        whiskerprops={"color": COLOURS[0]},
        capprops={"color": COLOURS[0]},
        flierprops={"marker": ".", "markersize": 2.5, "alpha": 0.4, "markeredgecolor": COLOURS[0]},
    )
    axes.invert_yaxis()
    limit = ROOM * max(it.quantile(0.99) for it in found) + SHORTEST_AXIS
    longer = sum(int((it.seconds > limit).sum()) for it in found)
    axes.set_xlim(0, limit * 1e3 if longer else None)
    note = f" ({longer} longer beyond the right edge)" if longer else ""
    axes.set_xlabel(f"response delay, ms{note}", loc="left")
    return figure


def draw_rates(look: Selection) -> Figure:
    """Values a second of each drive, and below it the misses a second by reason."""
    figure, (rates, misses) = new_figure([2.2, 1.8], sharex=True)
    edges = time_edges(look.begin, look.end)
    width = (edges[1] - edges[0]) / 1e9
    middles = days(((edges[1:] + edges[:-1]) / 2).astype(np.int64))
    for number, drive in enumerate(look.drives):
        counts = sum(_counted(it.time[~it.missed], edges) for it in look.of(drive))
        rates.plot(middles, counts / width, linewidth=1.3, label=label(drive), **line_style(number))
    rates.set_title("values a second", loc="left", fontsize=10)
    rates.set_ylim(bottom=0)
    reasons = [reason for reason, _ in _reasons(look.series).most_common()]
    stacked = {
        reason: sum(_counted(_times_of(it, reason), edges) for it in look.series) / width
        for reason in reasons[:MOST_REASONS]
    }
    for reason in reasons[MOST_REASONS:]:
        more = sum(_counted(_times_of(it, reason), edges) for it in look.series) / width
        stacked["other reasons"] = stacked.get("other reasons", 0.0) + more
    misses.set_title("misses a second, by reason", loc="left", fontsize=10)
    if stacked:
        misses.stackplot(
            middles,
            list(stacked.values()),
            labels=list(map(label, stacked)),
            colors=_SHADES,
            step="mid",
            linewidth=0,
        )
        misses.legend(fontsize=8, frameon=False, loc="upper left", ncols=3)
        misses.set_ylim(0, 1.35 * float(np.sum(list(stacked.values()), axis=0).max()))
    else:
        misses.text(0.5, 0.5, "none", transform=misses.transAxes, ha="center", va="center", color=TEXT)
        misses.set_ylim(0, 1)
    figure.legend(*rates.get_legend_handles_labels(), loc="outside upper left", ncols=6, frameon=False)
    tell_time(misses)
    misses.set_xlim(*days(edges[[0, -1]].astype(np.int64)))
    return figure


_SHADES = ("#B00020", "#E69F00", "#56B4E9", "#CC79A7", "#009E73", "#0072B2", "#999999")


def _counted(time: Array, edges: Array) -> Array:
    return np.asarray(np.histogram(time, edges)[0], dtype=float)


def _times_of(series: Series, reason: str) -> Array:
    return np.asarray(series.time[series.missed & (series.status == series.statuses.index(reason))])


def _reasons(series: Sequence[Series]) -> Counter[str]:
    return sum((it.reasons() for it in series), Counter())


def reasons_of(look: Selection, drive: str) -> Counter[str]:
    """A drive's misses by reason."""
    return _reasons(look.of(drive))


def miss_shares(look: Selection, drive: str) -> tuple[Array, Array] | None:
    """Output frequencies in Hz, and which share of the drive's values is missed near each of them.

    The frequency at a miss is the last one seen. What was not asked for says nothing of noise. None
    where nothing was missed, and where the drive tells no frequency or keeps one.
    """
    (frequency, *_) = (*look.of(drive, FREQUENCY), None)
    reasons = [it for it in reasons_of(look, drive) if not it.startswith(UNASKED)]
    if frequency is None or not reasons:
        return None
    there = ~np.isnan(frequency.drawable)
    known_time, known = frequency.time[there], frequency.value[there]
    if not len(known) or known.max() - known.min() < 1.0:
        return None
    edges = np.linspace(known.min(), known.max(), BINS + 1)
    missed, asked = np.zeros(BINS), np.zeros(BINS)
    unasked = [at for at, status in enumerate(look.series[0].statuses) if status.startswith(UNASKED)]
    for it in look.of(drive):
        last = np.searchsorted(known_time, it.time, side="right") - 1
        there = (last >= 0) & ~np.isin(it.status, unasked)
        place = np.clip(np.searchsorted(edges, known[last[there]], side="right") - 1, 0, BINS - 1)
        asked += np.bincount(place, minlength=BINS)
        missed += np.bincount(place[it.missed[there]], minlength=BINS)
    enough = asked >= LEAST_IN_BIN
    middles = (edges[1:] + edges[:-1]) / 2
    return middles[enough], missed[enough] / asked[enough]


def draw_miss_shares(look: Selection) -> Figure | None:
    """Misses against output frequency: noise that comes with speed shows as a slope."""
    shares = {drive: miss_shares(look, drive) for drive in look.drives}
    if not any(shares.values()):
        return None
    figure, (axes,) = new_figure([2.4])
    for number, (drive, found) in enumerate(shares.items()):
        if found:
            axes.plot(
                *found, marker="o", markersize=4, linewidth=1.3, label=label(drive), **line_style(number)
            )
    axes.set_ylim(bottom=0, top=max(0.01, axes.get_ylim()[1]))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("output frequency of the drive, Hz", loc="left")
    axes.set_ylabel("missed")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=6, frameon=False)
    return figure
