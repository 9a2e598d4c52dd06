"""Real NATS servers, shared by the tests of a module, with or without a fleet's buckets."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from fleets import Desks
    from nats_clusters import Cluster

HERE = Path(__file__).parent
if not os.environ.get("CI") and not all(map(find_spec, ("nats", "nkeys", "pyarrow", "starlette"))):
    collect_ignore_glob = ["*"]  # the extra `fleet` is not installed; in CI this is an error


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Ignore warnings about nats-py's connections to a dead server, which the garbage collector finds."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"))


@pytest.fixture(scope="module")
def nats(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Return three servers without a fleet's buckets."""
    from nats_clusters import cluster

    with cluster(tmp_path_factory.mktemp("nats")) as running:
        yield running


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Return one server without a fleet's buckets."""
    from nats_clusters import cluster

    with cluster(tmp_path_factory.mktemp("nats"), 1) as server:
        yield server


@pytest.fixture(scope="module")
def fleet(nats: Cluster) -> Cluster:
    """Return three servers after `fleet init`."""
    from nats_clusters import initialised

    asyncio.run(initialised(nats.urls))
    return nats


@pytest.fixture(scope="module")
def one(running: Cluster) -> Cluster:
    """Return one server after `fleet init`."""
    from nats_clusters import initialised

    asyncio.run(initialised(running.urls))
    return running


@pytest.fixture
def desk(tmp_path: Path, _patient: None) -> Iterator[Desks]:
    """Return the command desk and stop desk of a gateway with a simulated drive."""
    from fleets import desks

    with desks(tmp_path) as made:
        yield made
