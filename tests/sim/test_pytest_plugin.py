"""The pytest plugin, used by another package, whose tests are those of the page `Test your own program`."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from toy import Toy

from multidrop import Bus
from multidrop.pytest_plugin import SimulatedPlant
from multidrop.sim import DriveFaults, Faults, FaultyWire

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "testing.md"
PLANT = (
    '[[line]]\nname = "{0}"\nport = "{1}"\n[[line.drive]]\nname = "{0}-1"\nmodel = "yd1000"\naddress = 1\n'
)
CONFTEST = """
import sys
assert [name for name in sys.modules if name.startswith("multidrop.core")] == []
"""
LOADER = """
def test_multidrop_is_not_compiled_again():
    import multidrop.bus
    assert "Rewriting" not in type(multidrop.bus.__loader__).__name__
"""


@pytest.mark.slow
def test_ten_tests_of_another_package_pass_in_parallel(
    tmp_path: Path, simulated_plant: Callable[..., SimulatedPlant], run: Callable[..., tuple[int, str, str]]
) -> None:
    for name, text in re.findall(r"```(?:toml|python)\n# ([\w-]+\.\w+)\n(.*?)```", PAGE.read_text(), re.S):
        (tmp_path / name).write_text(text)
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_loader.py").write_text(LOADER)
    hall = simulated_plant(tmp_path / "plant.toml", speed=20)
    (port,) = hall.ports.items()
    poll = ["poll", tmp_path / "plant.toml", "--port", "=".join(port)]
    for seconds in (0.3, 3, 30):  # a busy machine needs longer for the first value
        rows, capture = tmp_path / f"{seconds}.csv", tmp_path / f"{seconds}.pcapng"
        assert run(*poll, "--seconds", seconds, "--out", rows, "--capture", capture)[0] == 0
        if re.search("pump-1,output_current,.*,ok", rows.read_text()):
            break
    capture.rename(tmp_path / "hall.pcapng")
    options = ["-q", "-n", "3", "-p", "no:cacheprovider", "-p", "no:benchmark"]
    command = [sys.executable, "-m", "pytest", *options]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=180)
    assert re.search(r"^11 passed", done.stdout, re.MULTILINE), done.stdout + done.stderr


def test_pytest_plugin_simulates_each_line_of_a_plant_at_a_port_of_its_kind(
    tmp_path: Path, simulated_plant: Callable[..., SimulatedPlant]
) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(PLANT.format("hall", "/dev/ttyUSB0") + PLANT.format("roof", "tcp://10.0.0.7"))
    both = simulated_plant(path, faults=Faults(hang_up=0.01))
    assert [port.partition(":")[0] for port in both.ports.values()] == ["socket", "tcp"]
    assert {line.name: line.port for line in both.plant.lines} == both.ports
    assert list(both.drives) == ["hall-1", "roof-1"]
    with pytest.raises(ValueError, match="has no drive 'hall-2'; did you mean hall-1"):
        simulated_plant(path, faults=Faults(drives={"hall-2": DriveFaults()}))


def test_pytest_plugin_sets_simulated_values_by_name(simulated_line: Callable[..., FaultyWire]) -> None:
    line = simulated_line(Toy(1), speed=50)
    line.drives[0]["output_frequency"] = 12.5
    with Bus(line.path) as bus:
        assert bus.attach(Toy, address=1).read("output_frequency") == 12.5
