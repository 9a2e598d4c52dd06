"""`multidrop fleet status`, `lines` and `watch`: print a fleet's state once, or show it live on a terminal.

With --json, `watch` prints a line of JSON each second.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any

from multidrop.cli.fleet import add_server_arguments, open_path, run_with_paths
from multidrop.cli.support.output import print_json, print_text
from multidrop.cli.support.signals import on_end_signals
from multidrop.cli.support.terminal import Screen, TextLine, cut
from multidrop.cli.support.values import Row, aligned, columns_of, counted
from multidrop.supervisor import end_tasks, supervisor

if TYPE_CHECKING:
    from multidrop.fleet.overview import FleetWatch
    from multidrop.fleet.servers.connections import ServerPath

FleetState = Mapping[str, Any]  # a fleet's state, as `--json` prints it
EVERY_S = 1.0  # pause between two pictures of `watch`


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_server_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    works = {"status": _print_status, "lines": _print_lines, "watch": watch}
    return run_with_paths(arguments, partial(works[arguments.command], arguments))


async def watch(arguments: argparse.Namespace, paths: list[ServerPath]) -> int:
    """Show the fleet's state until Ctrl-C. While no server answers, show the last known state and its age."""
    from multidrop.fleet.overview import FleetView, FleetWatch

    if not arguments.json and not sys.stdout.isatty():
        raise ValueError("`multidrop fleet watch` needs a terminal. Without a terminal, add --json")
    path = await open_path(paths)
    view = FleetView(path)
    await view.check()
    over = asyncio.Event()
    on_end_signals(over.set)
    keeping = supervisor().keep("path", path.keep())
    try:
        with nullcontext(_print_json) if arguments.json else drawing() as show:
            await follow(FleetWatch(view), show, over)
    finally:
        supervisor().let_go("path")
        await end_tasks(keeping)
    return 0


async def follow(watch: FleetWatch, show: Callable[[dict[str, Any]], object], over: asyncio.Event) -> None:
    """Show the fleet's state and its age once a second, until `over` is set.

    Raises Ended if the task that keeps the connection open has ended.
    """
    while not over.is_set():
        supervisor().check()
        begun = time.monotonic()
        await watch.look()
        show(watch.state())
        with suppress(TimeoutError):
            await asyncio.wait_for(over.wait(), max(0.0, begun + EVERY_S - time.monotonic()))


def _print_json(fleet: FleetState) -> None:
    print_text(json.dumps(fleet), flush=True)


@contextmanager
def drawing(head: str = "multidrop fleet watch") -> Iterator[Callable[[dict[str, Any]], None]]:
    with Screen() as screen:
        yield lambda fleet: screen.draw(picture(fleet, screen.size, head))


# ---- the fleet's state, printed once ----


async def _fleet_state(paths: list[ServerPath]) -> dict[str, Any]:
    from multidrop.fleet.overview import FleetView

    view = FleetView(await open_path(paths))
    await view.look()
    return view.fleet()


async def _print_status(arguments: argparse.Namespace, paths: list[ServerPath]) -> int:
    found = await _fleet_state(paths)
    if arguments.json:
        print_json(found)
    else:
        lines = [*gateway_table(found), "", count_sentence(found), *trouble_sentences(found)]
        if found["moves"]:
            lines += ["", "last changes of master:", *move_table(found["moves"])]
        print_text("\n".join(lines))
    unpolled = (kind(found) for kind in (free_lines, unanswered_lines, lost_lines, failing_lines))
    return int(any((found.get("missing"), *unpolled)))


async def _print_lines(arguments: argparse.Namespace, paths: list[ServerPath]) -> int:
    found = await _fleet_state(paths)
    names = sorted(found["lines"], key=natural)
    if arguments.json:
        print_json({name: found["lines"][name] for name in names})
    else:
        print_text("\n".join(line_table(found, names)))
    return 0


# ---- the picture: everything important is shown by words, not only by colours ----


OLD_S = 3.0  # an older state of the fleet is shown dimmed
NOTES = 4  # limit of the rows for notes, and of the rows for problems
MOVES = 8  # limit of the rows that show changes of masters, if the lines fill the screen


def picture(fleet: FleetState, size: tuple[int, int], head: str) -> list[TextLine]:
    """Draw a fleet's gateways and lines, the latest changes of masters, and notes.

    `fleet` has the form that `fleet watch --json` prints, plus the key "notes": a list of sentences.
    """
    width, height = size
    is_old = fleet["age_s"] is None or fleet["age_s"] > OLD_S
    top = [_title(fleet, head, width), _warning(fleet, width)]
    foot = [TextLine(_cut(note, width)) for note in (*_notes(fleet, width), "Ctrl-C ends it")]
    room = max(0, height - len(top) - len(foot))
    body = [_row(text, width, is_old) for text in _body(fleet, width, room)[:room]]
    return [*top, *body, *[TextLine()] * (room - len(body)), *foot][:height]


def _body(fleet: FleetState, width: int, room: int) -> list[str]:
    """Return rows of text: all gateways, problems, then as many lines and changes of masters as fit."""
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
    moves_room = max(min(MOVES, room // 2), room - len(lines)) - 2
    rows = move_table(fleet["moves"][: max(0, moves_room)], width - 1)
    moves = ["", "last changes of master:", *rows] if rows else []
    return [*begin, *_first_lines(lines, room - len(moves)), *moves]


def _notes(fleet: FleetState, width: int) -> list[str]:
    """Return the last notes, wrapped: as many whole notes as fit."""
    notes: list[str] = []
    for note in reversed(fleet.get("notes", ())):
        wrapped = textwrap.wrap(note, width - 1, subsequent_indent=" " * 9)
        if len(wrapped) + len(notes) > NOTES:
            break
        notes = [*wrapped, *notes]
    return notes


def _first_lines(lines: list[str], room: int) -> list[str]:
    if len(lines) <= room:
        return lines
    kept = room - 1
    if kept < 2:  # there is room only for the table's heading
        return []
    return [*lines[:kept], f"and {len(lines) - kept} more lines"]


def _urgency(name: str, master: str | None, silent: set[str]) -> tuple[int, list[str | int]]:
    """Return a key that sorts lines without a master first, then lines whose master does not answer."""
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
    elif text.startswith(("GATEWAY ", "LINE ", "last changes of master")):
        style = "bold underline"
    return TextLine(_cut(text, width), style=style)


def _cut(text: str, width: int) -> str:
    return cut(text, width - 1)


# ---- tables and sentences ----


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
    """Return the table of the named lines. Columns are left out if it would be wider than `width`."""
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
    """Return the gateways that do not answer. Perhaps their lines are not polled."""
    return {name for name, gateway in fleet["gateways"].items() if gateway["says"] is None}


def free_lines(fleet: FleetState) -> list[str]:
    return [name for name, line in fleet["lines"].items() if not line["master"]]


def unanswered_lines(fleet: FleetState) -> list[str]:
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
    unanswered, lost, failing = (len(lines(fleet)) for lines in (unanswered_lines, lost_lines, failing_lines))
    more = f", {unanswered} whose master does not answer" if unanswered else ""
    more += f", {lost} with a lost port" if lost else ""
    more += f", {failing} on which polling fails" if failing else ""
    return f"{counted(len(fleet['lines']), 'line')}, {len(free_lines(fleet))} without a master{more}"


def move_table(moves: Iterable[FleetState], width: float = inf) -> list[str]:
    """Return a row of text for each change of a line's master: time, line, former and new master.

    If a row is longer than `width`, all rows leave out the former master.
    """
    rows = [
        (
            moment(move["at_ms"]),
            move["line"],
            "" if move["from"] is None else f"from {move['from'] or 'none'}",
            f"to {move['to'] or 'none'}",
        )
        for move in moves
    ]
    found = aligned(rows, "<<<<")
    if max(map(len, found), default=0) <= width:
        return found
    return aligned([(at, line, to) for at, line, _, to in rows], "<<<")


def trouble_sentences(fleet: FleetState) -> list[str]:
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
