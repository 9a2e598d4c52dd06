"""multidrop on Windows, with Wine: Ctrl-C, port names, ports that vanish, consoles, paths.

`MULTIDROP_WINE=FOLDER pytest -n 0 -m "" tests/windows` runs these tests. They are skipped without a folder
that `tools/wine make` has filled.
"""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from commands import BoundProcess
from motors import ReceivedRequests

from multidrop.families import InvtCHE
from multidrop.recording import open_recording
from multidrop.sim import MotorDrive, Simulator, Wire, simulated

PATIENCE_S = 300.0  # a busy machine needs a minute to start Python in Wine
SIZE = 50, 400  # rows and columns: wide enough that no sentence wraps
NOWHERE = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
ESCAPES = re.compile(r"\x1b(\[[0-9;?]*[A-Za-z]|\][^\x07]*\x07)")


class Console:
    """A Windows program and its console output."""

    def __init__(self, folder: Path, words: list[str], environment: dict[str, str]) -> None:
        self._heard = b""
        self._status: int | None = None
        self._pid, self._terminal = pty.fork()
        if self._pid == 0:
            termios.tcsetwinsize(0, SIZE)
            os.execvpe("wine", ["wine", str(folder / "python" / "python.exe"), *words], environment)

    def _hear(self) -> None:
        """Read the output continuously, because a program whose terminal is full would block."""
        while select.select([self._terminal], [], [], 0.01)[0]:
            try:
                self._heard += os.read(self._terminal, 4096)
            except OSError:  # end of the terminal
                time.sleep(0.01)
                return

    @property
    def said(self) -> str:
        return ESCAPES.sub("", self._heard.decode("utf-8", "replace"))

    @property
    def is_over(self) -> bool:
        if self._status is None:
            found, status = os.waitpid(self._pid, os.WNOHANG)
            self._status = os.waitstatus_to_exitcode(status) if found else None
        return self._status is not None

    def until(self, met: Callable[[], object]) -> None:
        end = time.monotonic() + PATIENCE_S
        while not met():
            self._hear()
            assert time.monotonic() < end, f"not met; it said {self.said!r}"

    def until_said(self, text: str) -> None:
        self.until(lambda: text in self.said)

    def press_ctrl_c(self) -> None:
        os.write(self._terminal, b"\x03")

    def status(self) -> int:
        """Wait for the program's end; return its exit status."""
        self.until(lambda: self.is_over)
        assert self._status is not None
        return self._status

    def kill(self) -> None:
        """Kill the program like `kill -9`."""
        if not self.is_over:
            os.kill(self._pid, signal.SIGKILL)
            self.status()

    def close(self) -> None:
        self.kill()
        os.close(self._terminal)


class Wine:
    """A folder that `tools/wine make` has filled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.environment = os.environ | {
            "WINEPREFIX": str(self.folder / "wine"),
            "WINEDEBUG": "-all",
            "WINEDLLOVERRIDES": "mscoree,mshtml=",
            "LC_ALL": "C.UTF-8",
            "TERM": "xterm",
        }

    def _port(self, name: str) -> Path:
        return self.folder / "wine" / "dosdevices" / name

    def terminal_of(self, name: str) -> str:
        return str(self._port(name).readlink())

    def link(self, name: str, terminal: str) -> None:
        """Assign a terminal to the COM port of this name."""
        port = self._port(name)
        port.unlink(missing_ok=True)
        port.symlink_to(terminal)

    def begin(self) -> None:
        """Start Wine's services without pipes, which they would keep open."""
        line = ["wine", str(self.folder / "python" / "python.exe"), "-c", ""]
        subprocess.run(line, env=self.environment, check=True, timeout=PATIENCE_S, **NOWHERE)

    def run(self, *words: object) -> subprocess.CompletedProcess[bytes]:
        """Run Windows Python with these arguments to its end, with pipes for input and output."""
        line = ["wine", str(self.folder / "python" / "python.exe"), *map(str, words)]
        pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.run(line, env=self.environment, check=False, timeout=PATIENCE_S, **pipes)

    def type_line(self, line: str, folder: Path) -> int:
        """Run Windows Python with these arguments by the Windows shell; return the exit status."""
        typed = folder / "typed.bat"
        program = f"Z:{self.folder}/python/python.exe".replace("/", "\\")
        typed.write_text(f"@{program} {line}\r\n", "ascii")
        shell = ["wine", "cmd", "/c", typed.name]
        ran = subprocess.run(
            shell, cwd=folder, env=self.environment, check=False, timeout=PATIENCE_S, **NOWHERE
        )
        return ran.returncode

    @contextmanager
    def console(self, *words: object) -> Iterator[Console]:
        """Start Windows Python on a console."""
        console = Console(self.folder, list(map(str, words)), self.environment)
        try:
            yield console
        finally:
            console.close()


FOLDER = os.environ.get("MULTIDROP_WINE", "")
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not FOLDER, reason="needs Wine, and MULTIDROP_WINE to name a folder of tools/wine"),
]


@pytest.fixture(scope="module")
def wine() -> Iterator[Wine]:
    """Yield a Wine folder. Wine's server is in another session, so it survives when a terminal is removed."""
    found = Wine(Path(FOLDER))
    subprocess.run(["wineserver", "-w"], env=found.environment, check=True)
    with BoundProcess(["wineserver", "-f", "-p"], env=found.environment) as server:
        found.begin()
        yield found
        subprocess.run(["wineserver", "-k"], env=found.environment, check=False)
        server.wait()


@pytest.fixture
def pump(wine: Wine) -> Iterator[MotorDrive]:
    """A drive on COM5."""
    with on_com5(wine) as drive:
        yield drive


PLANT = """
[[line]]
name = "hall"
port = 'COM5'
[[line.drive]]
name = "насос"
model = "invt-che"
address = 1
"""


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    path = tmp_path / "зал.toml"
    path.write_text(PLANT, "utf-8")
    return path


def test_ctrl_c_ends_a_poll_with_a_complete_recording(wine: Wine, pump: MotorDrive, plant: Path) -> None:
    out = plant.with_name("запись.arrows")
    with wine.console("-m", "multidrop", "poll", plant, "--out", out) as console:
        console.until(lambda: "ok" in statuses(out))
        console.press_ctrl_c()
        assert console.status() == 0, console.said
        console.until_said("насос")
    assert "ok" in statuses(out)


REALTIME = """
import sys
from multidrop import Poller
from multidrop.core import wake_lateness
from multidrop.core.port import _engine
with Poller(sys.argv[1], realtime=True) as poller:
    batches = iter(poller)
    while all(row.status != "ok" for row in next(batches)):
        pass
    print(_engine.is_realtime, len(wake_lateness(0.02, realtime=True)))
    while all(row.status != "ok" for row in next(batches)):
        pass
print(_engine.is_realtime)
"""


def test_realtime_scheduling_of_a_poll_ends_with_the_poll(wine: Wine, pump: MotorDrive, plant: Path) -> None:
    """Wine grants realtime scheduling. This test shows only that the calls work, not their effect."""
    ran = wine.run("-c", REALTIME, plant)
    assert ran.stdout.split() == [b"True", b"10", b"False"], ran.stderr
    assert b"realtime" not in ran.stderr


CLIENT = """
import time
from multidrop import Bus, InvtCHE
with Bus("COM5") as bus:
    pump = bus.attach(InvtCHE(1, maximum_frequency=50))
    pump.set_frequency(20)
    pump.start()
    bus.stop_on_exit()
    print("running", flush=True)
    time.sleep(600)
"""


def test_ctrl_c_stops_a_motor_with_stop_on_exit(wine: Wine, pump: MotorDrive) -> None:
    with wine.console("-c", CLIENT) as console:
        console.until_said("running")
        assert pump.motor.energised
        console.press_ctrl_c()
        console.status()
        console.until_said("KeyboardInterrupt")
    assert not pump.motor.energised


def test_ctrl_c_does_not_interrupt_a_stop(wine: Wine, pump: MotorDrive) -> None:
    pump.motor.deceleration_time = 5.0
    received = ReceivedRequests(pump)

    def stops() -> int:
        return sum(write.start == 0x1000 and write.data[-1] == 5 for write in received.writes)

    with wine.console("-c", CLIENT) as console:
        console.until_said("running")
        console.press_ctrl_c()
        console.until(stops)
        console.press_ctrl_c()
        console.status()
    assert not pump.motor.energised


# This script's start waits up to 300 s for the motor to turn, so that Ctrl-C comes during the wait.
START = """
import sys
import multidrop.cli
import multidrop.drive.family
multidrop.drive.family.START_TIME = 300.0
sys.exit(multidrop.cli.main(sys.argv[1:]))
"""


def test_ctrl_c_during_a_start_reports_sent_frames(wine: Wine, pump: MotorDrive, tmp_path: Path) -> None:
    """The test types the printed stop command, which stops the motor."""
    vars(pump.motor)["run"] = lambda direction=None: None
    received = ReceivedRequests(pump)
    plant = tmp_path / "hall 2.toml"
    plant.write_text(PLANT.replace("насос", "pump") + "maximum_frequency = 50\n", "utf-8")
    words = ("start", f"Z:{plant}".replace("/", "\\"), "pump", "--frequency", 20, "--yes")
    with wine.console("-c", START, *words) as console:
        console.until(lambda: received.starts)
        console.press_ctrl_c()
        assert console.status() == 130, console.said
        console.until_said("to stop it, type: ")
    assert len(received.starts) == 1
    interrupted, sent, offered = said_by(console)
    assert interrupted == "multidrop: interrupted"
    assert sent.startswith("multidrop: pump: control = FORWARD ")
    stop = offered.removeprefix("multidrop: to stop it, type: multidrop ")
    begun = len(received.writes)
    assert wine.type_line(f"-m multidrop {stop}", tmp_path) == 0
    assert [write.data for write in received.writes[begun:]] == [b"\0\5"]


@pytest.mark.parametrize("name", ["COM5", "com5", r"\\.\COM5", "COM10", "com10", r"\\.\COM10"])
def test_windows_port_can_be_opened_by_any_spelling_of_its_name(
    wine: Wine, pump: MotorDrive, name: str
) -> None:
    wine.link("com10", wine.terminal_of("com5"))
    ran = wine.run("-m", "multidrop", "state", name, "invt-che", 1)
    assert ran.returncode == 0, ran.stderr
    assert b"stopped" in ran.stdout


@pytest.mark.parametrize(
    ("name", "reason"), [("COM77", "there is no such port"), ("NUL", "it is not a serial port")]
)
def test_invalid_port_prints_one_sentence(wine: Wine, name: str, reason: str) -> None:
    ran = wine.run("-m", "multidrop", "state", name, "invt-che", 1)
    assert ran.returncode == 1
    (sentence,) = ran.stderr.decode().splitlines()
    assert reason in sentence


def test_piped_output_escapes_letters_outside_the_encoding(wine: Wine, plant: Path) -> None:
    ran = wine.run("-m", "multidrop", "plan", plant)
    assert ran.returncode == 0, ran.stderr
    assert rb"\u043d\u0430\u0441\u043e\u0441" in ran.stdout


def test_windows_console_prints_cyrillic_drive_names(wine: Wine, plant: Path) -> None:
    with wine.console("-m", "multidrop", "plan", plant) as console:
        assert console.status() == 0
        console.until_said("насос")


@pytest.mark.parametrize("form", ["8E1", "8O1", "8N2"])
def test_windows_port_can_be_opened_with_parity_or_two_stop_bits(
    wine: Wine, pump: MotorDrive, form: str
) -> None:
    """Check only that the port accepts both settings, because a pseudo-terminal does not use them."""
    ran = wine.run("-m", "multidrop", "state", "COM5", "invt-che", 1, "--format", form)
    assert ran.returncode == 0, ran.stderr


OPEN = "from multidrop import Bus\nBus('COM5', rs485={!r})"


@pytest.mark.parametrize(
    ("mode", "reason"),
    [
        ("rts-up", "does not switch RTS"),
        ("rts-down", "does not switch RTS"),
        ("kernel", "has no RS-485 mode"),
    ],
)
def test_rts_modes_are_refused_on_a_port_without_rts(
    wine: Wine, pump: MotorDrive, mode: str, reason: str
) -> None:
    ran = wine.run("-c", OPEN.format(mode))
    assert ran.returncode == 1
    sentence = ran.stderr.decode().splitlines()[-1]
    assert sentence.startswith("multidrop.errors.LineError: COM5: the driver " + reason)


def test_recording_of_a_killed_poll_is_readable(wine: Wine, pump: MotorDrive, plant: Path) -> None:
    """Check that the recording is complete, and that the port is free again."""
    out = plant.with_name("killed.arrows")
    with wine.console("-m", "multidrop", "poll", plant, "--out", out) as console:
        console.until(lambda: statuses(out).count("ok") > 20)
        seen = len(statuses(out))
        console.kill()
        assert console.status() == -signal.SIGKILL
    assert len(statuses(out)) >= seen
    assert set(statuses(out)) == {"ok"}
    later = out.with_name("later.arrows")
    ran = wine.run("-m", "multidrop", "poll", plant, "--out", later, "--seconds", 2)
    assert ran.returncode == 0, ran.stderr
    assert "ok" in statuses(later)


def test_polling_continues_when_a_vanished_port_comes_back(wine: Wine, plant: Path) -> None:
    out = plant.with_name("rows.arrows")
    with ExitStack() as stack:
        cable = stack.enter_context(ExitStack())
        cable.enter_context(on_com5(wine))
        console = stack.enter_context(wine.console("-m", "multidrop", "poll", plant, "--out", out))
        console.until(lambda: statuses(out).count("ok") > 20)
        cable.close()
        console.until(lambda: "port lost" in statuses(out))
        before = statuses(out).count("ok")
        cable.enter_context(on_com5(wine))
        console.until(lambda: statuses(out).count("ok") > before + 20)
        console.press_ctrl_c()
        assert console.status() == 0, console.said


@contextmanager
def on_com5(wine: Wine) -> Iterator[MotorDrive]:
    """A drive on COM5 that can turn its motor."""
    drive = simulated(InvtCHE(1, maximum_frequency=50))
    assert isinstance(drive, MotorDrive)
    drive.motor.acceleration_time = drive.motor.deceleration_time = 0.2
    with Simulator([Wire([drive])]) as line:
        wine.link("com5", line.wires[0].path)
        yield drive


def said_by(console: Console) -> list[str]:
    """Return the messages in the output that start with `multidrop:`."""
    return re.findall(r"multidrop: .*\S", console.said)


def statuses(path: Path) -> list[str]:
    """Return the status of each row so far."""
    if not path.exists() or not path.stat().st_size:
        return []
    return [row.status for batch in open_recording(path) for row in batch]
