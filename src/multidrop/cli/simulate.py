"""`multidrop simulate`: simulates the drives of a plant file, on pseudo-terminals or TCP ports.

`multidrop run --simulate` and the demos start it in a child process, with `simulator`. The demos' plant
is here too, with an operator who runs its motors.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import cycle
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

from multidrop.bus import Bus
from multidrop.cli import main
from multidrop.cli.support.arguments import add_speed_option
from multidrop.cli.support.output import print_text
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import speaks_tcp
from multidrop.drive.verbs import Condition
from multidrop.errors import BusError
from multidrop.families.registry import find_model
from multidrop.plant.loader import load_plant
from multidrop.plant.model import PlantLine
from multidrop.sim import FaultyWire, Simulator, load_faults, serve, simulated
from multidrop.sim.faults import HELP, Faults
from multidrop.sim.wire import is_dead_link

ANY_TCP = "tcp://127.0.0.1:0"  # any free TCP port of this computer; replaces a port on another computer
LOOPBACK = ("127.0.0.1", "localhost")
NO_TERMINALS = (
    "this system has no pseudo-terminals for --ports DIR: remove --ports, and give each line a port such as "
    "socket://127.0.0.1:5020"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "plant",
        metavar="PLANT.toml",
        help="the drives; lines' ports are ignored, except tcp:// on this machine and, without --ports, "
        "socket:// on this machine",
    )
    parser.add_argument(
        "--ports",
        metavar="DIR",
        type=Path,
        help="directory for a link to each line's port; needed if a line has neither of these ports",
    )
    parser.add_argument("--unpaced", action="store_true", help="answer at once, not at the pace of a wire")
    parser.add_argument("--faults", metavar="FILE", help="faults of lines and drives, as described below")
    add_speed_option(parser, "let simulated time pass N times as fast: wires, drives, motors and faults")
    parser.epilog = HELP
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


def run(arguments: argparse.Namespace) -> int:
    plant = load_plant(arguments.plant)
    names = [polled.drive.name for polled in plant.drives]
    faults = load_faults(arguments.faults, names) if arguments.faults else Faults()
    directory: Path | None = arguments.ports
    if directory is not None and not hasattr(os, "openpty"):
        raise ValueError(NO_TERMINALS)
    serial = [line.name for line in plant.lines if not (speaks_tcp(line.port) or _is_local_socket(line.port))]
    if directory is None and serial:
        raise ValueError(f"line {serial[0]} needs a pseudo-terminal: add --ports DIR")
    if directory is not None and directory.exists() and not directory.is_dir():
        raise ValueError(f"--ports {directory} is a file: name a directory; it is created if missing")
    ports = [_port(line, directory) for line in plant.lines]
    if directory is not None:
        directory.mkdir(parents=True, exist_ok=True)
    wires = [
        FaultyWire(
            [simulated(polled.drive) for polled in line.drives],
            faults,
            name=line.name,
            port=port,
            unpaced=arguments.unpaced,
        )
        for line, port in zip(plant.lines, ports, strict=True)
    ]
    serve(wires, _announce, speed=arguments.speed)
    return 0


def _is_local_socket(port: str) -> bool:
    url = urlsplit(port)
    return url.scheme == "socket" and url.hostname in LOOPBACK and bool(url.port)


def _port(line: PlantLine, directory: Path | None) -> str:
    """Return the port at which a line is simulated.

    Raises ValueError if the link to its pseudo-terminal cannot be created.
    """
    if speaks_tcp(line.port):
        url = urlsplit(line.port)
        return line.port if url.hostname in LOOPBACK and url.port else ANY_TCP
    if directory is None:
        return line.port
    link = directory / line.name
    if link.parent != directory:
        raise ValueError(
            f"--ports cannot name a file after line {line.name!r}: rename the line to a name without /"
        )
    if (link.is_symlink() or link.exists()) and not is_dead_link(link):
        raise ValueError(f"{link} exists already: remove it, or choose another directory with --ports")
    return str(link)


def _announce(simulator: Simulator) -> None:
    for wire in simulator.wires:
        print_text(f"ready {wire.name} {wire.path}", flush=True)


# ---- a simulator in a child process ----


@contextmanager
def simulator(
    plant: Path, ports: Path, faults: Path | None = None, *, speed: float = 1.0
) -> Iterator[dict[str, str]]:
    """Simulate the plant in a child process, and yield the lines' ports by name.

    In one process, simulator and poller would share an interpreter, and would delay each other.
    """
    names = [line.name for line in load_plant(plant).lines]
    words = [sys.executable, "-X", "utf8", "-m", __name__, str(plant)]
    if hasattr(os, "openpty"):
        words += ["--ports", str(ports)]
    if faults is not None:
        words += ["--faults", str(faults)]
    if speed != 1.0:
        words += ["--speed", str(speed)]
    pipe = subprocess.PIPE
    # Ctrl-C must not reach the child, which must run longer than the polling. So it gets its own session, or
    # on Windows its own process group.
    apart: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        apart = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, encoding="utf-8", **apart) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            found = {}
            for name in names:
                ready = f"ready {name} "
                if not (printed := process.stdout.readline().rstrip("\n")).startswith(ready):
                    raise OSError("the simulator did not start; the lines above give the reason")
                found[name] = printed.removeprefix(ready)
            yield found
        finally:
            process.stdin.close()


def simulate(words: Sequence[str]) -> int:
    """Simulate until standard input is closed, which also happens when the parent process ends."""

    def end_with_parent() -> None:
        os.read(0, 1)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=end_with_parent, daemon=True).start()
    return main(["simulate", *words])


# ---- the plant of the demos ----


LINES = {  # name, model and framing of each line's drives
    "pumps": (
        ("pump-1", "erman-er-g-220", "rtu"),
        ("pump-2", "erman-er-g-220", "rtu"),
        ("pump-3", "invt-che", "rtu"),
        ("pump-4", "danfoss-fc51", "rtu"),
        ("mixer-1", "yd1000", "rtu"),
    ),
    "fans": (
        ("fan-1", "invt-che", "rtu"),
        ("fan-2", "innovert-ibd", "rtu"),
        ("fan-3", "innovert-ibd", "ascii"),
        ("fan-4", "delta-vfd-el", "rtu"),
    ),
    "belts": (
        ("belt-1", "delixi-modbus", "rtu"),
        ("belt-2", "delixi-modbus", "ascii"),
        ("belt-3", "delixi-native", "delixi"),
        ("belt-4", "abb-acs355", "rtu"),
        ("belt-5", "invt-che", "rtu"),
        ("belt-6", "delta-ms300", "rtu"),
        ("belt-7", "optidrive-e3", "rtu"),
        ("mixer-2", "yd1000", "rtu"),
    ),
}
DRIVES = [name for drives in LINES.values() for name, *_ in drives]
POLLED = ("status", "terminals", "output_frequency", "output_current")
# By model: the registers to poll instead of POLLED. At 9600 bit/s, a YD1000 has time for two requests.
POLLED_OF = {"yd1000": ("status", "output_frequency")}
# faults, and settings of output terminals, which are polled with the period SLOW
SLOWLY = ("fault", "last_fault", "output_m01", "output_m02", "output_yabc", "output_virtual")
EVERY, SLOW = "500 ms", "2 s"
MAXIMUM_HZ = 50
TROUBLE = {  # the faults that some drives of the demo simulate
    "fan-1": 'trip = "30 s"\nfirst = "3 s"',
    "belt-5": 'trip = "50 s"',
    "belt-6": 'silence = "40 s"\nsilent_for = "3 s"\nfirst = "2 s"',
    "pump-2": 'silence = "70 s"',
    "fan-3": "loss = 0.02",
}
DRIFT = 0.25  # each simulated load moves up and down by this fraction of the rated torque
FIRST_STEP_S = 0.5  # pause between the first starts of a line's motors
STEP_S = 0.8  # pause before the operator turns to the next drive of a line
CALM = 3  # the operator changes a running motor's setpoint with a probability of 1 / CALM


def demo_files(folder: Path) -> tuple[Path, Path]:
    """Write a plant file and a file of simulated faults into a folder; return their paths."""
    plant, faults = folder / "demo.toml", folder / "faults.toml"
    plant.write_text("\n".join(_plant_tables(folder)), "utf-8")
    tables = (f"[drive.{name}]\ndrift = {DRIFT}\n{TROUBLE.get(name, '')}\n" for name in DRIVES)
    faults.write_text("\n".join(tables), "utf-8")
    return plant, faults


def _plant_tables(folder: Path) -> Iterator[str]:
    for line, drives in LINES.items():
        yield f'[[line]]\nname = "{line}"\nport = "{_demo_port(folder / line)}"\n'
        for address, (name, model, framing) in enumerate(drives, 1):
            family = find_model(model)
            given = {"maximum_frequency": MAXIMUM_HZ, "confirmed": 1}
            options = "".join(f"{key} = {value}\n" for key, value in given.items() if key in family.options)
            yield (
                f'[[line.drive]]\nname = "{name}"\nmodel = "{model}"\nframing = "{framing}"\n'
                f"address = {address}\nbaudrate = {min(38400, max(family.baudrates))}\n{options}"
                f'every = "{EVERY}"\npoll = [{", ".join(_polled(family))}]\n'
            )


def _polled(family: type[Drive]) -> Iterator[str]:
    """Yield the entries of the list `poll` in a plant file, for registers with a unit or named values."""
    entries = {
        '"{}"': POLLED_OF.get(family.model, POLLED),
        f'{{{{ register = "{{}}", every = "{SLOW}" }}}}': SLOWLY,
    }
    for entry, names in entries.items():
        found = [family.registers[name] for name in names if name in family.registers]
        yield from (entry.format(one.name) for one in found if one.step is not None or one.values is not None)


def _demo_port(link: Path) -> str:
    """Return a simulated line's port: a link to a pseudo-terminal, or a TCP port if there are no ptys."""
    if hasattr(os, "openpty"):
        return str(link)
    with socket.create_server(("127.0.0.1", 0)) as free:
        return f"socket://127.0.0.1:{free.getsockname()[1]}"


class Operator:
    """Runs motors while its `with` block is active: starts them, changes setpoints, resets trips.

    The operator does not restart a motor that a user has stopped.
    """

    def __init__(self, buses: Iterable[Bus]) -> None:
        self._is_over = threading.Event()
        self._threads = [threading.Thread(target=self._work, args=(bus,), daemon=True) for bus in buses]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Send no further commands. A command in progress ends when the poller closes its port."""
        self._is_over.set()

    def _work(self, bus: Bus) -> None:
        drives = list(bus.drives)
        for drive in drives:
            self._attempt(_start, drive)
            self._is_over.wait(FIRST_STEP_S)
        for drive in cycle(drives):
            if self._is_over.wait(STEP_S):
                return
            if not drive.stops_called[0]:
                self._attempt(_look_after, drive)

    def _attempt(self, command: Callable[[Drive], None], drive: Drive) -> None:
        # The drive may be silent, tripped, or too slow on a busy machine. The operator tries it again later.
        if not self._is_over.is_set():
            with suppress(BusError):
                command(drive)


def _start(drive: Any) -> None:
    drive.set_frequency(random.randrange(20, MAXIMUM_HZ))
    drive.start()


def _look_after(drive: Any) -> None:
    condition = drive.state().condition
    if condition is Condition.FAULT:
        drive.reset_fault()
        _start(drive)
    elif condition is Condition.STOPPED:
        _start(drive)
    elif random.randrange(CALM) == 0:
        drive.set_frequency(random.randrange(20, MAXIMUM_HZ))


if __name__ == "__main__":
    sys.exit(simulate(sys.argv[1:]))
