"""Kills of what a test started."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from typing import Any


def kill_all(processes: Iterable[subprocess.Popen[Any]]) -> None:
    """End processes, those that stand still too, and wait until they are gone."""
    killed = list(processes)
    for process in killed:
        process.kill()
    for process in killed:
        process.wait()
