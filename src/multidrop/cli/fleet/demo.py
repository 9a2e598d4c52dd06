"""`multidrop fleet demo`: a fleet on this computer; one gateway is killed, and the others take over."""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from multidrop.cli.fleet.connection import CA, CREDENTIALS, require_fleet
from multidrop.cli.fleet.demo_processes import (
    Children,
    free_ports,
    server_program,
    start_nodes,
    temporary_folder,
)
from multidrop.cli.fleet.views import drawing, follow
from multidrop.cli.support.output import print_text
from multidrop.cli.support.signals import end_signals_cancel
from multidrop.cli.support.values import counted

GATEWAYS = ("gw-1", "gw-2", "gw-3")
KILLED = "gw-2"
LINES = 12
DRIVES = 2  # drives per line
WAIT_S = 60.0  # time limit of a step, in s; on an idle computer, a step takes a few seconds
RUN_S = 2.0  # pause before the kill, and after each step
KEEP = "100 MB"  # limit of stored samples; each server may store 256 MB in all

Fleet = dict[str, Any]


class Stage:
    """The demo's output: its notes so far, and the newest view of the fleet."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.draw: Callable[[Fleet], object] | None = None  # None without a terminal
        self.fleet: Fleet = {"gateways": {}, "lines": {}}
        self.updated = asyncio.Event()
        self._started = time.monotonic()

    def note(self, sentence: str) -> None:
        self.notes.append(f"{time.monotonic() - self._started:5.1f} s  {sentence}")
        if self.draw is None:
            print_text(self.notes[-1], flush=True)

    def show(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self.updated.set()
        if self.draw:
            self.draw({**fleet, "notes": self.notes})

    def masters(self) -> dict[str, str | None]:
        return {name: line["master"] for name, line in self.fleet["lines"].items()}

    def are_masters(self, gateways: Sequence[str]) -> bool:
        """Return True if every line has a master, and the masters are exactly these gateways."""
        return set(self.masters().values()) == set(gateways)

    def shares(self) -> str:
        """Return the number of each gateway's lines, as text."""
        found = list(self.masters().values())
        return ", ".join(f"{name} {found.count(name)}" for name in GATEWAYS if name in found)

    async def until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for a view of the fleet that meets the condition. Raises OSError after a minute."""
        try:
            async with asyncio.timeout(WAIT_S):
                while not condition():
                    self.updated.clear()
                    await self.updated.wait()
        except TimeoutError:
            raise OSError(f"the demo has failed: {what} not within {WAIT_S:.0f} s") from None

    async def calm(self, seconds: float) -> None:
        """Wait until no line has changed its master for `seconds` s, because views may be out of date."""
        before: dict[str, str | None] | None = None
        while (found := self.masters()) != before:
            before = found
            await asyncio.sleep(seconds)
            self.updated.clear()
            await self.until(self.updated.is_set, "the fleet was read")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    pass


def run(arguments: argparse.Namespace) -> int:
    """Run a fleet, kill a gateway, and show the takeover. Raises OSError if a step exceeds a minute."""
    require_fleet()
    from multidrop.fleet.servers.connections import OLDEST

    program = server_program(OLDEST)
    stage = Stage()
    with temporary_folder() as folder, ExitStack() as stack:
        # so that the demo does not use the credentials of the user's own fleet
        none = dict.fromkeys((CREDENTIALS, CA), "")
        children = Children(folder, {"XDG_STATE_HOME": str(folder / "state"), **none})
        stack.callback(children.close)
        demo = Demo(folder, children, stage)
        demo.start(program)
        seconds = asyncio.run(demo.play())
        children.end(*GATEWAYS, "lines")
    print_text(f"the lines of the killed gateway had other masters after {seconds:.1f} s")
    return 0


def drives_of(line: str) -> list[str]:
    return [f"{line}-drive-{address}" for address in range(1, DRIVES + 1)]


def plant_file(ports: Mapping[str, int]) -> str:
    """Return the text of a plant file whose lines are on these TCP ports of this computer."""
    return "\n".join(
        f'[[line]]\nname = "{line}"\nport = "tcp://127.0.0.1:{port}"\n'
        + "".join(
            f'[[line.drive]]\nname = "{drive}"\nmodel = "innovert-ibd"\naddress = {address}\n'
            'poll = ["output_current"]\nevery = "100 ms"\n'
            for address, drive in enumerate(drives_of(line), 1)
        )
        for line, port in ports.items()
    )


class Demo:
    """Starts and ends the processes of the demo."""

    def __init__(self, folder: Path, children: Children, stage: Stage) -> None:
        self._folder = folder
        self._children = children
        self._stage = stage
        self._urls = ""

    def start(self, program: str) -> None:
        """Start servers, simulated lines and gateways."""
        note, children, plant = self._stage.note, self._children, self._folder / "plant.toml"
        lines = [f"line-{at}" for at in range(1, LINES + 1)]
        plant.write_text(plant_file(dict(zip(lines, free_ports(LINES), strict=True))), "utf-8")
        simulator = children.start_multidrop("lines", "simulate", str(plant))
        assert simulator.stdout is not None
        simulator.stdout.readline()  # waits for the line that is printed when the ports are open
        self._urls = ",".join(start_nodes(children, self._folder, program))
        note(f"three NATS servers are ready, in {self._folder}")
        children.run_multidrop("init", "fleet", "init", str(plant), "--keep", KEEP, "--nats", self._urls)
        note(f"`fleet init` has stored {LINES} lines of {DRIVES} simulated drives each")
        for gateway in GATEWAYS:
            self._start(gateway)
        note(f"{', '.join(GATEWAYS)} are started")

    def _start(self, gateway: str) -> None:
        folder = str(self._folder / gateway)
        self._children.start_multidrop(
            gateway, "fleet", "serve", gateway, "--folder", folder, "--nats", self._urls
        )

    async def play(self) -> float:
        """Kill a gateway and start it again; return how many seconds its lines took to get other masters.

        Raises KeyboardInterrupt if the process receives a signal.
        """
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

    async def _story(self) -> float:
        stage = self._stage
        await stage.until(lambda: stage.are_masters(GATEWAYS), "all lines had masters")
        await stage.calm(RUN_S)
        stage.note(f"every line has a master: {stage.shares()}")
        lines = [*stage.masters().values()].count(KILLED)
        killed = time.monotonic()
        self._children.kill(KILLED)
        stage.note(f"{KILLED} is KILLED, the master of {counted(lines, 'line')}")
        survivors = [name for name in GATEWAYS if name != KILLED]
        await stage.until(lambda: stage.are_masters(survivors), f"the lines of {KILLED} were taken over")
        seconds = time.monotonic() - killed
        stage.note(f"the others are masters of its lines now: {stage.shares()}")
        await asyncio.sleep(RUN_S)
        self._start(KILLED)
        stage.note(f"{KILLED} is started again")
        await stage.until(lambda: stage.are_masters(GATEWAYS), f"{KILLED} had lines again")
        stage.note(f"it has a share of the lines again: {stage.shares()}")
        await asyncio.sleep(RUN_S)
        return seconds


@contextmanager
def _drawn(stage: Stage) -> Iterator[None]:
    """Draw the stage on a terminal until the context ends. Print its notes in any case."""
    if not sys.stdout.isatty():
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
