"""Stalled adapters with their Linux drivers: polls and buses end, and held commands never leave."""

from __future__ import annotations

import signal

import pytest
from rig import Guest

pytestmark = [pytest.mark.slow, pytest.mark.long]

START = "01050000ff00"  # start of the frame that sets this coil of drive 1
LONG_S = 20.0  # the kernel's own limit is 30 s


@pytest.mark.parametrize("kind", ["ftdi", "cp210x", "ch341", "pl2303", "acm"])
def test_a_start_that_a_stalled_adapter_holds_is_discarded(guest: Guest, kind: str) -> None:
    found = guest.run("start_in_stall", kind=kind)
    assert found["close"] < LONG_S
    assert not any(frame.startswith(START) for frame in found["left after the close"])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("kind", ["ftdi", "acm"])
def test_a_poll_of_a_stalled_adapter_ends(guest: Guest, kind: str, number: int) -> None:
    found = guest.run("end_of_stalled_poll", kind=kind, signals=[number])
    assert found["seconds"] < LONG_S
