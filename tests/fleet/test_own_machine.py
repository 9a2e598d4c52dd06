"""Servers beside a gateway, and the lines that it avoids for them."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
from nats_clusters import Cluster
from peers import require_module

require_module("nats")

from multidrop.fleet import names, own_machine  # noqa: E402
from multidrop.fleet.cluster import cluster_of  # noqa: E402
from multidrop.fleet.errors import Unsure  # noqa: E402
from multidrop.fleet.leaders import owners_led_by  # noqa: E402
from multidrop.fleet.own_machine import OwnMachine  # noqa: E402
from multidrop.fleet.servers import ServerPath, paths_of  # noqa: E402

PATIENCE_S = 60.0
HOMES = dict(zip(("n1", "n2", "n3"), names.OWNERS, strict=True))


def path(server: str, *, is_local: bool) -> Any:
    return SimpleNamespace(server_name=server, is_local=is_local)


class Trial:
    """A gateway's own machine, and servers that say which buckets they lead, unless they are in trouble."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.found = OwnMachine()
        self.in_trouble = False
        monkeypatch.setattr(own_machine, "owners_led_by", self.led_by)

    async def led_by(self, servers: Any, path: Any) -> tuple[str, ...]:
        if self.in_trouble:
            raise Unsure("no leader")
        return tuple(HOMES[server] for server in sorted(servers))

    def look(self, *paths: Any) -> tuple[str, ...]:
        asyncio.run(self.found.look(paths, paths[0]))
        return self.found.avoided


def test_a_server_that_starts_later_is_found_and_one_that_is_gone_is_remembered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trial = Trial(monkeypatch)
    others = path("n1", is_local=False), path("n3", is_local=False)
    assert trial.look(*others, path("n1", is_local=False)) == ()
    assert trial.look(*others, path("n2", is_local=True)) == ("own_1",)
    assert trial.look(*others, path("n3", is_local=False)) == ("own_1",)


def test_where_all_servers_run_here_nothing_is_avoided(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Trial(monkeypatch).look(*(path(server, is_local=True) for server in HOMES)) == ()


def test_what_could_not_be_asked_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = Trial(monkeypatch)
    trial.in_trouble = True
    with pytest.raises(Unsure):
        trial.look(path("n2", is_local=True))
    trial.in_trouble = False
    assert trial.look(path("n2", is_local=True)) == ("own_1",)


def test_homes_are_those_to_which_leaders_are_brought() -> None:
    cluster = cluster_of({"cluster": {"leader": "n3", "replicas": [{"name": "n2"}, {"name": "n1"}]}})
    assert cluster is not None
    assert [cluster.home_of(place) for place in range(3)] == ["n1", "n2", "n3"]


async def led_by(server: str, path: ServerPath) -> tuple[str, ...]:
    """Ask until all leaders are there: they move home just after they were made."""
    ends = asyncio.get_running_loop().time() + PATIENCE_S
    while True:
        try:
            return await owners_led_by({server}, path)
        except Unsure:
            assert asyncio.get_running_loop().time() < ends
            await asyncio.sleep(0.1)


@pytest.mark.slow
@pytest.mark.long
def test_each_server_leads_one_bucket_at_home_and_is_seen_to_be_here(fleet: Cluster) -> None:
    async def main() -> None:
        paths = paths_of(fleet.urls)
        for one in paths:
            assert not one.is_local
            await one.open()
        assert [one.is_local for one in paths] == [True] * 3
        led = [await led_by(one.server_name, paths[0]) for one in paths]
        assert sorted(led) == [(bucket,) for bucket in names.OWNERS]
        for one in paths:
            await one.close()
        assert not ServerPath(fleet.urls).is_local

    asyncio.run(main())
