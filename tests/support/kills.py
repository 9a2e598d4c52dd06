"""Kills of what a test started."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from types import TracebackType
from typing import Any, AnyStr


class BoundProcess(subprocess.Popen[AnyStr]):
    """A process that is killed where its block fails: `Popen` waits for its end, which may never come."""

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
    """End processes, those that stand still too, and wait until they are gone."""
    killed = list(processes)
    for process in killed:
        process.kill()
    for process in killed:
        process.wait()
