"""Ledger and audit log on disks that are full, recover or fail, and with a clock that is set back."""

from __future__ import annotations

import json
import sqlite3
import threading
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from interruptions import full_at, read_only_directory
from simulated_bus import SimulatedBus, one

from multidrop.cli import main
from multidrop.control import records as write_records
from multidrop.control.eeprom_ledger import Ledger, LedgerCell
from multidrop.control.outcome import Effect
from multidrop.control.records import AuditLog, noted_first, read_audit, written_by
from multidrop.core import Message
from multidrop.errors import Unconfirmed, WriteForbidden
from multidrop.families import DelixiModbus, ErmanERG220, InvtCHE
from multidrop.sim import simulated
from multidrop.transport.aside_log import flush_log

CELL = LedgerCell("/dev/ttyUSB0", 1, "delixi-modbus", "frequency")
HOUR = 3600.0
NOON = 1_795_000_000.0
PATIENCE_S = 60.0


def raises_unkept() -> AbstractContextManager[object]:
    return pytest.raises(OSError, match=r"the ledger of EEPROM writes .* cannot be kept")


def writes(ledger: Ledger) -> int:
    return sum(wear.writes for wear in ledger.wear(NOON))


@pytest.mark.parametrize("room", range(0, 90, 10))
def test_a_full_disk_does_not_damage_other_audit_records(tmp_path: Path, room: int) -> None:
    path = tmp_path / "audit.jsonl"
    log, other = AuditLog(path), AuditLog(path)  # `other` is the log of another process
    log.add(0, {"write": "first"})
    with full_at(path.stat().st_size + room):
        for _ in range(2):
            with pytest.raises(OSError, match=r"only part|File too large"):
                log.add(1, {"write": "lost" * 20})
    other.add(2, {"write": "second"})
    log.add(3, {"write": "third"})
    for each in (log, other):
        each.close()
    assert [each["write"] for each in read_audit(path)] == ["first", "second", "third"]
    whole = path.read_bytes().splitlines()
    assert sum(not _is_record(line) for line in whole) == (1 if room else 0)


def test_read_audit_skips_invalid_lines(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    path.write_bytes(b'{"write": "a"}\n' + b"[" * 100_000 + b"\n[1]\n\xff\n" + b'{"write": "b"}\n{"write')
    assert [record["write"] for record in read_audit(path)] == ["a", "b"]


def test_closing_a_bus_waits_for_audit_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a stop that ends while its bus is closed would not be recorded."""
    begun, go_on = threading.Event(), threading.Event()

    class SlowLog(AuditLog):
        def add(self, utc_ns: int, record: dict[str, Any]) -> None:
            begun.set()
            assert go_on.wait(PATIENCE_S)
            super().add(utc_ns, record)

    monkeypatch.setattr(write_records, "CLOSING_NS", PATIENCE_S * 1e9)
    path = tmp_path / "audit.jsonl"
    line: Any = SimpleNamespace(port="/dev/ttyUSB0", identity="usb-1")
    records = write_records.WriteRecords(line, Ledger(tmp_path / "ledger"), SlowLog(path))
    records.log_later(InvtCHE(1), Message(1, 6, 0x1000, data=b"\0\5"), "control = STOP", Effect.DONE)
    noting, closing_it = threading.Thread(target=records.catch_up), threading.Thread(target=records.close)
    noting.start()
    assert begun.wait(PATIENCE_S)
    closing_it.start()
    closing_it.join(0.1)
    go_on.set()
    for thread in (noting, closing_it):
        thread.join(PATIENCE_S)
    assert [record["write"] for record in read_audit(path)] == ["control = STOP"]


def test_queued_audit_records_are_written_before_the_log_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    line: Any = SimpleNamespace(port="/dev/ttyUSB0", identity="usb-1")
    records = write_records.WriteRecords(line, Ledger(tmp_path / "ledger"), AuditLog(path))
    records.log_later(InvtCHE(1), Message(1, 6, 0x1000, data=b"\0\5"), "control = STOP", Effect.DONE)
    records.close()
    assert [record["write"] for record in read_audit(path)] == ["control = STOP"]


def _is_record(line: bytes) -> bool:
    try:
        json.loads(line)
    except ValueError:
        return False
    return True


def test_a_stop_is_sent_despite_a_full_disk(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "audit.jsonl"
    line, drive, sim = one(InvtCHE(1, maximum_frequency=50), audit=path)
    drive.set_frequency(20)
    drive.start()
    with full_at(path.stat().st_size + 50):
        drive.stop()
        line.bus._records.flush(PATIENCE_S)
    flush_log(PATIENCE_S)
    assert not sim.motor.energised
    assert "the audit log cannot be written: " in caplog.text
    assert line.bus.audit_trouble == "File too large"  # the system's error beyond the limit of `full_at`
    drive.set_frequency(30)
    assert line.bus.audit_trouble == ""
    line.bus.close()
    assert [each["write"] for each in read_audit(path)] == [
        "setpoint = 40.00 %",
        "control = FORWARD",
        "setpoint = 60.00 %",
    ]


def test_a_full_disk_prevents_writes_but_not_stops(tmp_path: Path) -> None:
    """In a `noted_first` block, each write must be recorded before it is sent."""
    path = tmp_path / "audit.jsonl"
    line = SimulatedBus(simulated(InvtCHE(1, maximum_frequency=50)), audit=path)
    drive = line.attach(InvtCHE(1, maximum_frequency=50))
    with noted_first():
        drive.set_frequency(20)
        drive.start()
        before = len(line.written)
        with full_at(path.stat().st_size):
            for write in (
                lambda: drive.set_frequency(25),
                drive.start,
                lambda: drive.send_raw(6, 0x1000, b"\0\1"),
            ):
                with pytest.raises(OSError, match=r"was not sent: the audit log cannot be written: \S"):
                    write()
            assert len(line.written) == before
            drive.stop()
            drive.write(drive.control, drive.control.decode(5))
            line.bus._records.flush(PATIENCE_S)
        drive.set_frequency(25)
    line.bus.close()
    noted = [(record["write"], record["outcome"], "sent" in record) for record in read_audit(path)]
    assert noted[:2] == [("setpoint = 40.00 %", "called", False), ("setpoint = 40.00 %", "done", True)]
    assert noted[-2:] == [("setpoint = 50.00 %", "called", False), ("setpoint = 50.00 %", "done", True)]


def test_an_interrupted_stop_is_recorded_as_sent_but_unknown(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50), audit=path)
    line.bus.check_identity(drive)

    line.fails = lambda request: KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        drive.stop()
    line.bus.close()
    called, ended = read_audit(path)
    assert (called["outcome"], ended["outcome"]) == ("called", "sent but unknown")
    assert "sent 0 to 2 times" in ended["why"]
    assert ended["why"].endswith("its caller was interrupted")


def test_a_repeated_stop_has_two_audit_records(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The first record is written before the first frame is sent, so it survives a kill of the process."""
    path = tmp_path / "audit.jsonl"
    line = SimulatedBus(*(simulated(InvtCHE(address)) for address in (1, 2)), audit=path)
    drives = [line.attach(InvtCHE(address)) for address in (1, 2)]
    monkeypatch.setattr(write_records, "CALLED_S", PATIENCE_S)
    noted_at_first: list[dict[str, Any]] = []

    def look(request: Message) -> bytes | None:
        if not noted_at_first:
            noted_at_first.extend(read_audit(path))
        return None

    line.answers = look
    line.loses = lambda request: request.address == 1
    with written_by("anna", "web"), pytest.raises(Unconfirmed):
        drives[0].stop(seconds=15)
    sent = len(line.written)
    (called,) = noted_at_first
    assert {key: called[key] for key in ("drive", "address", "write", "outcome", "by", "way")} == {
        "drive": "invt-che@1",
        "address": 1,
        "write": "stop",
        "outcome": "called",
        "by": "anna",
        "way": "web",
    }
    line.bus.stop_all(seconds=15)
    line.bus.close()
    first, ended, all_called, *each = read_audit(path)
    assert first == called
    assert (ended["outcome"], ended["sent"]) == ("sent but unknown", line.written[sent - 1])
    assert ended["frames"] == sent > 20
    assert (all_called["drive"], all_called["outcome"]) == ("invt-che@2, invt-che@1", "called")
    assert {one["drive"]: one["outcome"] for one in each} == {
        "invt-che@1": "sent but unknown",
        "invt-che@2": "stopped",
    }


def test_an_audit_log_on_a_hung_disk_times_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    answers = threading.Event()
    monkeypatch.setattr(write_records, "OPENING_S", 0.05)
    monkeypatch.setattr(Path, "open", lambda *details, **options: answers.wait(PATIENCE_S))
    with pytest.raises(OSError, match=r"audit log: not done within 0\.05 s; does the disk answer\?"):
        AuditLog(tmp_path / "audit.jsonl")
    answers.set()


def test_an_audit_log_in_a_read_only_directory_is_refused() -> None:
    with read_only_directory() as directory, pytest.raises(PermissionError, match=r"audit\.jsonl"):
        one(InvtCHE(1), audit=directory / "audit.jsonl")


@pytest.mark.parametrize("room", [0, 512, 4096, 8192, 12288])
def test_the_eeprom_ledger_refuses_writes_while_the_disk_is_full(tmp_path: Path, room: int) -> None:
    ledger = Ledger(tmp_path / "wear.sqlite")
    for at in range(3):
        assert ledger.enter(CELL, NOON + at, 0.0) == ""
    others = 0
    with full_at(room), raises_unkept():
        while others < 1000:  # fill the file until it has to grow
            others += not ledger.enter(LedgerCell("p" * 200, 2, "m", f"r{others}"), NOON, 0.0)
    assert others < 1000
    assert ledger.enter(CELL, NOON + 3, 0.0) == ""
    assert writes(ledger) == 4 + others


@pytest.mark.parametrize("room", [0, 512, 4096, 8192])
def test_the_eeprom_ledger_works_once_a_full_disk_has_room_again(tmp_path: Path, room: int) -> None:
    ledger = Ledger(tmp_path / "wear.sqlite")
    with full_at(room), pytest.raises(OSError, match="cannot be kept"):
        ledger.enter(CELL, NOON, 0.0)
    assert ledger.enter(CELL, NOON, 0.0) == ""
    assert writes(ledger) == 1


def test_an_unwritable_eeprom_ledger_prevents_writes_but_not_stops() -> None:
    with read_only_directory() as directory:
        for path in (directory / "wear.sqlite", directory / "deep" / "wear.sqlite"):
            line, drive, _ = one(DelixiModbus(1), ledger=path)
            with pytest.raises(OSError, match=r"the ledger of EEPROM writes .*wear\.sqlite cannot be kept"):
                drive.set_frequency(10)
            assert line.written == []
            drive.stop()  # a stop is sent without the ledger
            assert len(line.written) == 1


@pytest.mark.parametrize("seconds", [0.25, HOUR])
def test_a_clock_set_back_allows_one_additional_eeprom_write(tmp_path: Path, seconds: float) -> None:
    """After a clock is set back, the time since the last write is unknown."""
    ledger = Ledger(tmp_path / "wear.sqlite")
    assert ledger.enter(CELL, NOON, 60.0) == ""
    set_back = NOON - seconds
    assert ledger.enter(CELL, set_back, 60.0) == ""
    for second in range(60):  # each second of the minute after the clock was set back
        assert f"was written {second} s ago" in ledger.enter(CELL, set_back + second, 60.0)
    assert ledger.enter(CELL, set_back + 60, 60.0) == ""
    assert writes(ledger) == 3


def test_all_eeprom_writes_of_a_stop_are_counted_in_one_transaction(tmp_path: Path) -> None:
    """All writes are one transaction, because each transaction may wait for the disk or another process."""
    ledger = Ledger(tmp_path / "wear")
    wrong = replace(CELL, register="no text: \udcff")
    with pytest.raises(ValueError, match="surrogates not allowed"):
        ledger.note([CELL, CELL, wrong], 1000.0)
    assert ledger.wear(1000.0) == []
    ledger.note([CELL, CELL], 1000.0)
    assert [wear.writes for wear in ledger.wear(1000.0)] == [2]


def test_setting_the_clock_back_does_not_restore_the_yearly_eeprom_budget(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "wear.sqlite", budget=10)
    for at in range(10):
        assert ledger.enter(CELL, NOON + at, 0.0) == ""
    for set_back in (HOUR, 86400.0, NOON):  # NOON sets the clock to 1970, as on a board without a battery
        assert "10 times in a year" in ledger.enter(CELL, NOON - set_back, 0.0)


@pytest.mark.long
def test_one_write_a_minute_is_allowed_after_the_clock_is_set_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The EEPROM is written at most once a minute, and once more when the clock jumps back."""
    log = tmp_path / "audit.jsonl"
    line, drive, sim = one(DelixiModbus(1), audit=log)
    utc = [1_700_000_000 * 10**9]
    monkeypatch.setattr("multidrop.transport.clock.utc_minus_monotonic_ns", lambda: utc[0])
    tried = []
    for second in range(240):
        if second == 120:
            utc[0] -= 3600 * 10**9
        try:
            drive.set_frequency(10 + second / 10)
        except WriteForbidden:
            continue
        finally:
            line.sleep(1)
        tried.append(second)
    gaps = sorted(after - before for before, after in pairwise(tried))
    assert len(tried) >= 5
    assert all(gap >= 58 for gap in gaps[1:])  # all intervals but the one in which the clock was set back
    assert sim.counters.eeprom_writes["frequency"] == len(tried)
    line.bus.close()
    times = [str(each["time"]) for each in read_audit(log)]
    assert len(times) == len(tried)
    assert times != sorted(times)  # the clock was set back between two records


def test_the_eeprom_ledger_keeps_its_counts_when_the_bus_is_closed(tmp_path: Path) -> None:
    for life in range(3):
        _, drive, _ = one(ErmanERG220(1), ledger=tmp_path / "wear.sqlite")
        drive.set_frequency(10 + life)
    assert writes(Ledger(tmp_path / "wear.sqlite")) == 3


@pytest.mark.parametrize(
    "time", ["'yesterday'", "x'00'", "null", "9e999", "-1e308", "1e308", "1" + "0" * 400]
)
def test_a_write_is_refused_if_the_eeprom_ledger_holds_an_invalid_time(tmp_path: Path, time: str) -> None:
    ledger, cell = Ledger(tmp_path / "wear.sqlite"), LedgerCell("/dev/ttyUSB0", 1, "toy", "acceleration_time")
    assert ledger.enter(cell, 100.0, 60.0) == ""
    with closing(sqlite3.connect(ledger.path)) as file:
        file.execute(f"update writes set time = {time}")
        file.commit()
    why = "cannot be kept: a write of acceleration_time has an invalid time"
    with pytest.raises(OSError, match=why):
        ledger.enter(cell, 1000.0, 60.0)
    assert main(["wear", "--ledger", str(ledger.path)]) == 1
    with closing(sqlite3.connect(ledger.path)) as file:
        assert file.execute("select count(*) from writes").fetchone() == (1,)
