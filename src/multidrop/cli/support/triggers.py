"""The triggers of `poll` and `monitor`: their arguments, and a drawing of the newest trigger's signals."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from datetime import UTC, datetime
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

from multidrop.cli.support.arguments import argument
from multidrop.cli.support.polling import Triggering
from multidrop.cli.support.screen import sparkline
from multidrop.cli.support.values import columns_of, padded
from multidrop.plant.model import Plant
from multidrop.plant.triggers import POST_S, PRE_S, TriggerSeries, with_triggers
from multidrop.polling.batch import Row
from multidrop.recording import FORMATS, open_recording
from multidrop.toml_check import parse_duration


def add_trigger_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--trigger",
        metavar="CONDITION",
        action="append",
        default=[],
        help="record only around each moment at which this becomes true, such as "
        '"pump-1.output_current > 30"; fault: a fault of any drive; key: the key t; may be repeated',
    )
    for name, default, where in (("pre", PRE_S, "before"), ("post", POST_S, "after")):
        parser.add_argument(
            f"--{name}",
            metavar="TIME",
            type=argument(parse_duration),
            help=f"with --trigger: how long to record {where} each trigger; default: {default:g} s",
        )


def triggering_of(plant: Plant, arguments: argparse.Namespace) -> tuple[Plant, Triggering | None]:
    """Return the plant with a channel for each trigger's condition, and how the triggers are recorded.

    Raises ValueError for contradicting options and for a mistake in a condition.
    """
    if not arguments.trigger:
        if arguments.pre is not None or arguments.post is not None:
            raise ValueError(
                '--pre and --post belong to a trigger: add --trigger "pump-1.output_current > 30"'
            )
        return plant, None
    if not arguments.out:
        raise ValueError("--trigger needs --out, such as --out trip.arrows")
    if getattr(arguments, "rotate", None) is not None:
        raise ValueError("--trigger and --rotate exclude each other: each trigger has its own file")
    if arguments.out.suffix not in FORMATS:
        raise ValueError(f"{arguments.out}: a recording's name must end in {', '.join(FORMATS)}")
    try:
        found = with_triggers(plant, [condition for condition in arguments.trigger if condition != "key"])
    except ValueError as mistakes:
        raise ValueError("\n".join(f"--trigger {one}" for one in str(mistakes).splitlines())) from None
    how = Triggering(arguments.pre or PRE_S, arguments.post or POST_S, found.texts, found.signals)
    return found.plant, how


# ---- the picture of the last trigger ----

MOST_SIGNALS = 4  # limit of lines in the picture
LEAST_COLUMNS = 10  # least width of a curve
MOST_ROWS = 100_000  # rows read from a recording for a picture; new rows must wait during the reading


def trigger_picture(path: Path, how: Triggering, width: int, blocks: str) -> list[str]:
    """Draw the signals around the moment of a trigger, as lines of text with at most `width` columns.

    The signals are those that the condition names; for a trigger without a condition, they are the polled
    registers. `path` is a complete recording. Return [] if it cannot be read, because polling must go on.
    """
    try:
        recording = open_recording(path)
        trigger = recording.metadata["trigger"]
        rows = list(islice(chain.from_iterable(recording), MOST_ROWS + 1))
    except (ImportError, KeyError, OSError, ValueError):
        return []
    is_large = len(rows) > MOST_ROWS
    polled: dict[TriggerSeries, list[Row]] = {}
    for row in sorted([] if is_large else rows, key=lambda row: row.time_ns):
        polled.setdefault((row.drive, row.register), []).append(row)
    known = recording.metadata.get("drives", {})
    wanted = how.signals.get(trigger["condition"]) or [one for one in polled if one[0] in known]
    signals = {series: polled[series] for series in wanted if series in polled}
    shown = [*signals.items()][:MOST_SIGNALS]
    names = [".".join(series) for series, _ in shown]
    registers = [known.get(drive, {}).get("registers", {}).get(name, {}) for (drive, name), _ in shown]
    ranges = [_range(own, about.get("unit", "")) for about, (_, own) in zip(registers, shown, strict=True)]
    side = max(map(columns_of, names), default=0) + 2
    columns = max(LEAST_COLUMNS, width - side - max(map(columns_of, ranges), default=0) - 2)
    span = SpanOfTime(trigger["time_ns"], trigger["pre_s"], trigger["post_s"])
    time = datetime.fromtimestamp(trigger["time_ns"] / 1e9, UTC)
    note = ", which is too large for a picture" if is_large else ""
    lines = [f"trigger {time:%H:%M:%S.%f} UTC: {trigger['condition']}, in {path.name}{note}"]
    for name, text, (_, own) in zip(names, ranges, shown, strict=True):
        lines.append(
            f"{padded(name, '<', side)}{sparkline(span.history(own, columns), columns, blocks)}  {text}"
        )
    mark = " " * span.column(trigger["time_ns"], columns) + "^"
    return [*lines, f"{padded('', '<', side)}{mark} {span}"] if shown else lines


class SpanOfTime(NamedTuple):
    """The time that a trigger's picture shows, from `pre_s` before the trigger to `post_s` after it."""

    trigger_ns: int
    pre_s: float
    post_s: float

    def __str__(self) -> str:
        return f"from -{self.pre_s:g} s to {self.post_s:g} s"

    def column(self, time_ns: int, columns: int) -> int:
        """Return which of `columns` columns shows this time."""
        since_ns = time_ns - self.trigger_ns + round(self.pre_s * 1e9)
        span_ns = round((self.pre_s + self.post_s) * 1e9)
        return max(0, min(columns - 1, since_ns * columns // max(1, span_ns)))

    def history(self, rows: Iterable[Row], columns: int) -> list[float | None]:
        """Return a value for each column: the value with the largest magnitude among its rows.

        A column without rows has the value of the last row before it: None if that row is a miss.
        """
        found: dict[int, list[float | None]] = {}
        for row in rows:
            found.setdefault(self.column(row.time_ns, columns), []).append(row.value)
        history: list[float | None] = []
        last: float | None = None
        for column in range(columns):
            values = found.get(column, [last])
            history.append(max((value for value in values if value is not None), key=abs, default=None))
            last = values[-1]
        return history


def _range(rows: Iterable[Row], unit: str) -> str:
    values = [row.value for row in rows if row.value is not None]
    return f"{min(values):g} to {max(values):g} {unit}".rstrip() if values else "no value"
