"""Two simulated lines with two drives each, whose motors a test can watch while it changes the plant."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from lines import PATIENCE, line, polled, until
from toy import QuickToy, Toy

from multidrop.plant.model import PlantLine, PolledDrive
from multidrop.poller import Poller
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated

CURRENT, STATUS = Toy.registers["output_current"], Toy.registers["status"]


class TwoLines:
    """Two lines with two simulated drives each."""

    def __init__(self, port: str = "pty") -> None:
        self.pumps, self.fans = (
            {address: simulated(QuickToy(address)) for address in (1, 2)} for _ in ("hall", "yard")
        )
        self.simulator = Simulator(
            [Wire([*drives.values()], unpaced=True, port=port) for drives in (self.pumps, self.fans)]
        )

    def __enter__(self) -> TwoLines:
        self.simulator.__enter__()
        return self

    def __exit__(self, *failure: object) -> None:
        self.simulator.__exit__(None, None, None)

    def hall(self, *addresses: int, every: float | None = 0.02) -> PlantLine:
        return self._line(0, "hall", "pump", addresses, every)

    def yard(self, *addresses: int, every: float | None = 0.02) -> PlantLine:
        return self._line(1, "yard", "fan", addresses, every)

    def _line(
        self, number: int, name: str, drive: str, addresses: tuple[int, ...], every: float | None
    ) -> PlantLine:
        drives = [quick(f"{drive}-{address}", address, every) for address in addresses or (1, 2)]
        return line(self.simulator.wires[number].path, *drives, name=name)


def quick(name: str, address: int, every: float | None = 0.02) -> PolledDrive:
    return polled(QuickToy(address, name=name), [CURRENT, STATUS], every)


def samples(poller: Poller, drive: str) -> int:
    return sum(
        figures.samples
        for each in poller.statistics().values()
        for name, figures in each.drives.items()
        if name == drive
    )


def runs(drive: SimulatedDrive) -> bool:
    return drive["control"] == 1


class Blocked:
    """Blocks calls until its `with` block ends, and then waits for the threads that `start` has started."""

    def __init__(self) -> None:
        self._reached, self._go_on = threading.Event(), threading.Event()
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> Blocked:
        return self

    def __exit__(self, *failure: object) -> None:
        self._go_on.set()
        for thread in self._threads:
            thread.join(PATIENCE)
            assert not thread.is_alive()

    def blocking(
        self, act: Callable[..., Any], when: Callable[..., bool] = lambda *_: True
    ) -> Callable[..., Any]:
        """Return a function that calls `act`. If `when` is true, it first waits for the end of the block."""

        def blocked(*arguments: Any, **details: Any) -> Any:
            if when(*arguments):
                self._reached.set()
                assert self._go_on.wait(PATIENCE)
            return act(*arguments, **details)

        return blocked

    def await_call(self) -> None:
        """Wait until a call is blocked."""
        assert self._reached.wait(PATIENCE)

    @property
    def is_blocking(self) -> bool:
        """True if each thread is still alive."""
        return all(thread.is_alive() for thread in self._threads)

    def start(self, act: Callable[..., object], *arguments: object) -> threading.Thread:
        """Call `act` on a new thread; return the thread."""
        self._threads.append(threading.Thread(target=act, args=arguments))
        self._threads[-1].start()
        return self._threads[-1]


def until_sampled(poller: Poller, drive: str) -> None:
    until(lambda: samples(poller, drive) > 5)


def note_writes(sim: SimulatedDrive, writes: list[int]) -> None:
    """Append the address of each register that is written to the drive to `writes`."""
    write = sim.write

    def noted(function: int, start: int, values: list[int]) -> None:
        writes.append(start)
        write(function, start, values)

    vars(sim)["write"] = noted
