"""A drive that was attached to a poller's bus by hand: it is on the line, and not polled."""

from __future__ import annotations

from pathlib import Path

import pytest
from lines import until

from multidrop.families import YD1000
from multidrop.plant.loader import load_plant
from multidrop.poller import Poller
from multidrop.sim import Simulator, Wire, simulated

PLANT = """
[[line]]
name = "a"
port = "{port}"

[[line.drive]]
name = "pump"
model = "yd1000"
address = 1
poll = ["output_frequency"]
"""


@pytest.mark.slow
def test_it_is_beside_the_polled_ones(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    with Simulator([Wire([simulated(YD1000(1)), simulated(YD1000(9))])]) as simulator:
        path.write_text(PLANT.format(port=simulator.wires[0].path))
        poller = Poller(load_plant(path))
        extra = poller.bus("a").attach(YD1000, 9)
        with poller:
            assert extra.read(extra.output_frequency) == 0
            until(lambda: any(row.drive == "pump" for row in poller.take() or ()))
            with pytest.raises(ValueError, match="is not polled here; there are pump"):
                poller.set_rate(extra, None, 1.0)
