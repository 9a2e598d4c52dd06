"""The style of all pictures: colours that colour-blind readers can distinguish, few lines, time in UTC."""

from __future__ import annotations

import io
from collections.abc import Sequence
from datetime import UTC
from typing import Any

import numpy as np
from matplotlib import dates
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from multidrop.printable import printable
from multidrop.recording.series import Array

MOST_DRIVES = 100  # limit of drives in a picture; tables list all drives
# Okabe and Ito's colours without black and yellow; if they are used up, lines are dashed
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#555555")
DASHES = ("solid", "dashed", "dotted", "dashdot")
TEXT = "#555555"
FAULT = "#B00020"
GRID = "#DDDDDD"
FEWEST_BINS, MOST_BINS = 10, 120  # limits of the number of bins on the time axis
# usual width of a bin; it is changed to keep the number of bins within the limits
BIN_NS = 2_000_000_000
SHORTEST_NS = 1_000_000_000  # least length of the time axis
WIDTH = 11.0  # width of every figure, in inches
DPI = 110
# legend: width of a mark and of a letter, height of a row; in inches
LEGEND_MARK, LEGEND_LETTER, LEGEND_ROW = 0.7, 0.09, 0.21

_DATES: Any = dates  # matplotlib.dates has no type hints


class TimeBins:
    """The bins into which a picture divides the time axis of a recording; times are in ns UTC."""

    def __init__(self, begin: int, end: int) -> None:
        bins = int(np.clip((end - begin) / BIN_NS, FEWEST_BINS, MOST_BINS))
        self._edges = np.linspace(begin, max(end, begin + SHORTEST_NS), bins + 1)
        self._seconds = (self._edges[1] - self._edges[0]) / 1e9
        self.middles = days(((self._edges[1:] + self._edges[:-1]) / 2).astype(np.int64))

    def rates(self, time: Array, weights: Array | None = None) -> Array:
        """Return the events per second in each bin; with `weights`, the sum of weights per second.

        `time` has the time of each event.
        """
        return np.asarray(np.histogram(time, self._edges, weights=weights)[0] / self._seconds)

    def label(self, axes: Axes) -> None:
        """Label the x axis, and limit the axis to the bins."""
        label_time(axes)
        axes.set_xlim(*days(self._edges[[0, -1]].astype(np.int64)))


def label(text: str) -> str:
    """Escape a text for matplotlib, which reads `$` as a formula and hides entries that start with `_`."""
    shown = printable(text).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def line_style(number: int) -> dict[str, Any]:
    """Return the colour and dashes of the drive with this number, the same in every picture."""
    return {
        "color": COLOURS[number % len(COLOURS)],
        "linestyle": DASHES[number // len(COLOURS) % len(DASHES)],
    }


class NotebookFigure(Figure):
    """A figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        return png(self)


def new_figure(heights: Sequence[float], **details: Any) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes of the given heights (inches), one below the other."""
    figure = NotebookFigure(figsize=(WIDTH, sum(heights) + 0.6), layout="constrained", dpi=DPI)
    axes = figure.subplots(len(heights), 1, squeeze=False, height_ratios=list(heights), **details)[:, 0]
    for one in axes:
        one.grid(visible=True, color=GRID, linewidth=0.6)
        one.set_axisbelow(True)
        one.spines[["top", "right"]].set_visible(False)
    return figure, list(axes)


MOST_COLUMNS = 6  # limit of columns in a legend


def set_title(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", fontsize=10)


def add_legend(figure: Figure, handles: Sequence[Any]) -> None:
    """Add a legend above the axes, with as many columns as fit; the figure grows by the legend's height."""
    longest = max((len(handle.get_label()) for handle in handles), default=0)
    columns = max(1, min(MOST_COLUMNS, int(WIDTH / (LEGEND_MARK + LEGEND_LETTER * longest))))
    rows = -(-len(handles) // columns)
    figure.set_figheight(figure.get_figheight() + LEGEND_ROW * max(0, rows - 1))
    figure.legend(handles=handles, loc="outside upper left", ncols=columns, frameon=False)


def mark_times(axes: Axes, time: Array, height: float, apart: int, **details: Any) -> None:
    """Draw a tick at each time, but only one in each interval of `apart` ns."""
    if len(time):
        time = np.unique(time // max(1, apart)) * max(1, apart)
        axes.plot(days(time), np.full(len(time), height), "|", **details)


def days(time: Array) -> Array:
    """Convert times from ns UTC to matplotlib's days."""
    return np.asarray(_DATES.date2num(np.asarray(time, dtype="datetime64[ns]")))


def day(time: int) -> float:
    return float(days(np.array(time)))


def label_time(axes: Axes) -> None:
    """Label the x axis with the time of day in UTC, and the date if needed."""
    locator = _DATES.AutoDateLocator(tz=UTC)
    axes.xaxis.set_major_locator(locator)
    formatter = _DATES.ConciseDateFormatter(
        locator,
        tz=UTC,
        formats=["%Y", "%b", "%d %b", "%H:%M", "%H:%M", "%H:%M:%S.%f"],
        zero_formats=["", "%Y", "%b", "%d %b", "%H:%M", "%H:%M:%S"],
        offset_formats=["", "%Y", "%b %Y", "%d %b %Y", "%d %b %Y", "%d %b %Y"],
    )
    axes.xaxis.set_major_formatter(formatter)
    axes.set_xlabel("time, UTC", loc="left")


def png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
