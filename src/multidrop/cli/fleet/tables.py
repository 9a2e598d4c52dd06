"""A fleet as lines of text: its gateways, its lines and its last moves."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Mapping
from math import inf
from typing import Any

from multidrop.cli.support.values import Row, aligned, columns_of, counted

FleetState = Mapping[str, Any]  # a fleet's state, as `--json` prints it
GATEWAYS = (
    "GATEWAY",
    "HOST",
    "SESSION",
    "SINCE",
    "STATE",
    "LINES",
    "LEASE",
    "SPOOL",
    "UNSENT",
    "LAG",
    "LOST",
)
LINES = ("LINE", "PORT", "MASTER", "SINCE")
# Columns to leave out, in this order, until the table fits the terminal.
LEFT_OUT = ("SINCE", "HOST", "SESSION", "SPOOL", "LAG", "LEASE")
LINES_LEFT_OUT = ("PORT", "SINCE")
UNITS = ("B", "kB", "MB", "GB", "TB")


def moment(ms: int | None) -> str:
    """Return a time (ms since 1970) as UTC text; "?" for None and for an invalid time."""
    try:
        return "?" if ms is None else time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(ms // 1000))
    except (OverflowError, ValueError, OSError):
        return "?"


def gateway_table(fleet: FleetState, width: float = inf) -> list[str]:
    """Return the table of gateways. Columns are left out if it would be wider than `width`."""
    rows = [_gateway_row(name, gateway) for name, gateway in fleet["gateways"].items()]
    return _fitting([GATEWAYS, *rows], "<<><<>>>>>>", LEFT_OUT, width)


def _fitting(table: list[Row], sides: str, left_out: Iterable[str], width: float) -> list[str]:
    """Return a table as lines of text, with as many columns as fit. Its first row is the head."""
    for column in left_out:
        found = aligned(table, sides)
        if max(map(len, found)) <= width:
            return found
        at = table[0].index(column)
        table = [(*row[:at], *row[at + 1 :]) for row in table]
        sides = sides[:at] + sides[at + 1 :]
    return aligned(table, sides)


def _gateway_row(name: str, gateway: FleetState) -> Row:
    says = gateway["says"]
    head = (name, gateway["host"], str(gateway["session"]), moment(gateway["began_ms"]))
    if says is None:
        return (*head, "no answer", str(gateway["lines"]), "-", "-", "-", "-", "-")
    spool = says["spool"]
    return (
        *head,
        says["state"],
        str(gateway["lines"]),
        f"{says['margin_s']:.1f} s",
        size(spool["bytes"]),
        "-" if spool["behind"] is None else str(spool["behind"]),
        "-" if spool["lag_s"] is None else f"{spool['lag_s']:.1f} s",
        str(spool["lost"]),
    )


def size(number: float) -> str:
    """Return a number of bytes with a unit, in at most three digits."""
    for unit in UNITS[:-1]:
        if number < 1000:
            return f"{number:.0f} {unit}" if number >= 10 or unit == "B" else f"{number:.1f} {unit}"
        number /= 1000
    return f"{number:.0f} {UNITS[-1]}"


def natural(name: str) -> list[str | int]:
    """Return a sort key that puts line-2 before line-10."""
    return [int(part) if at % 2 else part for at, part in enumerate(re.split(r"([0-9]+)", name))]


def line_table(fleet: FleetState, names: Iterable[str], width: float = inf) -> list[str]:
    """Return the table of these lines. Columns are left out if it would be wider than `width`."""
    silent = silent_gateways(fleet)
    rows = [_line_row(name, fleet["lines"][name], silent) for name in names]
    return _fitting([LINES, *rows], "<<<<", LINES_LEFT_OUT, width)


def _line_row(name: str, line: FleetState, silent: set[str]) -> Row:
    master, since = line["master"], line["since_ms"]
    answer = ", no answer" if master in silent else ""
    return name, line["port"], f"{master}{answer}" if master else "none", moment(since) if master else ""


def line_columns(fleet: FleetState, names: Iterable[str], width: int) -> list[str]:
    """Return the lines and their masters in several columns, for a screen without room for the table."""
    silent = silent_gateways(fleet)
    rows = [_line_row(name, fleet["lines"][name], silent) for name in names]
    cells = aligned([(name, master) for name, _, master, _ in rows], "<<")
    across = max(1, (width + 3) // (max(map(columns_of, cells), default=0) + 3))
    down = -(-len(cells) // across)
    table = [tuple(cells[at::down]) for at in range(down)]
    padded = [(*row, *[""] * (len(table[0]) - len(row))) for row in table]
    return [*aligned(padded, "<" * len(table[0]), " | ")] if table else []


def silent_gateways(fleet: FleetState) -> set[str]:
    """Return the gateways that do not answer. Their lines may not be polled."""
    return {name for name, gateway in fleet["gateways"].items() if gateway["says"] is None}


def free_lines(fleet: FleetState) -> list[str]:
    """Return the lines without a master."""
    return [name for name, line in fleet["lines"].items() if not line["master"]]


def unsure_lines(fleet: FleetState) -> list[str]:
    """Return the lines whose master does not answer."""
    silent = silent_gateways(fleet)
    return [name for name, line in fleet["lines"].items() if line["master"] in silent]


def lost_lines(fleet: FleetState) -> list[str]:
    """Return the lines that are not polled because their master has lost the line's port."""
    return [line for gateway in fleet["gateways"].values() for line in _lines_in(gateway["says"], "lost")]


def failing_lines(fleet: FleetState) -> list[str]:
    """Return the lines whose values are missing because polling raises exceptions."""
    return [line for gateway in fleet["gateways"].values() for line in _lines_in(gateway["says"], "failing")]


def _lines_in(says: FleetState | None, key: str) -> list[str]:
    """Return the lines that a gateway's answer lists under this key; [] if there is no valid list."""
    found = (says or {}).get(key)
    return [line for line in found if isinstance(line, str)] if isinstance(found, list) else []


def count_sentence(fleet: FleetState) -> str:
    unsure, lost, failing = (len(lines(fleet)) for lines in (unsure_lines, lost_lines, failing_lines))
    more = f", {unsure} whose master does not answer" if unsure else ""
    more += f", {lost} with a lost port" if lost else ""
    more += f", {failing} on which polling fails" if failing else ""
    return f"{counted(len(fleet['lines']), 'line')}, {len(free_lines(fleet))} without a master{more}"


def move_table(moves: Iterable[FleetState], width: float = inf) -> list[str]:
    """Return a line of text for each move: time, line, former master (if there is room) and new master."""
    rows = [(moment(move["at_ms"]), move["line"], *_from_to(move)) for move in moves]
    found = aligned(rows, "<<<<")
    if max(map(len, found), default=0) <= width:
        return found
    return aligned([(at, line, to) for at, line, _, to in rows], "<<<")


def _from_to(move: FleetState) -> tuple[str, str]:
    before = "" if move["from"] is None else f"from {move['from'] or 'none'}"
    return before, f"to {move['to'] or 'none'}"


def trouble_sentences(fleet: FleetState) -> list[str]:
    """Return a sentence for each problem that a gateway reports."""
    found = [
        f"{name} on {gateway['host']} is missing: last seen {moment(gateway['seen_ms'])}"
        for name, gateway in fleet.get("missing", {}).items()
    ]
    for name, gateway in fleet["gateways"].items():
        says = gateway["says"] or {}
        found += [f"{name}: line {line}: {why}" for line, why in (says.get("troubles") or {}).items()]
        found += [
            f"{name}: line {line} cannot be opened from here; another gateway polls it"
            for line in _lines_in(says, "unopened")
            if line in fleet["lines"] and fleet["lines"][line]["master"] != name
        ]
        found += [
            f"{name}: {why}" for why in (says.get("trouble"), says.get("spool", {}).get("trouble")) if why
        ]
    return found
