"""Measure how regularly a line is polled beside busy processes, with and without realtime scheduling.

Linux's serial drivers pass received bytes on in a kernel work item, flush_to_ldisc. The kernel's trace shows
how late it starts.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import plug
from common import FAMILY, write_plant

from multidrop import Poller

WARM_UP_S = 1.0
# Kernel threads that pass bytes from a port to a program: work items, softirqs and USB/IP.
PASSING_ON = re.compile(r"kworker/|ksoftirqd/|vhci_[rt]x")
# Real-time priority of these kernel threads. It is higher than that of multidrop's thread, as in kernels with
# threaded interrupts.
PRIORITY = 2
TRACING = Path("/sys/kernel/tracing")
EVENTS = ("workqueue_queue_work", "workqueue_execute_start")
QUEUED = re.compile(r" (\d+\.\d+): workqueue_queue_work: work struct=(\w+) function=flush_to_ldisc ")
STARTED = re.compile(r" (\d+\.\d+): workqueue_execute_start: work struct (\w+): function flush_to_ldisc")


@contextmanager
def _busy_processes(count: int) -> Iterator[None]:
    children = []
    for _ in range(count):
        child = os.fork()
        if child == 0:
            while True:
                pass
        children.append(child)
    try:
        yield
    finally:
        for child in children:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)


def _schedule_kernel(policy: int, priority: int) -> int:
    """Set the scheduling of the kernel threads in PASSING_ON; return their number."""
    count = 0
    for comm in Path("/proc").glob("[0-9]*/comm"):
        with suppress(OSError):  # the thread has ended
            if PASSING_ON.match(comm.read_text("ascii")):
                os.sched_setscheduler(int(comm.parent.name), policy, os.sched_param(priority))
                count += 1
    return count


@contextmanager
def _kernel_first(is_wanted: bool) -> Iterator[None]:
    """Let the kernel's threads that pass bytes on run before all normal processes."""
    if is_wanted:
        _schedule_kernel(os.SCHED_FIFO, PRIORITY)
    try:
        yield
    finally:
        if is_wanted:
            _schedule_kernel(os.SCHED_OTHER, 0)


@contextmanager
def _traced_works() -> Iterator[list[float]]:
    """Yield a list. After the block, it has the delay of each start of flush_to_ldisc, in ms."""
    late: list[float] = []
    if not (TRACING / "trace").exists():
        subprocess.run(["mount", "-t", "tracefs", "tracefs", TRACING], check=True)
    (TRACING / "trace").write_text("", "ascii")
    for event in EVENTS:
        (TRACING / "events/workqueue" / event / "enable").write_text("1", "ascii")
    try:
        yield late
    finally:
        for event in EVENTS:
            (TRACING / "events/workqueue" / event / "enable").write_text("0", "ascii")
    queued: dict[str, float] = {}
    for line in (TRACING / "trace").read_text("ascii").splitlines():
        if found := QUEUED.search(line):
            queued[found[2]] = float(found[1])
        elif (found := STARTED.search(line)) and found[2] in queued:
            late.append(1000 * (float(found[1]) - queued.pop(found[2])))


def _spread(times: Sequence[float]) -> dict[str, float]:
    ordered = sorted(times)
    places = {"p50": len(ordered) // 2, "p99": len(ordered) * 99 // 100, "most": len(ordered) - 1}
    return {name: round(ordered[at], 2) for name, at in places.items()}


def _polled(plant: str, seconds: float, *, realtime: bool) -> dict[str, Any]:
    """Poll for `seconds` s; return the rate, the gaps between requests and the kernel's delays in ms."""
    sent: set[int] = set()
    with Poller(plant, realtime=realtime) as poller, _traced_works() as late:
        begun = time.monotonic_ns() + round(WARM_UP_S * 1e9)
        for batch in poller:
            sent.update(row.monotonic_ns for row in batch)
            if time.monotonic_ns() > begun + seconds * 1e9:
                break
    times = sorted(when for when in sent if begun <= when <= begun + seconds * 1e9)
    gaps = [(after - before) / 1e6 for before, after in pairwise(times)]
    return {"requests per s": round(len(times) / seconds, 1), "gap": _spread(gaps), "work": _spread(late)}


def cadence(kind: str, loops: int, seconds: float, rounds: int) -> dict[str, list[dict[str, Any]]]:
    """Poll two drives: first alone, then beside `loops` busy processes, without and with realtime scheduling.
    Last, the kernel threads that pass bytes on have realtime scheduling too. `kind` is that of a USB adapter,
    or "8250" for QEMU's UART.
    """
    far_end: dict[str, Any] = {"serial": "uart", "family": FAMILY, "addresses": [1, 2]}
    if kind == "8250":
        plug.do("connect", far_end)
        path = "/dev/ttyS1"
    else:
        path = plug.Adapter(kind, f"load-{kind}", family=FAMILY, addresses=[1, 2]).path
    plant = write_plant({"a": (path, [1, 2])}, every="")
    cases = {
        "alone": (0, False, False),
        "busy": (loops, False, False),
        "busy, realtime": (loops, True, False),
        "busy, realtime, kernel first": (loops, True, True),
    }
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in cases}
    for _ in range(rounds):
        for name, (count, realtime, is_kernel_first) in cases.items():
            with _busy_processes(count), _kernel_first(is_kernel_first):
                found[name].append(_polled(plant, seconds, realtime=realtime))
    return found
