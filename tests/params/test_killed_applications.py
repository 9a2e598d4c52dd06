"""If `apply` is killed, the next call writes the rest; no parameter is written twice, all are reported."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from random import Random
from threading import Timer
from time import monotonic

import pytest
from killable_apply import DRIVE
from kills import BoundProcess
from parameter_drives import factory_reset, raw_of, set_at_random, with_parameters, writable

from multidrop import Bus, DelixiNative, params
from multidrop.sim import Simulator, Wire

KILLS = 50
CODES = [f"P0{group}.{index:02}" for group in (1, 2) for index in range(10)]


class Lives:
    """Applies a parameter file repeatedly, in processes that are killed after some seconds."""

    def __init__(self, process: subprocess.Popen[str], port: str, file: Path, report: Path) -> None:
        self._process = process
        self._line = f"{port} {file} {report}\n"

    def live(self, seconds: float) -> int:
        """Apply the file in a process that is killed after `seconds`; return its status, 0 if complete."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(self._line)
        self._process.stdin.flush()
        life = int(self._process.stdout.readline())
        killer = Timer(seconds, self._kill, [life])
        killer.start()
        status = int(self._process.stdout.readline())
        killer.cancel()
        return status

    @staticmethod
    def _kill(life: int) -> None:
        with suppress(ProcessLookupError):
            os.kill(life, signal.SIGKILL)


@pytest.fixture
def lives(tmp_path: Path) -> Iterator[tuple[Lives, object]]:
    sim = with_parameters(DelixiNative(**DRIVE), CODES)
    there = writable(sim.drive, CODES)
    set_at_random(sim, there, Random(1))
    program = Path(__file__).parents[1] / "support" / "processes" / "killable_apply.py"
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path / "state")}
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        port = simulator.wires[0].path
        with Bus(port) as bus:
            saved = params.read(bus.attach(DelixiNative, **DRIVE), [one.code for one in there])
        params.save(saved, tmp_path / "saved.toml")
        with BoundProcess(
            [sys.executable, str(program)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        ) as process:
            yield Lives(process, port, tmp_path / "saved.toml", tmp_path / "report"), (sim, there)
            process.kill()


@pytest.mark.long
def test_killed_applications_are_finished_by_the_next(lives: tuple[Lives, object], tmp_path: Path) -> None:
    killed, (sim, there) = lives
    random, kills, whole_s = Random(41), 0, 60.0
    wanted = {one.code: raw_of(sim, one) for one in there}
    while kills < KILLS:
        factory_reset(sim, there)
        sim.counters.eeprom_writes.clear()
        differing = {one.code for one in there if raw_of(sim, one) != wanted[one.code]}
        begun = monotonic()
        while status := killed.live(random.uniform(0, whole_s) if kills or whole_s < 60 else whole_s):
            assert status == signal.SIGKILL
            kills += 1
        whole_s = min(whole_s, monotonic() - begun)
        assert {one.code: raw_of(sim, one) for one in there} == wanted
        names = {one.code: one.name for one in there}
        assert {names[code]: 1 for code in differing} == {
            name: count for name, count in sim.counters.eeprom_writes.items() if name in names.values()
        }
        told = (tmp_path / "report").read_text().splitlines()
        assert differing <= {line.partition(":")[0] for line in told}
