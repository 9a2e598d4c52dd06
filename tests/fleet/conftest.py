"""A cluster of three real NATS servers for each module, with a fleet's buckets."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest
from nats_clusters import Cluster, cluster
from peers import require_module

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Ignore remains of nats-py's connections to a dead server, which the garbage collector reports."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"))


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine function in an event loop of its own."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    wanted = inspect.signature(pyfuncitem.obj).parameters
    asyncio.run(pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in wanted}))
    return True


@pytest.fixture(scope="module")
def nats(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Return three servers without a fleet."""
    require_module("nats")
    with cluster(tmp_path_factory.mktemp("nats")) as running:
        yield running


@pytest.fixture(scope="module")
def fleet(nats: Cluster) -> Cluster:
    """Return three servers after `fleet init`."""
    from multidrop.fleet.servers.connections import paths_of
    from multidrop.fleet.servers.setup import set_up

    async def main() -> None:
        paths = paths_of(nats.urls)
        await set_up(paths)
        for path in paths:
            await path.close()

    asyncio.run(main())
    return nats
