"""Print tables as text, with a heading: subject, command, date and computer."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path


def heading(what: str) -> None:
    """Print the heading of a table: its subject, and the command, date and computer of the measurement."""
    print(what)
    print(f"command  {shlex.join(['python', *sys.orig_argv[1:]])}")
    print(f"date     {datetime.now(UTC):%Y-%m-%d %H:%M} UTC")
    print(f"machine  {_machine()}")
    print(flush=True)


def _machine() -> str:
    cpus = Path("/proc/cpuinfo")
    names = (
        [line for line in cpus.read_text("utf-8").splitlines() if "model name" in line]
        if cpus.exists()
        else []
    )
    cpu = names[0].partition(":")[2].strip() if names else platform.processor() or platform.machine()
    loads = os.getloadavg() if hasattr(os, "getloadavg") else ()
    load = ", ".join(f"{each:.1f}" for each in loads) or "unknown"
    return (
        f"{os.cpu_count()} x {cpu}, {platform.system()} {platform.release()}, "
        f"Python {platform.python_version()}, load before {load}"
    )


def show(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print the rows: text is left-aligned, numbers are right-aligned."""
    rows = list(rows)
    cells = [list(columns), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(line[at]) for line in cells) for at in range(len(columns))]
    left = [
        all(isinstance(row[at], str) and not _number(row[at]) for row in rows) for at in range(len(columns))
    ]
    for line in cells:
        padded = [
            cell.ljust(width) if to_left else cell.rjust(width)
            for cell, width, to_left in zip(line, widths, left, strict=True)
        ]
        print("  ".join(padded).rstrip())


def _number(text: object) -> bool:
    return bool(str(text)) and str(text)[0] in "-+.0123456789"
