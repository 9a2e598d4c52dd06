"""Read all values of a plant by OPC UA without pause; print their number first. Argument: the URL."""

from __future__ import annotations

import asyncio
import sys

from asyncua import Client, ua

MOST = 1000  # limit of nodes in one request


async def main(url: str) -> None:
    async with Client(url, timeout=60.0) as client:
        drives = await client.get_node("ns=2;i=1").get_children(nodeclassmask=ua.NodeClass.Object)
        nodes = [one.nodeid for drive in drives for one in await drive.get_variables()]
        print(len(nodes), flush=True)
        while True:
            await client.uaclient.read_attributes(nodes[:MOST], ua.AttributeIds.Value)


asyncio.run(main(sys.argv[1]))
