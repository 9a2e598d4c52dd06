"""Check that README is short, has the same installation commands as .ci/run, and a working example.

test_docs.py runs the code of all pages.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import patient
import pytest
from lines import PATIENCE
from sources import files, run_time_imports
from tables import table

from multidrop.cli import main
from multidrop.control import read_audit
from multidrop.families import MODELS
from multidrop.recording import open_recording

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


# ---- examples ----


EXAMPLES = ROOT / "examples"


PAGES = "\n".join(page.read_text("utf-8") for page in (ROOT / "docs").rglob("*.md"))


def run(directory: Path, name: str, *words: str, through: tuple[str, ...] = (patient.__file__,)) -> str:
    """Run an example; return the text that it prints."""
    done = subprocess.run(
        [sys.executable, "-W", "error", *through, str(EXAMPLES / name), *words],
        cwd=directory,
        env={**os.environ, "XDG_STATE_HOME": str(directory / "state")},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@table("path", sorted(EXAMPLES.glob("*.py")))
def test_example_is_linked_and_tested(path: Path) -> None:
    if path.name != "simulated_plant.py":  # imported by the others
        assert f"examples/{path.name}" in PAGES
        assert f'"{path.name}"' in Path(__file__).read_text("utf-8")


@pytest.mark.long
def test_a_logger_to_parquet(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    run(tmp_path, "logger.py", "--seconds", "1")
    rows = [row for batch in open_recording(tmp_path / "log.parquet") for row in batch]
    assert {row.drive for row in rows if row.status == "ok"} == {"pump", "fan"}


@pytest.mark.slow
def test_a_test_bench_measures_each_step_and_records(tmp_path: Path) -> None:
    lines = run(tmp_path, "test_bench.py", "0.5").splitlines()
    assert [line.partition(":")[0] for line in lines] == ["10.0 Hz", "20.0 Hz", "30.0 Hz"]
    assert {row.drive for batch in open_recording(tmp_path / "bench.arrows") for row in batch} == {"fan"}


@pytest.mark.slow
def test_own_device(tmp_path: Path) -> None:
    printed = run(tmp_path, "own_device.py")
    assert "temperature  21.4 degC" in printed
    assert "FILTER" in printed
    assert "target is now 22.5" in printed
    assert "refused: roof: target = 60 is outside 5 to 30 degC" in printed


@pytest.mark.slow
def test_asyncio(tmp_path: Path) -> None:
    lines = run(tmp_path, "asyncio_poll.py", "1").splitlines()
    assert "tick" in lines
    assert any(line.endswith(" rows") for line in lines)


@pytest.mark.long
def test_two_lines(tmp_path: Path) -> None:
    printed = run(tmp_path, "two_lines.py", "4")
    for name in ("pump-1: ", "pump-2: ", "fan-1: ", "hall-1: ", "hall-2: "):
        assert name in printed


@pytest.mark.slow
def test_pump_stops_when_its_program_ends(tmp_path: Path) -> None:
    printed = run(tmp_path, "pump.py", "1")
    assert "failed" not in printed
    assert printed.splitlines()[-1] == "the output frequency is now 0.0 Hz"
    assert any(
        "STOP" in str(record) or "stop" in str(record) for record in read_audit(tmp_path / "pump.jsonl")
    )


@pytest.mark.long
def test_a_noise_hunt(tmp_path: Path) -> None:
    printed = run(tmp_path, "noise_hunt.py", "5", through=())  # this example loses replies
    assert "pump-1: " in printed
    assert "bad checksum" in printed
    capture = tmp_path / "noise" / "all.pcapng"
    assert main(["decode", str(capture), "--out", str(tmp_path / "again.csv")]) == 0
    assert sum(len(batch) for batch in open_recording(tmp_path / "again.csv"))
