"""Print text and warnings, and ask for confirmation.

Control characters are escaped, and passwords in URLs are masked.
"""

from __future__ import annotations

import argparse
import logging
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from typing import TYPE_CHECKING, TextIO

from multidrop.errors import BusError, WriteForbidden
from multidrop.printable import masked, printable

if TYPE_CHECKING:
    from multidrop.drive.family import Drive


def spell_out_unencodable() -> None:
    """Let stdout escape characters that its encoding lacks, as stderr does. Windows' pipes lack many."""
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def print_text(text: object, *, file: TextIO | None = None, flush: bool = False) -> None:
    """Print the text. Control characters are escaped, except line feeds."""
    print("\n".join(map(printable, masked(str(text)).split("\n"))), file=file, flush=flush)


def print_json(found: object) -> None:
    import json  # imported here: many commands print no JSON

    print_text(json.dumps(found, indent=2))


def command_line(words: Sequence[str]) -> str:
    """Return the words as one command, quoted for this system's shell."""
    if sys.platform == "win32":
        from subprocess import list2cmdline

        return list2cmdline(words)
    return shlex.join(words)


def warn(sentences: str) -> None:
    """Print each line on stderr, after the program's name.

    A closed stderr is ignored, because it must not prevent a stop.
    """
    with suppress(OSError):
        for sentence in masked(sentences).splitlines():
            print(f"multidrop: {printable(sentence)}", file=sys.stderr)


class _Handler(logging.Handler):
    def __init__(self, show: Callable[[str], object], level: int) -> None:
        super().__init__(level)
        self._show = show

    def emit(self, record: logging.LogRecord) -> None:
        self._show(record.getMessage())


@contextmanager
def logging_to(show: Callable[[str], object], logger_name: str, level: int) -> Iterator[None]:
    """While the context lasts, pass this logger's messages to `show`, from this level up."""
    with logging_by(_Handler(show, level), {logger_name: level}):
        yield


@contextmanager
def logging_by(handler: logging.Handler, levels: Mapping[str, int]) -> Iterator[None]:
    """While the context lasts, pass these loggers' messages to a handler; close the handler at the end."""
    loggers = {logging.getLogger(name): level for name, level in levels.items()}
    before = {logger: logger.level for logger in loggers}
    for logger, level in loggers.items():
        logger.addHandler(handler)
        logger.setLevel(level)
    try:
        yield
    finally:
        for logger, level in before.items():
            logger.removeHandler(handler)
            logger.setLevel(level)
        handler.close()


# ---- confirmation before a motor may move or a register is written ----


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
    """If Ctrl-C ends the block, add notes to the KeyboardInterrupt about the requests sent so far.

    Yields the list of notes. At first the list says that no request was sent; the caller replaces its
    contents. If Ctrl-C came during the handling of a BusError, that error becomes a note too.
    """
    known = [f"{drive.name}: the {command} was not sent"]
    try:
        yield known
    except KeyboardInterrupt as interruption:
        before = interruption.__context__
        for text in [*known, *([str(before)] if isinstance(before, BusError) else [])]:
            interruption.add_note(text)
        raise
