"""The terminal: full-screen pictures of styled lines of text, sparklines, and the keys that are pressed."""

from __future__ import annotations

import codecs
import os
import re
import select
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from errno import EIO
from math import ceil
from types import TracebackType
from typing import NamedTuple, Self, TextIO

from multidrop.cli.support.values import columns_of, cut_to, padded
from multidrop.printable import printable

COLOURS = {"red": "31", "yellow": "33", "white": "37", "on-red": "41"}
ATTRIBUTES = {"bold": "1", "dim": "2", "underline": "4", "reverse": "7"}
_OPEN, _CLOSE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"  # enter and leave the alternate screen
_HOME = "\x1b[H"
BLOCKS, PLAIN_BLOCKS = "▁▂▃▄▅▆▇█", "_.-=+*#@"  # characters of sparklines, on Unicode terminals and on others
LARGEST = 1e150  # larger values are not drawn, because their sums would overflow


class TextLine(NamedTuple):
    """A line of text in a picture."""

    plain: str = ""
    style: str = ""  # names from COLOURS and ATTRIBUTES, separated by spaces


def cut(text: str, width: int) -> str:
    """Cut a text to a width in columns, and remove control characters. A ~ marks the cut."""
    return cut_to(printable(text), width)


def filled(text: str, width: int) -> str:
    return padded(cut(text, width), "<", width)


class Screen:
    """A terminal that shows one picture at a time. After its `with` block, the former content is shown again.

    On a terminal without cursor control, each picture is printed below the previous one.
    """

    def __init__(self, terminal: TextIO | None = None) -> None:
        self._terminal = terminal or sys.stdout
        self._encoding = self._terminal.encoding or "ascii"
        self.blocks = blocks_of(self._terminal)
        self.scrolls = os.environ.get("TERM", "").lower() in ("dumb", "unknown")
        self._codes = ATTRIBUTES | ({} if os.environ.get("NO_COLOR") else COLOURS)

    @property
    def size(self) -> tuple[int, int]:
        """Return a picture's columns and lines. On a terminal that scrolls, the last line stays empty."""
        width, height = shutil.get_terminal_size()
        return width, height - self.scrolls

    def __enter__(self) -> Self:
        self._write("" if self.scrolls else _OPEN)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._write("" if self.scrolls else _CLOSE)

    def draw(self, lines: Sequence[TextLine]) -> None:
        """Show these lines; each must fit the terminal's width."""
        if self.scrolls:
            self._write("".join(f"{self.encodable(line.plain)}\n" for line in lines))
        else:
            width, _ = self.size
            self._write(_HOME + "\r\n".join(self._drawn(line, width) for line in lines))

    def _drawn(self, line: TextLine, width: int) -> str:
        text = self.encodable(line.plain)
        codes = ";".join(self._codes[name] for name in line.style.split() if name in self._codes)
        blank = " " * (width - columns_of(text))
        return f"\x1b[{codes}m{text}\x1b[m{blank}" if codes else text + blank

    def encodable(self, text: str) -> str:
        """Replace each character that the terminal's encoding lacks by `?`, or a wide character by `??`.

        So each character keeps its width. An escape such as `\\u2026` would shift all columns after it.
        """
        try:
            text.encode(self._encoding)
        except UnicodeEncodeError:
            return "".join(self._mark(mark) for mark in text)
        return text

    def _mark(self, mark: str) -> str:
        try:
            mark.encode(self._encoding)
        except UnicodeEncodeError:
            return "?" * columns_of(mark)
        return mark

    def _write(self, text: str) -> None:
        self._terminal.write(text)
        self._terminal.flush()


def blocks_of(terminal: TextIO) -> str:
    """Return the characters of sparklines that a terminal can show."""
    return BLOCKS if "utf" in (terminal.encoding or "").lower() else PLAIN_BLOCKS


def sparkline(
    history: Iterable[float | None], width: int, blocks: str = BLOCKS, points: int | None = None
) -> str:
    """Draw a history in at most `width` columns, scaled from its smallest value to its largest.

    None and values beyond LARGEST, such as infinity, are blanks.

    If the history has more points than columns, each column shows the mean of several points. `points` is the
    number of points recorded so far, including those that the history has dropped. If it is given, later
    drawings average the same groups of points.
    """
    values = list(history)
    share = max(1, ceil(len(values) / width)) if width > 0 else 0
    if not share:
        return ""
    first = (len(values) if points is None else points) - len(values)
    columns: dict[int, list[float]] = {}
    for number, value in enumerate(values, first):
        drawn = [] if value is None or abs(value) > LARGEST else [value]
        columns.setdefault(number // share, []).extend(drawn)
    means = [sum(column) / len(column) if column else None for column in columns.values()][-width:]
    there = [mean for mean in means if mean is not None]
    low, high = min(there, default=0.0), max(there, default=0.0)
    # without 0 in the range, a steady value would look like 0, and noise like large changes
    low = min(low, 0.0)
    span, highest = high - low or 1.0, len(blocks) - 1
    return "".join(" " if mean is None else blocks[round((mean - low) / span * highest)] for mean in means)


# ---- keys ----


def keys_are_readable() -> bool:
    return sys.platform != "win32" and sys.stdin.isatty() and sys.stdout.isatty()


UP, DOWN, PAGE_UP, PAGE_DOWN, ENTER, ESCAPE = "up", "down", "page up", "page down", "enter", "escape"
KEYS = {  # maps the bytes that a terminal sends to the key's name
    b"\x1b[A": UP,
    b"\x1bOA": UP,
    b"\x1b[B": DOWN,
    b"\x1bOB": DOWN,
    b"\x1b[5~": PAGE_UP,
    b"\x1b[6~": PAGE_DOWN,
    b"\r": ENTER,
    b"\n": ENTER,
}
UNKNOWN = "unknown"
# Other escape sequences, and their first bytes. All bytes of a sequence are dropped: the key F4 sends
# ESC O S, and S alone is the command that stops all motors.
_SEQUENCE = re.compile(rb"\x1b(?:\[\[?[0-?]*[ -/]*[@-Z\\-~]|O[ -~])")
_BEGUN = re.compile(rb"\x1b(?:\[\[?[0-?]*[ -/]*|O)?")
SPLIT_S = 0.05  # how long to wait for the rest of an escape sequence
MOST_BYTES = 4  # limit of a character's bytes in UTF-8
# Letters of the Russian and Ukrainian layouts, and the Latin letters on the same keys.
LATIN = str.maketrans("йыіфнолеЙЫІФНОЛЕ", "qssayjktQSSAYJKT")


@contextmanager
def terminal_keys() -> Iterator[Callable[[float], str]]:
    """Yield a function that waits for a key, and returns the key's name or letter; "" if none is pressed.

    The function's argument is the longest wait in s. The function raises OSError if the terminal is closed.
    """
    assert sys.platform != "win32", "keys_are_readable excludes it"
    import termios
    import tty

    fd = sys.stdin.fileno()
    before = termios.tcgetattr(fd)
    tty.setcbreak(fd)
    pressed = b""  # bytes that were read but not returned yet

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
        with suppress(termios.error):  # the terminal may be closed by now
            termios.tcsetattr(fd, termios.TCSADRAIN, before)


def next_key(pressed: bytes) -> tuple[str, bytes]:
    """Return the name or letter of the first key in a terminal's bytes, and the bytes after this key."""
    if sequence := _SEQUENCE.match(pressed):
        return KEYS.get(sequence[0], UNKNOWN), pressed[sequence.end() :]
    if pressed[:1] == b"\x1b":
        return ESCAPE, pressed[1:]
    letter, rest = _first_letter(pressed)
    return KEYS.get(letter.encode(), letter), rest


def is_begun(pressed: bytes) -> bool:
    """Return True if these bytes start a key or letter whose other bytes may still come."""
    with suppress(UnicodeDecodeError):
        return bool(_BEGUN.fullmatch(pressed)) or (
            pressed != b"" and codecs.getincrementaldecoder("utf-8")().decode(pressed) == ""
        )
    return False


def _first_letter(pressed: bytes) -> tuple[str, bytes]:
    for length in range(1, MOST_BYTES + 1):
        with suppress(UnicodeDecodeError):
            return pressed[:length].decode(), pressed[length:]
    return "\ufffd", pressed[1:]
