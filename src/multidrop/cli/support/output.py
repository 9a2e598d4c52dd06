"""Output on stdout and stderr: control characters are escaped, and passwords in URLs are masked."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from typing import TextIO

from multidrop.printable import masked, printable


def spell_out_unencodable() -> None:
    """Let stdout escape characters that its encoding lacks, as stderr does. Windows' pipes lack many."""
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def print_text(text: object, *, file: TextIO | None = None, flush: bool = False) -> None:
    """Print the text. Control characters are escaped, except line feeds."""
    print("\n".join(map(printable, masked(str(text)).split("\n"))), file=file, flush=flush)


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
