"""SIGKILL of recorders and compaction at any moment: no written row is missing or doubled."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import histories
import pytest
from examples import usually
from histories import NOON, RUN, STEP
from kills import BoundProcess

from multidrop.history.compact import main as compact
from multidrop.history.folder import listing
from multidrop.history.history import History

pytest.importorskip("duckdb", reason="needs duckdb")
SUPPORT = os.pathsep.join(map(str, Path(histories.__file__).parents[1].iterdir()))


def killed_recorder(folder: Path, run: int, dice: random.Random) -> int:
    """Run a recorder for a while, and kill it; return the number of rows that it reported as written."""
    words = [sys.executable, histories.__file__, str(folder), str(run)]
    here = {**os.environ, "PYTHONPATH": SUPPORT}
    with BoundProcess(words, stdout=subprocess.PIPE, text=True, env=here, start_new_session=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline()  # wait until it records
        with History(folder) as history:  # read during recording
            check(history, {}, NOON + run * RUN)
        time.sleep(dice.uniform(0, 1.2))
        if dice.random() < 0.5:
            child.kill()  # only the recorder: compaction continues
        else:
            os.killpg(child.pid, signal.SIGKILL)
        said = child.stdout.read().split("\n")[:-1]
    return int(said[-1]) if said else 0


def check(history: History, written: dict[str, int], begin: int | None = None) -> int:
    """Check that each run has at least its written rows, without gaps; return the number of all rows.

    Rows before `begin` are ignored.
    """
    runs: dict[str, list[int]] = defaultdict(list)
    for rows in history.read(None, begin):
        for row in rows:
            runs[row.drive].append(row.monotonic_ns // STEP)
    for run, numbers in runs.items():
        assert numbers == list(range(len(numbers))), run  # in order, without gaps or duplicates
    for run, count in written.items():
        assert len(runs.get(run, ())) >= count, run
    return sum(map(len, runs.values()))


def total_of_tens(history: History, runs: int) -> int:
    names = [f"run-{run}.speed" for run in range(runs)]
    found = history.buckets(names, NOON, NOON + (runs + 1) * RUN, points=1000)
    return sum(sum(buckets.n) + sum(buckets.missed) for buckets in found.values())


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("kills", usually(3, 200))
def test_kills_of_recorder_and_compaction_lose_no_row(tmp_path: Path, kills: int) -> None:
    dice = random.Random(kills)
    written: dict[str, int] = {}
    for run in range(kills):
        written[f"run-{run}"] = killed_recorder(tmp_path, run, dice)
        with History(tmp_path) as history:
            name = f"run-{run}"
            assert check(history, {name: written[name]}, NOON + run * RUN) >= written[name]
        if run < 15 or run % 20 == 0 or run == kills - 1:
            with History(tmp_path) as history:
                total = check(history, written)
                assert total_of_tens(history, run + 1) == total
    assert sum(written.values()) > 100 * kills
    for _ in range(100):  # a remaining child may still compact
        compact([str(tmp_path), "--below", "99999999"])
        found = listing(tmp_path)
        if not found.segments:
            break
        time.sleep(0.1)
    assert not found.segments
    assert len(found.rows) > kills // 2
    assert any(file.first < file.last for file in found.tens)  # a day's ten-second summaries merged
    assert not [*tmp_path.rglob("*.part"), *(tmp_path / "damaged").iterdir()]
    with History(tmp_path) as history:
        assert check(history, written) == total
        assert total_of_tens(history, kills) == total
