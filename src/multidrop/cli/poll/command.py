"""The `poll` command: polls, shows the newest values, records, and prints a summary."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from multidrop.capture import CaptureWriter, FlightRecorder, Tapped
from multidrop.cli.poll.comparison import compare, comparison_text
from multidrop.cli.poll.live_table import LiveTable
from multidrop.cli.poll.rotation import add_rotation_arguments, rotation_of
from multidrop.cli.support.arguments import add_json_argument, duration
from multidrop.cli.support.files import check_capture, refuse_overwriting
from multidrop.cli.support.output import print_text
from multidrop.cli.support.plants import add_plant_argument, add_port_option, plant_of
from multidrop.cli.support.polling import Rotation, polling_session
from multidrop.cli.support.signals import Interruption
from multidrop.cli.support.values import aligned, counted
from multidrop.plant.model import Plant
from multidrop.poller import Poller
from multidrop.recording import FORMATS

_TAKE_S = 0.1  # between looks for new rows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_plant_argument(parser)
    add_port_option(parser)
    add_polling_arguments(parser, out=None, seconds=None)
    add_rotation_arguments(parser)


def add_polling_arguments(parser: argparse.ArgumentParser, *, out: str | None, seconds: float | None) -> None:
    """Add what `poll` and `demo` take: duration, files and --json."""
    parser.add_argument(
        "--seconds",
        metavar="S",
        type=duration,
        default=seconds,
        help=f"how long it polls; {f'{seconds:g} s' if seconds else 'until Ctrl-C'} if not given",
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        default=out,
        help=f"record into this new file: {', '.join(FORMATS)}; {out or 'nothing is recorded'} if not given",
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
    rotation = rotation_of(arguments)
    if arguments.out and not rotation:
        refuse_overwriting(arguments.out)
    return follow(plant_of(arguments.plant, arguments), arguments, rotation)


def follow(plant: Plant, arguments: argparse.Namespace, rotation: Rotation | None = None) -> int:
    """Poll the plant as the polling arguments say, and print the summary."""
    if arguments.capture:
        check_capture(arguments.capture)
    if arguments.flight_recorder and arguments.flight_recorder.is_file():
        raise ValueError(f"{arguments.flight_recorder} is a file: name a directory for the flight recorder")
    show = not arguments.json and sys.stdout.isatty()
    table = LiveTable(plant, sys.stdout) if show else None
    consumers = [table.add] if table else []
    with (
        polling_session(plant, arguments.out, *consumers, rotation=rotation) as session,
        ExitStack() as stack,
    ):
        taps = _Taps(session.poller, arguments, stack)
        with session.poller:
            for _ in _ticks(arguments.seconds, session.interruption):
                session.hand_out()
                taps.collect()
                if table:
                    table.draw_if_due(time.monotonic())
    if table:
        table.draw()
    return conclude(plant, session.poller.summary() | taps.summary(), arguments)


class _Taps:
    """Taps on the lines, for --capture and --flight-recorder; `stack` closes their files."""

    def __init__(self, poller: Poller, arguments: argparse.Namespace, stack: ExitStack) -> None:
        lines = list(poller.buses)
        self._capture = self._flight = self._tapped = None
        if arguments.capture:
            self._capture = stack.enter_context(CaptureWriter(arguments.capture, lines))
        if arguments.flight_recorder:
            self._flight = stack.enter_context(closing(FlightRecorder(arguments.flight_recorder, lines)))
        sinks = [sink for sink in (self._capture, self._flight) if sink]
        if sinks:
            self._tapped = stack.enter_context(Tapped(poller.buses, *sinks))

    def collect(self) -> None:
        if self._tapped:
            self._tapped.collect()

    def summary(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        if self._capture:
            found["capture"] = str(self._capture.path)
        if self._flight:
            found["flight_recordings"] = [str(path) for path in self._flight.written]
        if self._tapped:
            found["untapped_bytes"] = self._tapped.lost
        return found


def conclude(plant: Plant, polled: Mapping[str, Any], arguments: argparse.Namespace) -> int:
    """Print the poller's summary beside the prediction; return the exit status."""
    summary = {**polled, "recording": str(arguments.out) if arguments.out else None}
    for line in plant.lines:
        summary["lines"][line.name]["comparison"] = compare(line, summary["lines"][line.name])
    into = "segments of " if getattr(arguments, "rotate", None) else ""
    print_text(json.dumps(summary, indent=2) if arguments.json else _text(summary, into))
    return 0 if summary["samples"] else 1


def _ticks(seconds: float | None, interruption: Interruption) -> Iterator[None]:
    end = None if seconds is None else time.monotonic() + seconds
    while not interruption.came and (end is None or time.monotonic() < end):
        time.sleep(_TAKE_S if end is None else max(0.0, min(_TAKE_S, end - time.monotonic())))
        yield


def _text(summary: dict[str, Any], into: str) -> str:
    lines: list[str] = []
    for name, line in summary["lines"].items():
        lines.append(
            f"{name}: {counted(line['exchanges'], 'exchange')} in {line['seconds']:.1f} s, "
            f"utilisation {line['utilisation']:.1%}"
        )
        rows = [("DRIVE", "EXCHANGES/S", "SAMPLES/S", "MISSES")]
        for drive, counts in line["drives"].items():
            exchanges, samples = counts["exchanges_per_second"], counts["samples_per_second"]
            first, *more = [f"{reason} {count}" for reason, count in counts["misses"].items()] or ["none"]
            rows.append((drive, f"{exchanges:.1f}", f"{samples:.1f}", first))
            rows += [("", "", "", reason) for reason in more]
        lines += [f"  {row}" for row in aligned(rows, "<>><")]
        lines += comparison_text(line["comparison"])
    into = f" in {into}{summary['recording']}" if summary["recording"] else ""
    dropped = f", {summary['dropped']} dropped" if summary["dropped"] else ""
    samples, misses = counted(summary["samples"], "sample"), counted(summary["misses"], "miss", "misses")
    lines.append(f"{samples} and {misses}{into}{dropped}")
    lines += tap_text(summary)
    return "\n".join(lines)


def tap_text(summary: Mapping[str, Any]) -> Iterator[str]:
    if "capture" in summary:
        yield f"captured in {summary['capture']}"
    for path in summary.get("flight_recordings", ()):
        yield f"trouble: see {path}"
    if summary.get("untapped_bytes"):
        yield f"{counted(summary['untapped_bytes'], 'byte')} not captured: this machine was too slow"
