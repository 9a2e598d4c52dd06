"""The C programs of bench/: compiled once a run, and the paced line as a context."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

HERE = Path(__file__).parent
CORE = HERE.parent / "csrc"
CHECKSUM = (f"-I{CORE}", str(CORE / "checksum.c"))  # for programs that take the core's own checksums
FRAMES = (*CHECKSUM, str(CORE / "frame.c"))


@cache
def _directory() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="multidrop-bench-")  # removed when the process ends


@cache
def compiled(source: str, *flags: str) -> Path:
    """The program made of a C file in bench/."""
    target = Path(_directory().name) / Path(source).stem
    subprocess.run(["cc", "-O2", str(HERE / source), "-o", str(target), *flags], check=True)
    return target


@dataclass
class Line:
    """A paced line; its report is there when it has ended."""

    path: str
    report: dict[str, Any] = field(default_factory=dict)


@contextmanager
def paced_line(**options: Any) -> Iterator[Line]:
    """paced_line.c with these options, such as baudrate=9600, stray=True, silent="3,7"."""
    command = [str(compiled("paced_line.c"))]
    for name, value in options.items():
        key = f"--{name.replace('_', '-')}"
        command += [key] if value is True else [key, str(value)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = Line(process.stdout.readline().strip())
        yield line
        told, _ = process.communicate()
    line.report = json.loads(told)


@contextmanager
def talking(command: Sequence[object], **options: Any) -> Iterator[str]:
    """A program that says where it is to be found, and runs until standard input ends."""
    words = [str(word) for word in command]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **options) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()


@contextmanager
def on_one_processor() -> Iterator[None]:
    """Programs that are started meanwhile stay on the first processor (where the system can do that)."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    yield
    os.sched_setaffinity(0, allowed)
