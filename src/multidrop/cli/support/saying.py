"""Lines for people, on stdout or stderr: whatever names, ports and paths stand in them, they only print."""

from __future__ import annotations

from typing import TextIO

from multidrop.printable import printable


def say(text: object, *, file: TextIO | None = None, flush: bool = False) -> None:
    """Print the text; what would command a terminal is spelt out. Only \\n ends a line."""
    print("\n".join(map(printable, str(text).split("\n"))), file=file, flush=flush)
