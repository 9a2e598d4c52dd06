"""An interruption during the opening of a poller's ports leaves no port open."""

from __future__ import annotations

import threading

import pytest
from lines import ANY_PORT, PATIENCE, line, plant, polled
from toy import Toy

from multidrop.bus import Bus
from multidrop.poller import Poller
from multidrop.sim import Simulator, Wire, simulated


@pytest.mark.parametrize("interrupted", [0, 1, 2])
def test_no_port_stays_open(monkeypatch: pytest.MonkeyPatch, interrupted: int) -> None:
    """Neither one that was opened before it, nor one that is opened while it is passed on."""
    wires = [Wire([simulated(Toy(1))], unpaced=True, port=ANY_PORT) for _ in range(3)]
    buses: list[Bus] = []
    open_bus, others_are_open = Bus.__init__, threading.Semaphore(0)

    def opened(bus: Bus, port: str, **details: object) -> None:
        if port == simulator.wires[interrupted].path:
            for _ in range(2):
                assert others_are_open.acquire(timeout=PATIENCE)
            raise KeyboardInterrupt
        open_bus(bus, port, **details)  # type: ignore[arg-type]
        buses.append(bus)
        others_are_open.release()

    with Simulator(wires) as simulator:
        declared = [
            line(wire.path, polled(Toy(1, name=f"fan-{n}"), [Toy.output_current], None), name=f"line-{n}")
            for n, wire in enumerate(simulator.wires)
        ]
        monkeypatch.setattr(Bus, "__init__", opened)
        with pytest.raises(KeyboardInterrupt):
            Poller(plant(*declared))
        assert len(buses) == 2
        assert not any(bus.is_open for bus in buses)
