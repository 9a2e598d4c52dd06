"""Run Windows programs with Wine, each on a pty as its console."""

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
from contextlib import contextmanager
from pathlib import Path

PATIENCE_S = 300.0  # a busy machine needs a minute to start Python in Wine
SIZE = 50, 400  # rows and columns: no sentence wraps
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
        """Read the output: a program whose terminal is full would block."""
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
        """Wait for a condition."""
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
        """Start Wine's services without pipes, because services inherit them and keep them open."""
        line = ["wine", str(self.folder / "python" / "python.exe"), "-c", ""]
        subprocess.run(line, env=self.environment, check=True, timeout=PATIENCE_S, **NOWHERE)

    def run(self, *words: object) -> subprocess.CompletedProcess[bytes]:
        """Run Python to its end, with pipes."""
        line = ["wine", str(self.folder / "python" / "python.exe"), *map(str, words)]
        pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.run(line, env=self.environment, check=False, timeout=PATIENCE_S, **pipes)

    def type_line(self, line: str, folder: Path) -> int:
        """Type this after Python's name in the Windows shell; return the exit status."""
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
        """Start Python on a console."""
        console = Console(self.folder, list(map(str, words)), self.environment)
        try:
            yield console
        finally:
            console.close()
