"""A simulated plant for demos: a line with every family on it, and its motors running."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from multidrop.bus import Bus
from multidrop.cli import main
from multidrop.cli.support.output import print_text
from multidrop.cli.support.values import counted
from multidrop.errors import BadReply, Expired, NoReply, NotVerified, Unconfirmed
from multidrop.families import MODELS
from multidrop.plant.model import PlantLine

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
OPTIONS = {"maximum_frequency": 50}


def demo_port(folder: Path) -> str:
    """Return the simulated line's port: a link to a pseudo-terminal, or TCP if the system has none."""
    if hasattr(os, "openpty"):
        return str(folder / "mixed")
    with socket.create_server(("127.0.0.1", 0)) as free:
        return f"socket://127.0.0.1:{free.getsockname()[1]}"


def plant_file(port: str, registers: Sequence[str]) -> str:
    """Return the text of a plant file that polls these registers of each drive that has them."""
    tables = [f'[[line]]\nname = "mixed"\nport = "{port}"\n']
    for address, (name, model, framing) in enumerate(DRIVES, 1):
        family = MODELS[model]
        options = "".join(f"{key} = {value}\n" for key, value in OPTIONS.items() if key in family.options)
        polled = [register for register in registers if register in family.registers]
        tables.append(
            f'[[line.drive]]\nname = "{name}"\nmodel = "{model}"\nframing = "{framing}"\n'
            f"address = {address}\n{options}poll = {polled}\n"
        )
    return "\n".join(tables)


def start_motors(line: PlantLine, ledger: Path) -> None:
    """Start the simulated motors at different frequencies; say so on a terminal, because it takes seconds."""
    if sys.stdout.isatty():
        print_text(f"starting the motors of {counted(len(line.drives), 'simulated drive')} ...", flush=True)
    with Bus(line.port, ledger=ledger) as bus:
        for number, polled in enumerate(line.drives):
            drive = bus.attach(polled.drive)
            # On a busy machine a simulated drive may answer too late: its motor stays off.
            with suppress(BadReply, Expired, NoReply, NotVerified, Unconfirmed):
                drive.set_frequency(20.0 + 3 * number)
                drive.start()


@contextmanager
def simulator(plant: Path, ports: Path) -> Iterator[None]:
    """Simulate in a child process, so that simulator and poller do not share an interpreter."""
    words = [sys.executable, "-X", "utf8", "-m", __name__, str(plant)]
    if hasattr(os, "openpty"):
        words += ["--ports", str(ports)]
    pipe = subprocess.PIPE
    # A session of its own (on Windows a group) shields the child from Ctrl-C: it must outlive the polling.
    apart: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        apart = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, encoding="utf-8", **apart) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            if not process.stdout.readline().startswith("ready"):
                raise OSError("the simulator did not start; its reason is above")
            yield
        finally:
            process.stdin.close()


def simulate(words: Sequence[str]) -> int:
    """Simulate until standard input ends, which happens when the parent process ends."""

    def end_with_parent() -> None:
        os.read(0, 1)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=end_with_parent, daemon=True).start()
    return main(["simulate", *words])


if __name__ == "__main__":
    sys.exit(simulate(sys.argv[1:]))
