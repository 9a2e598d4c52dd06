"""A gateway interrupted during its start or shutdown ends, and sends no Modbus request afterwards."""

from __future__ import annotations

import asyncio
import gc
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import pytest
from commands import BoundProcess
from gateways import simulated_plant
from interruptions import every, interrupted_before
from lines import PATIENCE, until
from tables import first_in_ci

from multidrop import Bus, InvtCHE, Plant
from multidrop.gateway.gateway import Gateway
from multidrop.gateway.settings import ServeSettings
from multidrop.sim import EncodedDrive, Simulator, Wire

# Ctrl-C may also interrupt the destructor of an object. Python can only report this, and pytest then warns.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


class CtrlC(KeyboardInterrupt):
    """A KeyboardInterrupt that only this test raises."""


class Counting(EncodedDrive):
    """A simulated drive that counts the requests it received."""

    requests = 0

    def receive(self, frame: Any) -> Any:
        self.requests += 1
        return super().receive(frame)


@pytest.fixture
def drive(tmp_path: Path) -> Iterator[Counting]:
    """Run a simulated drive, and write a plant.toml for its line."""
    drive = Counting(InvtCHE(1, baudrate=38400))
    with Simulator([Wire([drive], unpaced=True)]) as simulator:
        (tmp_path / "plant.toml").write_text(
            f'[[line]]\nname = "hall"\nport = "{simulator.wires[0].path}"\nbaudrate = 38400\n'
            '[[line.drive]]\nname = "pump"\nmodel = "invt-che"\naddress = 1\npoll = ["output_current"]\n'
        )
        yield drive


def falls_silent(drive: Counting) -> None:
    def has_ended() -> bool:
        before = drive.requests
        sleep(0.02)  # enough time for several polls of a millisecond each
        return drive.requests == before

    until(has_ended, 10.0)


@pytest.mark.slow
@pytest.mark.parametrize("step", first_in_ci(151, 53))
def test_a_gateway_ends_if_interrupted_at_any_bytecode(drive: Counting, tmp_path: Path, step: int) -> None:
    """Raise KeyboardInterrupt before every `step`th bytecode of the main thread, from start to end."""
    plant = Plant.load(tmp_path / "plant.toml")

    def live() -> None:
        gateway = Gateway(plant, ServeSettings(port=0))
        asyncio.run(asyncio.wait_for(gateway.run(gateway.end), PATIENCE))

    def act(nth: int) -> bool:
        with suppress(CtrlC), interrupted_before(nth, CtrlC) as found:
            live()
        falls_silent(drive)
        gc.collect()
        with Bus(plant.lines[0].port, baudrate=38400) as bus:  # fails if the gateway still holds the port
            bus.attach(InvtCHE, 1).read(InvtCHE.registers["output_current"])
        return bool(found)

    assert every(step, act) > 1


# If a callback of Python's import system raises KeyboardInterrupt, Python prints the error and continues.
IN_AN_IMPORT = re.compile(
    r"Exception ignored in: .*\nTraceback \(most recent call last\):\n  File \"<frozen importlib.*\n"
    r"KeyboardInterrupt: *\n"
)
SIGNALLED = """
import os, sys, threading, time
from multidrop.cli import main

def send():
    for delay in {delays}:
        time.sleep(delay)
        os.kill(os.getpid(), {number})

threading.Thread(target=send, daemon=True).start()
sys.exit(main(["serve", {path!r}]))
"""


def started(path: Path, number: int, *delays: float) -> BoundProcess[str]:
    """Run `multidrop serve`, and send it a signal after each delay (s), one after the other."""
    code = SIGNALLED.format(delays=list(delays), number=int(number), path=str(path))
    return BoundProcess(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "again"),
    [(signal.SIGINT, None), (signal.SIGTERM, 0.0), (signal.SIGINT, 0.02), (signal.SIGTERM, 0.2)],
)
@pytest.mark.parametrize("stride", first_in_ci(3, 1))
def test_serve_ends_after_a_signal_at_any_moment(
    tmp_path: Path, number: int, again: float | None, stride: int
) -> None:
    """A second signal ends the command at once."""
    serve = '[serve]\nlisten = "127.0.0.1:0"\naudit = "audit.jsonl"\n[serve.may]\nstop = "anyone"\n'
    with simulated_plant(tmp_path, serve) as path:
        with started(path, number) as process:
            begun = monotonic()
            assert process.stdout is not None
            assert process.stdout.readline().startswith("ready ")
            usual_s = monotonic() - begun
            process.send_signal(number)
            process.communicate(timeout=PATIENCE)
        # not from 0, which would interrupt the script before it runs the command
        for moment in range(1, 13, stride):
            delays = [usual_s * moment / 9] + ([] if again is None else [again])
            with started(path, number, *delays) as process:
                _, errors = process.communicate(timeout=PATIENCE)
            assert process.returncode in (0, 130, -number), errors
            assert "Traceback" not in IN_AN_IMPORT.sub("", errors)
        assert not (tmp_path / "audit.jsonl").exists() or (tmp_path / "audit.jsonl").read_text() == ""
