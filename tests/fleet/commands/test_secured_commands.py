"""Commands under the rights that `fleet rights` writes: a commander may send them, a viewer may not."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from command_desks import LINE, MAY, Desks, desks
from nats.aio.client import Client
from nats.errors import NoRespondersError
from nats.errors import TimeoutError as NatsTimeout
from secured_clusters import GATEWAYS, SecuredCluster, secured_cluster

from multidrop.fleet.commands.fleet_commands import FleetCommands
from multidrop.fleet.commands.messages import CommandOutcome
from multidrop.fleet.commands.subjects import CommandSubjects
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import Bucket
from multidrop.fleet.servers.connections import connect, paths_of
from multidrop.fleet.servers.plant_store import store
from multidrop.fleet.servers.setup import open_all, set_up
from multidrop.supervisor import supervisor

pytestmark = [pytest.mark.slow, pytest.mark.long]

PATIENCE_S = 30.0
PLANT = {LINE: {"line": {"name": LINE, "drive": [{"name": "pump"}]}, "files": {}, "may": MAY}}


@pytest.fixture(params=[1, 3])
def servers(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[SecuredCluster]:
    with secured_cluster(tmp_path / "nats", request.param) as running:
        yield running


@asynccontextmanager
async def commanded(servers: SecuredCluster, made: Desks) -> AsyncIterator[CommandSubjects]:
    """Accept commands as a gateway, with a gateway's rights."""
    operator = paths_of(servers.urls, servers.options("operator"))
    await set_up(operator)
    await store(Bucket(names.PLANT, lambda: operator[0]), PLANT)
    gateway = GATEWAYS[0]
    paths = paths_of(servers.urls, servers.options(gateway))
    subjects = CommandSubjects(gateway, paths, made.lines, made.log)
    try:
        await open_all(paths)
        await subjects.begin()
        subjects.open(LINE, PLANT[LINE])
        await asyncio.gather(*supervisor().started)
        yield subjects
    finally:
        for path in (*operator, *paths):
            await path.close()


def test_a_commander_may_command_and_a_viewer_may_not(servers: SecuredCluster, tmp_path: Path) -> None:
    async def main(made: Desks) -> None:
        async with commanded(servers, made):
            for user, outcome in (("viewer", CommandOutcome.NOT_SENT), ("commander", CommandOutcome.DONE)):
                log = tmp_path / f"{user}.jsonl"
                async with FleetCommands(
                    servers.urls, by=user, log=log, options=servers.options(user)
                ) as asker:
                    told = await asker.write("pump", "frequency", 20.0)
                    assert told.outcome is outcome, told.text
                    if outcome is CommandOutcome.NOT_SENT:
                        assert f"do not allow to publish to cmd.{LINE}" in told.text
                        assert made.writes == []
                    stopped = await asker.stop()
                    assert stopped.ok == told.ok, stopped.text
            assert [name for name, _ in made.writes] == ["frequency", "control"]

    with desks(tmp_path) as made:
        asyncio.run(main(made))


async def nobody_is_asked(asker: Client) -> bool:
    """Return True if a server reports that no gateway subscribes to the line's commands."""
    while True:
        try:
            await asker.request(names.command_subject(LINE), b"{}", 1.0)
        except NoRespondersError:
            return True
        except NatsTimeout:
            continue
        return False


def test_servers_report_a_line_without_gateway(servers: SecuredCluster, tmp_path: Path) -> None:
    """Servers report this although commander and gateway are in different accounts."""

    async def main(made: Desks) -> None:
        async with commanded(servers, made) as subjects:
            askers = [await connect(url, servers.options("commander")) for url in servers.urls]
            assert not any([await nobody_is_asked(asker) for asker in askers])
            subjects.shut(LINE)
            await asyncio.gather(*supervisor().started)
            assert all([await nobody_is_asked(asker) for asker in askers])
            for asker in askers:
                await asker.close()
        assert made.writes == []

    with desks(tmp_path) as made:
        asyncio.run(asyncio.wait_for(main(made), PATIENCE_S))
