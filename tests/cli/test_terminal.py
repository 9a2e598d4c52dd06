"""The terminal: pictures that fit its encoding and width, keys, and the live table of `poll` and `demo`."""

from __future__ import annotations

import argparse
import logging
import os
import select
import signal
import sys
import threading
from io import BytesIO, StringIO, TextIOWrapper
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from commands import TOY_IS_RUN
from lines import PATIENCE, until
from recordings import recorded
from tables import table
from terminals import on_terminal

from multidrop.cli import run
from multidrop.cli.poll import Keys, LiveTable
from multidrop.cli.support.polling import Triggering, trigger_picture
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
from multidrop.control import exit_hook
from multidrop.plant.loader import load_plant
from multidrop.polling.batch import Row
from multidrop.recording import open_writer
from multidrop.recording.rows import from_rows


def test_sparkline_points_keep_their_columns_as_the_history_grows() -> None:
    assert sparkline([0, 7, 0, 7, 7, 7, None, None, 0, 0], 5) == "▅▅█ ▁"
    steps = [0.0] * 60 + [7.0] * 60 + [0.0] * 120
    pictures = [sparkline(steps[at : at + 120], 30, points=120 + at) for at in range(100)]
    assert {picture.strip("▁") for picture in pictures[:60]} == {"█" * 15}


def test_unencodable_characters_are_replaced_by_text_of_equal_width() -> None:
    text = "Июль 主 26 °C"
    for encoding, shown in (("ascii", "???? ?? 26 ?C"), ("utf-8", text)):
        with TextIOWrapper(BytesIO(), encoding) as terminal:
            assert Screen(terminal).encodable(text) == shown
        assert columns_of(shown) == columns_of(text)


def test_the_screen_is_drawn_in_the_alternate_terminal_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end, the terminal shows its former contents again."""
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
def test_several_keys_in_one_read_are_separated(pressed: bytes, told: list[str]) -> None:
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
def test_a_key_split_into_several_reads_is_one_key(
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


def test_waiting_for_a_key_raises_oserror_if_the_terminal_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reads of a closed terminal return immediately, empty or with an error. There may be no signal."""
    fd, slave = os.openpty()
    with open(slave) as stdin:  # noqa: PTH123 (it is no path)
        monkeypatch.setattr(sys, "stdin", stdin)
        with terminal_keys() as wait_for_key:
            os.close(fd)
            with pytest.raises(OSError):  # noqa: PT011 (in the system's words)
                wait_for_key(PATIENCE)


@pytest.mark.slow
@pytest.mark.long
def test_a_demo_shows_the_monitor_on_a_terminal(tmp_path: Path) -> None:
    out = tmp_path / "demo.arrows"
    with on_terminal("demo", "--out", out, "--seconds", 2, size=(120, 24)) as terminal:
        terminal.wait_for(">pump-1")
        terminal.wait_for_match(r"belts +8 ")
        terminal.wait_for("multidrop demo --web")
        terminal.wait_for(f"report {out}")
        terminal.wait_for("scan /dev/ttyUSB0")
        assert terminal.process.wait(timeout=60) == 0
    assert "belt-3" in {row.drive for row in recorded(out)}


@pytest.mark.long
def test_the_poll_command_shows_the_newest_values_on_a_terminal(plant: Path) -> None:
    with on_terminal("poll", plant, "--seconds", "1", size=(120, 24)) as terminal:
        terminal.wait_for("DRIVE   SAMPLES  MISSES  NEWEST VALUES")
        terminal.wait_for("output_current 0.00 A, mystery 0 raw, fault NONE, status none")
        # the line of the second drive says "no reply" or "not asked"
        terminal.wait_for("output_frequency: no")
        terminal.wait_for("utilisation")
        assert terminal.process.wait(timeout=60) == 0
        assert b"\x1b[4F\x1b[J" in terminal.written  # table, head and note are drawn over the previous ones


@pytest.mark.long
def test_the_live_table_is_cut_to_the_size_of_its_terminal(plant: Path) -> None:
    with on_terminal("poll", plant, "--seconds", "1", size=(40, 2)) as terminal:
        terminal.wait_for("... and 3 more drives")
        terminal.wait_for("utilisation")
        assert terminal.process.wait(timeout=60) == 0
        table = terminal.text.replace("\r\n", "\n").removeprefix(TOY_IS_RUN).partition("hall-1: ")[0]
        assert max(map(len, table.splitlines())) < 40


@pytest.mark.long
@pytest.mark.slow
def test_key_m_adds_a_comment_and_key_t_adds_a_trigger(plant: Path, tmp_path: Path) -> None:
    options = ("--trigger", "key", "--pre", "10 s", "--post", "10 s", "--out", tmp_path / "trip.csv")
    with on_terminal("poll", plant, *options, size=(100, 24)) as terminal:
        terminal.wait_for("m: add a comment; t: trigger; Ctrl-C: end")
        terminal.press("mkey j\x7fk, \u044f\r".encode())
        terminal.press(b"t")
        terminal.press(b"mnot this\x1b")
        until(lambda: list(tmp_path.glob("trip.*.csv")))
        terminal.process.send_signal(signal.SIGINT)
        terminal.wait_for("1 trigger recorded")
    rows = recorded(tmp_path / "trip.00000001.csv")
    events = [(row.register, row.status) for row in rows if row.drive == "event"]
    assert events == [("comment", "key k, \u044f"), ("trigger", "key t")]


def test_key_m_explains_that_comments_need_a_recording() -> None:
    poller, table = SimpleNamespace(mark=pytest.fail), SimpleNamespace(note="")
    keys = Keys(cast(Any, poller), cast(Any, table), lambda seconds: "", has_trigger=False, is_recorded=False)
    assert table.note == "Ctrl-C: end"
    keys.press("m")
    assert table.note.startswith("no comment: nothing is recorded; start poll with --out FILE")
    keys.press("\r")


@pytest.mark.long
@pytest.mark.slow
def test_the_terminal_shows_the_signal_around_the_last_trigger(plant: Path, tmp_path: Path) -> None:
    condition = "integral(pump-1.output_current >= 0) > 0.3"
    options = ("--trigger", condition, "--pre", "100 ms", "--post", "200 ms", "--out", tmp_path / "a.arrows")
    with on_terminal("poll", plant, *options, size=(100, 24)) as terminal:
        terminal.wait_for("^ from -0.1 s to 0.2 s")
        terminal.process.send_signal(signal.SIGINT)
        terminal.wait_for("1 trigger recorded")


def test_the_picture_of_a_trigger_marks_the_trigger_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    about = {"condition": "a.i > 3", "time_ns": 2 * 10**9, "pre_s": 1.0, "post_s": 3.0}
    registers = {"i": {"unit": "A"}, "u": {"unit": "V"}}
    rows = [Row(at * 10**8, at, 0, "a", name, float(at == 25), "ok") for at in range(10, 40) for name in "iu"]
    rows[0] = Row(10**9, 0, None, "a", "i", None, "no reply")
    with open_writer(
        tmp_path / "a.csv", {"trigger": about, "drives": {"a": {"registers": registers}}}
    ) as file:
        file.write(from_rows(rows))
    how = Triggering(1.0, 3.0, {}, {"a.i > 3": [("a", "i")]})
    assert trigger_picture(tmp_path / "a.csv", how, 55, "_#") == [
        "trigger 00:00:02.000000 UTC: a.i > 3, in a.csv",
        "a.i   ______________#________________________  0 to 1 A",
        "               ^ from -1 s to 3 s",
    ]
    of_all = trigger_picture(tmp_path / "a.csv", how._replace(signals={}), 55, "_#")
    assert [line[:3] for line in of_all] == ["tri", "a.i", "a.u", "   "]
    assert trigger_picture(tmp_path / "none.csv", how, 55, "_#") == []
    monkeypatch.setattr("multidrop.cli.support.polling.MOST_ROWS", len(rows) - 1)
    (line,) = trigger_picture(tmp_path / "a.csv", how, 55, "_#")
    assert line == "trigger 00:00:02.000000 UTC: a.i > 3, in a.csv, which is too large for a picture"


# ---- the table of `poll` on a terminal: cut to the terminal's width, and redrawn in place ----


DRIVE = '[[line.drive]]\nname = "{}"\nmodel = "invt-che"\naddress = 1\n'
NO_ROWS: Any = ()
WIDE_NAME = "\u4e3b\u6cf5-1"  # its first two characters take two columns each


@pytest.fixture
def size(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the terminal's columns and lines, in a list that a test may change."""
    found = [80, 24]
    terminal = SimpleNamespace(get_terminal_size=lambda: os.terminal_size(found))
    # replaced in this module only, because pytest uses the original function
    monkeypatch.setattr("multidrop.cli.poll.shutil", terminal)
    return found


def drawings(tmp_path: Path, encoding: str, size: list[int], *widths: int) -> list[str]:
    """Return what is drawn on a terminal of each width in turn."""
    path = tmp_path / "plant.toml"
    drive = DRIVE.format(WIDE_NAME)
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


def test_a_line_wider_than_the_terminal_ends_with_a_tilde(tmp_path: Path, size: list[int]) -> None:
    whole, narrow = drawings(tmp_path, "utf-8", size, 80, 40)
    head = "DRIVE   SAMPLES  MISSES  NEWEST VALUES\n"
    assert whole == f"{head}{WIDE_NAME}        1       0  output_frequency 42.50 Hz\n"
    assert narrow.endswith(f"{WIDE_NAME}        1       0  output_freque~\n")


def test_a_wrapped_table_is_redrawn_after_the_terminal_narrowed(tmp_path: Path, size: list[int]) -> None:
    """On a terminal of 40 columns, a line of 51 columns takes two rows, and the heading of 38 takes one."""
    again = [text[: text.index("J") + 1] for text in drawings(tmp_path, "utf-8", size, 80, 80, 40)[1:]]
    assert again == ["\x1b[2F\x1b[J", "\x1b[3F\x1b[J"]


def test_the_live_table_is_redrawn_below_a_warning(
    tmp_path: Path, size: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    """The table does not count the values of computed channels."""
    path = tmp_path / "plant.toml"
    drive = DRIVE.format("pump")
    channel = '[[line.drive.channel]]\nname = "hertz"\nvalue = "output_frequency"\nunit = "Hz"\n'
    path.write_text(f'[[line]]\nname = "hall"\nport = "x"\n{drive}{channel}')
    table = LiveTable(load_plant(path), sys.stderr)
    table.add(from_rows([Row(0, 0, 1000, "pump", "hertz", 42.5, "ok")]))
    logger = logging.getLogger("multidrop.polling")
    with table.showing_warnings():
        table.draw()
        logger.warning("pump.hours: 3 s are not counted")
        table.draw()
        logger.warning("the last one")
    drawing = "DRIVE  SAMPLES  MISSES  NEWEST VALUES\npump         0       0  hertz 42.5 Hz\n"
    warnings = "multidrop: pump.hours: 3 s are not counted\n", "multidrop: the last one\n"
    assert capsys.readouterr().err == f"{drawing}\x1b[2F\x1b[J{warnings[0]}{drawing}{warnings[1]}"


def test_the_columns_stay_aligned_if_a_name_cannot_be_encoded(tmp_path: Path, size: list[int]) -> None:
    (text,) = drawings(tmp_path, "ascii", size, 80)
    assert "\\u" not in text
    assert text.endswith("\n??-1        1       0  output_frequency 42.50 Hz\n")


def test_a_message_printed_at_a_signal_stays_above_the_redrawn_table(
    tmp_path: Path, size: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(f'[[line]]\nname = "hall"\nport = "x"\n{DRIVE.format("pump")}')
    terminal = StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr("multidrop.cli.poll.EVERY", 0.0)
    monkeypatch.setattr(exit_hook, "_print_error", print)
    monkeypatch.setattr(exit_hook, "_hook", hook := exit_hook.ExitHook())
    before = signal.signal(signal.SIGTERM, lambda number, frame: None)
    stopped = threading.Event()
    act = hook.add(lambda: None, stopped.wait, lambda: ["pump"])
    test: Any = SimpleNamespace(plan=SimpleNamespace(plant=load_plant(path)), phase="")
    try:
        with run._screen(test, argparse.Namespace(json=False)) as (show,):
            show(NO_ROWS)
            signal.raise_signal(signal.SIGTERM)
            for _ in range(2):
                show(NO_ROWS)
    finally:
        stopped.set()
        hook.await_effect()
        hook.finish(act)
        signal.signal(signal.SIGTERM, before)
    table = "DRIVE  SAMPLES  MISSES  NEWEST VALUES\npump         0       0\n"
    again = f"stopping all drives\n{table}"
    sentence = exit_hook.STOPPING.format("SIGTERM", "pump")
    assert terminal.getvalue() == f"checking the drives\n{table}{sentence}\n{again}\x1b[3F\x1b[J{again}"
