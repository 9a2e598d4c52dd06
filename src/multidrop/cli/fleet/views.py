"""`multidrop fleet status`, `lines` and `watch`: print a fleet's state once, or show it live on a terminal.

With --json, `watch` prints a line of JSON each second.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from multidrop.cli.fleet.connection import add_server_arguments, open_path, run_with_paths
from multidrop.cli.fleet.tables import (
    FleetState,
    count_sentence,
    failing_lines,
    free_lines,
    gateway_table,
    line_columns,
    line_table,
    lost_lines,
    move_table,
    natural,
    silent_gateways,
    trouble_sentences,
    unsure_lines,
)
from multidrop.cli.support.output import print_text
from multidrop.cli.support.screen import Screen, TextLine, cut
from multidrop.cli.support.signals import on_end_signals
from multidrop.supervisor import supervisor

if TYPE_CHECKING:
    from multidrop.fleet.overview import FleetWatch
    from multidrop.fleet.servers.connections import ServerPath

EVERY_S = 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_server_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    if arguments.command == "watch":
        return run_with_paths(arguments, partial(watch, is_json=arguments.json))
    return run_with_paths(arguments, partial(_PRINTERS[arguments.command], arguments))


async def watch(paths: list[ServerPath], *, is_json: bool) -> int:
    """Show the fleet until Ctrl-C. While no server answers, show the last view with its age."""
    from multidrop.fleet.overview import FleetView, FleetWatch
    from multidrop.supervisor import end_tasks

    if not is_json and not sys.stdout.isatty():
        raise ValueError("`multidrop fleet watch` needs a terminal; with --json it works without one")
    path = await open_path(paths)
    view = FleetView(path)
    await view.check()
    over = asyncio.Event()
    on_end_signals(over.set)
    keeping = supervisor().keep("path", path.keep())
    try:
        with _lines() if is_json else drawing() as show:
            await follow(FleetWatch(view), show, over)
    finally:
        supervisor().let_go("path")
        await end_tasks(keeping)
    return 0


async def follow(watch: FleetWatch, show: Callable[[dict[str, Any]], object], over: asyncio.Event) -> None:
    """Show the fleet once a second, with the age of the view, until `over` is set.

    Raises Ended if the task that keeps the connection open has ended.
    """
    while not over.is_set():
        supervisor().check()
        begun = time.monotonic()
        await watch.look()
        show(watch.state())
        with suppress(TimeoutError):
            await asyncio.wait_for(over.wait(), max(0.0, begun + EVERY_S - time.monotonic()))


@contextmanager
def _lines() -> Iterator[Callable[[dict[str, Any]], None]]:
    yield lambda fleet: print_text(json.dumps(fleet), flush=True)


@contextmanager
def drawing(head: str = "multidrop fleet watch") -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yield a function that draws a fleet on the full screen of the terminal."""
    with Screen() as screen:
        yield lambda fleet: screen.draw(picture(fleet, screen.size, head))


# ---- the fleet's state, printed once ----


async def _seen(paths: list[ServerPath]) -> dict[str, Any]:
    """Return the fleet's state."""
    from multidrop.fleet.overview import FleetView

    view = FleetView(await open_path(paths))
    await view.look()
    return view.fleet()


async def _print_status(arguments: argparse.Namespace, paths: list[ServerPath]) -> int:
    found = await _seen(paths)
    if arguments.json:
        print_text(json.dumps(found, indent=2))
    else:
        print_text("\n".join(_status_table(found)))
    return int(any((found.get("missing"), *(lines(found) for lines in _UNPOLLED))))


def _status_table(found: dict[str, Any]) -> list[str]:
    table = [*gateway_table(found), "", count_sentence(found), *trouble_sentences(found)]
    return [*table, "", "last moves:", *move_table(found["moves"])] if found["moves"] else table


async def _print_lines(arguments: argparse.Namespace, paths: list[ServerPath]) -> int:
    found = await _seen(paths)
    names = sorted(found["lines"], key=natural)
    ordered = {name: found["lines"][name] for name in names}
    print_text(json.dumps(ordered, indent=2) if arguments.json else "\n".join(line_table(found, names)))
    return 0


_UNPOLLED = (free_lines, unsure_lines, lost_lines, failing_lines)  # kinds of lines that may not be polled
_PRINTERS = {"status": _print_status, "lines": _print_lines}


# ---- the picture: everything important is shown by words, not only by colours ----


OLD_S = 3.0  # an older view is dimmed
NOTES = 4  # limit of the lines for notes, and for problems
MOVES = 8  # limit of the rows for moves while the lines fill the rest of the screen


def picture(fleet: FleetState, size: tuple[int, int], head: str) -> list[TextLine]:
    """Draw a fleet's gateways, lines, moves and notes.

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
    elif text.startswith(("GATEWAY ", "LINE ", "last moves")):
        style = "bold underline"
    return TextLine(_cut(text, width), style=style)


def _cut(text: str, width: int) -> str:
    return cut(text, width - 1)
