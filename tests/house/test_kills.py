"""Check that a failing test kills its processes without waiting for them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from kills import BoundProcess

TESTS = Path(__file__).parents[1]
SLEEPS = [sys.executable, "-c", "import time; time.sleep(3600)"]


def test_failing_block_kills_its_process() -> None:
    with pytest.raises(ZeroDivisionError), BoundProcess(SLEEPS) as process:
        raise ZeroDivisionError
    assert process.returncode


def test_no_test_starts_an_unbound_process() -> None:
    unbound = "with subprocess." + "Popen("
    assert [str(path) for path in TESTS.rglob("*.py") if unbound in path.read_text("utf-8")] == []
