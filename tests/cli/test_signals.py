"""Signals during a command: repeated Ctrl-C, and the closing of its terminal."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from batches import METADATA, counting
from commands import Run, plant_file
from peers import require_module
from recordings import recorded
from terminals import closing_terminal

from multidrop import cli
from multidrop.cli.support import signals
from multidrop.cli.support.signals import end_signals_interrupt, noting_signals, on_end_signals, run_loop
from multidrop.recording import open_writer

PATIENCE = 60.0


@pytest.fixture
def hangup_is_deadly() -> Iterator[None]:
    """Let SIGHUP end the process, even if the tests run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def hang_up() -> None:
    """Send SIGHUP to this process. If no command handled it, the process would end."""
    assert callable(signal.getsignal(signal.SIGHUP))
    signal.raise_signal(signal.SIGHUP)


def test_a_closed_terminal_is_noted_but_does_not_interrupt(hangup_is_deadly: None) -> None:
    with noting_signals() as interruption:
        for _ in range(2):  # a shell and the system send one signal each
            hang_up()
        assert interruption.came
        signal.raise_signal(signal.SIGTERM)  # a system that ends the session sends SIGTERM too
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)


def test_a_closed_terminal_interrupts_a_command_once(hangup_is_deadly: None) -> None:
    with end_signals_interrupt():
        with pytest.raises(KeyboardInterrupt):
            hang_up()
        hang_up()
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_the_creation_of_the_event_loop_prints_no_traceback(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python would print a traceback for an incomplete loop, and a warning for work that never ran."""
    make = asyncio.SelectorEventLoop._make_self_pipe  # type: ignore[attr-defined]

    def interrupted(loop: asyncio.SelectorEventLoop) -> None:
        signal.raise_signal(number)
        make(loop)

    async def work() -> None:
        raise AssertionError("this never runs")

    monkeypatch.setattr(asyncio.SelectorEventLoop, "_make_self_pipe", interrupted)
    with end_signals_interrupt(), pytest.raises(KeyboardInterrupt):
        run_loop(work())
    # If the coroutine was not closed, Python warns now, and pytest turns the warning into an error.
    gc.collect()


def test_sighup_is_ignored_under_nohup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with end_signals_interrupt(), noting_signals() as interruption:
            signal.raise_signal(signal.SIGHUP)
        assert not interruption.came
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_closed_terminal_ends_a_service_only_once(hangup_is_deadly: None) -> None:
    ends: list[int] = []

    async def service() -> None:
        on_end_signals(lambda: ends.append(1))
        hang_up()
        async with asyncio.timeout(PATIENCE):
            while not ends:
                await asyncio.sleep(0)
        hang_up()
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(asyncio.CancelledError):
            await asyncio.sleep(PATIENCE)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)

    terminate = signal.getsignal(signal.SIGTERM)
    try:
        asyncio.run(service())
    finally:
        signal.signal(signal.SIGTERM, terminate)
    assert ends == [1]


def test_a_second_signal_interrupts_immediately() -> None:
    with noting_signals() as interruption:
        assert not interruption.came
        signal.raise_signal(signal.SIGINT)
        assert interruption.came
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)


@pytest.mark.long
@pytest.mark.slow
def test_the_poll_command_keeps_its_recording_when_its_terminal_is_closed(
    plant: Path, tmp_path: Path
) -> None:
    require_module("pyarrow")
    out = tmp_path / "out.parquet"  # a Parquet file cannot be read unless it was closed
    with closing_terminal("poll", plant, "--out", out) as terminal:
        terminal.wait_for_match(r"pump-1 +[1-9]")
        terminal.close()
        assert terminal.process.wait(PATIENCE) >= 0
    assert any(row.value is not None for row in recorded(out))


@pytest.mark.long
def test_the_simulate_command_removes_its_links_when_its_terminal_is_closed(tmp_path: Path) -> None:
    link = tmp_path / "ports" / "hall-1"
    words = ["simulate", plant_file(tmp_path), "--ports", tmp_path / "ports"]
    with closing_terminal(*words) as terminal:
        terminal.wait_for("ready hall-1")
        assert link.is_symlink()
        terminal.close()
        assert terminal.process.wait(PATIENCE) >= 0  # the process was not ended by a signal
    assert not link.is_symlink()


@pytest.mark.long
@pytest.mark.slow
def test_serve_demo_ends_when_its_terminal_is_closed() -> None:
    """SIGHUP makes `serve` reload its plant file, but the demo has none."""
    require_module("uvicorn")
    with closing_terminal("serve", "--demo", "--no-browser") as terminal:
        terminal.wait_for("Ctrl-C ends it")
        terminal.close()
        assert terminal.process.wait(PATIENCE) >= 0  # the process was not ended by a signal


@pytest.mark.slow
def test_a_gateway_ends_when_its_terminal_is_closed(tmp_path: Path) -> None:
    require_module("uvicorn")
    path = plant_file(tmp_path)
    with path.open("a") as file:
        file.write('[serve]\nlisten = "127.0.0.1:0"\n')
    with closing_terminal("serve", path) as terminal:
        terminal.wait_for("ready http")
        path.write_text("no plant")
        terminal.process.send_signal(signal.SIGHUP)
        terminal.wait_for("reload, asked for by a signal")
        terminal.close()
        assert terminal.process.wait(PATIENCE) == 0


@pytest.mark.parametrize(
    ("before", "group", "reloads"),
    [(signal.SIG_DFL, os.getpgrp(), 1), (signal.SIG_DFL, 1, 2), (signal.SIG_IGN, os.getpgrp(), 2)],
    ids=["before a terminal", "in the background", "by nohup"],
)
def test_sighup_of_a_closed_terminal_ends_only_a_foreground_command(
    monkeypatch: pytest.MonkeyPatch, before: signal.Handlers, group: int, reloads: int
) -> None:
    came: list[str] = []
    terminal: list[int | None] = [group]
    monkeypatch.setattr(signals, "_foreground", lambda: terminal[-1])

    async def service() -> None:
        signals.on_reload_signal(lambda: came.append("reload"), lambda: came.append("end"))
        for number in (1, 2):
            hang_up()
            async with asyncio.timeout(PATIENCE):
                while len(came) < number:
                    await asyncio.sleep(0)
            terminal.append(None)

    was = signal.signal(signal.SIGHUP, before)
    try:
        asyncio.run(service())
    finally:
        signal.signal(signal.SIGHUP, was)
    assert came == ["reload"] * reloads + ["end"] * (2 - reloads)


def interrupted_class(words: list[str]) -> int:
    """Press Ctrl-C while a class is created, as during an import. Python 3.11 then raises RuntimeError."""

    class Interrupted:
        def __set_name__(self, owner: type, name: str) -> None:
            raise KeyboardInterrupt

    type("Imported", (), {"attribute": Interrupted()})
    return 0


def interrupted_parser(words: list[str]) -> int:
    """Raise as argparse does if Ctrl-C comes while it parses: its `finally` fails."""
    try:
        raise KeyboardInterrupt
    finally:
        raise AttributeError("'_StoreAction' object has no attribute 'save_nargs'")


CARELESS = """\
import signal
try:
    signal.raise_signal(signal.SIGINT)
except:
    pass
"""


def test_ctrl_c_during_a_conversion_leaves_no_output_file(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "asammdf.py").write_text(CARELESS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "asammdf", None)
    del sys.modules["asammdf"]
    with open_writer(tmp_path / "a.csv", METADATA) as writer:
        writer.write(counting(1, 0))
    words = ("convert", tmp_path / "a.csv", tmp_path / "a.mf4")
    assert run(*words) == (130, "", "multidrop: interrupted\n")
    assert not (tmp_path / "a.mf4").exists()


def test_ctrl_c_during_the_first_imports_prints_one_sentence() -> None:
    code = (
        "import sys, types; from multidrop.__main__ import main\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'multidrop.cli': raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupting()); sys.exit(main())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "multidrop: interrupted\n")


@pytest.mark.parametrize("run", [interrupted_class, interrupted_parser])
def test_a_keyboard_interrupt_wrapped_in_an_exception_prints_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], run: Callable[[list[str]], int]
) -> None:
    monkeypatch.setattr(cli, "_run_interruptible", run)
    assert cli.main(["models"]) == 130
    assert capsys.readouterr().err == "multidrop: interrupted\n"
