"""Count a process's threads and descriptors: comparing before and after shows leaks."""

import threading
from pathlib import Path


def descriptors() -> int:
    return len(list(Path("/dev/fd").iterdir()))


def threads() -> int:
    """Count the threads except the logging thread, which starts with the first entry and stays."""
    return sum(thread.name != "multidrop log" for thread in threading.enumerate())
