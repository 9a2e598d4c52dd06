"""How pictures look: colours that can be told apart by everyone, few lines, time in UTC."""

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
from multidrop.report.load import Array

# Okabe and Ito's, without black and yellow; then the same once more, dashed.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#555555")
DASHES = ("solid", "dashed", "dotted", "dashdot")
TEXT = "#555555"
FAULT = "#B00020"
GRID = "#DDDDDD"
FEWEST_BUCKETS, MOST_BUCKETS = 10, 120  # of the time axis
BUCKET_NS = 2_000_000_000  # the width of one, between these
SHORTEST_NS = 1_000_000_000  # time axis
WIDTH = 11.0  # inches
DPI = 110

_DATES: Any = dates  # it has no types


def label(text: str) -> str:
    """A name as a picture shows it: no mathematics, and never left out of a legend."""
    shown = printable(text).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def line_style(number: int) -> dict[str, Any]:
    """Of the number-th drive, in every picture."""
    return {
        "color": COLOURS[number % len(COLOURS)],
        "linestyle": DASHES[number // len(COLOURS) % len(DASHES)],
    }


def new_figure(heights: Sequence[float], **details: Any) -> tuple[Figure, list[Axes]]:
    """A figure of axes below each other, as high in inches as said."""
    figure = Figure(figsize=(WIDTH, sum(heights) + 0.6), layout="constrained", dpi=DPI)
    axes = figure.subplots(len(heights), 1, squeeze=False, height_ratios=list(heights), **details)[:, 0]
    for one in axes:
        one.grid(visible=True, color=GRID, linewidth=0.6)
        one.set_axisbelow(True)
        one.spines[["top", "right"]].set_visible(False)
    return figure, list(axes)


def time_edges(begin: int, end: int) -> Array:
    """Of the buckets into which a picture cuts the time, in ns UTC."""
    buckets = int(np.clip((end - begin) / BUCKET_NS, FEWEST_BUCKETS, MOST_BUCKETS))
    return np.linspace(begin, max(end, begin + SHORTEST_NS), buckets + 1)


def days(time: Array) -> Array:
    """Times in ns UTC as matplotlib counts them."""
    return np.asarray(_DATES.date2num(np.asarray(time, dtype="datetime64[ns]")))


def day(time: int) -> float:
    return float(days(np.array(time)))


def tell_time(axes: Axes) -> None:
    """Its x axis says the time of day in UTC, and the date where that is not clear."""
    locator = _DATES.AutoDateLocator(tz=UTC)
    axes.xaxis.set_major_locator(locator)
    formatter = _DATES.ConciseDateFormatter(
        locator,
        tz=UTC,
        formats=["%Y", "%b", "%d %b", "%H:%M", "%H:%M", "%H:%M:%S"],
        zero_formats=["", "%Y", "%b", "%d %b", "%H:%M", "%H:%M:%S"],
        offset_formats=["", "%Y", "%b %Y", "%d %b %Y", "%d %b %Y", "%d %b %Y"],
    )
    axes.xaxis.set_major_formatter(formatter)
    axes.set_xlabel("time, UTC", loc="left")


def png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
