"""Changes of this machine's network: a browser breaks off its requests at each, so the two take turns."""

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
    """Keep the network as it is; any number of processes may."""
    with _locked(fcntl.LOCK_SH):
        yield


@contextmanager
def changing_network() -> Iterator[None]:
    """Let cards come and go; one process at a time."""
    with _locked(fcntl.LOCK_EX):
        yield
