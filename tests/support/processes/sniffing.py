"""Run `multidrop sniff` in another process, on lines with a passive listener."""

from __future__ import annotations

import array
import fcntl
import json
import os
import signal
import subprocess
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from commands import MULTIDROP, BoundProcess
from lines import until
from ptys import passing

from multidrop.core import set_settings


class Sniffer:
    """A running `multidrop sniff`; its decoded JSON objects are complete when the block ends."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.told: list[dict[str, Any]] = []
        self.process = process

    @property
    def exchanges(self) -> list[dict[str, Any]]:
        return [record for record in self.told if record.get("result") == "ok"]

    @property
    def summary(self) -> dict[str, int]:
        return dict(self.told[-1]["summary"])


# Run `multidrop sniff` without time limits, because replies may be late on a busy machine.
PATIENT = """
import sys
from multidrop.cli import main
from multidrop.cli import sniff
sniff._SILENT_S = sniff._GIVEN_UP_S = float("inf")
sys.exit(main())
"""


@contextmanager
def sniffing(port: str, *words: object, patient: bool = False) -> Iterator[Sniffer]:
    program = [sys.executable, "-c", PATIENT] if patient else MULTIDROP
    command = [*program, "sniff", port, "--json", *map(str, words)]
    pipe = subprocess.PIPE
    with BoundProcess(command, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stderr.readline() == f"listening on {port}, Ctrl-C ends\n"
        sniffer = Sniffer(process)
        out = process.stdout
        reader = threading.Thread(target=lambda: sniffer.told.extend(map(json.loads, out)))
        reader.start()
        try:
            yield sniffer
            until(lambda: unread(port) == 0)
        finally:
            process.send_signal(signal.SIGINT)
            reader.join(timeout=60)
            process.kill()


def unread(port: str) -> int:
    """Return the number of bytes waiting at the listener's port."""
    count = array.array("i", [0])
    fd = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.ioctl(fd, termios.FIONREAD, count)
    finally:
        os.close(fd)
    return count[0]


@contextmanager
def tapped(drives: str, baudrate: int, hear: Callable[[bytes], bytes] = bytes) -> Iterator[tuple[str, str]]:
    """Yield the paths of the master's and the listener's ports; `drives` is the port of the drives.

    `hear(said)` returns the bytes that the listener receives in place of `said`.
    """
    behind = os.open(drives, os.O_RDWR | os.O_NOCTTY)
    set_settings(behind, baudrate, "8N1")
    (master, master_port), (tap, tap_port) = os.openpty(), os.openpty()
    for port in (master_port, tap_port):
        tty.setraw(port)

    def take(other: int, said: bytes) -> None:
        os.write(tap, hear(said))  # the listener gets a request before its reply
        os.write(other, said)

    try:
        with passing({behind: partial(take, master), master: partial(take, behind)}):
            yield os.ttyname(master_port), os.ttyname(tap_port)
    finally:
        for fd in (behind, master, master_port, tap, tap_port):
            os.close(fd)
