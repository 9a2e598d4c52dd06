"""`multidrop demo`: polls and records a simulated line with every family on it."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from multidrop.bus import Bus
from multidrop.cli.monitor.command import is_possible, watch
from multidrop.cli.poll.command import add_polling_arguments, conclude, follow
from multidrop.cli.support.files import refuse_overwriting
from multidrop.drives import MODELS
from multidrop.errors import BadReply, NoReply, NotDone, Unconfirmed
from multidrop.plant.loader import load_plant
from multidrop.plant.model import PlantLine
from multidrop.recording import open_reader

DRIVES = (  # name, model, framing
    ("erman", "erman-er-g-220", "rtu"),
    ("che", "invt-che", "rtu"),
    ("ibd", "innovert-ibd", "rtu"),
    ("ibd-ascii", "innovert-ibd", "ascii"),
    ("delixi", "delixi-modbus", "rtu"),
    ("delixi-ascii", "delixi-modbus", "ascii"),
    ("delixi-native", "delixi-native", "delixi"),
    ("yd1000", "yd1000", "rtu"),
)
POLLED = ("output_frequency", "motor_speed", "output_current", "dc_bus_voltage")
OPTIONS = {"maximum_frequency": 50}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_polling_arguments(parser, out="demo.arrows", seconds=10.0)


def run(arguments: argparse.Namespace) -> int:
    _make_room(arguments.out)
    with TemporaryDirectory(prefix="multidrop-") as directory:
        path = Path(directory) / "demo.toml"
        path.write_text(_plant_file(Path(directory) / "mixed"))
        with _simulator(path, Path(directory)):
            plant = load_plant(path)
            _start_motors(plant.lines[0])
            if _can_be_watched(arguments):
                return conclude(plant, watch(plant, out=arguments.out, seconds=arguments.seconds), arguments)
            return follow(plant, arguments)


def _make_room(out: Path) -> None:
    """Remove an earlier demo's recording, and nothing else. Raises ValueError for any other file."""
    with suppress(ValueError, TypeError, OSError):  # no file, or no recording
        if set(open_reader(out).metadata.get("drives", ())) == {name for name, *_ in DRIVES}:
            out.unlink()
    refuse_overwriting(out)


def _can_be_watched(arguments: argparse.Namespace) -> bool:
    """Tell whether the monitor can show the demo: it writes no captures, and needs a terminal and rich."""
    if arguments.capture or arguments.flight_recorder:
        return False
    return not arguments.json and is_possible() and find_spec("rich") is not None


def _plant_file(port: Path) -> str:
    tables = [f'[[line]]\nname = "mixed"\nport = "{port}"\n']
    for address, (name, model, framing) in enumerate(DRIVES, 1):
        family = MODELS[model]
        options = "".join(f"{key} = {value}\n" for key, value in OPTIONS.items() if key in family.options)
        polled = [register for register in POLLED if register in family.registers]
        tables.append(
            f'[[line.drive]]\nname = "{name}"\nmodel = "{model}"\nframing = "{framing}"\n'
            f"address = {address}\n{options}poll = {polled}\n"
        )
    return "\n".join(tables)


def _start_motors(line: PlantLine) -> None:
    """Start every simulated motor, each at another frequency."""
    with Bus(line.port, ledger=Path(line.port).with_name("wear.sqlite")) as bus:
        for number, polled in enumerate(line.drives):
            drive = bus.attach(polled.drive)
            # On a busy machine a simulated drive may answer too late: the demo goes on without its motor.
            with suppress(BadReply, NoReply, NotDone, Unconfirmed):
                drive.set_frequency(20.0 + 3 * number)
                drive.start()


@contextmanager
def _simulator(plant: Path, ports: Path) -> Iterator[None]:
    """Simulate in another process: the two sides do not share an interpreter."""
    words = [sys.executable, "-m", "multidrop", "simulate", str(plant), "--ports", str(ports)]
    # A session of its own keeps Ctrl-C from it: it must outlive the polling.
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        assert process.stdout is not None
        try:
            if not process.stdout.readline().startswith("ready"):
                raise OSError("the simulator did not start; see above")
            yield
        finally:
            process.terminate()
