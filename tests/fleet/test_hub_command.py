"""`multidrop hub`: stores a stream in files, and reports each mistake in one sentence."""

from __future__ import annotations

import asyncio
import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from nats_clusters import Cluster, cluster, free_ports
from peers import require_module
from spooled import exchanges_in, numbered
from terminals import closing_terminal

from multidrop import History
from multidrop.cli import main
from multidrop.fleet.samples import parquet_sink
from multidrop.fleet.samples.forwarder import Forwarder
from multidrop.fleet.samples.hub import SampleHub
from multidrop.fleet.samples.samples_stream import create_stream, samples_path
from multidrop.fleet.samples.spool import Spool
from multidrop.supervisor import end_tasks

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Servers whose stream has 40 exchanges in 4 messages, from one gateway's spool."""
    folder = tmp_path_factory.mktemp("nats")

    async def forward(urls: list[str]) -> None:
        async with samples_path(urls) as path:
            await create_stream(path, replicas=1)
            spool = Spool(folder / "spool", "gateway-1")
            forwarder = Forwarder(spool, path)
            task = asyncio.create_task(forwarder.run())
            for number in range(4):
                spool.append(numbered(number * 10, 10))
                assert await asyncio.to_thread(spool.sync, 30.0)
            while forwarder.last != 4:
                await asyncio.sleep(0.01)
            await end_tasks(task)
            spool.close()

    with cluster(folder, 1) as one:
        asyncio.run(asyncio.wait_for(forward(one.urls), 60.0))
        yield one


@pytest.mark.slow
def test_hub_once_stores_every_row_of_the_stream_once(
    running: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    require_module("duckdb")
    words = ["hub", running.urls[0], "--parquet", str(tmp_path), "--once"]
    assert main(words) == 0
    assert capsys.readouterr().out == (
        "400 rows kept, to message 4 of the stream; 0 alarms, 0 messages missing, "
        "0 left out because they came twice\n"
    )
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        **{"place": 4, "behind": 0, "rows": 0, "alarms": 0, "missing": 0, "doubled": 0, "trouble": None}
    }
    with History(tmp_path) as history:
        rows = [tuple(row) for batch in history.read() for row in batch]
    assert exchanges_in(sorted(rows)) == list(range(40))


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("end", ["terminal closed", "SIGTERM"])
def test_stored_rows_survive_any_end_of_the_hub(
    running: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str], end: str
) -> None:
    words = ["hub", running.urls[0], "--parquet", str(tmp_path), "--every", "0.2"]
    ends = time.monotonic() + PATIENCE_S
    with closing_terminal(*words) as terminal:
        while not list(tmp_path.glob("rows/*-00000004.*.parquet")):
            assert time.monotonic() < ends
            time.sleep(0.05)
        if end == "SIGTERM":
            terminal.process.terminate()
        else:
            terminal.close()
        assert terminal.process.wait(PATIENCE_S) == 130
    assert main([*words[:-2], "--once", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["place"], found["rows"], found["alarms"]) == (4, 0, 0)
    with History(tmp_path) as history:
        rows = [tuple(row) for batch in history.read() for row in batch]
    assert exchanges_in(sorted(rows)) == list(range(40))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_hub_only_between_steps_of_its_task(
    running: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    """An exception raised inside nats-py's own tasks would leave pending futures."""
    done: list[str] = []

    async def read(hub: SampleHub, *, once: bool) -> None:
        signal.raise_signal(number)
        done.append("went on")
        try:
            await asyncio.sleep(PATIENCE_S)
        finally:
            done.append("ended")

    monkeypatch.setattr(SampleHub, "run", read)
    assert main(["hub", running.urls[0], "--parquet", str(tmp_path)]) == 130
    assert done == ["went on", "ended"]


def test_the_hub_fails_if_compaction_ends(
    running: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def end(folder: Path) -> None:
        raise ZeroDivisionError("a mistake")

    monkeypatch.setattr(parquet_sink, "compact_for_ever", end)
    assert main(["hub", running.urls[0], "--parquet", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "Traceback" in said  # the log is on stderr too
    assert said.endswith("multidrop: compaction has ended: ZeroDivisionError: a mistake\n")


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    status = main(["hub", *words])
    return status, capsys.readouterr().err


@pytest.mark.slow
def test_no_server_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"nats://127.0.0.1:{free_ports(1)[0]}"
    status, told = refused(capsys, url, "--parquet", str(tmp_path / "hub"))
    assert status == 1
    assert told.startswith(f"multidrop: no NATS server answers at {url}: ")
    assert told.count("\n") == 1


def test_the_hubs_servers_may_come_from_the_environment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ports = free_ports(2)
    urls = ",".join(f"nats://127.0.0.1:{port}" for port in ports)
    monkeypatch.setenv("MULTIDROP_NATS", urls)
    status, told = refused(capsys, "--parquet", str(tmp_path))
    assert status == 1
    assert all(f"nats://127.0.0.1:{port}" in told for port in ports)
    status, told = refused(capsys, "http://a:4222", "--parquet", str(tmp_path))
    assert (status, told) == (
        2,
        "multidrop: http://a:4222 is not an address of a NATS server; write nats://127.0.0.1:4222\n",
    )


def test_the_hub_refuses_a_foreign_folder_in_one_sentence(
    running: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "report.txt").write_text("mine")
    assert refused(capsys, running.urls[0], "--parquet", str(tmp_path)) == (
        1,
        f"multidrop: {tmp_path} is not a hub's folder: it holds 'report.txt'; name an empty one\n",
    )


def test_the_hub_requires_exactly_one_sink(capsys: pytest.CaptureFixture[str]) -> None:
    status, told = refused(capsys, "nats://127.0.0.1:4222")
    assert status == 2
    assert "one of the arguments --parquet --postgres is required" in told
    status, told = refused(capsys, "nats://x", "--parquet", "a", "--postgres", "b")
    assert status == 2
    assert "not allowed with argument" in told


def test_missing_credentials_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "nobody.creds"
    told = refused(capsys, "nats://x", "--parquet", str(tmp_path / "hub"), "--credentials", str(path))
    assert told == (2, f"multidrop: {path}: No such file or directory\n")
    assert not (tmp_path / "hub").exists()


def test_a_missing_stream_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with cluster(tmp_path / "nats", 1) as one:
        status, told = refused(capsys, one.urls[0], "--parquet", str(tmp_path / "hub"), "--once")
    assert status == 1
    assert told.endswith("multidrop: there is no stream 'samples': create it with `multidrop fleet init`\n")
