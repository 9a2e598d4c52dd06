"""`multidrop poll`: polls a plant, shows the newest values, records, and prints a summary."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext, suppress
from dataclasses import replace
from logging import WARNING
from math import ceil
from pathlib import Path
from typing import Any, TextIO

from multidrop.capture import CaptureWriter, FlightRecorder, Tapped
from multidrop.cli.support.arguments import (
    add_json_argument,
    add_plant_argument,
    add_port_option,
    argument,
    duration,
    plant_of,
)
from multidrop.cli.support.files import check_capture, refuse_overwriting
from multidrop.cli.support.output import logging_to, print_text, warn
from multidrop.cli.support.polling import (
    LiveDrive,
    LivePlant,
    Rotation,
    Triggering,
    add_trigger_arguments,
    polling_session,
    trigger_picture,
    triggering_of,
)
from multidrop.cli.support.signals import Interruption
from multidrop.cli.support.terminal import ENTER, ESCAPE, blocks_of, keys_are_readable, terminal_keys
from multidrop.cli.support.values import aligned, columns_of, counted, cut_to, shortened
from multidrop.planning.prediction import Prediction, predict
from multidrop.plant.model import Plant, PlantLine, planned_on
from multidrop.poller import Poller
from multidrop.polling.added_rows import EVENT, LONGEST_TEXT, TRIGGER
from multidrop.polling.batch import Rows
from multidrop.printable import printable
from multidrop.recording import FORMATS
from multidrop.recording.segments import parse_age, parse_size
from multidrop.recording.triggered import TriggeredWriter

_TAKE_S = 0.1  # pause between two deliveries of new rows, in s


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_plant_argument(parser)
    add_port_option(parser)
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="run the polling thread before this computer's normal programs",
    )
    add_polling_arguments(parser, out=None, seconds=None)
    add_rotation_arguments(parser)
    add_trigger_arguments(parser)


def add_polling_arguments(parser: argparse.ArgumentParser, *, out: str | None, seconds: float | None) -> None:
    """Add the arguments that `poll` and `demo` share: duration, files and --json."""
    parser.add_argument(
        "--seconds",
        metavar="S",
        type=duration,
        default=seconds,
        help=f"how long to poll; default: {f'{seconds:g} s' if seconds else 'until Ctrl-C'}",
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        default=out,
        help=f"record into this new file: {', '.join(FORMATS)}; default: {out or 'no recording'}",
    )
    parser.add_argument(
        "--capture", metavar="FILE.pcapng", type=Path, help="capture the lines' traffic, for Wireshark"
    )
    parser.add_argument(
        "--flight-recorder",
        metavar="DIR",
        type=Path,
        help="after an anomaly, write a capture of the last minutes there",
    )
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    rotation = rotation_of(arguments)
    if arguments.out and not rotation and not arguments.trigger:
        refuse_overwriting(arguments.out)
    plant = plant_of(arguments.plant, arguments)
    plant = replace(plant, realtime=arguments.realtime or plant.realtime)
    plant, triggering = triggering_of(plant, arguments)
    if "key" in arguments.trigger and (arguments.json or not keys_are_readable()):
        raise ValueError(
            "--trigger key waits for a key press, so it needs a terminal and no --json. "
            "Otherwise give a condition, such as --trigger fault"
        )
    return conclude(plant, follow(plant, arguments, triggering or rotation), arguments)


def follow(
    plant: Plant,
    arguments: argparse.Namespace,
    how: Rotation | Triggering | None = None,
    beside: Callable[[Poller], AbstractContextManager[object]] = nullcontext,
) -> dict[str, Any]:
    """Poll the plant as the polling arguments require; return the summary.

    `how` says how the recording is split into files. `beside` makes a context for the time of polling, such
    as the demo's operator.
    """
    if arguments.capture:
        check_capture(arguments.capture)
    if arguments.flight_recorder and arguments.flight_recorder.is_file():
        raise ValueError(f"--flight-recorder {arguments.flight_recorder} is a file: name a directory")
    show = not arguments.json and sys.stdout.isatty()
    table = LiveTable(plant, sys.stdout) if show else None
    consumers = [table.add] if table else []
    with polling_session(plant, arguments.out, *consumers, how=how) as session, ExitStack() as stack:
        if table:
            stack.enter_context(table.showing_warnings())
        taps = _Taps(session.poller, arguments, stack)
        keys = (
            stack.enter_context(Keys.of_terminal(session.poller, table, how, arguments.out))
            if table
            else None
        )
        wait = keys.wait if keys else time.sleep
        with session.poller, beside(session.poller):
            for _ in _ticks(arguments.seconds, session.interruption, wait):
                session.hand_out()
                taps.collect()
                if table:
                    if isinstance(session.writer, TriggeredWriter) and isinstance(how, Triggering):
                        table.show_trigger(session.writer.newest, how)
                    table.draw_if_due(time.monotonic())
    if table:
        table.draw()
    summary = session.poller.summary() | taps.summary()
    if session.writer and isinstance(how, Triggering):
        summary["triggers"] = list(map(str, session.writer.files))
    return summary


class _Taps:
    """Writes the traffic of all lines into the files of --capture and --flight-recorder.

    `stack` closes these files.
    """

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
    has_file = arguments.out and "triggers" not in polled
    summary = {**polled, "recording": str(arguments.out) if has_file else None}
    for line in plant.lines:
        summary["lines"][line.name]["comparison"] = compare(line, summary["lines"][line.name])
    into = "segments of " if getattr(arguments, "rotate", None) else ""
    print_text(json.dumps(summary, indent=2) if arguments.json else _text(summary, into))
    return 0 if summary["samples"] else 1


def _ticks(
    seconds: float | None, interruption: Interruption, wait: Callable[[float], None]
) -> Iterator[None]:
    end = None if seconds is None else time.monotonic() + seconds
    while not interruption.came and (end is None or time.monotonic() < end):
        wait(_TAKE_S if end is None else max(0.0, min(_TAKE_S, end - time.monotonic())))
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
    if "triggers" in summary:
        yield f"{counted(len(summary['triggers']), 'trigger')} recorded"
        yield from (f"trigger: see {path}" for path in summary["triggers"])
    if summary.get("untapped_bytes"):
        yield f"{counted(summary['untapped_bytes'], 'byte')} not captured: this machine was too slow"


# ---- the live table ----
#
# The monitor takes over the terminal, and can stop motors. The table of `poll` stays on the terminal above
# the summary, and its keys only add events.


EVERY = 0.5  # pause between two drawings, in s
LEAST_HEIGHT = 4  # a terminal shows a note only if it has more lines than this
_UP_AND_CLEAR = "\x1b[{}F\x1b[J"


class LiveTable:
    """A table with one line per drive: numbers of samples and missed values so far, and newest values.

    Each drawing replaces the previous one.
    """

    def __init__(self, plant: Plant, terminal: TextIO, heading: Callable[[], str] = str) -> None:
        self._plant = LivePlant(plant)
        self._heading = heading  # returns a line above the table; "" for none
        self._terminal = terminal
        self._channels = {(one.drive.name, channel.name) for one in plant.drives for channel in one.channels}
        self._samples: Counter[str] = Counter()
        self._misses: Counter[str] = Counter()
        self.note = ""  # a sentence that is shown below the table
        self._trigger: Path | None = None  # recorded file that is shown in `_picture`
        self._picture: list[str] = []
        self._drawn: list[str] = []  # lines of text that are on the terminal now
        self._next_draw = 0.0
        self._warnings: deque[str] = deque()  # warnings that are not shown yet; any thread may add one

    @contextmanager
    def showing_warnings(self) -> Iterator[None]:
        """While the context lasts, show warnings of the log above the table.

        If another thread printed them, the next drawing would overwrite them.
        """
        try:
            with logging_to(self._warnings.append, "multidrop", WARNING):
                yield
        finally:
            self._show_warnings()

    def _show_warnings(self) -> None:
        while self._warnings:
            warn(self._warnings.popleft())

    def add(self, rows: Rows) -> None:
        added = list(rows)
        self._plant.add(added)
        for row in added:
            if row.drive != EVENT and (row.drive, row.register) not in self._channels:
                (self._misses if row.value is None else self._samples)[row.drive] += 1

    def show_trigger(self, newest: Path | None, how: Triggering) -> None:
        """Show a picture of this trigger's recording below the table, until the next recording is ready."""
        if newest is None or newest == self._trigger:
            return
        width = shutil.get_terminal_size().columns - 1
        self._trigger = newest
        self._picture = trigger_picture(newest, how, width, blocks_of(self._terminal))

    def keep_drawing(self, now: float) -> None:
        """Keep the last drawing on the screen; draw the next one below it, EVERY s after `now` or later.

        A sentence that another part of the program prints between the two drawings stays visible too.
        """
        self._drawn = []
        self._next_draw = now + EVERY

    def draw_if_due(self, now: float) -> None:
        if now >= self._next_draw:
            self._next_draw = now + EVERY
            self.draw()

    def draw(self) -> None:
        columns, height = shutil.get_terminal_size()
        # `?` replaces characters that the terminal cannot show, because escapes would be wider
        encoding = self._terminal.encoding or "utf-8"
        shown = (printable(line).encode(encoding, "replace").decode(encoding) for line in self._lines())
        lines = [cut_to(line, columns - 1) for line in shown]
        note = [self.note] if self.note and height > LEAST_HEIGHT else []
        if height > LEAST_HEIGHT + len(self._picture):
            note = [*self._picture, *note]
        note = [cut_to(printable(line), columns - 1) for line in note]
        height -= len(note)
        if len(lines) > height - 1:
            lines = [*lines[: height - 2], f"... and {counted(len(lines) - height + 2, 'more drive')}"]
        lines += note
        # If the terminal has become narrower since the previous drawing, it has wrapped the lines of that
        # drawing.
        rows = sum(max(1, ceil(columns_of(line) / columns)) for line in self._drawn)
        back = _UP_AND_CLEAR.format(min(rows, height - 1 + len(note))) if self._drawn else ""
        with suppress(OSError):  # recording continues after the terminal is closed
            if self._warnings:
                print(back, end="", file=self._terminal, flush=True)
                self._show_warnings()
                back = ""
            print(back + "\n".join(lines), file=self._terminal, flush=True)
        self._drawn = lines

    def _lines(self) -> Iterator[str]:
        if heading := self._heading():
            yield heading
        rows = [("DRIVE", "SAMPLES", "MISSES", "NEWEST VALUES")]
        for drive in self._plant.drives:
            counts = str(self._samples[drive.name]), str(self._misses[drive.name])
            rows.append((drive.name, *counts, ", ".join(_values(drive))))
        yield from aligned(rows, "<>><")


class Keys:
    """Handles the keys of `multidrop poll`.

    The key `m` starts a comment, which gets the time of the key press. A comment is a row of the recording.
    Without a recording, the key only shows NO_RECORDING. If rows around triggers are recorded, the key `t` is
    a trigger.
    """

    def __init__(
        self,
        poller: Poller,
        table: LiveTable,
        wait_for_key: Callable[[float], str],
        *,
        has_trigger: bool,
        is_recorded: bool,
    ) -> None:
        self._has_trigger = has_trigger
        self._is_recorded = is_recorded
        self._poller = poller
        self._table = table
        self._wait_for_key = wait_for_key
        self._text: str | None = None  # the comment's text so far; None if the user is not typing one
        self._begun = 0.0
        self._show()

    @classmethod
    @contextmanager
    def of_terminal(
        cls, poller: Poller, table: LiveTable, how: Rotation | Triggering | None, out: Path | None
    ) -> Iterator[Keys | None]:
        """Yield a handler of key presses in this terminal.

        Yield None if key presses cannot be read, for example because the process runs in the background.
        """
        if not (keys_are_readable() and _is_in_foreground()):
            yield None
            return
        with terminal_keys() as wait_for_key:
            has_trigger = isinstance(how, Triggering)
            yield cls(poller, table, wait_for_key, has_trigger=has_trigger, is_recorded=out is not None)
        table.note = ""

    def wait(self, seconds: float) -> None:
        """Wait for `seconds` s, and carry out the keys that are pressed in this time."""
        end = time.monotonic() + seconds
        with suppress(OSError):  # the terminal is closed; the recording continues
            while (left := end - time.monotonic()) > 0 and _is_in_foreground():
                if key := self._wait_for_key(left):
                    self.press(key)
        time.sleep(max(0.0, end - time.monotonic()))

    def press(self, key: str) -> None:
        if self._text is None:
            if key == "m" and not self._is_recorded:
                self._table.note = NO_RECORDING
                return
            if key == "m":
                self._text, self._begun = "", time.monotonic()
            elif key == "t" and self._has_trigger:
                self._poller.mark("key t", kind=TRIGGER)
        elif key == ENTER:
            with suppress(ValueError):  # raised for an empty comment, which is not recorded
                self._poller.mark(self._text, ago=time.monotonic() - self._begun)
            self._text = None
        elif key == ESCAPE:
            self._text = None
        elif key in BACKSPACES:
            self._text = self._text[:-1]
        elif len(key) == 1 and key.isprintable() and len(self._text) < LONGEST_TEXT:
            self._text += key
        self._show()

    def _show(self) -> None:
        comment = "m: add a comment; " if self._is_recorded else ""
        trigger = "t: trigger; " if self._has_trigger else ""
        keys = f"{comment}{trigger}Ctrl-C: end"
        self._table.note = keys if self._text is None else f"comment: {self._text}_"


BACKSPACES = ("\x7f", "\b")
NO_RECORDING = "no comment: nothing is recorded; start poll with --out FILE; Ctrl-C: end"


def _is_in_foreground() -> bool:
    """Return True if this process may read its terminal; in the background, reading would suspend it."""
    if sys.platform == "win32":
        return False
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except OSError:  # the terminal is not the controlling terminal of this process
        return True


def _values(drive: LiveDrive) -> Iterator[str]:
    for poll in drive.polled.series:
        name = poll.register.name
        if name in drive.missed:
            yield f"{name}: {drive.missed[name].status}"
        elif name in drive.newest:
            yield f"{name} {drive.shown(name)}"


# ---- the comparison with the prediction ----


Figures = dict[str, Any]


def compare(line: PlantLine, summary: dict[str, Any]) -> dict[str, Figures]:
    """Return a line's rates: measured, predicted with the manuals' delays, predicted with measured delays."""
    drives = summary["drives"]
    delays = {
        polled.drive: drives[polled.drive.name]["response_delay_ms"] / 1e3
        for polled in line.drives
        if drives[polled.drive.name]["exchanges_per_second"]  # no delay was measured for a silent drive
    }
    polls = [poll for polled in line.drives for poll in polled.polls]
    # if some registers have a period, the line has no bus cycle to measure
    is_timed = any(poll.every is not None for poll in polls)
    cycles = (summary["samples"] + sum(summary["misses"].values())) / len(polls)
    by_delays = predict(planned_on(line, delays), delays, summary["switching_ms"] / 1e3)
    return {
        "predicted": _figures(predict(planned_on(line), switching=line.switching)),
        "predicted_with_measured_delays": _figures(by_delays),
        "measured": {
            "cycle_ms": None if is_timed or not cycles else round(summary["seconds"] / cycles * 1e3, 3),
            "utilisation": summary["utilisation"],
            "switching_ms": summary["switching_ms"],
            "exchanges_per_second": {name: drive["exchanges_per_second"] for name, drive in drives.items()},
        },
    }


def _figures(prediction: Prediction) -> Figures:
    drives = dict.fromkeys(rate.drive for rate in prediction.rates)
    return {
        "cycle_ms": round(prediction.cycle * 1e3, 3),
        "switches": prediction.switches,
        "utilisation": round(prediction.utilisation, 4),
        "exchanges_per_second": {
            drive.name: round(prediction.exchanges_per_second(drive), 2) for drive in drives
        },
    }


def comparison_text(found: dict[str, Figures]) -> Iterator[str]:
    columns = list(found.values())
    cycles = ("-" if column["cycle_ms"] is None else f"{column['cycle_ms']:.1f} ms" for column in columns)
    rows = [
        ("", "PREDICTED", "WITH DELAYS", "MEASURED"),
        ("bus cycle", *cycles),
        ("utilisation", *(f"{column['utilisation']:.1%}" for column in columns)),
    ]
    for name in found["measured"]["exchanges_per_second"]:
        rates = (f"{column['exchanges_per_second'][name]:.1f}" for column in columns)
        rows.append((f"{shortened(name)}, exchanges/s", *rates))
    yield from (f"  {row}" for row in aligned(rows, "<>>>"))
    yield "  WITH DELAYS: predicted with the measured response delays"
    if found["predicted"]["switches"]:
        took = found["measured"]["switching_ms"]
        yield f"  and the measured {took:.2f} ms to change the port's settings"


def add_rotation_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rotate",
        metavar="TIME",
        type=argument(parse_age),
        help='start a new file at this interval, such as "1 h": run.00000001.arrows and so on',
    )
    parser.add_argument(
        "--keep",
        metavar="TIME",
        type=argument(parse_age),
        help='with --rotate: remove files older than this, such as "30 days"',
    )
    parser.add_argument(
        "--most",
        metavar="SIZE",
        type=argument(parse_size),
        help='with --rotate: remove the oldest files beyond this total size, such as "20 GB"',
    )


def rotation_of(arguments: argparse.Namespace) -> Rotation | None:
    """Return how the recording is split into files. Raises ValueError for contradicting options."""
    if arguments.rotate is None:
        if arguments.keep is not None or arguments.most is not None:
            raise ValueError(
                '--keep and --most need --rotate, because they delete whole files: add --rotate "1 h"'
            )
        return None
    if not arguments.out or arguments.out.suffix != ".arrows":
        raise ValueError(
            "--rotate needs --out with a file name that ends in .arrows, such as --out run.arrows"
        )
    return Rotation(arguments.rotate, arguments.keep, arguments.most)
