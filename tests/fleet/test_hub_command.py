"""`multidrop hub` stores a stream of samples in files, and reports each mistake in one sentence."""

from __future__ import annotations

import asyncio
import json
import signal
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import nats_clusters
import pytest
from commands import Run
from fleets import plant_text
from free_ports import free_ports
from nats_clusters import Cluster, cluster
from peers import require_module
from spooled import NOON, STEP, exchanges_in, numbered
from terminals import closing_terminal

from multidrop import History
from multidrop.cli import main
from multidrop.fleet.samples import hub
from multidrop.fleet.samples.hub import Commit, ParquetSink, SampleHub, StoredPosition, compact_for_ever
from multidrop.fleet.samples.samples_stream import (
    Forwarder,
    create_stream,
    publish,
    samples_path,
    stream_info,
)
from multidrop.fleet.servers.connections import ServerPath
from multidrop.history import compact as compact_module
from multidrop.history.compact import main as compact
from multidrop.samples.message import RowBuffer, unpack
from multidrop.samples.spool import Spool
from multidrop.supervisor import end_tasks

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A server whose stream has 40 exchanges in 4 messages, from one gateway's spool."""
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
def test_hub_option_once_stores_all_rows_and_exits(
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
def test_stored_rows_survive_a_closed_terminal_or_sigterm(
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
def test_signal_cancels_only_the_hubs_own_task(
    running: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    """An exception that a signal handler raises inside nats-py's own tasks would leave pending futures."""
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


def test_hub_exits_with_an_error_if_compaction_fails(
    running: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def end(folder: Path) -> None:
        raise ZeroDivisionError("a mistake")

    monkeypatch.setattr(hub, "compact_for_ever", end)
    assert main(["hub", running.urls[0], "--parquet", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "Traceback" in said  # the log is also printed on stderr
    assert said.endswith("multidrop: compaction has ended: ZeroDivisionError: a mistake\n")


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    status = main(["hub", *words])
    return status, capsys.readouterr().err


@pytest.mark.slow
def test_an_unreachable_server_is_reported_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"nats://127.0.0.1:{free_ports(1)[0]}"
    status, told = refused(capsys, url, "--parquet", str(tmp_path / "hub"))
    assert status == 1
    assert told.startswith(f"multidrop: no NATS server answers at {url}: ")
    assert told.count("\n") == 1


def test_the_hub_takes_server_addresses_from_the_environment(
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


def test_the_hub_refuses_a_folder_of_another_program_in_one_sentence(
    running: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "report.txt").write_text("mine")
    assert refused(capsys, running.urls[0], "--parquet", str(tmp_path)) == (
        1,
        f"multidrop: {tmp_path} holds 'report.txt', not written by `multidrop hub`: name an empty folder\n",
    )


def test_the_hub_requires_either_a_folder_or_a_database(capsys: pytest.CaptureFixture[str]) -> None:
    status, told = refused(capsys, "nats://127.0.0.1:4222")
    assert status == 2
    assert "one of the arguments --parquet --postgres is required" in told
    status, told = refused(capsys, "nats://x", "--parquet", "a", "--postgres", "b")
    assert status == 2
    assert "not allowed with argument" in told


def test_missing_credentials_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "nobody.creds"
    told = refused(capsys, "nats://x", "--parquet", str(tmp_path / "hub"), "--credentials", str(path))
    assert told == (2, f"multidrop: {path}: No such file or directory\n")
    assert not (tmp_path / "hub").exists()


def test_a_missing_stream_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with cluster(tmp_path / "nats", 1) as one:
        status, told = refused(capsys, one.urls[0], "--parquet", str(tmp_path / "hub"), "--once")
    assert status == 1
    assert told.endswith("multidrop: there is no stream 'samples': create it with `multidrop fleet init`\n")


# ---- compaction of a hub's files: readers get each row exactly once before, during and after it ----


HOUR = 360_000  # number of exchanges in an hour; there is one per STEP
FILES, EXCHANGES = 12, 10  # number of files, four for each hour, and of exchanges in each file


@pytest.fixture
def sink(tmp_path: Path) -> Iterator[ParquetSink]:
    require_module("duckdb")
    made = ParquetSink(tmp_path)
    yield made
    made.close()


def first_of(file: int) -> int:
    return file // 4 * HOUR + file % 4 * EXCHANGES


def write(sink: ParquetSink, files: range) -> None:
    """Write these files into the hub's folder, with two messages in each file."""
    for file in files:
        buffer = RowBuffer()
        assert buffer.add(numbered(first_of(file), EXCHANGES).columns())
        tables = [unpack(message.data) for message in buffer.messages()]
        last = 2 * file + 2
        sink.write(Commit("made", last - 1, last, {"a.x": last}, tables, 10 * EXCHANGES))


def check(folder: Path, files: int) -> None:
    with History(folder) as history:
        rows = sorted(tuple(row) for batch in history.read() for row in batch)
        end = NOON + (files // 4 + 1) * HOUR * STEP
        found = history.buckets("pump-2.value_3", NOON, end, points=10)["pump-2.value_3"]
    wanted = [number for file in range(files) for number in range(first_of(file), first_of(file) + EXCHANGES)]
    assert exchanges_in(rows) == wanted
    of = [row for row in rows if row[3:5] == ("pump-2", "value_3")]
    assert sum(found.n) + sum(found.missed) == len(of)
    assert sum(found.n) == sum(row[5] is not None for row in of)


def names(folder: Path, kind: str) -> list[str]:
    return sorted(path.name.split(".")[0] for path in (folder / kind).glob("*.parquet"))


def merge(folder: Path) -> None:
    assert compact([str(folder), "--below", "0", "--merge-rows"]) == 0


@pytest.mark.long
def test_the_files_of_a_past_hour_are_merged_into_one(sink: ParquetSink, tmp_path: Path) -> None:
    write(sink, range(FILES))
    merge(tmp_path)
    newest = [f"{2 * file + 1:08d}-{2 * file + 2:08d}" for file in range(8, FILES)]
    assert names(tmp_path, "rows") == ["00000001-00000008", "00000009-00000016", *newest]
    assert names(tmp_path, "tens") == ["00000001-00000008", "00000009-00000016", *newest[:-1]]
    check(tmp_path, FILES)
    assert sink.begin("made") == StoredPosition(24, {"a.x": 24})
    merge(tmp_path)
    check(tmp_path, FILES)
    write(sink, range(FILES, FILES + 2))
    merge(tmp_path)
    check(tmp_path, FILES + 2)
    for path in sorted((tmp_path / "rows").glob("*.parquet"))[3:]:
        path.unlink()
    assert names(tmp_path, "rows")[-1] == "00000017-00000024"
    # merged files contain the hub's stored position too
    assert sink.begin("made") == StoredPosition(24, {"a.x": 24})


# keeps the normal priority: with the lowest one, the process takes minutes on a busy machine
USUAL_PRIORITY = """
import os
os.nice = os.sched_setscheduler = lambda *details: 0
"""


class Broken(Exception):
    """Raised in place of the end of the process."""


@pytest.mark.long
@pytest.mark.slow
def test_compaction_interrupted_before_any_step_loses_no_row(
    sink: ParquetSink, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compaction is interrupted after each possible number of written or removed files, and then repeated."""
    write(sink, range(FILES))
    steps = {"replace": Path.replace, "unlink": Path.unlink}
    left = 0

    def counted(name: str) -> Any:
        def act(path: Path, *details: Any, **more: Any) -> Any:
            nonlocal left
            left -= 1
            if left < 0:
                raise Broken
            return steps[name](path, *details, **more)

        return act

    for name in steps:
        monkeypatch.setattr(Path, name, counted(name))
    breaks = 0
    for least in range(100):
        left = least % 9
        try:
            merge(tmp_path)
        except Broken:
            breaks += 1
            check(tmp_path, FILES)
        else:
            break
    monkeypatch.undo()
    assert breaks > 10
    check(tmp_path, FILES)
    assert names(tmp_path, "rows")[:2] == ["00000001-00000008", "00000009-00000016"]


@pytest.mark.long
def test_reading_files_during_a_merge_fails_or_gives_all_rows_once(sink: ParquetSink, tmp_path: Path) -> None:
    write(sink, range(FILES))
    told = []
    for at in (0, 1, 5):
        folder = tmp_path / "copies" / str(at)
        (folder / "rows").mkdir(parents=True)
        for path in (tmp_path / "rows").glob("*.parquet"):
            (folder / "rows" / path.name).write_bytes(path.read_bytes())
        with History(folder) as history:
            batches = iter(history.read())
            rows = [tuple(row) for _ in range(at) for row in next(batches)]
            merge(folder)
            try:
                rows += [tuple(row) for batch in batches for row in batch]
            except OSError as error:
                told.append((at, str(error)))
            else:
                assert len(rows) == len(set(rows)) == FILES * EXCHANGES * 10
    sentence = "files were merged during this read: read the history again"
    assert [at for at, _ in told] == [1, 5]
    assert all(text.endswith(sentence) for _, text in told)


@pytest.mark.long
def test_compaction_merges_files_only_up_to_the_size_limit(
    sink: ParquetSink, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(sink, range(FILES))
    size = max(path.stat().st_size for path in (tmp_path / "rows").glob("*.parquet"))
    monkeypatch.setattr(compact_module, "MOST_MERGED", 2 * size)
    merge(tmp_path)
    assert names(tmp_path, "rows")[:2] == ["00000001-00000004", "00000005-00000008"]
    check(tmp_path, FILES)


@pytest.mark.long
async def test_the_hub_compacts_files_while_it_reads_the_stream(
    sink: ParquetSink, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(sink, range(FILES))
    (tmp_path / "usual").mkdir()
    (tmp_path / "usual" / "sitecustomize.py").write_text(USUAL_PRIORITY)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "usual"))
    task = asyncio.create_task(compact_for_ever(tmp_path, every=0.01))
    async with asyncio.timeout(300.0):
        while len(names(tmp_path, "rows")) > 6:
            await asyncio.sleep(0.02)
    task.cancel()
    await asyncio.wait([task])
    check(tmp_path, FILES)


# ---- samples never use the disk space of leases: servers that cannot store leases would end all polling ----


MESSAGE = 500_000  # bytes


@pytest.fixture
def _small_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nats_clusters, "MAX_FILE", "20M")


def with_path(servers: Cluster, work: Callable[[ServerPath], Awaitable[object]]) -> None:
    async def live() -> None:
        async with samples_path(servers.urls) as path:
            await work(path)

    asyncio.run(live())


@pytest.mark.usefixtures("_small_servers")
@pytest.mark.long
def test_a_full_stream_of_samples_leaves_disk_space_for_records(run: Run, tmp_path: Path) -> None:
    async def fill(path: ServerPath) -> None:
        for _ in range(60):
            await publish(path, "samples.gw-1.log", bytes(MESSAGE), {})
        found = await stream_info(path)
        assert (found.last, 60 - found.first < 8_000_000 / MESSAGE) == (60, True)

    with cluster(tmp_path / "nats", 1) as one:
        words = ["fleet", "init", "--nats", one.urls[0], "--json", "--keep", "8 MB"]
        status, out, _ = run(*words)
        assert (status, json.loads(out)["samples_bytes"]) == (0, 8_000_000)
        with_path(one, fill)
        (tmp_path / "plant.toml").write_text(plant_text())
        status, out, _ = run(*words, tmp_path / "plant.toml")
        assert (status, json.loads(out)["lines"]["new"]) == (0, 1)


@pytest.mark.usefixtures("_small_servers")
@pytest.mark.slow
@pytest.mark.parametrize("number", [1, pytest.param(3, marks=pytest.mark.long)])
def test_servers_with_too_little_disk_space_are_reported(run: Run, tmp_path: Path, number: int) -> None:
    with cluster(tmp_path / "nats", number) as small:
        status, out, err = run("fleet", "init", "--nats", ",".join(small.urls))
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert "the NATS servers have no room for so many samples: keep less with" in err


@pytest.mark.usefixtures("_small_servers")
@pytest.mark.long
def test_init_keeps_and_reports_an_existing_stream(run: Run, tmp_path: Path) -> None:
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
