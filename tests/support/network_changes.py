"""Coordinate network changes: a browser aborts its requests at each, so the two exclude each other."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LOCK = Path(tempfile.gettempdir()) / f"multidrop-network-{os.getuid()}"


@contextmanager
def _locked(how: int) -> Iterator[None]:
    with LOCK.open("w") as file:
        fcntl.flock(file, how)
        yield


@contextmanager
def steady_network() -> Iterator[None]:
    """Prevent network changes; any number of processes may hold this."""
    with _locked(fcntl.LOCK_SH):
        yield


@contextmanager
def changing_network() -> Iterator[None]:
    """Allow network changes; one process at a time."""
    with _locked(fcntl.LOCK_EX):
        yield
