"""Run every example against simulated drives and check its output."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import patient
import pytest
from lines import PATIENCE
from tables import table

from multidrop.cli import main
from multidrop.control import read_audit
from multidrop.recording import open_recording

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
PAGES = "\n".join(page.read_text("utf-8") for page in (ROOT / "docs").rglob("*.md"))


def run(directory: Path, name: str, *words: str, through: tuple[str, ...] = (patient.__file__,)) -> str:
    """Return what an example prints."""
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
