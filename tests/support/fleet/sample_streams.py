"""A connection to NATS servers with an empty stream of samples."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from nats_clusters import Cluster

from multidrop.fleet.errors import FleetError
from multidrop.fleet.samples import samples_stream
from multidrop.fleet.samples.samples_stream import create_stream, samples_path
from multidrop.fleet.servers.connections import ServerPath


@asynccontextmanager
async def empty_stream(servers: Cluster) -> AsyncIterator[ServerPath]:
    """Yield an open ServerPath to the servers, on which the stream of samples is empty."""
    async with samples_path(servers.urls) as path:
        with suppress(FleetError):
            await samples_stream._ask(path, "STREAM.DELETE.samples", {})
        await create_stream(path, replicas=1)
        yield path
