"""Check that README is short, installs like .ci/run, and that its ten-line example works.

test_docs.py runs the code of all pages.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import patient
import pytest
from lines import PATIENCE
from sources import files, run_time_imports

from multidrop.families import MODELS

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text("utf-8")

SETTING_UP = [
    "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/multidrop demo",
    "python3 -m venv .venv && .venv/bin/pip install '.[test]' && .venv/bin/pytest",
]


def test_readme_is_short() -> None:
    assert len(README.splitlines()) <= 120


def test_the_benchmarks_page_is_short() -> None:
    assert len((ROOT / "bench" / "README.md").read_text("utf-8").splitlines()) <= 80


def test_the_bench_extra_installs_all_that_benchmarks_import() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    nested = [extra for name in ("test", "history", "plot") for extra in extras[name]]
    assert any("multidrop[test,history,plot]" in wanted for wanted in extras["bench"])
    distributions = {"pyserial": "serial", "modbus-tk": "modbus_tk", "cffi": "cffi"}
    wanted = {
        re.split(r"[\[><=; ]", text)[0] for text in [*project["dependencies"], *extras["bench"], *nested]
    }
    installed = {distributions.get(name, name) for name in wanted}
    ours = {"multidrop", "bench", *(path.stem for path in (ROOT / "tests" / "support").rglob("*.py"))}
    imported = {name.partition(".")[0] for path in files("bench") for name in run_time_imports(path)}
    assert imported - ours - set(sys.stdlib_module_names) - installed == set()


def test_setup_equals_ci() -> None:
    patterns = re.findall(r"grep -m1 -E '([^']+)' README\.md", (ROOT / ".ci" / "run").read_text("utf-8"))
    found = [next(line for line in README.splitlines() if re.search(pattern, line)) for pattern in patterns]
    assert sorted(found) == sorted(SETTING_UP)


@pytest.mark.slow
def test_ten_line_example_runs(tmp_path: Path) -> None:
    """Run the lines in a fresh interpreter without a warning."""
    (block,) = re.findall(r"^```python\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)
    (tmp_path / "ten_lines.py").write_text(block)
    done = subprocess.run(
        [sys.executable, "-W", "error", patient.__file__, "ten_lines.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert (done.returncode, done.stderr) == (0, "")
    values, acceleration = done.stdout.splitlines()
    assert values.startswith("{'output_current': ")
    assert acceleration == "20.0 s"


def test_readme_lists_every_family() -> None:
    table = README.partition("## Families")[2].partition("\n\nThey may share")[0]
    assert re.findall(r"^\| `([^`]+)`", table, re.MULTILINE) == list(MODELS)
