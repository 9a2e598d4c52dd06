"""Compaction of a hub's folder: a child process of low priority, begun again and again; it may be killed."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

EVERY_S = 300.0

_log = logging.getLogger("multidrop.fleet.samples.hub")


async def compact_for_ever(folder: Path, every: float = EVERY_S) -> None:
    """Merge the files of hours that are over, and make tens for plots, until cancelled. Needs duckdb."""
    if importlib.util.find_spec("duckdb") is None:
        _log.warning("files are not merged: that needs duckdb, pip install 'multidrop[history]'")
        await asyncio.Event().wait()
    words = ["-m", "multidrop.history.compact", str(folder), "--below", "0", "--merge-rows"]
    while True:
        await asyncio.sleep(every)
        try:
            await _compact(words)
        except Exception as failure:  # such as of a system without a process left: it is tried again
            _log.error("files are not merged now", exc_info=failure)


async def _compact(words: Sequence[str]) -> None:
    child = await asyncio.create_subprocess_exec(
        sys.executable,
        *words,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        _, said = await child.communicate()
    except asyncio.CancelledError:
        child.kill()
        await child.wait()
        raise
    if child.returncode:
        last = said.decode("utf-8", "replace").strip().splitlines()[-1:]
        _log.error("compaction ended with %d: %s", child.returncode, *(last or ["no word"]))
