"""Scenarios with stalled adapters: the adapter accepts no bytes, so the driver keeps the bytes to send."""

from __future__ import annotations

import fcntl
import os
import struct
import threading
import time
from typing import Any

import plug
from common import FAMILY, Poll, attempt, insist, write_plant

from multidrop import Bus, ErmanERG220, Poller
from multidrop.transport import open_port

FRAME = 8  # length in bytes of each request in this file
TIOCGSERIAL, TIOCSSERIAL = 0x541E, 0x541F
SERIAL_STRUCT, CLOSING_WAIT = 72, 40  # length of Linux's struct serial_struct, and place of its closing_wait


def close_only_if_sent(path: str) -> None:
    """Let the driver close this port only when all bytes are sent, instead of after 30 s.

    So a process never ends unless it discards these bytes itself.
    """
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    settings = bytearray(SERIAL_STRUCT)
    fcntl.ioctl(fd, TIOCGSERIAL, settings)
    struct.pack_into("H", settings, CLOSING_WAIT, 0)
    fcntl.ioctl(fd, TIOCSSERIAL, settings)
    os.close(fd)


def end_of_stalled_poll(kind: str, signals: list[int]) -> dict[str, Any]:
    """End a poll by signals, 2 s apart, while its adapter stalls; then let the adapter continue."""
    adapter = plug.Adapter(kind, f"stall-{kind}", family=FAMILY, addresses=[1, 2], encoded=True)
    close_only_if_sent(adapter.path)
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
    """Call start and stop during a stall, close the port, and let the adapter continue. Return the frames
    that it still sends, and in `waits` the time limit in s of each wait of `close` for the adapter.
    """
    adapter = plug.Adapter(kind, f"held-{kind}", family=FAMILY, addresses=[1])
    close_only_if_sent(adapter.path)
    bus = Bus(adapter.path)
    pump = bus.attach(ErmanERG220, address=1, name="pump")
    insist(pump.set_frequency, 30.0)
    adapter.do("stall", True)
    facts: dict[str, Any] = {"start": str(attempt(pump.start)), "stop": str(attempt(pump.stop, seconds=5))}
    waits: list[float] = []
    close_behind = open_port.close_behind

    def close(fd: int, other: int, seconds: float) -> None:
        waits.append(seconds)
        close_behind(fd, other, seconds)

    open_port.close_behind = close
    begun = time.monotonic()
    bus.close()
    facts |= {"close": time.monotonic() - begun, "waits": waits}
    count = len(adapter.state["requests"])
    adapter.do("stall", False)
    time.sleep(2)
    return facts | {"left after the close": adapter.state["requests"][count:]}


def stop_in_stall(kind: str, seconds: float) -> dict[str, Any]:
    """Stop a drive while the adapter of its polled line stalls. Return the stop's result, the frames that are
    sent after the stall, and the statuses of failed reads.
    """
    adapter = plug.Adapter(kind, f"stop-{kind}", family=FAMILY, addresses=[1, 2])
    stopped: list[str] = []
    with Poller(write_plant({"a": (adapter.path, [1, 2])})) as poller:
        pump = poller["a-1"]
        insist(pump.set_frequency, 30.0)
        adapter.do("stall", True)
        time.sleep(seconds / 2)
        count = len(adapter.state["requests"])
        stopping = threading.Thread(target=lambda: stopped.append(str(attempt(pump.stop))))
        stopping.start()
        time.sleep(seconds / 2)
        adapter.do("stall", False)
        stopping.join()
        misses = poller.summary()["lines"]["a"]["misses"]
    sent = bytes.fromhex("".join(adapter.state["requests"][count:]))
    frames = [sent[at : at + FRAME].hex() for at in range(0, len(sent), FRAME)]
    return {"stop": stopped[0], "frames": frames, "misses": misses}
