"""Stalled adapters: they accept no bytes, so the driver keeps the bytes to send."""

from __future__ import annotations

import time
from typing import Any

import plug
from common import FAMILY, Poll, attempt, insist

from multidrop import Bus, ErmanERG220


def end_of_stalled_poll(kind: str, signals: list[int]) -> dict[str, Any]:
    """End a poll by signals, 2 s apart, while its adapter stalls; then let the adapter continue."""
    adapter = plug.Adapter(kind, f"stall-{kind}", family=FAMILY, addresses=[1, 2], encoded=True)
    poll = Poll({"a": (adapter.path, [1, 2])})
    poll.wait_for("ok", "a")
    adapter.do("stall", True)
    poll.wait_for("no reply", "a", after=len(poll.rows()))
    begun = time.monotonic()
    for number in signals:
        poll.command.signal(number)
        if number != signals[-1]:
            time.sleep(2)
    status, output = poll.command.outcome()
    seconds = time.monotonic() - begun
    count = len(adapter.state["requests"])
    adapter.do("stall", False)
    time.sleep(2)
    late = adapter.state["requests"][count:]
    return {"status": status, "output": output, "seconds": seconds, "left after the end": late}


def start_in_stall(kind: str) -> dict[str, Any]:
    """Call start and stop during a stall, then close; let the adapter continue; return the late frames."""
    adapter = plug.Adapter(kind, f"held-{kind}", family=FAMILY, addresses=[1])
    bus = Bus(adapter.path)
    pump = bus.attach(ErmanERG220, address=1, name="pump")
    insist(pump.set_frequency, 30.0)
    adapter.do("stall", True)
    facts: dict[str, Any] = {"start": str(attempt(pump.start)), "stop": str(attempt(pump.stop, seconds=5))}
    begun = time.monotonic()
    bus.close()
    facts["close"] = time.monotonic() - begun
    count = len(adapter.state["requests"])
    adapter.do("stall", False)
    time.sleep(2)
    return facts | {"left after the close": adapter.state["requests"][count:]}
