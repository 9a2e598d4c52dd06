"""Kill a test's processes; count threads and descriptors to find leaks."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, AnyStr


class BoundProcess(subprocess.Popen[AnyStr]):
    """A process that is killed if its `with` block fails, whereas `Popen` would wait for its end."""

    def __exit__(
        self, kind: type[BaseException] | None, failure: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if failure is not None:
            self.kill()
        super().__exit__(kind, failure, traceback)


def kill_all(processes: Iterable[subprocess.Popen[Any]]) -> None:
    """Kill processes, even suspended ones, and wait for their end."""
    killed = list(processes)
    for process in killed:
        process.kill()
    for process in killed:
        process.wait()


def descriptors() -> int:
    return len(list(Path("/dev/fd").iterdir()))


def threads() -> int:
    """Return the number of threads, except the logging thread, which starts at the first log entry."""
    return sum(thread.name != "multidrop log" for thread in threading.enumerate())
