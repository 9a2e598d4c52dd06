"""Samples never use the disk space of leases: servers that cannot store leases would end all polling."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from pathlib import Path

import nats_clusters
import pytest
from commands import Run
from nats_clusters import Cluster, cluster

from multidrop.fleet.samples.samples_stream import about, create_stream, publish, samples_path
from multidrop.fleet.servers.connections import ServerPath

MESSAGE = 500_000  # bytes
PLANT = """
[[line]]
name = "hall-1"
port = "socket://127.0.0.1:4001"
[[line.drive]]
name = "pump-1"
model = "innovert-ibd"
address = 1
poll = ["output_current"]
"""


@pytest.fixture(autouse=True)
def _small_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nats_clusters, "MAX_FILE", "20M")


def with_path(servers: Cluster, work: Callable[[ServerPath], Awaitable[object]]) -> None:
    async def live() -> None:
        async with samples_path(servers.urls) as path:
            await work(path)

    asyncio.run(live())


@pytest.mark.long
def test_a_stream_that_is_full_leaves_room_for_records(run: Run, tmp_path: Path) -> None:
    async def fill(path: ServerPath) -> None:
        for _ in range(60):
            await publish(path, "samples.gw-1.log", bytes(MESSAGE), {})
        found = await about(path)
        assert (found.last, 60 - found.first < 8_000_000 / MESSAGE) == (60, True)

    with cluster(tmp_path / "nats", 1) as one:
        words = ["fleet", "init", "--nats", one.urls[0], "--json", "--keep", "8 MB"]
        status, out, _ = run(*words)
        assert (status, json.loads(out)["samples_bytes"]) == (0, 8_000_000)
        with_path(one, fill)
        (tmp_path / "plant.toml").write_text(PLANT)
        status, out, _ = run(*words, tmp_path / "plant.toml")
        assert (status, json.loads(out)["lines"]["new"]) == (0, 1)


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, pytest.param(3, marks=pytest.mark.long)])
def test_servers_with_too_little_room_are_one_sentence(run: Run, tmp_path: Path, number: int) -> None:
    with cluster(tmp_path / "nats", number) as small:
        status, out, err = run("fleet", "init", "--nats", ",".join(small.urls))
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert "the NATS servers have no room for so many samples: keep less with" in err


@pytest.mark.long
def test_an_existing_stream_is_kept_and_reported(run: Run, tmp_path: Path) -> None:
    with cluster(tmp_path / "nats", 1) as one:
        with_path(one, lambda path: create_stream(path, replicas=1))
        _, out, err = run("fleet", "init", "--nats", one.urls[0], "--json")
        assert json.loads(out)["samples_bytes"] is None
        assert (
            "the stream of samples has no limit: when it fills the servers, no line is polled; `nats" in err
        )
    with cluster(tmp_path / "other", 1) as one:
        with_path(one, lambda path: create_stream(path, replicas=1, most_bytes=8_000_000))
        _, _, err = run("fleet", "init", "--nats", one.urls[0], "--keep", "9 MB")
        assert (
            "the stream of samples still keeps 8.0 MB; `nats stream edit samples --max-bytes 9000000`" in err
        )
        assert "the stream of samples" not in run("fleet", "init", "--nats", one.urls[0])[2]


def test_an_invalid_stream_size_is_rejected(run: Run) -> None:
    status, out, err = run("fleet", "init", "--keep", "much")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert "invalid size 'much'" in err
