"""Commands on tcp:// ports: simulate serves such a line, scan finds its drives, and poll reads them."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest
from commands import Run, running

from multidrop.families import ErmanERG220, InnovertIBD, InvtCHE
from multidrop.plant.loader import load_plant
from multidrop.sim import Simulator, Wire, simulated

PLANT = """
[[line]]
name = "net"
port = "{port}"

[[line.drive]]
name = "pump"
model = "innovert-ibd"
address = 1
poll = ["output_current"]
"""


@pytest.mark.long
def test_simulate_serves_a_line_of_a_plant_over_modbus_tcp(tmp_path: Path, run: Run) -> None:
    plant = tmp_path / "plant.toml"
    plant.write_text(PLANT.format(port="tcp://10.0.0.7"))
    with running("simulate", plant, "--ports", tmp_path / "ports", "--unpaced") as (_, said):
        ready, name, port = said.readline().split()
        assert (ready, name) == ("ready", "net")
        assert port.startswith("tcp://127.0.0.1:")
        status, shown, _ = run("read", port, "innovert-ibd", "1", "output_current")
        assert status == 0
        assert "output_current" in shown


@pytest.mark.long
def test_a_local_port_is_served_as_the_plant_names_it(tmp_path: Path, run: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    plant = tmp_path / "plant.toml"
    plant.write_text(PLANT.format(port=port))
    with running("simulate", plant, "--unpaced") as (_, said):
        assert said.readline() == f"ready net {port}\n"
        assert "output_current" in run("read", plant, "pump", "output_current")[1]


def test_simulating_a_serial_line_needs_a_directory_for_its_port(tmp_path: Path, run: Run) -> None:
    plant = tmp_path / "plant.toml"
    plant.write_text(PLANT.format(port="/dev/ttyUSB0"))
    assert run("simulate", plant)[::2] == (
        2,
        "multidrop: line net needs a pseudo-terminal: add --ports DIR\n",
    )


@pytest.mark.long
def test_scan_finds_drives_behind_a_gateway_and_writes_their_plant_file(tmp_path: Path, run: Run) -> None:
    sims = [simulated(drive) for drive in (InnovertIBD(1), InvtCHE(2), ErmanERG220(3))]
    out = tmp_path / "found.toml"
    with Simulator([Wire(sims, port="tcp://127.0.0.1:0", unpaced=True)]) as line:
        port = line.wires[0].path
        status, _, complaint = run("scan", port, "--addresses", "1-3", "--out", str(out))
        assert status == 0, complaint
        (found,) = load_plant(out).lines
        assert found.port == port
        models = {polled.drive.address: polled.drive.model for polled in found.drives}
        assert models == {1: "innovert-ibd", 2: "invt-che", 3: "erman-er-g-220"}
        status, _, _ = run("poll", str(out), "--seconds", "1", "--out", str(tmp_path / "run.csv"))
        assert status == 0
    assert "ok" in (tmp_path / "run.csv").read_text()
