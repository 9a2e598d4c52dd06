"""Run `multidrop sniff` in another process."""

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
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from commands import MULTIDROP
from kills import BoundProcess
from lines import until


class Sniffer:
    """A running `multidrop sniff`; its objects are complete when the block ends."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.told: list[dict[str, Any]] = []
        self.process = process

    @property
    def exchanges(self) -> list[dict[str, Any]]:
        return [record for record in self.told if record.get("result") == "ok"]

    @property
    def summary(self) -> dict[str, int]:
        return dict(self.told[-1]["summary"])


# Checks the pairing of replies: on a busy machine they may come after the master's timeout.
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
    """Return the number of bytes that the listener has not read."""
    count = array.array("i", [0])
    fd = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.ioctl(fd, termios.FIONREAD, count)
    finally:
        os.close(fd)
    return count[0]
