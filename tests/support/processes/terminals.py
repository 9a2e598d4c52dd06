"""Run commands on a terminal of their own, and read its screen."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager

from commands import MULTIDROP


class Terminal:
    """A command running on its own pty, with all its output so far."""

    def __init__(self, words: list[str], size: tuple[int, int], **environment: str) -> None:
        self.fd, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", size[1], size[0], 0, 0))
        self.before = termios.tcgetattr(slave)
        self.slave = slave
        clean = {name: text for name, text in os.environ.items() if name not in ("COLUMNS", "LINES")}
        self.process = self._begin(words, clean | {"TERM": "xterm"} | environment)
        self.written = b""

    def _begin(self, words: list[str], environment: dict[str, str]) -> subprocess.Popen[bytes]:
        slave = self.slave
        return subprocess.Popen(words, stdin=slave, stdout=slave, stderr=slave, env=environment)

    def wait_for(self, text: str, seconds: float = 60) -> None:
        self.wait_for_match(re.escape(text), seconds)

    def wait_for_match(self, pattern: str, seconds: float = 60) -> None:
        end = time.monotonic() + seconds
        while not re.search(pattern, self.text):
            assert time.monotonic() < end, self.text[-3000:]
            if select.select([self.fd], [], [], 0.1)[0]:
                self.written += os.read(self.fd, 65536)

    @property
    def text(self) -> str:
        return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", self.written.decode(errors="replace"))

    def press(self, keys: bytes) -> None:
        self.written = b""
        os.write(self.fd, keys)


class ClosingTerminal(Terminal):
    """A terminal with its own session, whose processes get SIGHUP when the terminal closes."""

    def _begin(self, words: list[str], environment: dict[str, str]) -> subprocess.Popen[bytes]:
        slave = self.slave

        def take_terminal() -> None:
            signal.signal(signal.SIGHUP, signal.SIG_DFL)  # restore the default action
            fcntl.ioctl(slave, termios.TIOCSCTTY, 0)

        process = subprocess.Popen(
            words,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            env=environment,
            start_new_session=True,
            preexec_fn=take_terminal,
        )
        os.close(slave)
        return process

    def close(self) -> None:
        os.close(self.fd)


@contextmanager
def closing_terminal(*words: object, size: tuple[int, int] = (80, 24)) -> Iterator[ClosingTerminal]:
    """Run a command on a terminal that the test closes; yield the terminal."""
    terminal = ClosingTerminal([*MULTIDROP, *map(str, words)], size)
    try:
        yield terminal
    finally:
        terminal.process.kill()
        terminal.process.wait()


@contextmanager
def on_terminal(*words: object, size: tuple[int, int] = (80, 24), **environment: str) -> Iterator[Terminal]:
    terminal = Terminal([*MULTIDROP, *map(str, words)], size, **environment)
    try:
        yield terminal
    finally:
        terminal.process.kill()
        terminal.process.wait()
        os.close(terminal.fd)
        os.close(terminal.slave)
