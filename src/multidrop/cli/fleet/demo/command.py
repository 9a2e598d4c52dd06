"""The demo's story: a fleet begins, one of its gateways is killed, comes back, and nothing is missing."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from multidrop.cli.fleet.connection import require_fleet
from multidrop.cli.fleet.demo.children import Children, await_line
from multidrop.cli.fleet.demo.judgement import Judgement, Kill, judge
from multidrop.cli.fleet.demo.nats_nodes import server_program, start_nodes
from multidrop.cli.fleet.demo.numbered_lines import DRIVES, drive_name, plant_file
from multidrop.cli.fleet.demo.vanishing_folder import vanishing_folder
from multidrop.cli.fleet.nats import CA, CREDENTIALS
from multidrop.cli.fleet.tables import natural
from multidrop.cli.fleet.watch import drawing, follow
from multidrop.cli.support.output import print_text
from multidrop.cli.support.signals import end_signals_cancel

GATEWAYS = ("gw-1", "gw-2", "gw-3")
KILLED = "gw-2"
LINES = 12
PATIENCE_S = 60.0  # for what takes seconds on a machine that is not busy
RUN_S = 2.0  # before the kill, and after each thing that happened
KEEP = "100 MB"  # of samples, of the 256 MB that each server has

Fleet = dict[str, Any]


class Stage:
    """The notes of all that happened so far, and the newest look at the fleet."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.draw: Callable[[Fleet], object] | None = None  # on a terminal
        self.fleet: Fleet = {"gateways": {}, "lines": {}}
        self.looked = asyncio.Event()
        self._begun = time.monotonic()

    def note(self, sentence: str) -> None:
        self.notes.append(f"{time.monotonic() - self._begun:5.1f} s  {sentence}")
        if self.draw is None:
            print_text(self.notes[-1], flush=True)

    def show(self, told: Fleet) -> None:
        self.fleet = told
        self.looked.set()
        if self.draw:
            self.draw({**told, "notes": self.notes})

    def masters(self) -> dict[str, str | None]:
        return {name: line["master"] for name, line in self.fleet["lines"].items()}

    def behind(self) -> list[int | None]:
        """Return the messages of each gateway that the stream lacks; None is not known."""
        said = [gateway["says"] for gateway in self.fleet["gateways"].values()]
        return [says and says["spool"]["behind"] for says in said]

    def shares(self) -> str:
        """Say who has how many lines."""
        found = list(self.masters().values())
        return ", ".join(f"{name} {found.count(name)}" for name in GATEWAYS if name in found)

    async def until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for a look at which this is so. Raises OSError where it is not for a minute."""
        try:
            async with asyncio.timeout(PATIENCE_S):
                while not condition():
                    self.looked.clear()
                    await self.looked.wait()
        except TimeoutError:
            raise OSError(f"{what} not within {PATIENCE_S:.0f} s: the demo has failed") from None

    async def calm(self, seconds: float) -> None:
        """Wait until no line has had another master for so long: what is shown may be older than it is."""
        before: dict[str, str | None] | None = None
        while (found := self.masters()) != before:
            before = found
            await asyncio.sleep(seconds)
            self.looked.clear()
            await self.until(self.looked.is_set, "the fleet was looked at")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    pass


def run(arguments: argparse.Namespace) -> int:
    """Show it all; 0 where every answer of the drives was found again."""
    require_fleet()
    from multidrop.fleet.servers.connections import OLDEST

    program = server_program(OLDEST)
    stage = Stage()
    with vanishing_folder() as folder, ExitStack() as stack:
        none = dict.fromkeys((CREDENTIALS, CA), "")  # of a fleet that the user may have
        children = Children(folder, {"XDG_STATE_HOME": str(folder / "state"), **none})
        stack.callback(children.close)
        demo = Demo(folder, children, stage)
        demo.begin(program)
        kill = asyncio.run(demo.play())
        found = demo.end(kill)
    for sentence in found.sentences():
        print_text(sentence)
    print_text(
        "nothing is missing of what was on a disk" if found.holds else "something is MISSING: see above"
    )
    return 0 if found.holds else 1


class Demo:
    """The demo's processes, from their begin to their end."""

    def __init__(self, folder: Path, children: Children, stage: Stage) -> None:
        self._folder = folder
        self._children = children
        self._stage = stage
        self._urls = ""

    def begin(self, program: str) -> None:
        """Start servers, lines, gateways and a hub."""
        note, children = self._stage.note, self._children
        simulator = children.start("lines", sys.executable, "-m", _module("numbered_lines"), str(LINES))
        urls = start_nodes(children, self._folder, program)
        self._urls = ",".join(urls)
        note(f"three NATS servers of this machine are ready, in {self._folder}")
        plant = self._folder / "plant.toml"
        plant.write_text(plant_file(json.loads(await_line(simulator) or "{}")), "utf-8")
        children.run_multidrop("init", "fleet", "init", str(plant), "--keep", KEEP, "--nats", self._urls)
        note(f"`fleet init` has stored {LINES} lines of {DRIVES} simulated drives each")
        for gateway in GATEWAYS:
            self._start(gateway)
        self._start_hub("hub", "--every", "2")
        note(f"{', '.join(GATEWAYS)} and a hub are started")

    def _start(self, gateway: str) -> None:
        folder = str(self._folder / gateway)
        self._children.start_multidrop(
            gateway, "fleet", "serve", gateway, "--folder", folder, "--nats", self._urls
        )

    def _start_hub(self, name: str, *words: str) -> None:
        parquet = str(self._parquet)
        self._children.start_multidrop(name, "hub", *self._urls.split(","), "--parquet", parquet, *words)

    @property
    def _parquet(self) -> Path:
        return self._folder / "parquet"

    # ---- what is watched ----

    async def play(self) -> Kill:
        """Kill a gateway, start it again, and show it. Raises KeyboardInterrupt for a signal."""
        over = asyncio.Event()
        with end_signals_cancel(), _drawn(self._stage):
            watching = asyncio.create_task(self._watch(over))
            try:
                return await self._story()
            finally:
                over.set()
                await watching

    async def _watch(self, over: asyncio.Event) -> None:
        from multidrop.fleet.overview import FleetView, FleetWatch
        from multidrop.fleet.servers.connections import ServerPath

        path = ServerPath(self._urls.split(","))
        try:
            await path.open()
            await follow(FleetWatch(FleetView(path)), self._stage.show, over)
        finally:
            await path.close()

    async def _story(self) -> Kill:
        stage = self._stage
        await stage.until(lambda: self._are_all(GATEWAYS), "all lines had masters")
        await stage.calm(RUN_S)
        stage.note(f"every line has a master: {stage.shares()}")
        kill = self._kill()
        survivors = [name for name in GATEWAYS if name != KILLED]
        await stage.until(lambda: self._are_all(survivors), f"the lines of {KILLED} were taken over")
        stage.note(f"the others are masters of its lines now: {stage.shares()}")
        await asyncio.sleep(RUN_S)
        self._start(KILLED)
        stage.note(f"{KILLED} is started again: what it had on its disk goes to the hub")
        await stage.until(lambda: self._are_all(GATEWAYS), f"{KILLED} had lines again")
        stage.note(f"it has a share of the lines again: {stage.shares()}")
        await asyncio.sleep(RUN_S)
        # A gateway that ends forwards for a few seconds, and leaves what is left to its next start.
        await stage.until(lambda: stage.behind() == [0] * len(GATEWAYS), "all messages were forwarded")
        return kill

    def _are_all(self, gateways: tuple[str, ...] | list[str]) -> bool:
        """Say whether these, each of them, and nobody else are the masters of all lines."""
        return set(self._stage.masters().values()) == set(gateways)

    def _kill(self) -> Kill:
        lines = [line for line, master in self._stage.masters().items() if master == KILLED]
        before = time.time_ns()
        self._children.kill(KILLED)
        kill = Kill(
            frozenset(drive_name(line, address) for line in lines for address in range(1, DRIVES + 1)),
            before,
            time.time_ns(),
        )
        self._stage.note(f"{KILLED} is KILLED; it was master of {', '.join(sorted(lines, key=natural))}")
        return kill

    # ---- what is left ----

    def end(self, kill: Kill) -> Judgement:
        """End all in good order, let the hub read what is left, and judge."""
        children = self._children
        children.end(*GATEWAYS)
        [said] = children.end("lines").values()
        children.end("hub")
        self._start_hub("hub-once", "--once", "--json")
        children["hub-once"].wait(PATIENCE_S)
        spools = {gateway: self._folder / gateway / "spool" for gateway in GATEWAYS}
        return judge(self._parquet, spools, json.loads(said), kill)


def _module(name: str) -> str:
    return f"{__package__}.{name}"


@contextmanager
def _drawn(stage: Stage) -> Iterator[None]:
    """Draw on a terminal, if rich is there; the notes are printed in any case."""
    if not (sys.stdout.isatty() and find_spec("rich")):
        yield
        return
    try:
        with drawing("multidrop fleet demo") as stage.draw:
            shown = len(stage.notes)
            yield
    finally:
        stage.draw = None
        for sentence in stage.notes[shown:]:
            print_text(sentence)
