"""A fleet as lines of text: its gateways, its lines and its last moves."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Mapping
from math import inf
from typing import Any

from multidrop.cli.support.values import Row, aligned, counted

Told = Mapping[str, Any]  # as `--json` prints it
GATEWAYS = (
    "GATEWAY",
    "HOST",
    "SESSION",
    "SINCE",
    "STATE",
    "LINES",
    "MARGIN",
    "SPOOL",
    "BEHIND",
    "LAG",
    "LOST",
)
LINES = ("LINE", "PORT", "MASTER", "SINCE")
LEFT_OUT = ("SINCE", "HOST", "SESSION")  # in this order, where a terminal is too narrow for all
UNITS = ("B", "kB", "MB", "GB", "TB")


def moment(ms: int) -> str:
    """Return a time (ms since 1970) as UTC; "?" for a number that no calendar has."""
    try:
        return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(ms // 1000))
    except (OverflowError, ValueError, OSError):
        return "?"


def gateway_table(fleet: Told, width: float = inf) -> list[str]:
    """Return the table of gateways, without some columns where it would be wider than `width`."""
    table = [GATEWAYS, *(_gateway_row(name, gateway) for name, gateway in fleet["gateways"].items())]
    sides = "<<><<>>>>>>"
    for column in LEFT_OUT:
        found = aligned(table, sides)
        if max(map(len, found)) <= width:
            return found
        at = table[0].index(column)
        table = [(*row[:at], *row[at + 1 :]) for row in table]
        sides = sides[:at] + sides[at + 1 :]
    return aligned(table, sides)


def _gateway_row(name: str, gateway: Told) -> Row:
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
    """Return a number of bytes in the unit that leaves three digits at most."""
    for unit in UNITS[:-1]:
        if number < 1000:
            return f"{number:.0f} {unit}" if number >= 10 or unit == "B" else f"{number:.1f} {unit}"
        number /= 1000
    return f"{number:.0f} {UNITS[-1]}"


def natural(name: str) -> list[str | int]:
    """Return a key that orders names as people do: line-2 before line-10."""
    return [int(part) if at % 2 else part for at, part in enumerate(re.split(r"([0-9]+)", name))]


def line_table(lines: Mapping[str, Told]) -> list[str]:
    return aligned([LINES, *(_line_row(name, line) for name, line in lines.items())], "<<<<")


def _line_row(name: str, line: Told) -> Row:
    return name, line["port"], line["master"] or "none", moment(line["since_ms"]) if line["master"] else ""


def free_lines(fleet: Told) -> list[str]:
    """Return the lines without a master."""
    return [name for name, line in fleet["lines"].items() if not line["master"]]


def count_sentence(fleet: Told) -> str:
    return f"{counted(len(fleet['lines']), 'line')}, {len(free_lines(fleet))} without a master"


def move_table(moves: Iterable[Told]) -> list[str]:
    """Return a line for each move: when, which line, from whom, to whom."""
    rows = [(moment(move["at_ms"]), move["line"], *_from_to(move)) for move in moves]
    return aligned(rows, "<<<<")


def _from_to(move: Told) -> tuple[str, str]:
    before = "" if move["from"] is None else f"from {move['from'] or 'nobody'}"
    return before, f"to {move['to'] or 'nobody'}"


def trouble_sentences(fleet: Told) -> list[str]:
    """Return the troubles that gateways report, a sentence for each."""
    found = []
    for name, gateway in fleet["gateways"].items():
        says = gateway["says"] or {}
        found += [f"{name}: line {line}: {why}" for line, why in (says.get("troubles") or {}).items()]
        found += [
            f"{name}: {why}" for why in (says.get("trouble"), says.get("spool", {}).get("trouble")) if why
        ]
    return found
