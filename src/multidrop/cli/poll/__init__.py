"""`multidrop poll`: a plant's drives again and again, into a recording and before one's eyes."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from multidrop.cli.poll.comparison import compared, comparison_text
from multidrop.cli.poll.live_table import LiveTable
from multidrop.cli.poll.tapping import Tapping, tapping_text
from multidrop.cli.support.arguments import add_json_argument, duration
from multidrop.cli.support.files import check_capture, refuse_overwriting
from multidrop.cli.support.saying import say
from multidrop.cli.support.signals import Interruption
from multidrop.cli.support.values import aligned
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant
from multidrop.poller import Poller
from multidrop.polling.batch import Rows
from multidrop.recording import open_writer

_TAKE_S = 0.1  # between looks for new rows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plant", metavar="PLANT.toml", help="lines, drives, and what is polled")
    add_polling_arguments(parser, out=None, seconds=None)


def add_polling_arguments(parser: argparse.ArgumentParser, *, out: str | None, seconds: float | None) -> None:
    """How long, into which file, and how it is told."""
    parser.add_argument(
        "--seconds",
        metavar="S",
        type=duration,
        default=seconds,
        help=f"how long; {seconds or 'until Ctrl-C'}",
    )
    parser.add_argument(
        "--out", metavar="FILE", type=Path, default=out, help=f"recording, by suffix; {out or 'none'}"
    )
    parser.add_argument(
        "--capture", metavar="FILE.pcapng", type=Path, help="all that goes over the lines, for Wireshark"
    )
    parser.add_argument(
        "--flight-recorder",
        metavar="DIR",
        type=Path,
        help="when something goes wrong, a capture of the last minutes is written there",
    )
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    if arguments.out:
        refuse_overwriting(arguments.out)
    return follow(load_plant(arguments.plant), arguments)


def follow(plant: Plant, arguments: argparse.Namespace) -> int:
    """Poll the plant as `add_polling_arguments` says, and tell what became of it."""
    if arguments.capture:
        check_capture(arguments.capture)
    if arguments.flight_recorder and arguments.flight_recorder.is_file():
        raise ValueError(f"{arguments.flight_recorder} is a file: name a directory for the flight recorder")
    show = not arguments.json and sys.stdout.isatty()
    table = LiveTable(plant, sys.stdout) if show else None
    with ExitStack() as stack:
        interruption = stack.enter_context(Interruption())
        poller = stack.enter_context(closing(Poller(plant)))  # first: without ports there is no recording
        takers: list[Callable[[Rows], None]] = [table.add] if table else []
        if arguments.out:
            takers.append(stack.enter_context(open_writer(arguments.out, plant.metadata())).write)
        tapping = stack.enter_context(Tapping(poller, arguments.capture, arguments.flight_recorder))
        with poller:
            for _ in _ticks(arguments.seconds, interruption):
                _hand_out(poller, takers)
                tapping.collect()
                if table:
                    table.draw_if_due(time.monotonic())
        _hand_out(poller, takers)  # what came while it closed
    if table:
        table.draw()
    return conclude(plant, poller.summary() | tapping.summary(), arguments)


def conclude(plant: Plant, told: Mapping[str, Any], arguments: argparse.Namespace) -> int:
    """Tell what became of the polling; the exit status."""
    summary = {**told, "recording": str(arguments.out) if arguments.out else None}
    for line in plant.lines:
        summary["lines"][line.name]["comparison"] = compared(line, summary["lines"][line.name])
    say(json.dumps(summary, indent=2) if arguments.json else _text(summary))
    return 0 if summary["samples"] else 1


def _ticks(seconds: float | None, interruption: Interruption) -> Iterator[None]:
    end = None if seconds is None else time.monotonic() + seconds
    while not interruption.came and (end is None or time.monotonic() < end):
        time.sleep(_TAKE_S if end is None else max(0.0, min(_TAKE_S, end - time.monotonic())))
        yield


def _hand_out(poller: Poller, takers: list[Callable[[Rows], None]]) -> None:
    while batch := poller.take():
        for take in takers:
            take(batch)


def _text(summary: dict[str, Any]) -> str:
    lines: list[str] = []
    for name, line in summary["lines"].items():
        lines.append(
            f"{name}: {line['exchanges']} exchanges in {line['seconds']:.1f} s, "
            f"utilisation {line['utilisation']:.1%}"
        )
        rows = [("DRIVE", "EXCHANGES/S", "SAMPLES/S", "MISSES")]
        for drive, told in line["drives"].items():
            exchanges, samples = told["exchanges_per_second"], told["samples_per_second"]
            first, *more = [f"{reason} {count}" for reason, count in told["misses"].items()] or ["none"]
            rows.append((drive, f"{exchanges:.1f}", f"{samples:.1f}", first))
            rows += [("", "", "", reason) for reason in more]
        lines += [f"  {row}" for row in aligned(rows, "<>><")]
        lines += comparison_text(line["comparison"])
    into = f" in {summary['recording']}" if summary["recording"] else ""
    dropped = f", {summary['dropped']} dropped" if summary["dropped"] else ""
    lines.append(f"{summary['samples']} samples and {summary['misses']} misses{into}{dropped}")
    lines += tapping_text(summary)
    return "\n".join(lines)
