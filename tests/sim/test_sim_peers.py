"""Masters by other authors read and write simulated drives: mbpoll over RTU, pymodbus over ASCII."""

from __future__ import annotations

import subprocess

from peers import require_module, require_program
from tables import table

from multidrop.drive import Drive
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE, parameter
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated


class MyCHE(InvtCHE):
    acceleration_time = parameter(11, "s", step=0.1)


def mbpoll(sim: SimulatedDrive, options: str, *values: int) -> subprocess.CompletedProcess[str]:
    """Run mbpoll once against this drive to read, or to write the values; a pty has no parity."""
    program = require_program("mbpoll")
    baudrate, address = str(sim.drive.settings.baudrate), str(sim.drive.address)
    with Simulator([Wire([sim])]) as simulator:
        line = [program, "-q", "-m", "rtu", "-b", baudrate, "-P", "none", "-o", "1", "-a", address, "-0"]
        line += [*options.split(), simulator.wires[0].path, *map(str, values)]
        return subprocess.run(line, capture_output=True, text=True, timeout=120)


def values(done: subprocess.CompletedProcess[str]) -> list[str]:
    """Return the text behind "[address]:" in mbpoll's output."""
    assert done.returncode == 0, done.stderr
    return [line.split()[1] for line in done.stdout.splitlines() if line.startswith("[")]


@table(
    ("drive", "name", "value", "options", "shown"),
    [
        (ErmanERG220(1), "output_frequency", 28.5, "-r 1 -c 1 -t 3 -1", ["285"]),
        (ErmanERG220(31), "maximum_frequency", 60, "-r 3 -c 1 -t 4 -1", ["600"]),
        (InvtCHE(247), "output_voltage", 231, "-r 12291 -c 1 -t 4 -1", ["231"]),
        (InnovertIBD(1), "output_current", 2.5, "-r 3 -c 1 -t 4 -1", ["25"]),
    ],
)
def test_mbpoll_reads_registers_of_a_simulated_drive(
    drive: Drive, name: str, value: float, options: str, shown: list[str]
) -> None:
    sim = simulated(drive)
    sim[name] = value
    assert values(mbpoll(sim, options)) == shown


@table(
    ("drive", "options", "raw", "name", "value"),
    [
        (ErmanERG220(1), "-r 2 -t 4", [285], "frequency", 28.5),
        (ErmanERG220(1), "-r 12 -t 4", [200, 400], "deceleration_time", 40),
        (ErmanERG220(1), "-r 0 -t 0", [1], "start_coil", 1),
        (MyCHE(1), "-r 11 -t 4", [70], "acceleration_time", 7),
        (InnovertIBD(1), "-r 107 -t 4", [200], "acceleration_time", 20),
    ],
)
def test_mbpoll_writes_a_register_of_a_simulated_drive(
    drive: Drive, options: str, raw: list[int], name: str, value: float
) -> None:
    sim = simulated(drive)
    done = mbpoll(sim, options, *raw)
    assert done.returncode == 0, done.stderr
    assert sim[name] == value


def test_mbpoll_reports_the_drives_exception() -> None:
    done = mbpoll(simulated(InvtCHE(1)), "-r 32779 -c 1 -t 4 -1")
    assert done.returncode == 1
    assert "Illegal data address" in done.stderr


def test_mbpoll_times_out_if_the_drive_does_not_reply() -> None:
    done = mbpoll(simulated(InnovertIBD(1)), "-r 50 -c 1 -t 4 -1")
    assert done.returncode == 1
    assert "timed out" in done.stderr


def test_pymodbus_reads_and_writes_over_ascii() -> None:
    client = require_module("pymodbus.client")
    framer = require_module("pymodbus").FramerType.ASCII
    sim = simulated(InnovertIBD(240, framing="ascii"))
    with Simulator([Wire([sim])]) as simulator:
        master = client.ModbusSerialClient(simulator.wires[0].path, framer=framer, baudrate=9600, timeout=60)
        assert master.connect()
        try:
            assert master.read_holding_registers(22, count=1, device_id=240).registers == [0x1800]
            assert not master.write_register(107, 200, device_id=240).isError()
            assert master.read_holding_registers(107, count=2, device_id=240).registers == [200, 100]
        finally:
            master.close()
    assert sim["acceleration_time"] == 20
