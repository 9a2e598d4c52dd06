"""`multidrop stop PLANT.toml`: stop all drives of a plant, or of one of its lines."""

from __future__ import annotations

import argparse
import json
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any

from multidrop.bus import Bus
from multidrop.cli import DONE, FAILED, HARD_WIRED
from multidrop.cli.support.output import print_text
from multidrop.cli.support.plants import is_plant, plant_of
from multidrop.control.outcome import Seen, Stopped
from multidrop.plant.model import Plant, PlantLine


def add_plant_stop_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --all and --line, and show in the usage that a plant file alone is enough."""
    parser.usage = f"{parser.usage}\n       {parser.prog} PLANT.toml [--line LINE] [options]"
    parser.add_argument(
        "--all", action="store_true", help="all drives of the plant; so without it, if no drive is named"
    )
    parser.add_argument("--line", metavar="LINE", help="all drives of this line of the plant")


def names_plant(arguments: argparse.Namespace) -> bool:
    """Return True if the words name a whole plant or a line of it, and no single drive."""
    if arguments.command != "stop" or not arguments.words or not is_plant(arguments.words[0]):
        return False
    return len(arguments.words) == 1 or arguments.all or arguments.line is not None


def stop_plant(arguments: argparse.Namespace, audit: str | None) -> int:
    """Stop the lines side by side; print what became of each drive as its line is done.

    Raises ValueError for mistakes in the plant file or in the name of the line; nothing is sent then.
    """
    try:
        lines = _lines(plant_of(arguments.words[0], arguments), arguments)
    except (ValueError, TypeError) as mistake:
        raise ValueError(f"the stop was NOT sent: {mistake}") from mistake
    stops = [_LineStop(line, audit, arguments.seconds) for line in lines]
    finished: SimpleQueue[_LineStop] = SimpleQueue()
    try:
        _start(stops, finished)
        for _ in stops:
            stop = finished.get()
            if not arguments.json:
                print_text("\n".join(stop.so_far()))
    except KeyboardInterrupt as interruption:
        for note in (note for stop in stops for note in stop.so_far()):
            interruption.add_note(note)
        raise
    if arguments.json:
        print_text(json.dumps([record for stop in stops for record in stop.records()], indent=2))
    results = [result for stop in stops for result in stop.results]
    return DONE if all(result.seen is Seen.STOPPED for result in results) else FAILED


def _lines(plant: Plant, arguments: argparse.Namespace) -> Sequence[PlantLine]:
    """Return the lines to stop. A drive named beside --all or --line is a contradiction: ValueError."""
    if arguments.words[1:]:
        option = "--all" if arguments.all else "--line"
        raise ValueError(
            f"{' '.join(arguments.words[1:])} and {option} contradict each other: give one of them"
        )
    if arguments.all and arguments.line is not None:
        raise ValueError("--all and --line contradict each other: give one of them")
    return plant.lines if arguments.line is None else [plant.find_line(arguments.line)]


def _start(stops: Sequence[_LineStop], finished: SimpleQueue[_LineStop]) -> None:
    """Stop each line in a thread of its own: no line waits for the ports and ramps of another.

    If the system has no more threads, the remaining lines are stopped here, one after another.
    """
    without_thread = []
    for stop in stops:
        try:
            threading.Thread(target=stop.run, args=[finished], daemon=True).start()
        except RuntimeError:
            without_thread.append(stop)
    for stop in without_thread:
        stop.run(finished)


@dataclass(eq=False)
class _LineStop:
    """The stop of one line: opens its port and stops all its drives."""

    line: PlantLine
    audit: str | None
    seconds: float | None
    results: list[Stopped] = field(default_factory=list)
    bus: Bus | None = None

    def run(self, finished: SimpleQueue[_LineStop]) -> None:
        try:
            self._run()
        except Exception as failure:
            known = {result.drive for result in self.results}
            why = str(failure) or type(failure).__name__
            failed = [Stopped(name, Seen.FAILED, 0.0, why) for name in self._names if name not in known]
            self.results += failed
        finally:
            finished.put(self)

    def _run(self) -> None:
        line = self.line
        with Bus(
            line.port, echo=line.echo, transaction=line.ids, rs485=line.rs485, audit=self.audit
        ) as self.bus:
            for polled in line.drives:
                self.bus.attach(polled.drive)
            self.results += self.bus.stop_all(self.seconds).values()

    def so_far(self) -> list[str]:
        """Return a sentence for each drive: its result, or what is known of its stop."""
        known = {result.drive: _sentence(result) for result in self.results}
        if not known and self.bus:
            known = self.bus.stops_under_way()
        return [known.get(name, f"{name}: the stop was NOT sent") for name in self._names]

    def records(self) -> list[dict[str, Any]]:
        return [
            {"line": self.line.name, "drive": result.drive, "seen": result.seen.value}
            | {"seconds": round(result.seconds, 3), "why": result.why}
            for result in self.results
        ]

    @property
    def _names(self) -> list[str]:
        return [polled.drive.name for polled in self.line.drives]


def _sentence(result: Stopped) -> str:
    if result.seen is Seen.FAILED:
        return f"{result.drive}: the stop was NOT sent: {result.why}; {HARD_WIRED}"
    return str(result)
