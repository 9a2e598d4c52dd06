"""Draw the screens of the monitor as lines of text, for a given width and height.

Important states are shown by words and marks, not only by colours.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import NamedTuple

from multidrop.cli.support.polling import CURRENT, FAULT, FREQUENCY, STATE, LiveDrive, LivePlant, Moment
from multidrop.cli.support.terminal import TextLine, cut, filled, sparkline
from multidrop.cli.support.values import columns_of, counted, padded
from multidrop.printable import printable

LEAST_WIDTH, LEAST_HEIGHT = 60, 12
WIDE, WIDEST = 100, 110  # columns needed to show delays (WIDE), and also models (WIDEST)
LEAST_DRIVES = 3  # a trigger's curves are hidden if fewer drives than this would fit above them
# notes beside a register's value, if it is old, or if the register is not polled
OLD_NOTE, NOT_POLLED = "old", "not polled"
NEVER = "never"
# least width of a register's value; width of the value's age and of all blanks together
LEAST_VALUE, AROUND = 12, 13
OLD = "?"  # mark in front of an old value
HISTORY = "LAST MINUTE"  # table heading
STOPS = "s stop   S stop all   q quit"
ACKNOWLEDGE = (f"a acknowledge FAILURES   {STOPS}",)
HELP = (f"up/down choose   Enter registers   {STOPS}", f"up/down   Enter registers   {STOPS}")
PAGE_HELP = (f"up/down choose   PgUp/PgDn scroll   Enter back   {STOPS}", f"PgUp/PgDn   Enter back   {STOPS}")


@dataclass
class Position:
    """The user's selection in the monitor, a pending question, and unacknowledged failures."""

    chosen: int = 0  # index of the chosen drive
    page: bool = False  # True while one drive's registers are shown, instead of all drives
    scrolled: int = 0  # number of the page's lines above the visible part
    question: str = ""
    message: str = ""
    failures: list[str] = field(default_factory=list)  # unacknowledged failures of stops
    failures_shown: int = 0  # number of failures that are on the screen now
    # lines of text that draw the curves around the last trigger
    trigger: list[str] = field(default_factory=list)


class SideRead(NamedTuple):
    """One read of a register: the value as text, or why the read failed."""

    text: str
    monotonic_ns: int  # end of the read


def overview(
    plant: LivePlant, at: Position, size: tuple[int, int], now: Moment, blocks: str
) -> list[TextLine]:
    """Draw one line of text per drive. If not all drives fit, draw those around the chosen drive."""
    width, height = size
    top = [_title(plant, width, now), *_line_states(plant, width)]
    columns = _columns(plant, width)
    top.append(TextLine(_row(columns, {name: name for name in columns}, "")[:width], style="bold underline"))
    alarms = _alarms(at, size)
    room = height - len(top) - len(alarms) - 2
    curves = [TextLine(cut(f" {printable(line)}", width)) for line in at.trigger]
    if room < len(curves) + LEAST_DRIVES:
        curves = []
    room -= len(curves)
    first = max(0, min(at.chosen - room // 2, len(plant.drives) - room))
    rows = [
        _drive(drive, number == at.chosen, columns, width, now, blocks)
        for number, drive in enumerate(plant.drives[first : first + room], first)
    ]
    hidden = len(plant.drives) - len(rows)
    notes = [f"{OLD} old value"] if any(OLD in row.plain for row in rows) else []
    note = "   ".join([*notes, *([f"{hidden} more drives: scroll"] if hidden else [])])
    empty = [TextLine()] * (room - len(rows))
    return [*top, *rows, *empty, *curves, *alarms, *_foot(at, width, HELP, note)]


def page(
    shown: LiveDrive, others: Mapping[str, SideRead], at: Position, size: tuple[int, int], now: Moment
) -> list[TextLine]:
    """Draw every register of one drive.

    `others` has the values that a SideReader has read from registers that are not polled.
    """
    width, height = size
    drive = shown.polled.drive
    head = f" {shown.name}  {drive.title or drive.model}  address {drive.address}  "
    head += f"{drive.settings} {drive.framing}"
    state = f" {shown.state or 'state not polled'}   {shown.fault}   {_misses(shown.so_far.misses)}"
    top = [
        TextLine(filled(head, width), style="reverse"),
        TextLine(cut(state, width)),
        TextLine(cut(f" {_pace(shown)}", width)),
    ]
    names = [name for name, register in drive.registers.items() if register.readable]
    polled = [poll.register.name for poll in shown.polled.series]
    names = [*polled, *(name for name in names if name not in polled)]
    longest = max(map(len, names), default=0)
    cells = [_register(shown, name, others, now) for name in names]
    notes = max((len(note) for *_, note in cells), default=0)
    room = max(LEAST_VALUE, width - longest - notes - AROUND)  # columns that remain for registers' values
    values = max(LEAST_VALUE, min(room, max((columns_of(value) for value, *_ in cells), default=0)))
    rows = [
        _register_row(f"{name:<{longest}}", *cell, values, width)
        for name, cell in zip(names, cells, strict=True)
    ]
    alarms = _alarms(at, size)
    room = height - len(top) - len(alarms) - 2
    at.scrolled = max(0, min(at.scrolled, len(rows) - room))
    visible = rows[at.scrolled : at.scrolled + room]
    note = f"registers {at.scrolled + 1} to {at.scrolled + len(visible)} of {len(rows)}"
    return [
        *top,
        *visible,
        *[TextLine()] * (room - len(visible)),
        *alarms,
        *_foot(at, width, PAGE_HELP, note),
    ]


# ---- parts of both pictures ----


def _title(plant: LivePlant, width: int, now: Moment) -> TextLine:
    clock = f"{datetime.fromtimestamp(now.utc_ns / 1e9, UTC):%H:%M:%S} UTC "
    text = f" multidrop monitor  {printable(plant.plant.path.name)}"
    return TextLine(filled(text, width - len(clock)) + clock, style="reverse")


def _line_states(plant: LivePlant, width: int) -> list[TextLine]:
    lines = []
    longest = max((columns_of(line.name) for line in plant.plant.lines), default=0)
    for line in plant.plant.lines:
        recent = plant.recent[line.name]
        text = f" {padded(line.name, '<', longest)}  {recent.utilisation:4.0%} of the wire used  "
        text += f"{recent.exchanges_per_second:.1f} exchanges/s  {_misses(plant.so_far[line.name].misses)}"
        lines.append(TextLine(cut(text, width)))
    return lines


def _misses(reasons: Mapping[str, int]) -> str:
    if not reasons:
        return "no misses"
    ordered = sorted(reasons.items(), key=lambda reason: -reason[1])
    total = sum(reasons.values())
    return f"{total} missed: " + ", ".join(f"{reason} {count}" for reason, count in ordered)


def _pace(drive: LiveDrive) -> str:
    """Describe a drive's recent rate of exchanges, and its delays and losses since the start."""
    so_far, delays = drive.so_far, drive.so_far.delays
    parts = [f"{drive.recent.exchanges_per_second:.1f} exchanges/s"]
    if delays.replies:
        parts.append(f"delay {_ms(delays.p50)} ms, p99 {_ms(delays.p99)}, max {_ms(delays.longest)}")
    if so_far.late_replies:
        parts.append(f"{so_far.late_replies} late")
    if so_far.skipped_bytes:
        parts.append(f"{counted(so_far.skipped_bytes, 'byte')} skipped")
    return "  ".join(parts)


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.{0 if seconds >= 0.1 else 1}f}"


def _columns(plant: LivePlant, width: int) -> dict[str, int]:
    """Return the widths of the columns by heading. Fault and history share the rest of the line."""
    state = 12 if width >= WIDE else 10
    columns = {"DRIVE": 5, "STATE": state, "FREQUENCY": 10, "CURRENT": 10, "FAULT": 8, "AGE": 7}
    if width >= WIDEST:
        columns = {"DRIVE": 5, "MODEL": 14} | columns
    longest = max(columns_of(drive.name) for drive in plant.drives)
    most = 11 + max(0, width - WIDE) // 3
    columns["DRIVE"] += max(0, min(longest - 5, most, width - len(columns) - sum(columns.values())))
    if width > len(columns) + sum(columns.values()) + 6:
        columns["MISSED"] = 6
    if width >= WIDE:
        columns["DELAY"] = 8
    left = max(0, width - 1 - sum(columns.values()) - len(columns))
    more = min(left // 3, left - len(HISTORY), 26) if left >= len(HISTORY) else left
    columns["FAULT"] += more
    if left > more:
        columns[HISTORY] = left - more
    return columns


_RIGHT = {"FREQUENCY", "CURRENT", "AGE", "MISSED", "DELAY"}


def _row(columns: Mapping[str, int], cells: Mapping[str, str], mark: str) -> str:
    parts = []
    for head, width in columns.items():
        parts.append(padded(cut(cells.get(head, ""), width), ">" if head in _RIGHT else "<", width))
    return f"{mark:1}" + " ".join(parts)


def _drive(
    drive: LiveDrive, chosen: bool, columns: Mapping[str, int], width: int, now: Moment, blocks: str
) -> TextLine:
    old = {name for name in (STATE, FREQUENCY, CURRENT, FAULT) if drive.is_old(name, now)}

    def marked(text: str, register: str) -> str:
        return OLD + text if text and register in old else text

    cells = {
        "DRIVE": drive.name,
        "MODEL": drive.polled.drive.model,
        "STATE": marked(drive.state, drive.state_register),
        "FREQUENCY": marked(drive.shown(FREQUENCY), FREQUENCY),
        "CURRENT": marked(drive.shown(CURRENT), CURRENT),
        "FAULT": marked(drive.fault, FAULT) or drive.why_silent,
        "AGE": _age(drive.age(now)),
        "DELAY": f"{_ms(drive.so_far.delays.p50)} ms" if drive.so_far.delays.replies else "",
        "MISSED": str(drive.so_far.misses.total() or ""),
        HISTORY: sparkline(drive.history, columns.get(HISTORY, 0), blocks, drive.points),
    }
    style = "red" if drive.fault else "yellow" if drive.why_silent or old else ""
    text = _row(columns, cells, ">" if chosen else "!" if drive.fault else "")
    return TextLine(filled(text, width), style=f"{style} reverse" if chosen else style)


def _register(
    drive: LiveDrive, name: str, others: Mapping[str, SideRead], now: Moment
) -> tuple[str, str, str]:
    """Return a register's value, its age, and a note."""
    if any(poll.register.name == name for poll in drive.polled.series):
        miss = drive.missed.get(name)
        row = drive.newest.get(name)
        value = drive.shown(name) or (miss.status if miss else "not yet")
        note = miss.status if miss and row else OLD_NOTE if drive.is_old(name, now) else ""
        return value, _age(None if row is None else now.age(row)), note
    other = others.get(name)
    if other is None:
        return "...", "", NOT_POLLED
    return other.text, _age((now.monotonic_ns - other.monotonic_ns) / 1e9), NOT_POLLED


def _register_row(name: str, value: str, age: str, note: str, value_width: int, width: int) -> TextLine:
    text = f" {name}  {padded(cut(value, value_width), '>', value_width)}  {age:>6}  {note}"
    style = "dim" if note == NOT_POLLED else "yellow" if note or age == NEVER else ""
    return TextLine(cut(text, width), style=style)


def _alarms(at: Position, size: tuple[int, int]) -> list[TextLine]:
    """Draw as many unacknowledged failures as fit, the oldest first."""
    width, height = size
    most = max(2, (height - 8) // 2)
    lines: list[str] = []
    at.failures_shown = 0
    failures = list(at.failures)  # a copy, because a stop's thread may add a failure at any moment
    for failure in failures:
        wrapped = textwrap.wrap(printable(failure), width - 4, break_long_words=True)
        if lines and len(lines) + len(wrapped) > most - 1:
            break
        lines += wrapped[: most - 1]
        at.failures_shown += 1
    more = len(failures) - at.failures_shown
    lines += [f"... and {more} more; acknowledge these first"] if more else []
    return [TextLine(f" ! {line}".ljust(width), style="bold white on-red") for line in lines]


def _foot(at: Position, width: int, helps: Sequence[str], note: str) -> list[TextLine]:
    if at.question:
        return [TextLine(), TextLine(filled(f" {at.question}", width), style="bold reverse")]
    text = f" {at.message}" if at.message else f" {note}"
    helps = ACKNOWLEDGE if at.failures else helps
    help_text = next((help_text for help_text in helps if len(help_text) < width), helps[-1])
    return [TextLine(cut(text, width), style="bold"), TextLine(cut(f" {help_text}", width), style="dim")]


def _age(seconds: float | None) -> str:
    if seconds is None:
        return NEVER
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"
