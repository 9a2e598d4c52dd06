"""Compile the C programs of bench/ once per run, and run them and the paced line as context managers."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

HERE = Path(__file__).parents[1]
PROCESSORS = sorted(os.sched_getaffinity(0))
CORE = HERE.parent / "csrc"
FRAMES = (f"-I{CORE}", str(CORE / "body.c"), str(CORE / "frame.c"))  # core files for frames and checksums


@cache
def _directory() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="multidrop-bench-")  # removed when the process ends


@cache
def compiled(source: str, *flags: str) -> Path:
    """Compile a C file in bench/; return the path of the program."""
    target = Path(_directory().name) / Path(source).stem
    subprocess.run(["cc", "-O2", str(HERE / source), "-o", str(target), *flags], check=True)
    return target


def module(name: str, *words: object) -> list[str]:
    """Return the command that runs a module of bench/ in a process of its own."""
    return [sys.executable, "-m", name, *(str(word) for word in words)]


@dataclass
class Talker:
    """A running program that simulates one or more lines; `report` is set when it has ended."""

    said: str  # the program's first output: the ports of its lines
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def path(self) -> str:
        return self.said


@contextmanager
def talking(command: Sequence[object], **details: Any) -> Iterator[Talker]:
    """Run a program during the block; then close the program's standard input, and read its JSON report."""
    words = [str(word) for word in command]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(words, text=True, **pipes, **details) as process:
        assert process.stdout is not None
        said = process.stdout.readline()
        if not said.endswith("\n"):
            raise RuntimeError(f"{Path(words[0]).name} ended before its lines were ready")
        talker = Talker(said.strip())
        yield talker
        told, _ = process.communicate()
    talker.report = json.loads(told)


@contextmanager
def paced_line(**options: Any) -> Iterator[Talker]:
    """Run paced_line.c with these options, such as baudrate=9600, stray=True, silent="3,7"."""
    command: list[object] = [compiled("players/paced_line.c")]
    for name, value in options.items():
        key = f"--{name.replace('_', '-')}"
        command += [key] if value is True else [key, value]
    with talking(command) as line:
        yield line


@contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Run this number of programs that compute without pause during the block."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


@contextmanager
def on_processor(number: int) -> Iterator[None]:
    """Restrict programs started within the block to this processor, or to the last one if there are fewer."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {PROCESSORS[min(number, len(PROCESSORS) - 1)]})
    yield
    os.sched_setaffinity(0, before)
