"""Poll several lines in a forked process whose lease a test renews, and which the test suspends.

Each line of standard input starts one process, and has its arguments: FD LEASE GUARD TIMER BEYOND PORT... The
process's id is printed. FD is an inherited socket. Over this socket the process requests each renewal of its
lease with one byte, and the test grants it with one byte. LEASE, GUARD, TIMER and BEYOND are in s. TIMER
takes the place of GUARD for the kernel's timer. BEYOND is the time for which the process may send after its
lease has expired. It is 0, except in tests without the check of the clock before each write.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import socket
import sys
import time
import traceback
from contextlib import suppress
from pathlib import Path

from multidrop import Plant, PlantLine, Polled, PolledDrive, Poller
from multidrop.core import Mastership
from multidrop.drive import Drive, Framing
from multidrop.drive.register import HOLDING, reading


class Counted(Drive):
    """A drive with one register, which replies immediately."""

    framings = (Framing.RTU,)
    baudrates = (115_200,)
    most_registers = {HOLDING: 1}
    response_delay = 0.0
    response_timeout = 0.02

    number = reading(0)


def now_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def live(
    observer: socket.socket, lease: float, guard: float, timer: float, beyond: float, ports: list[str]
) -> None:
    mastership = Mastership(guard)
    mastership.guard_s = timer  # from here on, only the kernel's timer reads `guard_s`
    drives = [
        PolledDrive(Counted(1, name=f"drive-{n}"), (Polled(Counted.number, None),)) for n in range(len(ports))
    ]
    lines = [
        PlantLine(f"line-{n}", port, drives=(drive,))
        for n, (port, drive) in enumerate(zip(ports, drives, strict=True))
    ]
    with Poller(Plant(tuple(lines), Path("plant.toml")), mastership=mastership) as poller:
        while True:
            asked_ns = now_ns()
            observer.send(b"?")
            if not observer.recv(1):
                return
            with suppress(ValueError):  # ValueError: a renewal arrived too late, after a suspension
                mastership.extend(asked_ns + round((lease + beyond) * 1e9))
            poller.take()
            time.sleep(lease / 3)


def main() -> None:
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # let the system reap child processes
    faulthandler.register(signal.SIGUSR1)
    for words in map(str.split, sys.stdin):
        fd, lease, guard, timer, beyond, *ports = words
        if child := os.fork():
            print(child, flush=True)
            continue
        try:
            times = map(float, (lease, guard, timer, beyond))
            live(socket.socket(fileno=int(fd)), *times, ports)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(1)


if __name__ == "__main__":
    main()
