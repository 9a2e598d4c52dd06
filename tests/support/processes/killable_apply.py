"""Apply a parameter file in a forked process that may be killed.

Each line of standard input, PORT FILE REPORT, forks such a process; that is fast, because everything is
imported. Its process id is printed and, when it ends, its exit status. A process that completes records its
own and earlier parameter writes in REPORT.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from multidrop import Bus, BusError, DelixiNative, params

DRIVE: Any = {"address": 1, "baudrate": 38400}
TRIES = 20  # attempts, because replies may be missed on a busy machine


def apply(port: str, file: str, report: str) -> None:
    reported: list[str] = []
    for _ in range(TRIES):
        try:
            with Bus(port, expiry=60) as bus:
                drive = bus.attach(DelixiNative, **DRIVE)
                result = params.apply(drive, params.load(file), commissioning=True)
        except BusError:
            time.sleep(0.1)
            continue
        reported += [*(change.parameter.code for change in result.written), *result.earlier]
        if result.ok:
            break
    else:
        raise SystemExit("the application does not end")
    Path(report).write_text("\n".join(reported))


def main() -> None:
    for line in sys.stdin:
        process = os.fork()
        if process == 0:
            status = 1
            try:
                apply(*line.split())
                status = 0
            except BaseException:
                traceback.print_exc()
            os._exit(status)
        print(process, flush=True)
        print(os.waitpid(process, 0)[1], flush=True)


if __name__ == "__main__":
    main()
