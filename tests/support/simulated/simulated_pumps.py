"""A plant of simulated pumps on several lines in another process, which records the stop of each drive.

The pumps have Delta's command words, and ten adjacent readings that one request reads, at 115200 bit/s. Their
lines are sockets, because a pty depends on a kernel thread, which a busy machine delays.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any

from multidrop.drive import Drive
from multidrop.drive.parameters import Parameter, parameters_of
from multidrop.runs import RunPlan, load_test
from multidrop.sim import MotorDrive, Simulator, Wire, simulated

sys.path.extend(map(str, Path(__file__).parents[1].iterdir()))

from commands import BoundProcess
from free_ports import free_ports

from multidrop import Plant
from multidrop.families.profiles.command_codes import DeltaControl
from multidrop.sim import serve

FAMILY = """[family]
title = "A pump with Delta's words"
manual = "none: it is simulated"
profile = "delta"
counts_from = 0
addresses = [1, 247]
baudrates = [115200]
formats = ["8N1"]
together = { holding = 20 }
[command]
control = { at = "2000H", kept = "ram", place = "none" }
reset = { at = "2002H", kept = "ram", place = "none" }
[command.reference]
at = "2001H"
unit = "Hz"
step = 0.01
span = [0, 599]
kept = "ram"
place = "none"
[reading]
fault = { at = "2100H", place = "none" }
status = { at = "2101H", place = "none" }
reference_in_force = { at = "2102H", unit = "Hz", step = 0.01, place = "none" }
output_frequency = { at = "2103H", unit = "Hz", step = 0.01, place = "none" }
output_current = { at = "2104H", unit = "A", step = 0.01, place = "none" }
dc_bus_voltage = { at = "2105H", unit = "V", step = 0.1, place = "none" }
output_voltage = { at = "2106H", unit = "V", step = 0.1, place = "none" }
output_power = { at = "2107H", unit = "kW", step = 0.001, number_format = "I16", place = "none" }
motor_speed = { at = "2108H", unit = "rpm", place = "none" }
heatsink_temperature = { at = "2109H", unit = "°C", step = 0.1, place = "none" }
station = { at = "0900H", place = "none" }
"""
POLLED = (
    "fault",
    "status",
    "reference_in_force",
    "output_frequency",
    "output_current",
    "dc_bus_voltage",
    "output_voltage",
    "output_power",
    "motor_speed",
    "heatsink_temperature",
)
# addresses of the first polled reading, and of a register that is not polled
FIRST_READING, UNPOLLED = 0x2100, 0x0900
RAMP_S = 0.2  # deceleration time in s; `stop` waits for its end
WAVE_S = 0.1  # time between two changes of load and speed, in s


def write_plant(folder: Path, drives: Sequence[int], serve: str = "", every: str = "100 ms") -> Path:
    """Write a plant file and return its path. `drives` has the number of drives on each line."""
    (folder / "pump.toml").write_text(FAMILY)
    tables, number = [], 0
    for line, (count, port) in enumerate(zip(drives, free_ports(len(drives)), strict=True), 1):
        tables.append(f'[[line]]\nname = "line-{line}"\nport = "socket://127.0.0.1:{port}"\n')
        for address in range(1, count + 1):
            number += 1
            tables.append(
                f'[[line.drive]]\nname = "pump-{number}"\nmodel = "pump.toml"\naddress = {address}\n'
                f'every = "{every}"\npoll = {[*POLLED]}\n'
            )
    path = folder / "plant.toml"
    path.write_text("".join(tables) + serve)
    return path


class SimulatedPumps:
    """Controls the simulator, which runs in a process of its own."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    @property
    def pid(self) -> int:
        return self._process.pid

    def _ask(self, word: str) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(word, file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def run(self) -> None:
        """Start all motors and clear the recorded stops."""
        self._ask("run")

    def late_s(self) -> float:
        """Return the longest time (s) for which the process did not run since the last call."""
        return float(self._ask("late"))

    def stops(self) -> dict[str, tuple[float | None, bool]]:
        """Return the time of each drive's first stop frame, and whether its motor turns or should."""
        return {name: (at, turns) for name, (at, turns) in self._ask("stops").items()}


@contextmanager
def simulated_pumps(plant: Path, *before: str) -> Iterator[SimulatedPumps]:
    """Simulate the drives of a plant file in another process during the block.

    `before` are command-line words put before the command, such as `nice`.
    """
    words = [*before, sys.executable, __file__, str(plant)]
    with BoundProcess(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        try:
            if process.stdout.readline() != "ready\n":
                raise OSError("the simulator did not start")
            yield SimulatedPumps(process)
        finally:
            process.terminate()


# ---- the simulator process ----


def _stop_of(sim: MotorDrive) -> tuple[float | None, bool]:
    control = sim.drive.registers["control"].address
    stops = [at.time for at in sim.counters.writes if (at.address, at.raw) == (control, DeltaControl.STOP)]
    return min(stops, default=None), bool(sim.motor.goal) or sim.motor.energised


def _serve_words(sims: dict[str, MotorDrive], late: list[float]) -> None:
    for word in sys.stdin:
        if word.strip() == "run":
            for sim in sims.values():
                sim.counters.writes.clear()
                sim.motor.run(1)
            print("null", flush=True)
        elif word.strip() == "late":
            print(json.dumps(late[0]), flush=True)
            late[:] = [0.0]
        else:
            print(json.dumps({name: _stop_of(sim) for name, sim in sims.items()}), flush=True)


def _make_waves(sims: dict[str, MotorDrive], late: list[float]) -> None:
    due = time.monotonic()
    while True:
        now = time.monotonic()
        late[:] = [max(late[0], now - due)]
        due = now + WAVE_S
        for phase, sim in enumerate(sims.values()):
            sim.motor.load = 0.5 + 0.4 * math.sin(now / 3 + phase)
            sim.motor.target = 40.0 + 5.0 * math.sin(now / 7 + phase)
        time.sleep(WAVE_S)


def main(path: str) -> None:
    """Simulate the plant at `path` until terminated."""
    wires, sims = [], {}
    for line in Plant.load(path).lines:
        here = [simulated(polled.drive) for polled in line.drives]
        for sim in here:
            assert isinstance(sim, MotorDrive)
            sim.motor.deceleration_time = RAMP_S
            sims[sim.drive.name] = sim
        wires.append(Wire(here, name=line.name, port=str(line.port)))
    late = [0.0]  # longest time for which the process did not run, in s
    for work in (_serve_words, _make_waves):
        threading.Thread(target=work, args=(sims, late), daemon=True).start()
    serve(wires, lambda simulator: print("ready", flush=True))


if __name__ == "__main__":
    main(sys.argv[1])


# ---- simulated drives with parameters that their class does not declare, and their factory reset ----


def with_parameters(drive: Drive, codes: Iterable[str] = ()) -> MotorDrive:
    """Return the drive's simulation, to which parameters with these codes of its family are added."""
    sim = simulated(drive)
    assert isinstance(sim, MotorDrive)
    for code in codes:
        sim.memory.declare(parameters_of(type(drive))[code])
    return sim


def writable(drive: Drive, codes: Iterable[str]) -> list[Parameter]:
    return [one for code, one in parameters_of(type(drive)).items() if _is_there(code, one, codes)]


def _is_there(code: str, one: Parameter, codes: Iterable[str]) -> bool:
    return not one.never and (one.is_declared or code in codes)


def raw_of(sim: MotorDrive, one: Parameter) -> int:
    return sim.memory.of(one)[0].raw


def factory_reset(sim: MotorDrive, parameters: Iterable[Parameter]) -> None:
    """Set parameters to their factory values; if the manual prints none, to 0 or to their least value."""
    for one in parameters:
        low = one.span[0] if one.span else 0
        sim.memory.set(one, one.default if one.default is not None else low)
    sim.set_up()


def set_at_random(sim: MotorDrive, parameters: list[Parameter], random: Random) -> None:
    """Set parameters to random values within their limits."""
    for one in parameters:
        if one.values is None and not (one.at_least or one.at_most):
            low, high = one.coding.raw_span if one.span is None else map(one.coding.count_of, one.span)
            sim.memory.set_raw(one, random.randint(int(low), min(int(high), 0xFFFF)))
    sim.set_up()


def obey_the_line(sim: MotorDrive) -> None:
    """Let the line command the motor, if the drive's run source is a register."""
    source = sim.drive.registers.get("run_source")
    if source is not None and source.values is not None:
        sim["run_source"] = next(one for one in source.values if one.name.lower() == "line")


# ---- test files on a simulated plant: their text, and the simulator of their lines ----


CHE = {"model": "invt-che", "maximum_frequency": 50, "poll": ["output_frequency", "output_current", "fault"]}
STEPS = """
[[phase]]
name = "start"
[[phase.step]]
frequency = { fan = 10.0 }
start = ["fan"]

[[phase]]
name = "steps"
[[phase.step]]
frequency = { fan = [20.0, 30.0] }
dwell = "2 s"
"""


def write_test(folder: Path, text: str = STEPS, **drives: dict[str, Any]) -> Path:
    """Write a plant file and a test file; return the path of the test file.

    `drives` are keys of each drive's table by its name, by default of a `fan`. The line's port is a link in
    the folder.
    """
    plant = [f'[[line]]\nname = "hall"\nport = "{folder}/hall"']
    for address, (name, keys) in enumerate((drives or {"fan": CHE}).items(), 1):
        plant += ["[[line.drive]]", f'name = "{name}"', f"address = {address}"]
        plant += [
            f"{key} = {str(value) if isinstance(value, list) else repr(value)}" for key, value in keys.items()
        ]
    (folder / "plant.toml").write_text("\n".join(plant) + "\n")
    path = folder / "test.toml"
    path.write_text(f'plant = "plant.toml"\n{text}')
    return path


def far_ends(plan: RunPlan) -> list[Any]:
    """Return the simulated drives of a plan's line; their motors take 0.2 s to ramp up or down."""
    sims = [simulated(polled.drive) for polled in plan.plant.lines[0].drives]
    for sim in sims:
        for name in ("acceleration_time", "deceleration_time"):
            if name in sim.drive.registers and isinstance(sim, MotorDrive):
                sim[name] = 0.2
        if isinstance(sim, MotorDrive):
            sim.motor.acceleration_time = sim.motor.deceleration_time = 0.2
    return sims


@contextmanager
def simulated_test(
    path: Path, *, speed: float = 1.0, unpaced: bool = False
) -> Iterator[tuple[RunPlan, list[Any]]]:
    """Simulate the plant of a test file; yield the test and the simulated drives."""
    plan = load_test(path)
    sims = far_ends(plan)
    with Simulator([Wire(sims, port=plan.plant.lines[0].port, unpaced=unpaced)], speed=speed):
        yield plan, sims


def turning(sims: list[Any]) -> list[str]:
    """Return the names of the drives whose simulated motors are not switched off."""
    return [sim.drive.name for sim in sims if sim.motor.energised]
