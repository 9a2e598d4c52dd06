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
    """Simulate the plant file `text` and yield its plant; `{ports}` is replaced by a temporary directory.

    `wire_of` is called with a line's simulated drives and `port`, the path of its port, and returns a Wire.
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
