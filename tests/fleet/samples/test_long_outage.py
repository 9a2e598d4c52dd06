"""A long outage: the spool keeps as much as its limit allows, and the hub knows which rows are lost."""

from __future__ import annotations

import asyncio
from contextlib import closing
from pathlib import Path

import pytest
from nats_clusters import Cluster, cluster
from peers import require_module
from spooled import exchanges_in, numbered

from multidrop import History
from multidrop.fleet.samples.forwarder import Forwarder
from multidrop.fleet.samples.hub import HubState, SampleHub
from multidrop.fleet.samples.parquet_sink import ParquetSink
from multidrop.fleet.samples.samples_stream import create_stream, samples_path
from multidrop.fleet.samples.spool import Spool, SpoolState
from multidrop.supervisor import end_tasks

MESSAGES, EXCHANGES = 40, 5
PATIENCE_S = 60.0


async def forwarded(spool: Spool, servers: Cluster) -> None:
    async with samples_path(servers.urls) as path, asyncio.timeout(PATIENCE_S):
        forwarder = Forwarder(spool, path)
        task = asyncio.create_task(forwarder.run())
        while forwarder.last != spool.state().newest:
            await asyncio.sleep(0.01)
        await end_tasks(task)


async def kept(folder: Path, servers: Cluster) -> HubState:
    async with samples_path(servers.urls) as path:
        with closing(ParquetSink(folder)) as sink:
            hub = SampleHub(path, sink)
            await hub.run(once=True)
        return hub.state()


def filled(folder: Path, first: int, most: int) -> Spool:
    spool = Spool(folder, "gateway-1", most=most)
    for number in range(first, first + MESSAGES):
        spool.append(numbered(number * EXCHANGES, EXCHANGES))
        assert spool.sync(PATIENCE_S)
    return spool


@pytest.fixture
def most(tmp_path: Path) -> int:
    """Return a limit of about ten messages, in bytes."""
    spool = Spool(tmp_path / "one", "gateway-1")
    spool.append(numbered(0, EXCHANGES))
    assert spool.sync(PATIENCE_S)
    spool.close()
    return 10 * spool.state().stored


def settled(spool: Spool, most: int) -> SpoolState:
    while spool.state().stored > most:
        pass
    return spool.state()


@pytest.mark.long
async def test_after_an_outage_stored_and_lost_rows_add_up(tmp_path: Path, most: int) -> None:
    """The outage outlasts the spool's limit. Each row is stored, or counted by the spool as lost."""
    require_module("duckdb")
    with cluster(tmp_path / "nats", 1) as servers:

        async def live() -> tuple[HubState, SpoolState]:
            async with samples_path(servers.urls) as path:
                await create_stream(path, replicas=1)
            spool = await asyncio.to_thread(filled, tmp_path / "spool", 0, most)
            settled(spool, most)
            await forwarded(spool, servers)
            spool.close()
            return await kept(tmp_path / "hub", servers), spool.state()

        state, spooled = await live()
    assert 8 <= 40 - state.missing <= 10
    assert state.rows + spooled.lost == MESSAGES * EXCHANGES * 10
    assert (state.alarms, state.doubled) == (2, 0)  # missing messages, and lost rows
    with History(tmp_path / "hub") as history:
        rows = sorted(tuple(row) for batch in history.read() for row in batch)
    assert exchanges_in(rows) == list(range(state.missing * EXCHANGES, MESSAGES * EXCHANGES))
