"""Shared by the scenarios: a device, plant files, commands of multidrop, and the rows of a recording."""

from __future__ import annotations

import csv
import fcntl
import os
import signal
import struct
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import plug

from multidrop import Drive, reading, setting
from multidrop.cli import (  # noqa: F401 - imported before forks
    doctor,
    main,
    monitor,
    poll,
    recordings,
    registers,
    serve,
)
from multidrop.core import Framing
from multidrop.families.registry import find_model
from multidrop.sim import proof

KINDS = ("ftdi", "cp210x", "ch341", "pl2303", "acm")
BAUDRATES = (9600, 1200, 12345, 19200, 38400, 57600, 76800, 115200, 230400, 250000, 921600)
ATTEMPTS = 40  # number of attempts at a call that may fail on a busy computer
TCGETS2 = 0x802C542A


class Meter(Drive):
    """The device that tools/kernel/far_end.py simulates."""

    title = "meter"
    response_delay = 0.002
    baudrates = BAUDRATES
    formats = {Framing.RTU: ("8N1", "8E1", "8O1", "8N2", "8E2", "7E1")}
    a = reading(0x10, "A", place="-")
    b = reading(0x15, "A", place="-")
    target = setting(0x80, "A", place="-", span=(0, 60000))


def right(address: int, register: int) -> int:
    """Return the correct value of a meter's register."""
    return (address << 8 ^ register) & 0xFFFF


def attempt(call: Callable[..., object], *arguments: Any, **options: Any) -> Any:
    """Return the result of a call, or its error as text."""
    try:
        return call(*arguments, **options)
    except Exception as failure:
        return f"{type(failure).__name__}: {failure}"


def until_answered(call: Callable[..., object], *arguments: Any) -> Any:
    """Return what attempt() returns. Repeat the call if the error says that the adapter failed.

    pl2303 gives its adapter 100 ms to answer a USB request. An emulated adapter on a busy computer may need
    longer.
    """
    for _ in range(ATTEMPTS):
        result = attempt(call, *arguments)
        if "its adapter failed" not in str(result):
            break
    return result


def insist(call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Repeat a call until it succeeds, and return its result.

    On a busy computer, a write may expire, and a reply may come too late. Raises the last error after
    ATTEMPTS failures.
    """
    for _ in range(ATTEMPTS - 1):
        result = attempt(call, *arguments, **options)
        if not isinstance(result, str):
            return result
    return call(*arguments, **options)


def kernel_settings(path: str) -> tuple[int, str]:
    """Return the baud rate and format of a port, as the kernel states them."""
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        raw = fcntl.ioctl(fd, TCGETS2, bytes(44))
    finally:
        os.close(fd)
    control = struct.unpack_from("4I", raw)[2]
    parity = "N" if not control & 0x100 else "O" if control & 0x200 else "E"
    stop = 2 if control & 0x40 else 1
    return struct.unpack_from("2I", raw, 36)[1], f"{5 + (control >> 4 & 3)}{parity}{stop}"


class Command:
    """A command of multidrop in a forked process, because an interpreter takes seconds to start in the guest.
    The process has the user id and group id `user`, and the additional groups `groups`.
    """

    def __init__(self, *words: str, user: int = 0, groups: Sequence[int] = ()) -> None:
        self._output = Path(f"/tmp/output-{time.monotonic_ns()}")
        self.process = os.fork()
        if self.process:
            return
        status = 1
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            output = os.open(self._output, os.O_CREAT | os.O_WRONLY)
            for descriptor in (1, 2):
                os.dup2(output, descriptor)
            if user:
                os.setgroups(groups)
                os.setgid(user)
                os.setuid(user)
            status = main(list(words))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(status)

    @property
    def said(self) -> str:
        return self._output.read_text("utf-8", "replace")

    def is_over(self) -> bool:
        return os.waitid(os.P_PID, self.process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def signal(self, number: int) -> None:
        os.kill(self.process, number)

    def outcome(self) -> tuple[int, str]:
        """Wait for the end of the process; return its exit status and output."""
        plug.wait_until(self.is_over)
        return os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1]), self.said


def run(*words: str, **options: Any) -> tuple[int, str]:
    return Command(*words, **options).outcome()


MODEL = "erman-er-g-220"
FAMILY = "ErmanERG220"
POLLED = ("output_frequency", "output_current")


def write_plant(lines: dict[str, tuple[str, Iterable[int]]], more: str = "", every: str = "500 ms") -> str:
    """Write a plant file of lines, each with its port and addresses; return the file's path.

    With `every` = "" the drives are polled as fast as possible.
    """
    text = more
    for line, (port, addresses) in lines.items():
        text += f'[[line]]\nname = "{line}"\nport = "{port}"\n'
        for address in addresses:
            text += f'[[line.drive]]\nname = "{line}-{address}"\nmodel = "{MODEL}"\naddress = {address}\n'
            text += f'every = "{every}"\n' if every else ""
            text += f"poll = {list(POLLED)}\n".replace("'", '"')
    path = Path("/tmp/plant.toml")
    path.write_text(text, "utf-8")
    return str(path)


class Poll:
    """`multidrop poll` in a process. Each register of each drive has a different value."""

    def __init__(self, lines: dict[str, tuple[str, Iterable[int]]]) -> None:
        self.out = Path(f"/tmp/poll-{time.monotonic_ns()}.csv")
        self.command = Command("poll", write_plant(lines), "--out", str(self.out))
        self._rows: list[dict[str, str]] = []
        self._read = 0  # number of the file's bytes that are already in `_rows`

    def rows(self) -> list[dict[str, str]]:
        """Return the rows so far. Reads only the new ones, because the guest is slow."""
        if self.out.exists():
            with self.out.open("rb") as file:
                header = file.readline().decode()
                file.seek(max(self._read, len(header)))
                new = file.read()
            whole = new[: new.rfind(b"\n") + 1]
            self._read = max(self._read, len(header)) + len(whole)
            self._rows += csv.DictReader(whole.decode().splitlines(), header.strip().split(","))
        return self._rows

    def wait_for(
        self, status: str, lines: Iterable[str], after: int = 0, patience: float = plug.PATIENCE_S
    ) -> int:
        """Wait until each line has a row with this status, not counting the first `after` rows.

        Return the number of rows.
        """
        wanted = set(lines)

        def is_there() -> bool:
            assert not self.command.is_over(), self.command.said
            rows = self.rows()[after:]
            time.sleep(0.3)
            return wanted <= {row["drive"].partition("-")[0] for row in rows if row["status"] == status}

        try:
            plug.wait_until(is_there, patience)
        except AssertionError as failure:
            failure.add_note(f"since row {after}: {statuses(self.rows()[after:])}\n{self.command.said}")
            raise
        return len(self.rows())

    def end(self) -> dict[str, Any]:
        """End the poll by Ctrl-C; return its exit status and output, and a summary of its rows.

        `statuses` has the statuses of each line in their order. `wrong` has the rows with a wrong value.
        """
        begun = time.monotonic()
        self.command.signal(signal.SIGINT)
        status, output = self.command.outcome()
        rows = self.rows()
        return {
            "status": status,
            "output": output,
            "seconds": time.monotonic() - begun,
            "rows": len(rows),
            "good": sum(row["status"] == "ok" for row in rows),
            "wrong": [row for row in rows if row["status"] == "ok" and not is_right(row)],
            "statuses": statuses(rows),
        }


def is_right(row: dict[str, str]) -> bool:
    """Return True if the row's value is the correct one for its drive and register."""
    drive = find_model(MODEL)(int(row["drive"].rpartition("-")[2]))
    return abs(float(row["value"]) - proof(drive, drive.registers[row["register"]])) < 1e-9


def statuses(rows: list[dict[str, str]]) -> dict[str, list[str]]:
    """Return the statuses of each line in order, without consecutive repetitions."""
    found: dict[str, list[str]] = {}
    for row in rows:
        found.setdefault(row["drive"].partition("-")[0], []).append(row["status"])
    return {line: [status for status, _ in groupby(all_of)] for line, all_of in found.items()}
