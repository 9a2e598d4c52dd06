"""Kill the processes of a test."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from types import TracebackType
from typing import Any, AnyStr


class BoundProcess(subprocess.Popen[AnyStr]):
    """A process that is killed if its block fails: `Popen` would wait for its end."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        failure: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if failure is not None:
            self.kill()
        super().__exit__(kind, failure, traceback)


def kill_all(processes: Iterable[subprocess.Popen[Any]]) -> None:
    """Kill processes, suspended ones too, and wait for their end."""
    killed = list(processes)
    for process in killed:
        process.kill()
    for process in killed:
        process.wait()
