"""Find stops among a simulated line's frames, and let threads act between frames."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from motors import MAKE, STARTS
from simulated_bus import SimulatedBus, is_write, one

from multidrop.core import Completion, Exchange, Message
from multidrop.drive import Condition, Direction, Drive, Script, State, read, write
from multidrop.drive.register import Kept, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import BusError
from multidrop.families import InvtCHE
from multidrop.sim import simulated

STOPS: dict[str, Callable[[Message], bool]] = {  # by family: whether a request is its documented stop
    "erman-er-g-220": lambda each: each.function == 5 and each.start == 1 and each.data != b"\0\0",
    "invt-che": lambda each: each.start == 0x1000 and each.data[-1] == 5,
    "innovert-ibd": lambda each: each.start == 0x2000 and each.data[-1] == 1,
    "delixi-modbus": lambda each: each.start == 0x2000 and each.data[-1] == 1,
    "delixi-native": lambda each: each.function == 2 and each.start == 1,
    "yd1000": lambda each: each.start == 0x1000 and each.data[0] == 0xC0,
}


class Own(Drive):
    """A user's drive whose stop is a setting that wears the EEPROM."""

    model = "own"
    title = "OWN 1"
    speed = reading(0x10, "rpm")
    run = setting(0x20, kept=Kept.EEPROM)
    ratio = setting(0x21, kept=Kept.RAM)

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor."""
        yield from read(self.speed)
        yield from write(self.run, 1)

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor."""
        yield from write(self.run, 0)

    @verb
    def state(self) -> Script[State]:
        """Return the state that the drive reports."""
        speed = yield from read(self.speed)
        return State(Condition.RUNNING if speed else Condition.STOPPED)


def writes(line: SimulatedBus, begun: int = 0) -> list[Message]:
    return [request for request, _ in line.frames[begun:] if is_write(request)]


def starts(line: SimulatedBus, model: str) -> list[str]:
    """Return the frames sent so far that start a motor of this family."""
    return [frame for request, frame in line.frames if is_write(request) and STARTS[model](request)]


def all_stopped(line: SimulatedBus, sims: list[Any]) -> bool:
    """Return True if no motor turns."""
    for sim in sims:
        sim.pass_time(line.seconds)
    return not any(sim.motor.energised for sim in sims)


def first(line: SimulatedBus, begun: int, met: Callable[[Message], bool]) -> int | None:
    """Return how many frames from `begun` on precede the first write that `met` accepts, or None."""
    wanted = (at for at, (each, _) in enumerate(line.frames[begun:]) if is_write(each) and met(each))
    return next(wanted, None)


class Meanwhile:
    """After a number of further frames, lets another thread act, and waits for that thread."""

    def __init__(self, line: SimulatedBus, frames: int, act: Callable[[], object]) -> None:
        self.failure: BaseException | None = None
        self.has_come = False
        self._left = frames
        self._act = act
        self._carry_out = line.carry_out
        vars(line)["carry_out"] = self.carry_out

    def carry_out(self, exchange: Exchange, **times: Any) -> Completion:
        completion = self._carry_out(exchange, **times)
        self._left -= 1
        if self._left == 0:
            self.has_come = True
            thread = threading.Thread(target=self._run)
            thread.start()
            thread.join(120)
            assert not thread.is_alive()
        return completion

    def _run(self) -> None:
        try:
            self._act()
        except BaseException as failure:
            self.failure = failure


def che_drives(
    count: int = 1, *, hz: float = 20, runs_s: float | None = None
) -> tuple[SimulatedBus, list[Any], list[Any]]:
    """Return a simulated bus, its INVT CHE drives, whose setpoints are written, and their simulations.

    If `runs_s` is given, all motors have been running for this many seconds.
    """
    sims: list[Any] = [simulated(InvtCHE(address, maximum_frequency=50)) for address in range(1, count + 1)]
    line = SimulatedBus(*sims)
    drives: list[Any] = [line.attach(sim.drive) for sim in sims]
    for drive in drives:
        drive.set_frequency(hz)
        if runs_s is not None:
            drive.start()
    line.sleep(runs_s or 0)
    return line, drives, sims


def plain_stop(drive: Drive) -> tuple[Any, Any]:
    register = drive.registers.get("control") or drive.register("stop_coil")
    assert register.harmless
    return register, register.decode(register.harmless[-1])


def started_while(
    tmp_path: Path, model: str, frames: int, act: Callable[[SimulatedBus, Any], object]
) -> tuple[SimulatedBus, Any, Meanwhile, int, BaseException | None]:
    """Start a drive while another thread acts after `frames` frames.

    Returns the bus, the drive, the action, the number of frames before the start, and its error or None.
    """
    line, drive, _ = one(MAKE[model](1), ledger=tmp_path / f"wear-{frames}")
    drive.set_frequency(20)
    begun = len(line.frames)
    meanwhile = Meanwhile(line, frames, lambda: act(line, drive))
    failure = None
    try:
        drive.start()
    except BusError as error:
        failure = error
    return line, drive, meanwhile, begun, failure
