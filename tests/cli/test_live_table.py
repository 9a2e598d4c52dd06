"""The table of `poll` on a terminal: cut to the terminal's width, and redrawn in place."""

from __future__ import annotations

import os
from io import BytesIO, TextIOWrapper
from pathlib import Path

import pytest

import multidrop.cli.poll
from multidrop.cli.poll import LiveTable
from multidrop.plant.loader import load_plant
from multidrop.polling.batch import Row
from multidrop.recording.rows import from_rows

WIDE_NAME = "\u4e3b\u6cf5-1"  # its first two characters take two columns each


@pytest.fixture
def size(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the terminal's columns and lines, in a list that a test may change."""
    found = [80, 24]
    monkeypatch.setattr(multidrop.cli.poll.shutil, "get_terminal_size", lambda: os.terminal_size(found))
    return found


def drawings(tmp_path: Path, encoding: str, size: list[int], *widths: int) -> list[str]:
    """Return what is drawn on a terminal of each of these widths in turn."""
    path = tmp_path / "plant.toml"
    drive = f'[[line.drive]]\nname = "{WIDE_NAME}"\nmodel = "invt-che"\naddress = 1\n'
    path.write_text(f'[[line]]\nname = "hall"\nport = "x"\n{drive}poll = ["output_frequency"]\n', "utf-8")
    terminal = TextIOWrapper(BytesIO(), encoding, errors="backslashreplace")
    table = LiveTable(load_plant(path), terminal)
    table.add(from_rows([Row(0, 0, 1000, WIDE_NAME, "output_frequency", 42.5, "ok")]))
    found, before = [], 0
    for size[0] in widths:
        table.draw()
        written = terminal.buffer.getvalue().decode(encoding)  # type: ignore[attr-defined]
        found.append(written[before:])
        before = len(written)
    return found


def test_a_table_line_that_is_cut_ends_with_a_mark(tmp_path: Path, size: list[int]) -> None:
    whole, narrow = drawings(tmp_path, "utf-8", size, 80, 40)
    head = "DRIVE   SAMPLES  MISSES  NEWEST VALUES\n"
    assert whole == f"{head}{WIDE_NAME}        1       0  output_frequency 42.50 Hz\n"
    assert narrow.endswith(f"{WIDE_NAME}        1       0  output_freque~\n")


def test_a_wrapped_table_is_redrawn_after_the_terminal_narrowed(tmp_path: Path, size: list[int]) -> None:
    """On a terminal of 40 columns, a line of 51 columns takes two rows, and the heading of 38 takes one."""
    again = [text[: text.index("J") + 1] for text in drawings(tmp_path, "utf-8", size, 80, 80, 40)[1:]]
    assert again == ["\x1b[2F\x1b[J", "\x1b[3F\x1b[J"]


def test_a_name_that_cannot_be_encoded_moves_no_column(tmp_path: Path, size: list[int]) -> None:
    (text,) = drawings(tmp_path, "ascii", size, 80)
    assert "\\u" not in text
    assert text.endswith("\n??-1        1       0  output_frequency 42.50 Hz\n")
