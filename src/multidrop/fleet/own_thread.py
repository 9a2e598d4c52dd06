"""A thread for each command, so that none waits for another."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

R = TypeVar("R")


def in_own_thread(work: Callable[[], R]) -> asyncio.Future[R]:
    """Begin work in a thread of its own, or here and now where the system gives none."""
    loop = asyncio.get_running_loop()
    executor = ThreadPoolExecutor(1, "multidrop command")
    try:
        return loop.run_in_executor(executor, work)
    except RuntimeError:
        future: asyncio.Future[R] = loop.create_future()
        future.set_result(work())
        return future
    finally:
        executor.shutdown(wait=False)
