"""A Debian in QEMU, booted once for all tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from peers import require_built
from rig import Guest, boot


@pytest.fixture(scope="session")
def built() -> Path:
    """Return the folder of `tools/kernel/build`, which MULTIDROP_KERNEL names."""
    return require_built("MULTIDROP_KERNEL", "tools/kernel/build")


@pytest.fixture(scope="session")
def guest(built: Path) -> Iterator[Guest]:
    with boot(built) as booted:
        yield booted
