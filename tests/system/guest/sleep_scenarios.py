"""The computer sleeps (S3). The adapter is QEMU's usb-serial: vhci_hcd forbids a sleep while it has a device.

Only the first sleep after a boot lasts, so each scenario needs its own boot.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import plug
from common import FAMILY, Meter, Poll, attempt

from multidrop import Bus

SLEEP_S = 6.0


def _plugged_in(**far_end: Any) -> dict[str, str]:
    """Plug QEMU's adapter in; return its names."""
    plug.do("connect", {"serial": "usb", **far_end})
    plug.wait_until(plug.ttys)
    plug.settle()
    return {"tty": f"/dev/{plug.ttys()[0]}", "by-id": str(next(Path("/dev/serial/by-id").iterdir()))}


def _sleep() -> float:
    """Let the computer sleep; return the duration in s."""
    before = time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()
    plug.do("wake", SLEEP_S)
    Path("/sys/power/state").write_text("mem", "ascii")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic() - before


def sleep_in_poll(names: str) -> dict[str, Any]:
    """Let the computer sleep during a poll. `names` says how the port is named: "tty" or "by-id"."""
    found = _plugged_in(family=FAMILY, addresses=[1, 2], encoded=True)
    poll = Poll({"a": (found[names], [1, 2])})
    seen = poll.wait_for("ok", "a")
    slept = _sleep()
    came_back = attempt(poll.wait_for, "ok", "a", after=seen + 50, patience=30.0)
    facts = poll.end()
    return facts | {
        "slept": slept,
        "came back": isinstance(came_back, int),
        "ttys": [found["tty"], *(f"/dev/{tty}" for tty in plug.ttys())],
    }


def sleep_in_write() -> dict[str, Any]:
    """Let the computer sleep while a thread writes 1, 2, 3 ...; return the values seen on the line."""
    name = _plugged_in()["by-id"]
    written = []
    is_over = threading.Event()
    with Bus(name, baudrate=9600, format="8N1") as bus:
        meter, silent = bus.attach(Meter, address=2), bus.attach(Meter, address=9)

        def write() -> None:
            while not is_over.is_set():
                written.append(attempt(meter.write, meter.target, len(written) + 1))

        def keep_busy() -> None:
            while not is_over.is_set():
                attempt(silent.read, silent.a)

        threads = [threading.Thread(target=call) for call in (write, keep_busy)]
        for thread in threads:
            thread.start()
        time.sleep(4)
        slept = _sleep()
        time.sleep(5)
        is_over.set()
        for thread in threads:
            thread.join()
    frames = [bytes.fromhex(frame) for frame in plug.do("requests", "usb")]
    values = [int.from_bytes(frame[4:6]) for frame in frames if frame[1] == 6]
    return {"slept": slept, "values": values, "failed": sum(isinstance(result, str) for result in written)}
