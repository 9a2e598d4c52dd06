"""A computer that sleeps (S3), with QEMU's USB adapter and its Linux driver. Each test boots a guest."""

from __future__ import annotations

from pathlib import Path

import pytest
from rig import boot

pytestmark = pytest.mark.long


@pytest.mark.parametrize("names", ["tty", "by-id"])
def test_a_poll_goes_on_after_a_sleep(built: Path, names: str) -> None:
    """The adapter gets another tty name, because its old name is still in use when it comes back."""
    with boot(built) as guest:
        found = guest.run("sleep_in_poll", names=names)
    assert found["slept"] > 1
    assert found["ttys"] == ["/dev/ttyUSB0", "/dev/ttyUSB1"]
    assert found["wrong"] == []
    assert found["came back"]


def test_no_write_is_repeated_after_a_sleep(built: Path) -> None:
    with boot(built) as guest:
        found = guest.run("sleep_in_write")
    assert found["slept"] > 1
    assert len(found["values"]) > 2
    assert found["values"] == sorted(set(found["values"]))
