"""`multidrop fleet watch`: shows the fleet live on a terminal, or prints a line of JSON each second."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from multidrop.cli.fleet.connection import add_server_arguments, open_path, run_with_paths
from multidrop.cli.fleet.screen import picture
from multidrop.cli.support.output import print_text
from multidrop.cli.support.screen import Screen
from multidrop.cli.support.signals import on_end_signals
from multidrop.supervisor import supervisor

if TYPE_CHECKING:
    from multidrop.fleet.overview import FleetWatch
    from multidrop.fleet.servers.connections import ServerPath

EVERY_S = 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_server_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    return run_with_paths(arguments, partial(watch, is_json=arguments.json))


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
