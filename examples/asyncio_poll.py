"""Poll in an asyncio program with other tasks: `python examples/asyncio_poll.py [SECONDS]`."""

from __future__ import annotations

import asyncio
import sys

from simulated_plant import simulated_plant

from multidrop import Poller

PLANT = """
[[line]]
name = "hall"
port = "{ports}/hall"

[[line.drive]]
name = "pump"
model = "innovert-ibd"
address = 1
poll = ["output_current", "motor_speed"]
"""


async def count(poller: Poller) -> None:
    """Print a line for each batch."""
    async for batch in poller:
        print(f"{len(batch)} rows")


async def tick() -> None:
    """Print "tick" five times a second: other work of the same program."""
    while True:
        await asyncio.sleep(0.2)
        print("tick")


async def main(seconds: float) -> None:
    with simulated_plant(PLANT) as plant, Poller(plant) as poller:
        tasks = [asyncio.create_task(count(poller)), asyncio.create_task(tick())]
        await asyncio.wait(tasks, timeout=seconds)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


if __name__ == "__main__":
    asyncio.run(main(float(sys.argv[1]) if sys.argv[1:] else 3.0))
