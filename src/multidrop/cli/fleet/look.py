"""`multidrop fleet status` and `lines`: print a fleet's state, from its records and its gateways' answers."""

from __future__ import annotations

import argparse
import json
from functools import partial
from typing import TYPE_CHECKING, Any

from multidrop.cli.fleet.connection import add_server_arguments, open_path, run_with_paths
from multidrop.cli.fleet.tables import (
    count_sentence,
    failing_lines,
    free_lines,
    gateway_table,
    line_table,
    lost_lines,
    move_table,
    natural,
    trouble_sentences,
    unsure_lines,
)
from multidrop.cli.support.output import print_text

if TYPE_CHECKING:
    from multidrop.fleet.servers.connections import ServerPath


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_server_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    return run_with_paths(arguments, partial(_LOOKS[arguments.command], arguments))


async def _seen(paths: list[ServerPath]) -> dict[str, Any]:
    from multidrop.fleet.overview import FleetView

    view = FleetView(await open_path(paths))
    await view.look()
    return view.fleet()


async def _status(arguments: argparse.Namespace, paths: list[ServerPath]) -> int:
    found = await _seen(paths)
    if arguments.json:
        print_text(json.dumps(found, indent=2))
    else:
        print_text("\n".join(_table(found)))
    return int(any((found.get("missing"), *(lines(found) for lines in _BAD))))


def _table(found: dict[str, Any]) -> list[str]:
    table = [*gateway_table(found), "", count_sentence(found), *trouble_sentences(found)]
    return [*table, "", "last moves:", *move_table(found["moves"])] if found["moves"] else table


async def _lines(arguments: argparse.Namespace, paths: list[ServerPath]) -> int:
    found = await _seen(paths)
    names = sorted(found["lines"], key=natural)
    ordered = {name: found["lines"][name] for name in names}
    print_text(json.dumps(ordered, indent=2) if arguments.json else "\n".join(line_table(found, names)))
    return 0


_BAD = (free_lines, unsure_lines, lost_lines, failing_lines)
_LOOKS = {"status": _status, "lines": _lines}
