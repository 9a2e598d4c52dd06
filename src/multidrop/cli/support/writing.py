"""Confirmation before a motor may move or a register is written."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from multidrop.drive.family import Drive
from multidrop.errors import BusError, WriteForbidden
from multidrop.printable import printable


def confirm(question: str, arguments: argparse.Namespace) -> None:
    """Ask the user, unless --yes was given. Raises WriteForbidden if the answer is not yes."""
    if arguments.yes:
        return
    if not sys.stdin.isatty():
        raise WriteForbidden(f"{question} There is no terminal to ask on: add --yes to confirm")
    _drop_typed_input()
    print(f"{printable(question)} [y/N] ", end="", file=sys.stderr, flush=True)
    answer = ""
    try:
        answer = sys.stdin.readline()
    except KeyboardInterrupt as interruption:
        interruption.add_note("nothing was sent")
        raise
    finally:
        if not answer.endswith("\n"):  # at the end of input, end the question's line
            print(file=sys.stderr)
    if answer.strip().lower() not in ("y", "yes"):
        raise WriteForbidden("nothing was sent")


def _drop_typed_input() -> None:
    """Drop pending input, so that a "y" typed before the question does not answer it."""
    if sys.platform == "win32":
        return
    import termios

    with suppress(OSError, termios.error):  # stdin is not a terminal
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)


@contextmanager
def reporting_interruption(drive: Drive, command: str) -> Iterator[list[str]]:
    """On Ctrl-C, add notes about the requests sent so far, also while the port is being opened or closed.

    Yields the list of notes. At first it says that no request was sent; the caller replaces its contents. If
    another failure was being handled when Ctrl-C came, that failure is added to the notes.
    """
    known = [f"{drive.name}: the {command} was not sent"]
    try:
        yield known
    except KeyboardInterrupt as interruption:
        before = interruption.__context__
        for text in [*known, *([str(before)] if isinstance(before, BusError) else [])]:
            interruption.add_note(text)
        raise
