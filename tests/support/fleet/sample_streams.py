"""A connection to NATS servers with an empty stream of samples."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from nats.aio.client import Client
from nats_clusters import Cluster

from multidrop.fleet.samples import samples_stream
from multidrop.fleet.samples.samples_stream import StreamError, connect, create_stream


@asynccontextmanager
async def client_of(servers: Cluster) -> AsyncIterator[Client]:
    """Give a connection to servers with an empty stream."""
    client = await connect(servers.urls)
    try:
        with suppress(StreamError):
            await samples_stream._ask(client, "STREAM.DELETE.samples", {})
        await create_stream(client, replicas=1)
        yield client
    finally:
        await client.close()
