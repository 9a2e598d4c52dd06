"""The log of commands on disks that hang or fail, and after its thread was killed."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

import pytest
from command_desks import Desks, desks
from kills import BoundProcess
from lines import PATIENCE

from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.messages import CommandOutcome

HANGING_LOG = """
import asyncio, sys, threading
from pathlib import Path
from multidrop.fleet.commands import log as logs

async def main():
    log = logs.CommandLog(Path(sys.argv[1]))
    log._add = lambda record, now_ns: threading.Event().wait()
    asyncio.create_task(log.note({}))
    await asyncio.sleep(0.05)
    log.close()

asyncio.run(main())
"""
HANGING_LINE = """
import asyncio, sys, threading
from pathlib import Path
from multidrop.core import Mastership
from multidrop.fleet.lines.fleet_lines import FleetLines
from multidrop.fleet.samples.polled_units import PolledUnits

async def main():
    lines = FleetLines(Mastership(), Path(sys.argv[1]).parent, PolledUnits())
    lines._take = lambda record: threading.Event().wait()
    asyncio.create_task(lines.take("hall", {}))
    await asyncio.sleep(0.05)
    await lines.close()

asyncio.run(main())
"""


async def _write_and_stop(desk: Desks) -> None:
    answer = await desk.do(desk.offered())
    assert answer.outcome is CommandOutcome.NOT_SENT
    assert answer.text.endswith("commands.jsonl: RuntimeError: SystemExit: killed")
    assert desk.writes == []
    stopped = await desk.stop()
    assert stopped is not None
    assert stopped.ok
    assert desk.written == {"control"}


async def test_a_killed_log_thread_blocks_commands_but_not_stops(tmp_path: Path) -> None:
    with desks(tmp_path) as desk, patch.object(CommandLog, "_add", side_effect=SystemExit("killed")):
        await _write_and_stop(desk)


async def test_log_records_keep_the_order_of_calls_and_end_at_closing(tmp_path: Path) -> None:
    log = CommandLog(tmp_path / "commands.jsonl")
    await asyncio.gather(*(log.note({"step": number}) for number in range(5)))
    log.close()
    with pytest.raises(OSError, match=r"commands\.jsonl is closed"):
        await log.note({})
    lines = (tmp_path / "commands.jsonl").read_text().splitlines()
    assert [line.partition('"step": ')[2] for line in lines] == ["0}", "1}", "2}", "3}", "4}"]


@pytest.mark.slow
@pytest.mark.parametrize("script", [HANGING_LOG, HANGING_LINE], ids=["log", "line"])
def test_a_hanging_disk_or_port_does_not_block_the_exit(tmp_path: Path, script: str) -> None:
    words = [sys.executable, "-c", script, str(tmp_path / "commands.jsonl")]
    with BoundProcess(words, stderr=subprocess.PIPE, text=True) as process:
        _, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0, errors
