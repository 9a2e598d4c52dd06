"""The audit log: each write with its frame, its outcome and the reason for it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from simulated_bus import SimulatedBus, one

from multidrop.control.audit_log import read_audit
from multidrop.core import Completion, Exchange, Framing, Message, build_reply
from multidrop.errors import (
    DriveException,
    LineError,
    Unconfirmed,
)
from multidrop.families import YD1000, InvtCHE
from multidrop.families.invt_che import CHEControl
from multidrop.transport.aside_log import flush


def test_a_refused_raw_request_is_recorded_as_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1), audit=tmp_path / "audit")
    refusal = build_reply(Framing.RTU, Message(1, 6, exception=0x12))
    line.answers = lambda request: refusal if request.function == 6 else None
    with pytest.raises(DriveException, match="code 12H"):
        drive.send_raw(6, 0x1000, b"\0\5")
    line.bus.close()
    assert [entry["outcome"] for entry in read_audit(tmp_path / "audit")] == ["refused by the drive"]


@pytest.mark.parametrize("is_lost", [False, True])
def test_the_outcome_of_a_raw_request_is_recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_lost: bool
) -> None:
    line, drive, _ = one(monkeypatch, YD1000(1), audit=tmp_path / "audit")
    line.loses = lambda request: is_lost
    with pytest.raises(Unconfirmed) if is_lost else nullcontext():
        drive.send_raw(6, 0x0000, b"\x00\x01")
    line.bus.close()
    (entry,) = read_audit(tmp_path / "audit")
    assert entry["write"] == "raw request 01 06 00 00 00 01 48 0A"
    assert entry["outcome"] == ("unconfirmed" if is_lost else "done")


def test_the_audit_log_has_every_write(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    log = tmp_path / "audit.jsonl"
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50), audit=log)
    drive.set_frequency(20)
    line.loses = lambda request: request.function == 6
    with pytest.raises(Unconfirmed):
        drive.start()
    line.bus.close()
    noted = list(read_audit(log))
    assert [(record["write"], record["sent"][:17], record["outcome"]) for record in noted] == [
        ("setpoint = 40.00 %", "01 06 20 00 0F A0", "done"),
        ("control = FORWARD", "01 06 10 00 00 01", "unconfirmed"),
    ]
    assert noted[0]["held"] == 40
    assert noted[0]["time"].startswith("2023-11-14T22:")
    assert (noted[1]["drive"], noted[1]["address"], noted[1]["port"]) == ("invt-che@1", 1, "hall")


def test_a_log_that_cannot_be_written_does_not_hinder_a_stop(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1), audit="/dev/full")
    drive.stop()
    line.bus.close()
    flush(60)
    assert [each[:17] for each in line.written] == ["01 06 10 00 00 05"]
    assert "the audit log cannot be written" in caplog.text


LOST = LineError("hall", "the port was lost")
LOST.is_sent = True


ENDINGS: dict[str, tuple[BaseException, int, Callable[[SimulatedBus, Any], object], str]] = {
    "port lost at the reading back": (
        LOST,
        3,
        lambda line, drive: drive.set_frequency(30),
        "setpoint = 60.00 %",
    ),
    "port lost in a start": (LOST, 6, lambda line, drive: drive.start(), "control = FORWARD"),
    "interrupted": (KeyboardInterrupt(), 6, lambda line, drive: drive.start(), "control = FORWARD"),
    "port lost in a raw request": (
        LOST,
        6,
        lambda line, drive: drive.send_raw(6, 0x1000, b"\0\5"),
        "raw request 01 06 10 00 00 05 4D 09",
    ),
    "port lost in a broadcast": (
        LOST,
        6,
        lambda line, drive: line.bus.broadcast(drive.control, CHEControl.STOP),
        "control = STOP",
    ),
}


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_write_without_an_outcome_is_recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ending: str
) -> None:
    failure, function, act, what = ENDINGS[ending]
    log = tmp_path / "audit.jsonl"
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50), audit=log)
    drive.set_frequency(20)
    before = len(line.written)
    carry_out = line.carry_out

    def fail(exchange: Exchange, **times: Any) -> Completion:
        if exchange.request.function == function and (function == 6 or len(line.written) > before):
            raise failure
        return carry_out(exchange, **times)

    monkeypatch.setattr(line, "carry_out", fail)
    with pytest.raises((type(failure), Unconfirmed)):
        act(line, drive)
    line.bus.close()
    (record,) = list(read_audit(log))[1:]
    assert (record["write"], record["outcome"], bool(record["why"])) == (what, "unconfirmed", True)
