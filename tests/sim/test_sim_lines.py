"""Simulated lines on real ptys and TCP ports, used by independent clients and by the pytest plugin."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import checksums
import pytest
from commands import descriptors, threads
from lines import Own, until
from peers import require_module, require_program
from ptys import opened, receive
from tables import table
from toy import QuickToy, Toy

from multidrop import YD1000, Bus, NoReply
from multidrop.core import Framing, Message, build_request, parse_reply, reply_length, set_settings
from multidrop.drive import Drive
from multidrop.families.delixi import DelixiNative
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE, parameter
from multidrop.pytest_plugin import SimulatedPlant
from multidrop.sim import (
    DriveFaults,
    EncodedDrive,
    Faults,
    FaultyWire,
    SimulatedDrive,
    Simulator,
    Wire,
    encoded,
    serve,
    simulated,
)

READ = Message(1, 0x03, 0x3000, 2)  # a read request to an INVT CHE


def wire(*, unpaced: bool = True, port: str = "pty") -> Wire:
    return Wire([EncodedDrive(InvtCHE(1))], unpaced=unpaced, port=port)


def expected(address: int = 1) -> bytes:
    table = InvtCHE.output_frequency.table
    return b"".join(encoded(address, table, at).to_bytes(2) for at in (0x3000, 0x3001))


def exchange(fd: int, request: Message, framing: Framing = Framing.RTU) -> Message:
    os.write(fd, build_request(framing, request))
    received = receive(fd, reply_length(framing, request))
    used, reply = parse_reply(framing, received, request)
    assert used == len(received)
    assert reply is not None
    return reply


@table("port", ["pty", "socket://127.0.0.1:0"])
@table("unpaced", [True, False], ids=["unpaced", "paced"])
def test_simulated_port_can_be_opened_and_read_repeatedly(port: str, unpaced: bool) -> None:
    with Simulator([wire(port=port, unpaced=unpaced)]) as sim:
        for _ in range(3):
            with opened(sim.wires[0].path) as fd:
                assert exchange(fd, READ).data == expected()
            time.sleep(0.005)  # a paced line needs silence before the next request


def test_ended_simulator_leaves_no_thread_or_descriptor() -> None:
    before = descriptors(), threads()
    for port in ("pty", "socket://127.0.0.1:0"):
        with Simulator([wire(port=port), wire()]) as sim:
            with opened(sim.wires[0].path) as fd:
                exchange(fd, READ)
            assert threads() == before[1] + 1
    assert (descriptors(), threads()) == before


def test_one_thread_simulates_many_lines() -> None:
    wires = [Wire([EncodedDrive(InvtCHE(at))], unpaced=True) for at in range(1, 65)]
    before = threads()
    with Simulator(wires) as sim:
        assert threads() == before + 1
        for at, each in enumerate(sim.wires, 1):
            with opened(each.path) as fd:
                assert exchange(fd, Message(at, 3, 0x3000, 2)).data == expected(at)


def test_reply_on_a_paced_line_is_never_faster_than_a_serial_line() -> None:
    with Simulator([wire(unpaced=False)]) as sim, opened(sim.wires[0].path) as fd:
        begin = time.monotonic()
        exchange(fd, READ)
        taken = time.monotonic() - begin
    delay = sim.wires[0].drives[0].delay
    # without an upper limit, because the test machine may be busy
    assert taken >= (8 + 9) * 10 / 9600 + delay


def test_simulator_serves_a_second_tcp_client_after_the_first_disconnects() -> None:
    with Simulator([wire(port="socket://127.0.0.1:0")]) as sim, ExitStack() as clients:
        path = sim.wires[0].path
        with opened(path) as first:
            exchange(first, READ)
            second = clients.enter_context(opened(path))
            os.write(second, build_request(Framing.RTU, READ))
            assert receive(second, 1, patience=0.05) == b""
        assert parse_reply(Framing.RTU, receive(second, 9), READ)[0] == 9


def test_simulator_serves_a_second_tcp_client_after_a_connection_reset() -> None:
    """The connection of a killed client ends like this: with unread bytes and a reset of the connection."""
    with Simulator([wire(port="socket://127.0.0.1:0")]) as sim:
        path = sim.wires[0].path
        host, _, port = path.removeprefix("socket://").partition(":")
        with socket.create_connection((host, int(port))) as first:
            exchange(first.fileno(), READ)
            first.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        with opened(path) as second:
            assert exchange(second, READ).data == expected()


class Broken(Wire):
    """A wire whose method `distort`, which every reply passes, raises an exception."""

    def distort(self, reply: bytes) -> bytes:
        raise ZeroDivisionError("a mistake of the test's own")


def ask_in_vain(broken: Wire) -> None:
    with Simulator([broken]) as sim, opened(broken.path) as fd:
        os.write(fd, build_request(Framing.RTU, READ))
        until(lambda: sim.failure)


def test_exception_in_the_simulator_thread_is_raised_on_exit() -> None:
    with pytest.raises(ZeroDivisionError, match="a mistake of the test's own"):
        ask_in_vain(Broken([EncodedDrive(InvtCHE(1))], unpaced=True))


def test_simulated_drives_with_three_framings_reply_on_one_line() -> None:
    drives = [
        EncodedDrive(InvtCHE(1)),
        simulated(InnovertIBD(2, framing="ascii")),
        simulated(DelixiNative(3)),
    ]
    with Simulator([Wire(drives, unpaced=True)]) as sim, opened(sim.wires[0].path) as fd:
        assert exchange(fd, READ).data == expected()
        assert exchange(fd, Message(2, 3, 22, 1), Framing.ASCII).data == b"\x18\x00"
        assert exchange(fd, Message(3, 3, data=bytes(4)), Framing.DELIXI).start == 1
        assert exchange(fd, READ).data == expected()


def test_simulated_drives_ignore_a_client_at_another_baud_rate() -> None:
    drives = [EncodedDrive(InvtCHE(1)), simulated(ErmanERG220(2))]  # the baud rates are 9600 and 38400
    state = Message(2, 4, 0x0400, 4)
    with Simulator([Wire(drives, unpaced=True)]) as sim:
        path = sim.wires[0].path
        with opened(path, 38400) as fd:
            os.write(fd, build_request(Framing.RTU, READ))
            assert receive(fd, 1, patience=0.05) == b""
            assert exchange(fd, state).data == bytes(8)
            set_settings(fd, 9600, "8N1")
            assert exchange(fd, READ).data == expected()
            os.write(fd, build_request(Framing.RTU, state))
            assert receive(fd, 1, patience=0.05) == b""


def test_simulated_drive_answers_a_valid_frame_after_garbage() -> None:
    with Simulator([wire()]) as sim, opened(sim.wires[0].path) as fd:
        for garbage in (b"\x00", bytes(range(256)), b":::" * 2000, b"\xff" * 5000):
            os.write(fd, garbage)
            time.sleep(0.03)  # longer than the silence that ends a frame on a wire without delays
            assert exchange(fd, READ).data == expected()


def test_simulated_drive_refuses_a_request_with_an_unknown_function() -> None:
    with Simulator([Wire([simulated(ErmanERG220(1))])]) as sim, opened(sim.wires[0].path, 38400) as fd:
        os.write(fd, checksums.rtu("01 2B"))
        assert receive(fd, 5) == checksums.rtu("01 AB 01")


def test_simulated_pty_is_opened_through_its_link(tmp_path: Path) -> None:
    link = tmp_path / "hall-1"
    with Simulator([wire(port=str(link))]) as sim:
        assert sim.wires[0].path == str(link)
        with opened(str(link)) as fd:
            assert exchange(fd, READ).data == expected()
        with pytest.raises(FileExistsError), Simulator([wire(), wire(port=str(link))]):
            pass
    assert not link.is_symlink()


@pytest.mark.parametrize("url", ["socket://127.0.0.1", "socket://:5020"])
def test_simulated_tcp_port_without_host_or_port_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match=r"socket://host:port, such as"), Simulator([wire(port=url)]):
        pass


def _serve(link: str, connection: Connection) -> None:
    serve([wire(port=link)], lambda simulator: connection.send(simulator.wires[0].path))


@pytest.mark.long
def test_terminated_simulator_process_removes_its_link(tmp_path: Path) -> None:
    link = tmp_path / "hall-1"
    ours, theirs = multiprocessing.Pipe()
    arguments = (str(link), theirs)
    process = multiprocessing.get_context("spawn").Process(target=_serve, args=arguments, daemon=True)
    process.start()
    try:
        assert ours.poll(60)
        with opened(ours.recv()) as fd:
            assert exchange(fd, READ).data == expected()
    finally:
        process.terminate()
        process.join()
    assert process.exitcode == 0
    assert not link.is_symlink()


PATIENCE = 60.0


def test_signal_to_another_thread_ends_the_simulator() -> None:
    """The signal goes to another thread, so its handler does not run before the main thread sleeps."""

    def terminate() -> None:
        time.sleep(0.05)
        signal.pthread_kill(threading.get_ident(), signal.SIGTERM)

    def end_at_last() -> None:
        if not over.wait(PATIENCE):
            late.append(True)
            simulators[0].interrupt()

    over = threading.Event()
    late: list[bool] = []
    simulators: list[Simulator] = []
    threads = [threading.Thread(target=each) for each in (terminate, end_at_last)]

    def begin(simulator: Simulator) -> None:
        simulators.append(simulator)
        for thread in threads:
            thread.start()

    serve([Wire([simulated(Own(1))])], begin)
    over.set()
    for thread in threads:
        thread.join()
    assert not late


class Ill(Exception):
    """Raised by a simulated drive in a test."""


class IllDrive(EncodedDrive):
    def receive(self, frame: Any) -> Any:
        raise Ill("of this drive")


@pytest.mark.long
def test_failing_simulated_drive_does_not_disturb_other_lines(caplog: pytest.LogCaptureFixture) -> None:
    wires = [Wire([drive], unpaced=True) for drive in (IllDrive(Toy(1)), EncodedDrive(Toy(1)))]
    simulator = Simulator(wires)

    def ask() -> None:
        with simulator, Bus(wires[0].path) as ill, Bus(wires[1].path) as well:
            for _ in range(2):
                with pytest.raises(NoReply):
                    (ill.drives[0] if ill.drives else ill.attach(QuickToy, 1)).read(Toy.output_current)
                drive = well.drives[0] if well.drives else well.attach(Toy, 1)
                drive.read(Toy.output_current)
            assert isinstance(simulator.failure, Ill)

    with pytest.raises(Ill, match="of this drive"):
        ask()
    assert [record.name for record in caplog.records if record.levelname == "ERROR"] == ["multidrop.sim"]


def test_failure_of_the_simulator_thread_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    simulator = Simulator([Wire([EncodedDrive(Toy(1))])])

    def fail(*details: object) -> None:
        raise Ill("of select")

    monkeypatch.setattr("multidrop.sim.simulator.select", SimpleNamespace(select=fail))
    simulator.__enter__()
    until(lambda: isinstance(simulator.failure, Ill))
    with pytest.raises(Ill, match="of select"):
        simulator.__exit__()
    assert "no drive answers any more" in caplog.text


@pytest.mark.slow
def test_option_speed_makes_simulated_time_pass_faster() -> None:
    """With `speed=20` a motor's ramp of 10 s takes less than one second."""
    sim = simulated(YD1000(1))
    with Simulator([Wire([sim])], speed=20) as simulator, Bus(simulator.wires[0].path) as bus:
        fan = bus.attach(YD1000, 1)
        fan.set_frequency(50.0)
        fan.start()
        until(lambda: fan.read(fan.output_frequency) == 50.0)
        assert sim.now > 10 * time.monotonic()  # `now` is the simulated time in s


@table("speed", [0, -1, float("inf"), float("nan")])
def test_simulator_refuses_an_invalid_speed(speed: float) -> None:
    with pytest.raises(ValueError, match="is not a positive number"):
        Simulator([], speed=speed)


class MyCHE(InvtCHE):
    acceleration_time = parameter(11, "s", step=0.1)


def mbpoll(
    sim: SimulatedDrive, options: str, *values: int, wait: str = "10"
) -> subprocess.CompletedProcess[str]:
    """Run mbpoll once to read from this drive, or to write the values. `wait` is its timeout in s."""
    program = require_program("mbpoll")
    baudrate, address = str(sim.drive.settings.baudrate), str(sim.drive.address)
    with Simulator([Wire([sim])]) as simulator:
        line = [program, "-q", "-m", "rtu", "-b", baudrate, "-P", "none", "-o", wait, "-a", address, "-0"]
        line += [*options.split(), simulator.wires[0].path, *map(str, values)]
        return subprocess.run(line, capture_output=True, text=True, timeout=120)


def values(done: subprocess.CompletedProcess[str]) -> list[str]:
    """Return the texts after "[address]:" in the output of mbpoll."""
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
    done = mbpoll(simulated(InnovertIBD(1)), "-r 50 -c 1 -t 4 -1", wait="0.1")
    assert done.returncode == 1
    assert "timed out" in done.stderr


def test_pymodbus_reads_and_writes_a_simulated_drive_in_ascii_framing() -> None:
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


# ---- the pytest plugin; tests of another package are those of the page `Test your own program` ----


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
def test_documented_pytest_examples_pass_in_parallel_processes(
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


def test_pytest_plugin_simulates_serial_and_tcp_lines_of_a_plant(
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
