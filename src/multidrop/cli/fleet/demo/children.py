"""Children: the demo's processes. None of them outlives it, however it ends."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from multidrop.cli.fleet.demo import dying_child

PATIENCE_S = 10.0  # for a child that was asked to end


class Children:
    """Processes by name, each with a log in this folder and a session of its own, away from Ctrl-C."""

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._environment = {**os.environ, **environment}
        self._running: dict[str, subprocess.Popen[str]] = {}

    def __getitem__(self, name: str) -> subprocess.Popen[str]:
        return self._running[name]

    def start(self, name: str, *words: str) -> subprocess.Popen[str]:
        """Start a program; what it says on stderr stands in its log."""
        guard = [sys.executable, "-I", "-S", str(dying_child.__file__), str(os.getpid())]
        with self._log(name).open("ab") as log:
            self._running[name] = subprocess.Popen(
                [*guard, *words],
                stdout=subprocess.PIPE,
                stderr=log,
                env=self._environment,
                encoding="utf-8",
                start_new_session=True,
            )
        return self._running[name]

    def start_multidrop(self, name: str, *words: str) -> subprocess.Popen[str]:
        return self.start(name, sys.executable, "-m", "multidrop", *words)

    def run_multidrop(self, name: str, *words: str) -> str:
        """Run a command to its end, and return its output. Raises OSError with what it said."""
        out, _ = self.start_multidrop(name, *words).communicate()
        if self._running[name].returncode:
            raise OSError(f"`multidrop {words[0]}` of the demo failed: {self.last_words(name)}")
        return out

    def kill(self, name: str) -> None:
        """Kill it as a power cut would: it has no time for anything."""
        self._running[name].kill()
        _reap(self._running[name])

    def end(self, *names: str) -> dict[str, str]:
        """Ask them to end in good order, and return what each said on stdout since it was last read."""
        for name in names:
            self._running[name].terminate()
        return {name: self._ended(name) for name in names}

    def _ended(self, name: str) -> str:
        try:
            return self._running[name].communicate(timeout=PATIENCE_S)[0]
        except subprocess.TimeoutExpired:
            self.kill(name)
            raise OSError(f"{name} of the demo did not end: {self.last_words(name)}") from None

    def last_words(self, name: str) -> str:
        """Return the last line of its log."""
        lines = self._log(name).read_text("utf-8", "replace").splitlines()
        return lines[-1] if lines else "it said nothing"

    def close(self) -> None:
        """Kill those that still run."""
        for process in self._running.values():
            process.kill()
        for process in self._running.values():
            _reap(process)

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"


def _reap(process: subprocess.Popen[str]) -> None:
    process.wait()
    if process.stdout:
        process.stdout.close()


def await_line(process: subprocess.Popen[str]) -> str:
    """Return the next line that a child prints; "" where it has ended."""
    assert process.stdout is not None
    return process.stdout.readline().rstrip()
