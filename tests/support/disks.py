"""Disks that are full, come back, or take nothing: without a mount, and for root too."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

NOBODY = 65534


@contextmanager
def full_at(size: int) -> Iterator[None]:
    """No file of this process grows beyond so many bytes; a write that would is cut off there."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def read_only_directory() -> Iterator[Path]:
    """A directory in which nothing can be made; root, who can everywhere, becomes nobody."""
    user = os.geteuid()
    with TemporaryDirectory() as directory:
        Path(directory).chmod(0o555)
        if user == 0:
            os.seteuid(NOBODY)
        try:
            yield Path(directory)
        finally:
            os.seteuid(user)
            Path(directory).chmod(0o755)
