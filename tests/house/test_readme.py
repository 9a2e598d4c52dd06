"""README's code runs as it is pasted, and its commands are commands."""

from __future__ import annotations

import asyncio
import importlib
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from lines import PATIENCE

from multidrop import Bus, Poller, load_plant, open_reader
from multidrop.cli import COMMANDS, main
from multidrop.drives import MODELS
from multidrop.sim import Simulator, Wire, simulated

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text("utf-8")

SETTING_UP = [
    "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/multidrop demo",
    "python3 -m venv .venv && .venv/bin/pip install '.[test]' && .venv/bin/pytest",
]
MARKS = ("set_frequency", "class Fan", "load_plant", "add_reader")  # one for each block of Python


def code(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)


def python(mark: str) -> str:
    """The block of Python with this in it."""
    (block,) = (it for it in code("python") if mark in it)
    return block


def run(block: str, directory: Path) -> str:
    """Return what a fresh interpreter prints when it runs this."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", block],
        cwd=directory,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Path]:
    """README's plant file, its port that of a simulated line."""
    (text,) = code("toml")
    path, port = tmp_path / "plant.toml", tmp_path / "hall-1"
    assert '"/dev/ttyUSB0"' in text
    path.write_text(text.replace('"/dev/ttyUSB0"', f'"{port}"'))
    drives = [simulated(it.drive) for it in load_plant(path).lines[0].drives]
    with Simulator([Wire(drives, port=str(port))]):
        yield path


def test_all_its_python_is_run_here() -> None:
    assert [mark for block in code("python") for mark in MARKS if mark in block] == list(MARKS)


def test_ten_lines(tmp_path: Path) -> None:
    values, acceleration = run(python("set_frequency"), tmp_path).splitlines()
    assert values.startswith("{'output_current': ")
    assert acceleration == "20.0 s"


def test_a_drive_of_one_s_own(tmp_path: Path) -> None:
    space: dict[str, Any] = {"__name__": "fan"}
    exec(python("class Fan"), space)
    fan = simulated(space["Fan"](3))
    fan["speed"] = 1440
    with Simulator([Wire([fan], unpaced=True)]) as line, Bus(line.wires[0].path) as bus:
        ours = bus.attach(space["Fan"], address=3)
        assert bus.read(ours, ours.speed) == 1440
        assert bus.write(ours, ours.frequency, 42.0) == 42.0
    (tmp_path / "fan.py").write_text(python("class Fan"))
    (model,) = re.findall(r'`(model = "fan.py:Fan")`', README)
    path = tmp_path / "fans.toml"
    path.write_text(
        f'[[line]]\nname = "roof"\nport = "x"\n[[line.drive]]\nname = "fan-1"\naddress = 3\n{model}\n'
    )
    assert [poll.register.name for poll in load_plant(path).lines[0].drives[0].polls] == ["speed", "current"]


def test_polling_a_plant(plant: Path) -> None:
    block = python("load_plant")
    assert "seconds=60" in block
    run(block.replace("seconds=60", "seconds=1"), plant.parent)
    rows = [row for batch in open_reader(plant.parent / "run.arrows") for row in batch]
    assert {(row.drive, row.register) for row in rows if row.value is not None} == {
        ("pump-1", "output_current"),
        ("pump-1", "terminals"),
    }


def test_polling_in_an_asyncio_program(plant: Path) -> None:
    async def first() -> Any:
        loop = asyncio.get_running_loop()
        came = loop.create_future()
        with Poller(load_plant(plant)) as poller:
            space = {"loop": loop, "poller": poller, "handle": lambda it: came.done() or came.set_result(it)}
            exec(python("add_reader"), space)
            try:
                return await asyncio.wait_for(came, PATIENCE)
            finally:
                loop.remove_reader(poller.fileno())

    assert {row.drive for row in asyncio.run(first())} == {"pump-1"}


def test_setting_up_is_what_ci_does() -> None:
    assert [line for block in code("sh") for line in block.splitlines()] == SETTING_UP
    patterns = re.findall(r"grep -m1 -E '([^']+)' README\.md", (ROOT / ".ci" / "run").read_text("utf-8"))
    found = [next(line for line in README.splitlines() if re.search(it, line)) for it in patterns]
    assert sorted(found) == sorted(SETTING_UP)


COMMANDED = sorted({*re.findall(r"`(?:uv run )?multidrop ([^`]+)`", README)})


@pytest.mark.parametrize("words", COMMANDED)
def test_its_commands_are_commands(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name, *arguments = shlex.split(words)
    assert name in COMMANDS
    if not arguments and name not in {"models", "demo"}:
        return  # named, not given as it is typed
    module = importlib.import_module(f"multidrop.cli.{COMMANDS[name][0]}")
    monkeypatch.setattr(module, "run", lambda arguments: 0)
    assert main([name, *arguments]) == 0


def test_its_families_are_all_there_are() -> None:
    table = README.partition("## The families")[2].partition("\n\n`multidrop models`")[0]
    assert re.findall(r"^\| `([^`]+)`", table, re.MULTILINE) == list(MODELS)
