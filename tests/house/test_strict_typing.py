"""Check users' scripts with `mypy --strict`: Python blocks of these pages, and the examples."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "docs" / "howto" / "coming-from.md"]
SCRIPTS = {
    **{
        page.stem.replace("-", "_"): "".join(
            re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
        )
        for page in PAGES
    },
    **{path.stem: path.read_text("utf-8") for path in (ROOT / "examples").glob("*.py")},
}
TYPES = """
from multidrop import Bus, InnovertIBD

with Bus("/dev/ttyUSB0") as bus:
    pump = bus.attach(InnovertIBD, address=1)
    reveal_type(pump.read(pump.output_current))
    reveal_type(pump.read("output_current", pump.output_frequency))
    reveal_type(pump.write(pump.acceleration_time, 20.0))
    reveal_type(pump.stop(seconds=5).ok)
    reveal_type(pump.state())
    pump.write(pump.acceleration_time, "fast")
    pump.red("output_current")
"""
FOUND = [
    'note: Revealed type is "float"',
    'note: Revealed type is "dict[str, Any]"',
    'note: Revealed type is "float"',
    'note: Revealed type is "bool"',
    'note: Revealed type is "multidrop.drive.state.State"',
    'error: No overload variant of "write" of "RegisterAccess"',
    'error: "InnovertIBD" has no attribute "red"',
]


def mypy(folder: Path) -> str:
    """Return mypy's output for the scripts in a user's folder."""
    words = ["--strict", "--follow-imports=silent", "--config-file=", f"--cache-dir={folder / 'cache'}", "."]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words],
        cwd=folder,
        env={"MYPYPATH": str(ROOT / "src")},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    return done.stdout + done.stderr


def test_scripts_of_users_are_strictly_typed(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    for name, script in SCRIPTS.items():
        (tmp_path / f"{name}.py").write_text(script, "utf-8")
    found = mypy(tmp_path)
    assert found.startswith("Success"), found


def test_values_have_the_types_of_their_registers(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    (tmp_path / "script.py").write_text(TYPES, "utf-8")
    found = mypy(tmp_path)
    for sentence in FOUND:
        assert sentence in found
