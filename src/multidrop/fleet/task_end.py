"""Task end: tasks that go on until they are cancelled."""

from __future__ import annotations

import asyncio
from typing import Any

AGAIN_S = 0.2


async def end_tasks(*tasks: asyncio.Task[Any]) -> list[Any]:
    """Cancel them until each is over, and return what they returned or raised.

    Once is not enough: `asyncio.wait_for` swallows what comes in the moment in which its own wait is over.
    """
    left = set(tasks)
    while left:
        for task in left:
            task.cancel()
        _, left = await asyncio.wait(left, timeout=AGAIN_S)
    return await asyncio.gather(*tasks, return_exceptions=True)
