"""`multidrop monitor`: shows a polled plant live. Its keys stop motors; no key starts one."""

from __future__ import annotations

import argparse
import re
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from datetime import UTC, datetime
from functools import partial
from logging import WARNING
from pathlib import Path
from typing import Any

from multidrop.cli.monitor_screen import LEAST_HEIGHT, LEAST_WIDTH, Position, SideRead, overview, page
from multidrop.cli.support.arguments import add_plant_argument, add_port_option, plant_of
from multidrop.cli.support.files import refuse_overwriting
from multidrop.cli.support.output import logging_to, warn
from multidrop.cli.support.polling import (
    POINT_S,
    LiveDrive,
    LivePlant,
    Moment,
    PollingSession,
    Triggering,
    add_trigger_arguments,
    polling_session,
    trigger_picture,
    triggering_of,
)
from multidrop.cli.support.terminal import (
    DOWN,
    ENTER,
    ESCAPE,
    LATIN,
    PAGE_DOWN,
    PAGE_UP,
    UP,
    Screen,
    TextLine,
    keys_are_readable,
    terminal_keys,
)
from multidrop.cli.support.values import counted, value_text
from multidrop.errors import BusError
from multidrop.plant.model import Plant
from multidrop.poller import Poller
from multidrop.polling.added_rows import TRIGGER
from multidrop.recording.triggered import TriggeredWriter
from multidrop.transport import clock

DRAW_S = 0.25
SCROLL_S = 2.0  # seconds between two pictures on a terminal without cursor control
PAGE = 10  # number of lines that a page key scrolls
_STOP_KEYS = ("s", "S")
STILL_STOPPING = "waiting for a stop in progress; press Ctrl-C repeatedly to leave, and watch the motors"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_plant_argument(parser)
    add_port_option(parser)
    parser.add_argument("--out", metavar="FILE", type=Path, help="record too, into this new file")
    add_trigger_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    if not keys_are_readable():
        raise ValueError(
            "`multidrop monitor` needs a terminal on Linux or macOS; `multidrop poll` needs none"
        )
    if arguments.out and not arguments.trigger:
        refuse_overwriting(arguments.out)
    plant, triggering = triggering_of(plant_of(arguments.plant, arguments), arguments)
    summary = watch(plant, out=arguments.out, how=triggering)
    return 0 if summary["samples"] else 1


def watch(
    plant: Plant,
    *,
    out: Path | None = None,
    how: Triggering | None = None,
    seconds: float | None = None,
    beside: Callable[[Poller], AbstractContextManager[object]] = nullcontext,
) -> dict[str, Any]:
    """Poll the plant and show it until the user quits or `seconds` have passed; return the poller's summary.

    If `how` is given, only the rows around triggers are recorded, and they are shown as curves. Otherwise all
    rows are recorded. `beside` makes a context for the time of polling, such as the demo's operator. The
    monitor also ends when the terminal is closed. It always waits for stops in progress.
    """
    screen = Screen()
    _check_size(screen)
    live = LivePlant(plant, plant.metadata()["planned"])
    with polling_session(plant, out, live.add, how=how) as session:
        monitor = Monitor(live, session, screen, how)
        with session.poller, beside(session.poller):
            try:
                monitor.show(seconds)
            finally:
                # wait before the ports are closed, because a stop may not have been sent yet
                failures = monitor.await_stops()
        for sentence in failures:
            warn(sentence)
    return session.poller.summary()


class Monitor:
    """Draws the newest values of a polled plant on the screen, and carries out the user's keys."""

    def __init__(
        self, plant: LivePlant, session: PollingSession, screen: Screen, how: Triggering | None = None
    ) -> None:
        self._screen = screen
        self._session = session
        self._plant = plant
        self._at = Position()
        self._on_yes: Callable[[], None] | None = None  # called if the user answers the question with y
        self._stops: list[threading.Thread] = []  # threads that carry out stops
        # numbers of stopped drives and of all drives, by line name
        self._stop_results: dict[str, tuple[int, int]] = {}
        self._has_left = False
        self._side_reader = SideReader(session.poller)
        self._how = how
        self._trigger: Path | None = None  # recorded file whose curves are shown

    def show(self, seconds: float | None) -> None:
        """Draw and react to keys until the user quits, a signal comes, or `seconds` have passed."""
        begun = next_draw = next_tick = next_point = time.monotonic()
        # Show warnings on the screen, because on stderr they would overwrite it.
        every = SCROLL_S if self._screen.scrolls else DRAW_S
        with (
            self._screen,
            terminal_keys() as wait_for_key,
            logging_to(self._show_message, "multidrop", WARNING),
        ):
            while not (self._session.interruption.came or self._has_left):
                now = time.monotonic()
                if seconds is not None and now - begun >= seconds:
                    return
                if now >= next_tick:
                    next_tick += 1.0
                    self._session.hand_out()
                    self._plant.tick(now, self._session.poller.statistics())
                if now >= next_point:
                    next_point = max(next_point + POINT_S, now)
                    self._session.hand_out()
                    self._plant.remember()
                if now >= next_draw:
                    next_draw = max(next_draw + every, now)
                    self._session.hand_out()
                    self._show_trigger()
                    self._screen.draw(self._picture())
                key = wait_for_key(max(0.0, min(next_draw, next_tick, next_point) - time.monotonic()))
                if key:
                    self._obey(key)
                    next_draw = 0.0

    def _show_trigger(self) -> None:
        """Once a trigger's recording is complete, draw it in a thread, so that no stop waits for it."""
        writer, how = self._session.writer, self._how
        if how is None or not isinstance(writer, TriggeredWriter) or writer.newest in (None, self._trigger):
            return
        newest = self._trigger = writer.newest
        width, _ = self._screen.size

        def draw() -> None:
            lines = trigger_picture(newest, how, width - 2, self._screen.blocks)
            # if a later trigger's recording is complete by now, that one is drawn instead
            if newest == self._trigger:
                self._at.trigger = lines

        with suppress(RuntimeError):  # no thread can start: the curves of the earlier trigger stay
            threading.Thread(target=draw, daemon=True).start()

    def _show_message(self, text: str) -> None:
        self._at.message = text

    def await_stops(self) -> list[str]:
        """Wait for the stops in progress, and record rows meanwhile.

        Return the failures of stops that the user has not acknowledged.
        """
        if self._is_stopping:
            warn(STILL_STOPPING)
        while self._is_stopping:
            self._session.hand_out()
            self._stops[-1].join(DRAW_S)
        return self._at.failures

    @property
    def _is_stopping(self) -> bool:
        return any(thread.is_alive() for thread in self._stops)

    def _picture(self) -> Sequence[TextLine]:
        size, now = self._screen.size, Moment(time.time_ns(), clock.now_ns())
        if self._at.page:
            others = self._side_reader.read(self._chosen)
            return page(self._chosen, others, self._at, size, now)
        return overview(self._plant, self._at, size, now, self._screen.blocks)

    @property
    def _chosen(self) -> LiveDrive:
        return self._plant.drives[self._at.chosen]

    # ---- keys ----

    def _obey(self, key: str) -> None:
        key = key.translate(LATIN)
        # a key that stops motors never counts as the answer to a question
        if self._on_yes and key not in _STOP_KEYS:
            on_yes, self._on_yes, self._at.question = self._on_yes, None, ""
            if key in ("y", "Y"):  # the user may have caps lock on
                on_yes()
            else:
                self._at.message = "nothing was sent"
            return
        self._at.message = ""
        actions: dict[str, Callable[[], None]] = {
            UP: lambda: self._move(-1),
            DOWN: lambda: self._move(1),
            PAGE_UP: lambda: self._scroll(-PAGE),
            PAGE_DOWN: lambda: self._scroll(PAGE),
            "k": lambda: self._move(-1),
            "j": lambda: self._move(1),
            " ": lambda: self._scroll(PAGE),
            ENTER: self._turn_page,
            ESCAPE: self._leave_page,
            "s": self._ask_to_stop,
            "S": self._ask_to_stop_all,
            "a": self._acknowledge,
            "t": self._mark_trigger,
            "q": self._leave,
        }
        if key in actions:
            actions[key]()

    def _move(self, by: int) -> None:
        self._at.chosen = max(0, min(self._at.chosen + by, len(self._plant.drives) - 1))
        self._at.scrolled = 0

    def _scroll(self, by: int) -> None:
        if self._at.page:
            self._at.scrolled = max(0, self._at.scrolled + by)
        else:
            self._move(by)

    def _turn_page(self) -> None:
        self._at.page = not self._at.page
        self._at.scrolled = 0
        if not self._at.page:
            self._side_reader.rest()

    def _leave_page(self) -> None:
        if self._at.page:
            self._turn_page()

    def _mark_trigger(self) -> None:
        if self._how is not None:
            self._session.poller.mark("key t", kind=TRIGGER)
            self._at.message = "trigger by key t"

    def _acknowledge(self) -> None:
        """Remove the failures that are on the screen now, to make room for those that did not fit."""
        del self._at.failures[: self._at.failures_shown]

    def _leave(self) -> None:
        if not self._is_stopping:
            self._has_left = True
            return
        self._at.question = "A stop is in progress. Quit when it is done? y quits, any other key does not"
        self._on_yes = self._leave_now

    def _leave_now(self) -> None:
        self._has_left = True

    def _ask_to_stop(self) -> None:
        chosen = self._chosen
        self._at.question = f"Stop {chosen.name}? y stops it, any other key does not"
        self._on_yes = lambda: self._in_background(f"stopping {chosen.name}", lambda: self._stop(chosen))

    def _ask_to_stop_all(self) -> None:
        drives = counted(len(self._plant.drives), "drive")
        self._at.question = f"Stop ALL {drives}? y stops them, any other key does not"
        self._on_yes = self._stop_lines

    def _stop_lines(self) -> None:
        """Stop all lines in parallel, so that no line waits for the deceleration of another.

        If some threads cannot be started, first send a stop to each line without a thread, and only then wait
        for these stops.
        """
        self._stop_results = {}
        stops = {
            line.name: (f"stopping all drives on {line.name}", partial(self._stop_all, line.name))
            for line in self._plant.plant.lines
        }
        left = [line for line, stop in stops.items() if not self._begin(*stop)]
        for line in left if len(left) > 1 else ():
            with suppress(Exception):  # the failure is reported when the stop is repeated below
                self._session.poller.bus(line).stop_all(seconds=0.0)
        for line in left:
            self._carry_out(*stops[line])

    def _in_background(self, what: str, work: Callable[[], tuple[str, list[str]]]) -> None:
        if not self._begin(what, work):
            self._carry_out(what, work)

    def _begin(self, what: str, work: Callable[[], tuple[str, list[str]]]) -> bool:
        """Start a thread that sends a stop and waits for the motor; return False if no thread can start."""
        self._at.message = what
        thread = threading.Thread(target=self._carry_out, args=(what, work), daemon=True)
        try:
            thread.start()
        except RuntimeError:
            return False
        self._stops = [*filter(threading.Thread.is_alive, self._stops), thread]
        return True

    def _carry_out(self, what: str, work: Callable[[], tuple[str, list[str]]]) -> None:
        """Carry out a stop. Its failures stay on the screen until the user acknowledges them."""
        try:
            self._at.message, failures = work()
        except Exception as failure:  # the user must see every failure of a stop
            self._at.message = f"{what} failed"
            failures = [f"{what} failed: {str(failure) or type(failure).__name__}"]
        clock = datetime.now(UTC)
        self._at.failures += [f"{clock:%H:%M:%S} {failure}" for failure in failures]

    def _stop(self, chosen: LiveDrive) -> tuple[str, list[str]]:
        chosen.polled.drive.stop()
        return f"{chosen.name} has stopped", []

    def _stop_all(self, line: str) -> tuple[str, list[str]]:
        stopped = self._session.poller.bus(line).stop_all().values()
        doubtful = [str(stop) for stop in stopped if not stop.ok]
        self._stop_results[line] = len(stopped) - len(doubtful), len(stopped)
        have, asked = map(sum, zip(*[*self._stop_results.values()], strict=True))
        lines, done = len(self._plant.plant.lines), len(self._stop_results)
        so_far = f", on {done} of {lines} lines so far" if done < lines else ""
        return f"{have} of {asked} drives stopped{so_far}", doubtful


def _check_size(screen: Screen) -> None:
    width, height = screen.size
    if width < LEAST_WIDTH or height < LEAST_HEIGHT:
        raise ValueError(
            f"the terminal has {width} x {height} characters; "
            f"the monitor needs at least {LEAST_WIDTH} x {LEAST_HEIGHT}"
        )


# ---- side reads ----

LEAST_PAUSE_S = 0.1  # least pause between two reads
# share of the line's time for reads of unpolled registers: on a line with spare time, and on a full line
MOST_SHARE, LEAST_SHARE = 0.05, 0.01


class SideReader:
    """Reads a drive's registers that are not polled, one after another, in its own thread.

    The reads take at most MOST_SHARE of the line's time, or LEAST_SHARE if the line has no spare time.
    """

    def __init__(self, poller: Poller) -> None:
        self._poller = poller
        self._drive: LiveDrive | None = None
        self._found: dict[str, SideRead] = {}
        self._thread: threading.Thread | None = None

    def read(self, drive: LiveDrive) -> dict[str, SideRead]:
        """Return the values that were read so far, by register, and continue to read this drive."""
        if self._drive is not drive:
            self._drive, self._found = drive, {}
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._read_all, args=(drive, self._found), daemon=True)
            self._thread.start()
        return self._found

    def rest(self) -> None:
        """Read no more registers until the next call of `read`."""
        self._drive = None

    def _read_all(self, chosen: LiveDrive, found: dict[str, SideRead]) -> None:
        drive = chosen.polled.drive
        polled = {poll.register.name for poll in chosen.polled.polls}
        for name, register in drive.registers.items():
            if not register.readable or name in polled:
                continue
            if self._drive is not chosen:
                return
            asked = time.monotonic()
            try:
                text = value_text(register, drive.read(register))
            except BusError as failure:
                text = _in_words(failure)
            found[name] = SideRead(text, clock.now_ns())
            time.sleep(pause_s(time.monotonic() - asked, chosen.line_utilisation))


def pause_s(read_s: float, utilisation: float) -> float:
    """Return the pause in s after a read that took `read_s` on a line with this planned utilisation."""
    share = min(MOST_SHARE, max(LEAST_SHARE, 1.0 - utilisation))
    return max(LEAST_PAUSE_S, read_s * (1.0 / share - 1.0))


def _in_words(failure: BusError) -> str:
    """Describe a failure in a few words, such as "no reply"."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(failure).__name__).lower()
