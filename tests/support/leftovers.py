"""Counts of what a process holds: compared before and after, they show what was left behind."""

import threading
from pathlib import Path


def descriptors() -> int:
    return len(list(Path("/dev/fd").iterdir()))


def threads() -> int:
    """Count the threads, without the one that logs: it begins with the process's first entry, and stays."""
    return sum(thread.name != "multidrop log" for thread in threading.enumerate())
