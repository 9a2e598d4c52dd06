"""The terminal: pictures and sparklines that fit its encoding and width, and keys from its bytes."""

from __future__ import annotations

import os
import select
import sys
from io import BytesIO, StringIO, TextIOWrapper
from types import SimpleNamespace

import pytest
from lines import PATIENCE
from tables import table

from multidrop.cli.support.terminal import (
    DOWN,
    ENTER,
    PAGE_UP,
    UNKNOWN,
    UP,
    Screen,
    TextLine,
    next_key,
    sparkline,
    terminal_keys,
)
from multidrop.cli.support.values import columns_of


def test_a_growing_history_keeps_its_points_in_the_same_sparkline_columns() -> None:
    assert sparkline([0, 7, 0, 7, 7, 7, None, None, 0, 0], 5) == "▅▅█ ▁"
    steps = [0.0] * 60 + [7.0] * 60 + [0.0] * 120
    pictures = [sparkline(steps[at : at + 120], 30, points=120 + at) for at in range(100)]
    assert {picture.strip("▁") for picture in pictures[:60]} == {"█" * 15}


def test_replaced_characters_keep_the_text_in_its_columns() -> None:
    text = "Июль 主 26 °C"
    for encoding, shown in (("ascii", "???? ?? 26 ?C"), ("utf-8", text)):
        with TextIOWrapper(BytesIO(), encoding) as terminal:
            assert Screen(terminal).encodable(text) == shown
        assert columns_of(shown) == columns_of(text)


def test_each_picture_replaces_the_last_and_is_removed_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "6")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    terminal = StringIO()
    with Screen(terminal) as screen:
        screen.draw([TextLine("pump", "red reverse"), TextLine("fan")])
    assert terminal.getvalue() == (
        "\x1b[?1049h\x1b[?25l\x1b[H\x1b[31;7mpump\x1b[m  \r\nfan   \x1b[?25h\x1b[?1049l"
    )


@table(
    ("pressed", "told"),
    [
        (b"q", ["q"]),
        (b"\x1b[A\x1b[B\r", [UP, DOWN, ENTER]),
        (b"\x1bOBsy", [DOWN, "s", "y"]),
        (b"\x1b[5~\x1b", ["page up", "escape"]),
        ("ыk ".encode(), ["ы", "k", " "]),
        (b"\xd1s\xff", ["\ufffd", "s", "\ufffd"]),
        (b"\x1bOSy\x1b[1;2S\x1b[[As\x1b[a\x1bOq", [UNKNOWN, "y", UNKNOWN, UNKNOWN, "s", UNKNOWN, UNKNOWN]),
    ],
)
def test_keys_whose_bytes_arrive_together_are_separated(pressed: bytes, told: list[str]) -> None:
    found = []
    while pressed:
        key, pressed = next_key(pressed)
        found.append(key)
    assert found == told


@table(
    ("pieces", "pressed"),
    [
        ([b"\x1b", b"OS", b"s"], [UNKNOWN, "s"]),  # the bytes of the key F4 end in S, which is a key too
        ([b"j\x1b[", b"5", b"~y"], ["j", PAGE_UP, "y"]),
        (["\u044b".encode()[:1], "\u044b".encode()[1:]], ["\u044b"]),
        ([b"\x1b", b""], ["escape"]),
    ],
)
def test_a_key_whose_bytes_arrive_separately_is_one_key(
    monkeypatch: pytest.MonkeyPatch, pieces: list[bytes], pressed: list[str]
) -> None:
    """A network may split a key's bytes: those of F4 end in S, which must not stop all drives."""
    terminal, end = os.openpty()
    left = iter(pieces)

    def wait(*waited: object) -> object:
        os.write(terminal, next(left, b""))
        return real(*waited)  # type: ignore[arg-type]

    real = select.select
    with open(end, closefd=True) as stdin:  # noqa: PTH123
        monkeypatch.setattr(sys, "stdin", stdin)
        with terminal_keys() as wait_for_key:
            monkeypatch.setattr("multidrop.cli.support.terminal.select", SimpleNamespace(select=wait))
            assert [wait_for_key(PATIENCE) for _ in pressed] == pressed
    os.close(terminal)


def test_a_closed_terminal_is_not_read_in_a_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reads of a closed terminal return immediately, empty or with an error. There may be no signal."""
    fd, slave = os.openpty()
    with open(slave) as stdin:  # noqa: PTH123 (it is no path)
        monkeypatch.setattr(sys, "stdin", stdin)
        with terminal_keys() as wait_for_key:
            os.close(fd)
            with pytest.raises(OSError):  # noqa: PT011 (in the system's words)
                wait_for_key(PATIENCE)
