"""`multidrop monitor`: a plant's drives live on a terminal; its keys stop motors, and none starts one."""

from __future__ import annotations

import argparse
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from datetime import UTC, datetime
from functools import partial
from os import get_terminal_size
from pathlib import Path
from typing import Any

from multidrop.cli.monitor.keys import DOWN, ENTER, ESCAPE, PAGE_DOWN, PAGE_UP, UP, keys
from multidrop.cli.monitor.side_reads import SideReader
from multidrop.cli.monitor.watched import Watched, WatchedPlant
from multidrop.cli.support.extra import need
from multidrop.cli.support.files import refuse_overwriting
from multidrop.cli.support.saying import say
from multidrop.cli.support.signals import Interruption
from multidrop.control.outcome import Seen
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant
from multidrop.poller import Poller
from multidrop.polling.batch import Rows
from multidrop.recording import open_writer

DRAW_S = 0.25
SCROLL_S = 2.0  # between two pictures that scroll
PAGE = 10  # lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plant", metavar="PLANT.toml", help="lines, drives, and what is polled")
    parser.add_argument("--out", metavar="FILE", type=Path, help="record what is polled as well")


def run(arguments: argparse.Namespace) -> int:
    need("rich", "monitor", "monitor")
    if not is_possible():
        raise ValueError("`multidrop monitor` needs a terminal; `multidrop poll` works without one")
    if arguments.out:
        refuse_overwriting(arguments.out)
    summary = watch(load_plant(arguments.plant), out=arguments.out)
    return 0 if summary["samples"] else 1


def is_possible() -> bool:
    """Whether there is a terminal to draw on and to take keys from."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def watch(plant: Plant, *, out: Path | None = None, seconds: float | None = None) -> dict[str, Any]:
    """Poll the plant and show it until the user has seen enough; the poller's summary."""
    console = _console()
    with ExitStack() as stack:
        interruption = stack.enter_context(Interruption())
        poller = stack.enter_context(closing(Poller(plant)))  # first: without ports there is no recording
        takers: list[Callable[[Rows], None]] = []
        if out:
            takers.append(stack.enter_context(open_writer(out, plant.metadata())).write)
        with poller:
            monitor = _Monitor(plant, poller, takers, console)
            monitor.show(interruption, seconds)
            for sentence in monitor.left_open():
                say(f"multidrop: {sentence}", file=sys.stderr)
        while batch := poller.take():  # what came while it closed
            for take in takers:
                take(batch)
    return poller.summary()


def _console() -> Any:
    """The terminal; ValueError where there is too little of it."""
    from rich.console import Console

    from multidrop.cli.monitor.screen import LEAST_HEIGHT, LEAST_WIDTH

    console = Console()
    if console.is_dumb_terminal:
        width, height = get_terminal_size()
        console = Console(width=width, height=height - 1)  # it scrolls: the line after the last one is empty
    if console.width < LEAST_WIDTH or console.height < LEAST_HEIGHT:
        raise ValueError(
            f"the terminal is too small: it has {console.width} x {console.height} characters, "
            f"and the monitor needs {LEAST_WIDTH} x {LEAST_HEIGHT}"
        )
    return console


class _Shown(logging.Handler):
    """Hands warnings to `show`."""

    def __init__(self, show: Callable[[str], None]) -> None:
        super().__init__(logging.WARNING)
        self._show = show

    def emit(self, record: logging.LogRecord) -> None:
        self._show(record.getMessage())


@contextmanager
def _warnings_to(show: Callable[[str], None]) -> Iterator[None]:
    """Keep the library's warnings off standard error, where they would spoil the screen."""
    log, shown = logging.getLogger("multidrop"), _Shown(show)
    log.addHandler(shown)
    try:
        yield
    finally:
        log.removeHandler(shown)


class _Monitor:
    def __init__(
        self, plant: Plant, poller: Poller, takers: list[Callable[[Rows], None]], console: Any
    ) -> None:
        from multidrop.cli.monitor.screen import BLOCKS, PLAIN_BLOCKS, Position

        self._console = console
        self._poller = poller
        self._plant = WatchedPlant(plant)
        self._takers = [self._plant.add, *takers]
        self._at = Position()
        self._answer: Callable[[], None] | None = None  # what a y does
        self._stops: list[threading.Thread] = []  # under way, or done
        self._stood: dict[str, str] = {}  # what the last stop of all came to, by line
        self._has_left = False
        self._side = SideReader(poller)
        self._blocks = BLOCKS if "utf" in console.encoding else PLAIN_BLOCKS

    def show(self, interruption: Interruption, seconds: float | None) -> None:
        begun = next_draw = next_tick = time.monotonic()
        with self._drawing() as (draw, every), keys() as wait_for_key, _warnings_to(self._show_warning):
            while not interruption.came and not self._has_left:
                now = time.monotonic()
                if seconds is not None and now - begun >= seconds:
                    return
                if now >= next_tick:
                    next_tick += 1.0
                    self._take()
                    self._plant.tick(now, self._poller.statistics())
                if now >= next_draw:
                    next_draw = max(next_draw + every, now)
                    self._take()
                    draw(self._drawn())
                key = wait_for_key(max(0.0, min(next_draw, next_tick) - time.monotonic()))
                if key:
                    self._obey(key)
                    next_draw = 0.0

    def _show_warning(self, text: str) -> None:
        self._at.message = text

    def left_open(self) -> Iterator[str]:
        """What nobody has acknowledged, and whether a stop was under way."""
        yield from self._at.failures
        if self._is_stopping:
            yield "a stop was under way and is not waited for: look at the motors"

    @property
    def _is_stopping(self) -> bool:
        return any(thread.is_alive() for thread in self._stops)

    @contextmanager
    def _drawing(self) -> Iterator[tuple[Callable[[Any], None], float]]:
        """How a picture is drawn, and how often: on a terminal that cannot go back, below the last one."""
        if self._console.is_dumb_terminal:
            yield self._console.print, SCROLL_S
            return
        from rich.control import Control

        with self._console.screen(hide_cursor=True) as screen:

            def draw(picture: Any) -> None:
                self._console.control(Control.home())  # else it would be drawn below the last one
                screen.update(picture)

            yield draw, DRAW_S

    def _take(self) -> None:
        while batch := self._poller.take():
            for take in self._takers:
                take(batch)

    def _drawn(self) -> Any:
        from rich.text import Text

        from multidrop.cli.monitor.screen import overview, page

        size = self._console.width, self._console.height
        now_ns = time.time_ns()
        if self._at.page:
            others = self._side.read(self._chosen)
            lines = page(self._chosen, others, self._at, size, now_ns)
        else:
            lines = overview(self._plant, self._at, size, now_ns, self._blocks)
        return Text("\n", no_wrap=True, end="").join(lines)

    @property
    def _chosen(self) -> Watched:
        return self._plant.drives[self._at.chosen]

    # ---- keys ----

    def _obey(self, key: str) -> None:
        if self._answer:
            answer, self._answer, self._at.question = self._answer, None, ""
            if key == "y":
                answer()
            else:
                self._at.message = "nothing was sent"
            return
        self._at.message = ""
        actions: dict[str, Callable[[], None]] = {
            UP: lambda: self._move(-1),
            DOWN: lambda: self._move(1),
            PAGE_UP: lambda: self._scroll(-PAGE),
            PAGE_DOWN: lambda: self._scroll(PAGE),
            ENTER: self._turn_page,
            ESCAPE: self._leave_page,
            "s": self._ask_to_stop,
            "S": self._ask_to_stop_all,
            "a": self._acknowledge,
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
            self._side.rest()

    def _leave_page(self) -> None:
        if self._at.page:
            self._turn_page()

    def _acknowledge(self) -> None:
        """What was shown is seen; what had no room yet is shown next."""
        del self._at.failures[: self._at.failures_shown]

    def _leave(self) -> None:
        if not self._is_stopping:
            self._has_left = True
            return
        self._at.question = "A stop is under way. Leave all the same? y leaves, any other key does not"
        self._answer = self._leave_all_the_same

    def _leave_all_the_same(self) -> None:
        self._has_left = True

    def _ask_to_stop(self) -> None:
        chosen = self._chosen
        self._at.question = f"Stop {chosen.name}? y stops it, any other key does not"
        self._answer = lambda: self._in_background(f"stopping {chosen.name}", lambda: self._stop(chosen))

    def _ask_to_stop_all(self) -> None:
        count = len(self._plant.drives)
        self._at.question = f"Stop ALL {count} drives? y stops them, any other key does not"
        self._answer = self._stop_lines

    def _stop_lines(self) -> None:
        """All lines at the same time: none waits for another's ramps."""
        self._stood = {}
        for line in self._plant.plant.lines:
            self._in_background(f"stopping all drives on {line.name}", partial(self._stop_all, line.name))

    def _in_background(self, what: str, work: Callable[[], tuple[str, list[str]]]) -> None:
        """A stop waits until the motor stands: meanwhile the screen goes on."""
        self._at.message = what
        thread = threading.Thread(target=self._carry_out, args=(what, work), daemon=True)
        self._stops = [*filter(threading.Thread.is_alive, self._stops), thread]
        thread.start()

    def _carry_out(self, what: str, work: Callable[[], tuple[str, list[str]]]) -> None:
        """Carry out a stop, and keep on the screen what failed until it is acknowledged."""
        try:
            self._at.message, failures = work()
        except Exception as failure:  # whatever it is: who asked for a stop must see that it failed
            failures = [f"{what} failed: {str(failure) or type(failure).__name__}"]
        clock = datetime.now(UTC)
        self._at.failures += [f"{clock:%H:%M:%S} {failure}" for failure in failures]

    def _stop(self, it: Watched) -> tuple[str, list[str]]:
        it.polled.drive.stop()
        return f"{it.name} has stopped", []

    def _stop_all(self, line: str) -> tuple[str, list[str]]:
        found = self._poller.bus(line).stop_all().values()
        doubtful = [str(it) for it in found if it.seen is not Seen.STOPPED]
        self._stood[line] = f"{len(found) - len(doubtful)} of {len(found)} drives on {line} have stopped"
        return "; ".join(self._stood.values()), doubtful
