"""The picture of a fleet, as lines of text for a given width and height.

Everything important is shown by words, not only by colours. An old view is dimmed, and shows its age.
"""

from __future__ import annotations

import textwrap
import time
from typing import Any

from multidrop.cli.fleet.tables import (
    FleetState,
    count_sentence,
    gateway_table,
    line_columns,
    line_table,
    move_table,
    natural,
    silent_gateways,
    trouble_sentences,
)
from multidrop.cli.support.screen import TextLine, cut

OLD_S = 3.0  # an older view is dimmed
NOTES = 4  # limit of the lines for notes, and for problems
MOVES = 8  # limit of the moves' table, with its head, if the lines' table needs the other room


def picture(fleet: FleetState, size: tuple[int, int], head: str) -> list[TextLine]:
    """Draw a fleet's gateways, lines, moves and notes.

    `fleet` has the form that `fleet watch --json` prints, and further "notes".
    """
    width, height = size
    is_old = fleet["age_s"] is None or fleet["age_s"] > OLD_S
    top = [_title(fleet, head, width), _warning(fleet, width)]
    foot = [TextLine(_cut(note, width)) for note in (*_notes(fleet, width), "Ctrl-C ends it")]
    room = max(0, height - len(top) - len(foot))
    body = [_row(text, width, is_old) for text in _body(fleet, width, room)[:room]]
    return [*top, *body, *[TextLine()] * (room - len(body)), *foot][:height]


def _body(fleet: FleetState, width: int, room: int) -> list[str]:
    """Return all gateways, and as many moves and lines as fit."""
    begin = [
        *gateway_table(fleet, width - 1),
        "",
        count_sentence(fleet),
        *trouble_sentences(fleet)[:NOTES],
        "",
    ]
    room = max(0, room - len(begin))
    silent = silent_gateways(fleet)
    names = sorted(fleet["lines"], key=lambda name: _urgency(name, fleet["lines"][name]["master"], silent))
    lines = line_table(fleet, names, width - 1)
    if len(lines) > room // 2:
        columns = line_columns(fleet, sorted(names, key=natural), width - 1)
        lines = columns if len(columns) <= room // 2 else lines
    moves = _moves(fleet, width, max(min(MOVES, room // 2), room - len(lines)))
    return [*begin, *_fitting(lines, room - len(moves)), *moves]


def _notes(fleet: FleetState, width: int) -> list[str]:
    """Return the last notes, wrapped: as many whole notes as fit."""
    notes: list[str] = []
    for note in reversed(fleet.get("notes", ())):
        wrapped = textwrap.wrap(note, width - 1, subsequent_indent=" " * 9)
        if len(wrapped) + len(notes) > NOTES:
            break
        notes = [*wrapped, *notes]
    return notes


def _moves(fleet: FleetState, width: int, room: int) -> list[str]:
    rows = move_table(fleet["moves"][: max(0, room - 2)], width - 1)
    return ["", "last moves:", *rows] if rows else []


def _fitting(lines: list[str], room: int) -> list[str]:
    if len(lines) <= room:
        return lines
    kept = room - 1
    if kept < 2:  # there is room only for the table's head
        return []
    return [*lines[:kept], f"and {len(lines) - kept} more lines"]


def _urgency(name: str, master: str | None, silent: set[str]) -> tuple[int, list[str | int]]:
    """Return a sort key: lines without a master come first, then lines whose master does not answer."""
    return 0 if master is None else 1 if master in silent else 2, natural(name)


def _title(fleet: FleetState, head: str, width: int) -> TextLine:
    clock = time.strftime("%H:%M:%S UTC ", time.gmtime(fleet["at_ms"] / 1000))
    text = f" {head}"[: max(0, width - len(clock))]
    return TextLine((text.ljust(width - len(clock)) + clock)[:width], style="reverse")


def _warning(fleet: FleetState, width: int) -> TextLine:
    if not fleet["trouble"]:
        return TextLine()
    age = "not read yet" if fleet["age_s"] is None else f"this is {fleet['age_s']:.0f} s old"
    return TextLine(_cut(f"{age}: {fleet['trouble']}", width), style="bold red")


def _row(text: str, width: int, is_old: bool) -> TextLine:
    style: Any = "dim" if is_old else ""
    if "no answer" in text or "  none" in text:
        style = "bold red"
    elif text.startswith(("GATEWAY ", "LINE ", "last moves")):
        style = "bold underline"
    return TextLine(_cut(text, width), style=style)


def _cut(text: str, width: int) -> str:
    return cut(text, width - 1)
