"""On real ports: processes that exit or are killed, two processes with one EEPROM ledger, and echoes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import checksums
import pytest
from commands import BoundProcess
from simulated_bus import SimulatedBus, is_write, one
from tables import table, usually

from multidrop.bus import Bus
from multidrop.control.eeprom_ledger import BUDGET, YEAR, Ledger, LedgerCell
from multidrop.control.outcome import Effect
from multidrop.control.records import AuditLog, read_audit
from multidrop.core import Message, build_request
from multidrop.drive import Drive
from multidrop.errors import NoReply, Unconfirmed
from multidrop.families import YD1000, DelixiModbus, DelixiNative, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.sim import MotorDrive, Simulator, Wire, simulated

CLIENT = """
import signal, sys, time
from multidrop import Bus, InvtCHE
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # pytest may run with another handler
class Pump(InvtCHE):  # long timeouts for a busy machine
    response_timeout = 60.0
    response_delay = 15.0
with Bus(sys.argv[1], expiry=60) as bus:
    pump = bus.attach(Pump(1, maximum_frequency=50))
    pump.set_frequency(20)
    pump.start()
    if sys.argv[2] == "stop":
        bus.stop_on_exit()
    print("running", flush=True)
    {then}
"""
ENDINGS = {  # code that the client runs after the motor's start, signal sent to it, exit status
    "SIGTERM": ("time.sleep(60)", signal.SIGTERM, -signal.SIGTERM),
    "SIGINT": ("time.sleep(60)", signal.SIGINT, 1),
    "SIGHUP": ("time.sleep(60)", signal.SIGHUP, -signal.SIGHUP),  # sent when the client's terminal is closed
    "leaving": ("pass", None, 0),
    "error": ("raise RuntimeError", None, 1),
    "exit": ("sys.exit(3)", None, 3),
}


@contextmanager
def pump() -> Iterator[tuple[MotorDrive, str]]:
    sim = simulated(InvtCHE(1, maximum_frequency=50))
    assert isinstance(sim, MotorDrive)
    sim.motor.deceleration_time = 0.2
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        yield sim, simulator.wires[0].path


@pytest.mark.long
@pytest.mark.parametrize(
    ("opted", "ending"),
    [*(("stop", ending) for ending in ENDINGS), *usually(*(("leave", ending) for ending in ENDINGS))],
)
def test_motors_are_stopped_at_exit_only_with_stop_on_exit(ending: str, opted: str) -> None:
    then, number, status = ENDINGS[ending]
    with pump() as (sim, port):
        words = [sys.executable, "-c", CLIENT.format(then=then), port, opted]
        with BoundProcess(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True
        ) as client:
            assert client.stdout is not None
            line = client.stdout.readline()
            assert line == "running\n"
            if number is not None:
                client.send_signal(number)
            client.communicate()
        assert client.returncode in (status, -int(number or 0))
        written = [write.raw for write in sim.counters.writes if write.name == "control"]
        assert written[:2] == ([1, 5] if opted == "stop" else [1])
        assert set(written[2:]) <= {5, 8}  # stops (5) and STOP_JOG (8), repeated if a reply is late
        assert sim.motor.energised == (opted == "leave")


def test_closing_a_bus_with_stop_on_exit_stops_motors_and_restores_handlers() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pump() as (sim, port):
        with Bus(port) as bus:
            bus.attach(sim.drive)
            bus.stop_on_exit()
            bus.stop_on_exit()
            assert signal.getsignal(signal.SIGTERM) != before[1]
        assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
        written = [write.raw for write in sim.counters.writes]
        assert written[0] == 5
        assert set(written) <= {5, 8}  # stops (5) and STOP_JOG (8), repeated if a reply is late


CELL = LedgerCell("/dev/ttyUSB0", 1, "delixi-modbus", "frequency")

# The program pauses: without pauses, one of the two processes could hold SQLite's lock for too long.
ENTRANT = """
import sys, time
from multidrop.control.eeprom_ledger import LedgerCell, Ledger
ledger = Ledger(sys.argv[1], budget=30)
cell = LedgerCell("/dev/ttyUSB0", 1, "delixi-modbus", "frequency")
entered = 0
for at in range(25):
    entered += not ledger.enter(cell, 1e9 + at, 0.0)
    time.sleep(0.003)
print(entered)
"""


@pytest.mark.long
def test_two_processes_share_one_eeprom_write_budget(tmp_path: Path) -> None:
    path = tmp_path / "wear.sqlite"
    words = [sys.executable, "-c", ENTRANT, str(path)]
    both = [subprocess.Popen(words, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert sum(int(each.communicate()[0]) for each in both) == 30
    (wear,) = Ledger(path).wear(1e9 + 100)
    assert (wear.cell, wear.writes) == (CELL, 30)


def test_eeprom_ledger_entries_persist_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "wear.sqlite"
    assert Ledger(path).wear(0) == []
    assert Ledger(path).enter(CELL, 1000.0, 60.0) == ""
    assert "was written 59 s ago" in Ledger(path).enter(CELL, 1059.0, 60.0)
    assert Ledger(path).enter(CELL, 1060.0, 60.0) == ""
    assert Ledger(path).enter(CELL, 1000.0, 60.0) == ""  # counted although the clock was set back
    other = LedgerCell("/dev/ttyUSB0", 2, "delixi-modbus", "frequency")
    assert Ledger(path).enter(other, 1061.0, 60.0) == ""
    assert [(each.cell.address, each.writes, each.this_year) for each in Ledger(path).wear(1061.0)] == [
        (1, 3, 3),
        (2, 1, 1),
    ]
    assert [each.this_year for each in Ledger(path).wear(1061.0 + YEAR)] == [0, 0]


def test_the_yearly_eeprom_budget_allows_10_000_writes_in_ten_years() -> None:
    assert BUDGET * 10 == 10_000


def test_an_invalid_ledger_file_raises_a_one_sentence_error(tmp_path: Path) -> None:
    path = tmp_path / "wear.sqlite"
    path.write_text("this is no database, and long enough to be looked at as one" * 20)
    with pytest.raises(OSError, match=r"the ledger of EEPROM writes .* cannot be kept"):
        Ledger(path).enter(CELL, 0.0, 60.0)


WRITER = """
import sys
from multidrop.control.records import AuditLog
log = AuditLog(sys.argv[1])
for number in range(200):
    log.add(number, {"writer": sys.argv[2], "number": number, "text": "x" * 200})
"""


@pytest.mark.slow
def test_audit_log_lines_of_two_processes_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    writers = [subprocess.Popen([sys.executable, "-c", WRITER, str(path), name]) for name in "ab"]
    assert [writer.wait() for writer in writers] == [0, 0]
    records = list(read_audit(path))
    for name in "ab":
        assert [record["number"] for record in records if record["writer"] == name] == list(range(200))


@table("torn_at", range(0, 120, 7))
def test_other_audit_records_survive_a_truncated_line(tmp_path: Path, torn_at: int) -> None:
    path = tmp_path / "audit.jsonl"
    log = AuditLog(path)
    log.add(0, {"write": "first"})
    log.add(1, {"write": "second"})
    log.close()
    whole = path.read_bytes()
    path.write_bytes(whole[: min(torn_at, len(whole))])
    log = AuditLog(path)
    log.add(2, {"write": "third"})
    log.close()
    found = [each["write"] for each in read_audit(path)]
    assert found[-1] == "third"
    assert found == [name for name in ("first", "second") if name in found] + ["third"]


@contextmanager
def echoing(hears: Any = None) -> Iterator[str]:
    """Yield a port that echoes all that is sent; `hears` returns a drive's reply to a request."""
    ours, theirs = os.openpty()
    path = os.ttyname(theirs)
    done = threading.Event()

    def echo() -> None:
        while not done.is_set():
            try:
                received = os.read(ours, 1024)
            except OSError:
                return
            os.write(ours, received + (hears(received) if hears else b""))

    thread = threading.Thread(target=echo, daemon=True)
    thread.start()
    try:
        yield path
    finally:
        done.set()
        os.write(theirs, b"x")
        thread.join()
        os.close(theirs)
        os.close(ours)


@pytest.mark.long
def test_an_echo_on_a_line_without_drives_confirms_no_command() -> None:
    with echoing() as port, Bus(port) as bus:
        pump = bus.attach(InvtCHE(1, maximum_frequency=50))
        with pytest.raises(NoReply):
            pump.start()
        with pytest.raises((NoReply, Unconfirmed)):
            pump.stop(seconds=0.5)


@pytest.mark.slow
def test_an_echo_is_not_taken_for_the_reply_to_a_write() -> None:
    """The drive answers two reads, then dies: the write is answered only by its echo."""
    read = {
        bytes.fromhex("01 03 30 16 00 01 6A CE"): bytes.fromhex("01 03 02 01 01 78 14"),
        checksums.rtu("010330000002"): checksums.rtu("01030400000000"),  # the two reads, each with its reply
    }

    def hears(request: bytes) -> bytes:
        return read.get(request, b"")

    with echoing(hears) as port, Bus(port) as bus:
        pump = bus.attach(InvtCHE(1))
        with pytest.raises(Unconfirmed, match="no reply"):
            pump.write(pump.setpoint, 50.0)


DRIVES = (
    ErmanERG220(1),
    InvtCHE(1, maximum_frequency=50),
    InnovertIBD(1),
    DelixiModbus(1),
    DelixiNative(1),
    YD1000(1),
)


def dies_and_echoes(line: SimulatedBus, drive: Drive) -> None:
    """From now on, answer each write with its echo, and no read at all."""
    line.deafens = lambda request: True
    line.answers = lambda request: build_request(drive.framing, request) if is_write(request) else None


@table("declared", DRIVES)
def test_an_echo_does_not_confirm_a_stop_sent_as_a_register_write(declared: Drive) -> None:
    line, drive, _ = one(type(declared)(1, **declared.option))
    stop = next(register for register in drive.registers.values() if register.harmless)
    value = stop.decode(stop.harmless[-1])
    assert drive.try_write(stop, value).effect is Effect.DONE
    dies_and_echoes(line, drive)
    with pytest.raises(Unconfirmed, match="echo"):
        drive.write(stop, value)


@pytest.mark.parametrize("family", [InnovertIBD, DelixiNative])
def test_an_echo_does_not_confirm_a_setpoint(family: type[Drive]) -> None:
    """The setpoint cannot be read back, so the echo is the only reply."""
    line, drive, _ = one(family(1))
    drive.set_frequency(20)
    dies_and_echoes(line, drive)
    for write in (lambda: drive.write(drive.frequency, 25.0), lambda: drive.set_frequency(25.0)):
        with pytest.raises(Unconfirmed, match="echo"):
            write()
        assert drive.commanded is None  # unknown: no start or ramp may rely on it


def test_a_write_is_unconfirmed_if_the_next_read_reveals_an_echo() -> None:
    """The drive missed the write, and answers the read after it."""
    line, drive, _ = one(InnovertIBD(1))
    drive.set_frequency(20)

    def echo(request: Message) -> bytes | None:
        line.has_echo |= not is_write(request)  # the core sets this flag when a reply follows an echo
        return build_request(drive.framing, request) if is_write(request) else None

    line.answers = echo
    outcome = drive.try_write(drive.frequency, 25.0)
    assert outcome.effect is Effect.UNCONFIRMED
    assert "the reply was the adapter's echo" in str(outcome.failure)


def test_an_echo_does_not_confirm_a_raw_request(tmp_path: Path) -> None:
    line, drive, _ = one(InnovertIBD(1), audit=tmp_path / "audit")
    drive.send_raw(6, 0x2001, b"\x07\xd0")
    dies_and_echoes(line, drive)
    with pytest.raises(Unconfirmed, match="echo"):
        drive.send_raw(6, 0x2001, b"\x07\xd0")
    line.bus.close()
    assert [entry["outcome"] for entry in read_audit(tmp_path / "audit")] == ["done", "unconfirmed"]


def test_a_write_is_confirmed_on_a_line_that_is_known_to_echo() -> None:
    """If the echo is known, the core can distinguish the drive's reply from the echo."""
    line, drive, _ = one(InnovertIBD(1))
    line.has_echo = True
    drive.set_frequency(20)
    line.loses = lambda request: not is_write(request)
    assert drive.try_write(drive.frequency, 25.0).effect is Effect.DONE
