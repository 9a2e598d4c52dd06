"""Check command-line mistakes of tools/: each prints one sentence and starts nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from tables import table

pytestmark = pytest.mark.long

TOOLS = Path(__file__).parents[2] / "tools"
LINUX = "multidrop-0.1.0-cp311-abi3-manylinux2014_x86_64.manylinux_2_17_x86_64.whl"
WINDOWS = "multidrop-0.1.0-cp311-abi3-win_amd64.whl"

# Arguments, typed in a folder with two wheels, a file and an empty folder; and the expected message.
MISTAKES = {
    "bare": "bare: it takes RELEASE WHEEL, and was given nothing",
    f"bare stable {LINUX} {LINUX}": f"bare: it takes RELEASE WHEEL, and was given: stable {LINUX} {LINUX}",
    "bare stable none.whl": "bare: there is no wheel none.whl: make one with `tools/wheels`",
    "bare stable file": "bare: file is not a wheel: its name must end with .whl",
    f"bare stable {WINDOWS}": f"bare: {WINDOWS} is the wrong wheel: use *manylinux*_x86_64.whl",
    "booted": "booted: it takes RELEASE WHEEL, and was given nothing",
    "booted stable none.whl": "booted: there is no wheel none.whl: make one with `tools/wheels`",
    f"booted stable {WINDOWS}": f"booted: {WINDOWS} is the wrong wheel: use *manylinux*_x86_64.whl",
    "foreign": "foreign: it takes MACHINE WHEEL [WORD]..., and was given nothing",
    f"foreign sparc {LINUX}": "foreign: unknown machine sparc: name arm64 or armhf",
    "foreign arm64 none.whl": "foreign: there is no wheel none.whl: make one with `tools/wheels`",
    f"foreign arm64 {LINUX}": f"foreign: {LINUX} is the wrong wheel: use *manylinux*_aarch64.whl",
    "foreign armhf empty": "foreign: empty is not a wheel: its name must end with .whl",
    "musl": "musl: it takes make FOLDER WHEEL [PACKAGE]..., or FOLDER WORD..., and was given nothing",
    "musl make new": "musl: make takes FOLDER WHEEL [PACKAGE]..., and was given: new",
    "musl make empty none.whl": "musl: empty exists already: name a new folder",
    "musl make new none.whl": "musl: there is no wheel none.whl: make one with `tools/wheels`",
    f"musl make new {LINUX}": f"musl: {LINUX} is the wrong wheel: use *musllinux*_x86_64.whl",
    "musl none -V": "musl: none is not a folder made by `tools/musl make`",
    "musl empty -V": "musl: empty is not a folder made by `tools/musl make`",
    "wine": "wine: it takes make FOLDER WHEEL [PACKAGE]..., test FOLDER, or FOLDER WORD..., and was given",
    "wine make new": "wine: make takes FOLDER WHEEL [PACKAGE]..., and was given: new",
    "wine make empty none.whl": "wine: empty exists already: name a new folder",
    "wine make new none.whl": "wine: there is no wheel none.whl: make one with `tools/wheels`",
    f"wine make new {LINUX}": f"wine: {LINUX} is the wrong wheel: use *win_amd64.whl",
    "wine test": "wine: test takes FOLDER, and was given nothing",
    "wine test empty": "wine: empty is not a folder made by `tools/wine make`",
    "wine test none": "wine: none is not a folder made by `tools/wine make`",
    "wine build new": "wine: build is not a folder made by `tools/wine make`",
    "wine file -V": "wine: file is not a folder made by `tools/wine make`",
    "wheels dist": "wheels: error: unrecognized arguments: dist",
    "wheels --only sparc": "wheels: error: argument --only: invalid choice: 'sparc'",
    "wheels --out file": "wheels: error: file is not a folder: name an empty or a new one with --out",
    "wheels --out .": "wheels: error: . contains sdists or wheels already: name an empty folder with --out",
    "wheels --out new --python pithon": "wheels: error: there is no interpreter pithon to try a wheel with",
    "wheels --out new --only windows --python python3": "wheels: error: --python tries the wheel of x86_64",
}


@pytest.mark.parametrize("words", MISTAKES)
def test_mistake_prints_one_sentence_and_starts_nothing(tmp_path: Path, words: str) -> None:
    for name in (LINUX, WINDOWS, "file"):
        (tmp_path / name).touch()
    (tmp_path / "empty").mkdir()
    there = sorted(tmp_path.rglob("*"))
    tool, *others = words.split()
    program = [sys.executable] if tool == "wheels" else []
    ran = subprocess.run(
        [*program, TOOLS / tool, *others],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert ran.returncode == 2, ran.stderr
    assert ran.stdout == ""
    *usage, sentence = ran.stderr.splitlines()
    assert sentence.startswith(MISTAKES[words])
    assert not usage or (tool == "wheels" and usage[0].startswith("usage: "))
    assert sorted(tmp_path.rglob("*")) == there


@table("tool", ["bare", "booted", "foreign", "musl", "wheels", "wine"])
def test_help_is_the_header_of_the_tool(tool: str) -> None:
    ran = subprocess.run([TOOLS / tool, "--help"], capture_output=True, text=True, check=True, timeout=60)
    assert f"tools/{tool} " in ran.stdout
    assert ran.stdout.isascii()
    assert ran.stderr == ""
