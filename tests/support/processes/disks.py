"""Simulate full and read-only disks without a mount; works for root too."""

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
    """Limit files of this process to `size` bytes; writes beyond the limit are cut off."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def read_only_directory() -> Iterator[Path]:
    """Yield a directory that rejects new files; root becomes `nobody`, because root can write anywhere."""
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
