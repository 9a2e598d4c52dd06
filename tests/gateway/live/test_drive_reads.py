"""Identities are checked before the first stop is called, so that the stop is sent immediately."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import pytest
from gateways import served
from lines import until

from multidrop import LineError, WriteForbidden
from multidrop.gateway.live import drive_reads as module
from multidrop.gateway.live.drive_reads import Identities

MAY = '[serve.may]\nstop = "anyone"\n'


@pytest.mark.long
def test_first_stop_reads_no_identity(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """No identity is read between the call of a stop and its Modbus frame."""
    asked: list[str] = []
    with served(tmp_path, MAY) as gateway:
        bus = gateway.gateway.bus("hall")
        check = bus._performer._writer.identity_check
        until(lambda: all(map(check.is_known, bus.drives)))
        with monkeypatch.context() as patched:
            patched.setattr(check, "_read", lambda drive, *more, **options: asked.append(drive.name))
            told = gateway.post("/api/stop").json
        assert [one["done"] for one in told.values()] == [True, True]
    assert asked == []


class Asked:
    """A bus that records the checked drives, and raises the exceptions in `failures`."""

    def __init__(self, failures: dict[str, Exception]) -> None:
        self.names: list[str] = []
        self.known: set[str] = set()
        self._failures = failures

    def knows_identity(self, drive: Any) -> bool:
        return drive.name in self.known

    def check_identity(self, drive: Any) -> None:
        self.names.append(drive.name)
        if drive.name in self._failures:
            raise self._failures[drive.name]


def ask_all(bus: Asked, is_there: Callable[[str], bool], *names: str) -> list[str]:
    """Check these drives in two rounds; return "failed" for each unexpected exception."""
    drives = [SimpleNamespace(drive=SimpleNamespace(name=name)) for name in names]
    plant = SimpleNamespace(lines=[SimpleNamespace(name="hall", drives=drives)])
    failed: list[str] = []
    rounds = 0

    def present() -> Any:
        nonlocal rounds
        rounds += 1
        if rounds > 2:
            raise asyncio.CancelledError
        return plant

    of: Any = Identities
    identities = of(present, lambda line: bus, is_there, lambda: failed.append("failed"))
    with suppress(asyncio.CancelledError):
        asyncio.run(identities.run())
    return failed


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PAUSE_S", 0.0)
    monkeypatch.setattr(module, "ROUND_S", 0.0)


def test_identity_of_a_silent_drive_is_not_read() -> None:
    bus = Asked({})
    assert ask_all(bus, lambda name: name != "silent", "pump-1", "silent", "pump-2") == []
    assert bus.names == ["pump-1", "pump-2"] * 2


def test_known_identity_is_not_read_again() -> None:
    """No thread is started for a known identity either."""
    bus = Asked({})
    bus.known.add("pump-1")
    assert ask_all(bus, lambda name: True, "pump-1", "pump-2") == []
    assert bus.names == ["pump-2"] * 2


def test_wrong_identity_is_logged_once_and_failures_do_not_end_the_check(
    caplog: pytest.LogCaptureFixture,
) -> None:
    stranger = WriteForbidden(
        "nothing is written to fan-1: it is no CHE", rule="it does not look like its family"
    )
    failures = {"fan-1": stranger, "lost": LineError("/dev/x", "gone"), "broken": RuntimeError("a bug")}
    bus = Asked(failures)
    with caplog.at_level(logging.WARNING):
        assert ask_all(bus, lambda name: True, *failures, "pump-1") == ["failed", "failed"]
    assert [one.message for one in caplog.records] == [str(stranger)]
    assert bus.names == [*failures, "pump-1"] * 2
