"""Subscribe to all OPC UA variables of a plant's drives; print time in s and value count each second.

Arguments: URL, and the interval of notifications in ms.
"""

from __future__ import annotations

import asyncio
import sys
import time
from typing import Any

from asyncua import Client, ua

TOGETHER = 500  # variables in one subscription request


class Counter:
    """The number of received values."""

    received = 0

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        self.received += 1


async def main(url: str, interval_ms: float) -> None:
    counter = Counter()
    async with Client(url, timeout=60.0) as client:
        drives = await client.get_node("ns=2;i=1").get_children(nodeclassmask=ua.NodeClass.Object)
        variables = [one for drive in drives for one in await drive.get_variables()]
        subscription = await client.create_subscription(interval_ms, counter)
        for at in range(0, len(variables), TOGETHER):
            await subscription.subscribe_data_change(variables[at : at + TOGETHER])
        while True:
            await asyncio.sleep(1.0)
            print(time.monotonic(), counter.received, flush=True)


asyncio.run(main(sys.argv[1], float(sys.argv[2])))
