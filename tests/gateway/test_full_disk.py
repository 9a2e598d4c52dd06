"""A full disk on its own file system: polling and stops continue, and /health reports the disk."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from errno import ENOSPC
from pathlib import Path
from typing import BinaryIO

import pytest
from gateways import Served, served
from lines import until

SERVE = """
[serve]
audit = "disk/audit.jsonl"
[serve.may]
stop = "anyone"
[serve.history]
folder = "disk/history"
"""
FULL = "No space left on device"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """Mount a file system of 1 MB beside the plant file."""
    path = tmp_path / "disk"
    path.mkdir()
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root may mount a file system of its own")
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "none", path], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.strip()}")
    yield path
    subprocess.run(["umount", "--lazy", path], check=True)


def fill(disk: Path) -> Path:
    """Fill the remaining space with a file, and return its path."""
    path = disk / "filler"
    with path.open("wb", buffering=0) as file:
        while has_room(file):
            pass
    return path


def has_room(file: BinaryIO) -> bool:
    try:
        file.write(bytes(4096))
    except OSError as failure:
        if failure.errno != ENOSPC:
            raise
        return False
    return True


def health(gateway: Served) -> tuple[str, str, str]:
    """Return from /health the status and the entries about history and audit log."""
    found = gateway.get("/health").json
    return found["status"], found["parts"]["history"], found["audit"]


def stop(gateway: Served) -> None:
    told = gateway.post("/api/stop").json
    assert [one["done"] for one in told.values()] == [True, True]


def dropped(gateway: Served) -> float:
    lines = gateway.get("/metrics").body.decode().splitlines()
    (line,) = [line for line in lines if line.startswith("multidrop_history_dropped_total ")]
    return float(line.split()[1])


@pytest.mark.long
def test_full_disk_is_reported_while_polling_and_stops_continue(disk: Path, tmp_path: Path) -> None:
    with served(tmp_path, SERVE) as gateway:
        gateway.await_state("pump-2", "stands")
        history = gateway.gateway.feeds["history"]
        until(lambda: history.state.rows > 0)
        stop(gateway)
        until(lambda: gateway.get("/api/audit").json["entries"])
        assert health(gateway) == ("ok", "ok", "ok")

        filler = fill(disk)
        until(lambda: FULL in health(gateway)[1])
        noted = len(gateway.get("/api/audit").json["entries"])
        sent = [sim.counters.requests for sim in gateway.sims.values()]
        while FULL not in health(gateway)[2]:  # the log's last block still has some space
            stop(gateway)
            assert len(gateway.get("/api/audit").json["entries"]) < noted + 40
        status, recorded, audit = health(gateway)
        assert status == "degraded"
        assert recorded.startswith("nothing is recorded: ")
        assert audit.startswith("the newest write is not noted: ")
        until(lambda: len(gateway.frame()["troubles"]) == 2)
        assert all(FULL in trouble for trouble in gateway.frame()["troubles"])
        until(lambda: dropped(gateway) > 40)
        now = [sim.counters.requests for sim in gateway.sims.values()]
        assert all(after > before + 10 for before, after in zip(sent, now, strict=True))
        assert gateway.gateway.poller is not None
        assert gateway.gateway.poller.summary()["dropped"] == 0

        rows = history.state.rows
        filler.unlink()
        until(lambda: history.state.rows > rows and health(gateway)[1] == "ok")
        stop(gateway)
        until(lambda: health(gateway) == ("ok", "ok", "ok"))
        until(lambda: gateway.frame()["troubles"] == [])
        assert len(gateway.get("/api/audit").json["entries"]) > noted
        assert list(gateway.gateway.failures.values()) == []
