"""Simulate the drives of a plant file, so that the examples run without hardware."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from multidrop import Plant
from multidrop.sim import Simulator, Wire, simulated


@contextmanager
def simulated_plant(text: str, wire_of: Callable[..., Wire] = Wire) -> Iterator[Plant]:
    """Simulate the plant of this plant file's text, and yield it; `{ports}` becomes a temporary directory.

    `wire_of` makes a wire from simulated drives and `port`, the path of its port.
    """
    with TemporaryDirectory() as directory:
        path = Path(directory) / "plant.toml"
        path.write_text(text.replace("{ports}", directory))
        plant = Plant.load(path)
        wires = [
            wire_of([simulated(polled.drive) for polled in line.drives], port=line.port)
            for line in plant.lines
        ]
        with Simulator(wires):
            yield plant
