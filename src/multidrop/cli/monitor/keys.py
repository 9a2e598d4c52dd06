"""Keys pressed on a terminal, one at a time."""

from __future__ import annotations

import codecs
import os
import re
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from errno import EIO

UP, DOWN, PAGE_UP, PAGE_DOWN, ENTER, ESCAPE = "up", "down", "page up", "page down", "enter", "escape"
KEYS = {  # as terminals send them
    b"\x1b[A": UP,
    b"\x1bOA": UP,
    b"k": UP,
    b"\x1b[B": DOWN,
    b"\x1bOB": DOWN,
    b"j": DOWN,
    b"\x1b[5~": PAGE_UP,
    b"\x1b[6~": PAGE_DOWN,
    b" ": PAGE_DOWN,
    b"\r": ENTER,
    b"\n": ENTER,
}
UNKNOWN = "unknown"
# A key that is no letter, as F4, which ends in S: it asks for nothing. And the beginning of one.
_SEQUENCE = re.compile(rb"\x1b(?:\[\[?[0-?]*[ -/]*[@-Z\\-~]|O[ -~])")
_BEGUN = re.compile(rb"\x1b(?:\[\[?[0-?]*[ -/]*|O)?")
SPLIT_S = 0.05  # after which the rest of one has not been sent
MOST_BYTES = 4  # of a character in UTF-8
# Letters of the Russian and the Ukrainian layout, and those of the same keys on a Latin one.
LATIN = str.maketrans("йыіфнолЙЫІФНОЛ", "qssayjkQSSAYJK")


@contextmanager
def keys() -> Iterator[Callable[[float], str]]:
    """Give a function that waits so many seconds for a key, and returns its name or letter, or "".

    It raises OSError once the terminal is gone. Raises ValueError on Windows, whose consoles have no such
    mode.
    """
    if sys.platform == "win32":
        raise ValueError("the live screen needs a terminal of Linux or macOS; `multidrop poll` works here")
    import termios
    import tty

    fd = sys.stdin.fileno()
    before = termios.tcgetattr(fd)
    tty.setcbreak(fd)
    pressed = b""  # and not returned yet

    def read() -> bytes:
        found = os.read(fd, 64)
        if not found:
            raise OSError(EIO, "the terminal is closed")
        return found

    def wait_for_key(seconds: float) -> str:
        nonlocal pressed
        if not pressed and select.select([fd], [], [], seconds)[0]:
            pressed = read()
        while is_begun(pressed) and select.select([fd], [], [], SPLIT_S)[0]:
            pressed += read()
        key, pressed = next_key(pressed)
        return key

    try:
        yield wait_for_key
    finally:
        with suppress(termios.error):  # of a terminal that is gone
            termios.tcsetattr(fd, termios.TCSADRAIN, before)


def next_key(pressed: bytes) -> tuple[str, bytes]:
    """Split off the first key of what a terminal sent: its name or letter, and the rest."""
    if sequence := _SEQUENCE.match(pressed):
        return KEYS.get(sequence[0], UNKNOWN), pressed[sequence.end() :]
    if pressed[:1] == b"\x1b":
        return ESCAPE, pressed[1:]
    letter, rest = _first_letter(pressed)
    return KEYS.get(letter.encode(), letter), rest


def is_begun(pressed: bytes) -> bool:
    """Return True for the beginning of a key or of a letter whose rest may be sent yet."""
    with suppress(UnicodeDecodeError):
        return bool(_BEGUN.fullmatch(pressed)) or (
            pressed != b"" and codecs.getincrementaldecoder("utf-8")().decode(pressed) == ""
        )
    return False


def _first_letter(pressed: bytes) -> tuple[str, bytes]:
    for length in range(1, MOST_BYTES + 1):
        with suppress(UnicodeDecodeError):
            return pressed[:length].decode().translate(LATIN), pressed[length:]
    return "\ufffd", pressed[1:]
