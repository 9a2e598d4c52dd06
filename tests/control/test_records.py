"""Records of a line's writes: the EEPROM ledger, which identifies ports by hardware, and the audit log."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from commands import BoundProcess
from lines import PATIENCE
from simulated_bus import SimulatedBus, one
from tables import table
from toy import Status, Toy

from multidrop.bus import Bus
from multidrop.control import eeprom_ledger
from multidrop.control.eeprom_ledger import Ledger, LedgerCell, default_ledger_path
from multidrop.control.ramp import start_staggered
from multidrop.control.records import noted_first, read_audit, written_by
from multidrop.core import Completion, Exchange
from multidrop.drive import Condition, Drive
from multidrop.drive.register import COIL, Kept, setting
from multidrop.errors import BusError, DriveException, LineError, Unconfirmed, WriteForbidden
from multidrop.families import YD1000, InvtCHE
from multidrop.families.invt_che import CHEControl
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated
from multidrop.transport import port_identity
from multidrop.transport.aside_log import flush_log
from multidrop.transport.line import Line
from multidrop.transport.port_identity import is_simulated

# ---- the ledger ----


def toys(port: str = "pty") -> Simulator:
    toy = simulated(Toy(1))
    toy["status"] = Status(0)
    return Simulator([Wire([toy], unpaced=True, port=port)])


def write(port: str, seconds: float, ledger: Ledger | None = None) -> None:
    with Bus(port, ledger=ledger, expiry=60.0) as bus:
        toy = bus.attach(Toy, 1)
        toy.write(toy.acceleration_time, seconds)


@pytest.mark.slow
def test_all_paths_of_a_port_share_one_eeprom_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ledger = Ledger(tmp_path / "wear")
    (tmp_path / "ports").mkdir()
    with toys(str(tmp_path / "ports" / "hall-1")) as sim:
        device = os.path.realpath(sim.wires[0].path)
        (tmp_path / "again").symlink_to(tmp_path / "ports")
        write("ports/hall-1", 12.0, ledger)
        spellings = (
            device,
            f"{tmp_path}/ports/hall-1",
            "again/hall-1",
            "./ports/../again/hall-1",
            f"spy://{device}",
        )
        for at, port in enumerate(spellings):
            with pytest.raises(WriteForbidden, match="but only one write in 60 s is allowed"):
                write(port, 13.0 + at, ledger)
        (wear,) = ledger.wear(0)
        assert (wear.cell.port, wear.writes) == (device, 1)


def test_all_names_of_a_host_share_one_eeprom_write_limit(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "wear")
    with toys("socket://127.0.0.1:0") as sim:
        path = sim.wires[0].path
        write(path, 12.0, ledger)
        with pytest.raises(WriteForbidden, match="but only one write in 60 s is allowed"):
            write(path.replace("127.0.0.1", "localhost"), 13.0, ledger)
        assert [each.cell.port for each in ledger.wear(0)] == [path.removeprefix("socket://")]


def test_adapters_are_identified_by_serial_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_identity, "BY_ID", tmp_path / "by-id")
    (tmp_path / "by-id").mkdir()
    for name in ("ttyUSB0", "ttyUSB1"):
        (tmp_path / name).touch()
    link = tmp_path / "by-id" / "usb-FTDI_A1-port0"
    link.symlink_to("../ttyUSB0")
    assert port_identity.of_device(f"{tmp_path}/ttyUSB0") == str(link)
    assert port_identity.of_device(f"{tmp_path}/ttyUSB1") == f"{tmp_path}/ttyUSB1"
    ledger = Ledger(tmp_path / "wear")
    cell = LedgerCell(str(link), 1, "m", "r", f"{tmp_path}/ttyUSB0")
    assert ledger.enter(cell, 1000.0, 60.0) == ""
    link.unlink()
    link.symlink_to("../ttyUSB1")  # the adapter was plugged in again, under another device name
    moved = LedgerCell(port_identity.of_device(f"{tmp_path}/ttyUSB1"), 1, "m", "r", f"{tmp_path}/ttyUSB1")
    assert "was written 5 s ago" in ledger.enter(moved, 1005.0, 60.0)


@table(
    ("name", "identity"),
    [
        ("socket://10.0.0.7:4001", "10.0.0.7:4001"),
        ("rfc2217://10.0.0.7:4001?ign_set_control", "10.0.0.7:4001"),
        ("socket://Server:4001", "server:4001"),
        ("socket://[fe80::1]:4001", "[fe80::1]:4001"),
        ("10.0.0.7:4001", "10.0.0.7:4001"),
        ("socket://nowhere", "socket://nowhere"),
        ("socket://a:99999", "socket://a:99999"),
        ("loop://", "loop://"),
        ("/dev/../dev/null", "/dev/null"),
    ],
)
def test_a_port_name_is_resolved_to_its_device(name: str, identity: str) -> None:
    assert port_identity.of_name(name) == identity
    assert port_identity.of_name(identity) == identity


def test_a_port_without_a_device_is_identified_by_its_name() -> None:
    line = Line("loop://").open()
    assert line.identity == "loop://"
    line.close()


@table(
    ("old", "spelt"),
    [
        *((each, each) for each in ("link", "device", "socket://hall:1")),
        *((each, each) for each in ("socket://10.0.0.7:4001", "rfc2217://10.0.0.7:4001")),
        ("link", "device"),
        ("socket://10.0.0.7:4001", "rfc2217://10.0.0.7:4001"),
    ],
)
def test_ledger_entries_under_an_older_port_name_are_counted(old: str, spelt: str) -> None:
    with TemporaryDirectory() as folder:
        Path(folder, "device").touch()
        Path(folder, "link").symlink_to("device")
        entered, present = (each if "://" in each else f"{folder}/{each}" for each in (old, spelt))
        ledger = Ledger(Path(folder, "wear"), budget=3)
        for at in range(2):
            assert ledger.enter(LedgerCell(entered, 1, "m", "r"), 1000.0 + at, 0.0) == ""
        now = {"socket://hall:1": "10.0.0.9:1"}.get(old, port_identity.of_name(present))
        cell = LedgerCell(now, 1, "m", "r", present)
        assert ledger.enter(cell, 1002.0, 0.0) == ""
        assert "written 3 times in a year" in ledger.enter(cell, 1003.0, 0.0)
        if old != "socket://hall:1":
            assert [(each.cell.port, each.writes) for each in ledger.wear(1003.0)] == [(now, 3)]


def test_writes_to_ram_registers_are_not_counted_in_the_eeprom_ledger(tmp_path: Path) -> None:
    class Fan(Drive):
        """A user's own drive."""

        relay = setting(1, table=COIL)
        speed = setting(2, kept=Kept.RAM)
        known = setting(3)
        latch = setting(4, table=COIL, kept=Kept.EEPROM)

    ledger = Ledger(tmp_path / "wear")
    sim = SimulatedDrive(Fan(1))
    line = SimulatedBus(sim, ledger=ledger)
    fan = line.attach(Fan(1, ram=["known"]))
    for register in (fan.relay, fan.speed, fan.known):
        fan.write(register, 1)
    assert ledger.wear(0) == []
    fan.write(fan.latch, 1)
    assert [each.cell.register for each in ledger.wear(0)] == ["latch"]
    assert set(sim.counters.eeprom_writes) == {"known", "latch"}  # the simulated drive has no option `ram`


with_names = pytest.mark.skipif(sys.platform != "linux", reason="this system has no names for it")


def test_eeprom_writes_are_refused_for_a_user_without_a_home_directory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A container's user often has neither HOME nor an entry in /etc/passwd."""

    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", home)
    # root could create the default path
    monkeypatch.setattr(eeprom_ledger, "NO_HOME", Path("/dev/null"), raising=False)
    toy = simulated(Toy(1))
    toy["status"] = Status(0)
    line = SimulatedBus(toy)
    drive = line.attach(Toy(1))
    drive.stop()
    with pytest.raises(OSError, match=r"EEPROM writes /dev/null/multidrop/wear\.sqlite cannot be kept"):
        drive.write(drive.acceleration_time, 12.0)
    assert toy.counters.eeprom_writes == {}


@with_names
@pytest.mark.parametrize("port", ["pty", "link", "socket://127.0.0.1:0", "socket://0.0.0.0:0"])
def test_writes_to_simulated_drives_are_not_counted_in_the_users_ledger(tmp_path: Path, port: str) -> None:
    with toys(str(tmp_path / "link") if port == "link" else port) as sim:
        path = sim.wires[0].path.replace("0.0.0.0", "127.0.0.1")
        write(path, 12.0)
        # the ledger limits the writes to a simulated drive too, but in a file of its own
        with pytest.raises(WriteForbidden, match="but only one write in 60 s is allowed"):
            write(path, 13.0)
    assert Ledger().wear(0) == []
    assert not list(default_ledger_path().parent.rglob("*.sqlite"))


@with_names
def test_a_ledger_passed_as_argument_counts_simulated_drives_too(tmp_path: Path) -> None:
    with toys() as sim:
        write(sim.wires[0].path, 12.0, Ledger(tmp_path / "wear"))
    assert len(Ledger(tmp_path / "wear").wear(0)) == 1


@pytest.mark.slow
@with_names
def test_a_port_counts_as_simulated_until_its_simulator_is_killed(tmp_path: Path) -> None:
    program = (
        "import time\nfrom multidrop.sim.wire import PtyPort\n"
        "from multidrop.drive.line_settings import Settings\n"
        "port = PtyPort(Settings(9600, '8N1'), None)\nprint(port.path, flush=True)\ntime.sleep(3600)"
    )
    with BoundProcess([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        device = process.stdout.readline().strip()
        held = os.open(device, os.O_RDWR | os.O_NOCTTY)  # keeps the pty from other tests
        try:
            assert is_simulated(device)
        finally:
            process.kill()
            process.wait(PATIENCE)
    assert not is_simulated(device)
    os.close(held)


def test_a_real_port_does_not_count_as_simulated() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        line = Line(f"socket://127.0.0.1:{listener.getsockname()[1]}").open()
        assert not is_simulated(line.identity)
        line.close()
    master, slave = os.openpty()
    assert not is_simulated(os.ttyname(slave))
    os.close(slave)
    os.close(master)


def test_a_simulated_write_is_counted_if_the_port_seems_real(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_identity, "_HAS_NAMES", False)
    with toys() as sim:
        write(sim.wires[0].path, 12.0)
    assert len(Ledger().wear(0)) == 1


# ---- the audit log ----


@pytest.mark.parametrize("outcome", ["done", "unconfirmed", "refused by the drive"])
def test_the_outcome_of_a_raw_request_is_recorded_immediately(tmp_path: Path, outcome: str) -> None:
    line, drive, _ = one(InvtCHE(1), audit=tmp_path / "audit")
    line.loses = lambda request: outcome == "unconfirmed"
    line.refuses = lambda request: 0x12 if request.function == 6 and outcome.startswith("refused") else 0
    failure = {"unconfirmed": Unconfirmed, "refused by the drive": DriveException}.get(outcome)
    with pytest.raises(failure) if failure else nullcontext():
        drive.send_raw(6, 0x1000, b"\0\5")
    (entry,) = read_audit(tmp_path / "audit")
    line.bus.close()
    assert (entry["write"], entry["outcome"]) == ("raw request 01 06 10 00 00 05 4D 09", outcome)
    assert entry["sent"] == "01 06 10 00 00 05 4D 09"


def test_the_audit_log_records_every_write(tmp_path: Path) -> None:
    log = tmp_path / "audit.jsonl"
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50), audit=log)
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


def test_a_stop_is_sent_even_if_the_audit_log_cannot_be_written(caplog: pytest.LogCaptureFixture) -> None:
    line, drive, _ = one(InvtCHE(1), audit="/dev/full")
    drive.stop()
    line.bus.close()
    flush_log(60)
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
def test_interrupted_and_failed_writes_are_recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ending: str
) -> None:
    failure, function, act, what = ENDINGS[ending]
    log = tmp_path / "audit.jsonl"
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50), audit=log)
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


DELAYS: dict[str, Callable[[SimulatedBus, Any], object]] = {
    "expired": lambda line, drive: line.sleep(5),
    "cancelled": lambda line, drive: line.bus.stop_all(),
    "silent": lambda line, drive: (line.sleep(60), setattr(line, "deafens", lambda request: True)),
}
WRITES: dict[str, tuple[str, Callable[[SimulatedBus, Any], object]]] = {
    "start": ("control = FORWARD", lambda line, drive: drive.start()),
    "raw": ("raw request 01 06 10 00 00 01 4C CA", lambda line, drive: drive.send_raw(6, 0x1000, b"\0\1")),
    "broadcast": ("setpoint = 0.00 %", lambda line, drive: line.bus.broadcast(drive.setpoint, 0.0)),
}


@pytest.mark.parametrize(("kind", "delay"), [*product(WRITES, ["expired", "cancelled"]), ("start", "silent")])
def test_a_recorded_write_gets_a_second_record_if_not_sent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: str, delay: str
) -> None:
    """Without the second record, the write would look as if it had been in flight when the process died."""
    log = tmp_path / "audit.jsonl"
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50), audit=log)
    drive.set_frequency(20)
    what, act = WRITES[kind]
    note_called = line.bus._records.note_called

    def called(*details: Any) -> None:
        note_called(*details)
        DELAYS[delay](line, drive)

    monkeypatch.setattr(line.bus._records, "note_called", called)
    with noted_first(), pytest.raises(BusError) as failure:
        act(line, drive)
    line.bus.close()
    first, second = (record for record in read_audit(log) if record["write"] == what)
    assert (first["outcome"], second["outcome"]) == ("called", "not sent")
    assert second["why"] == str(failure.value)
    assert not {"sent", "why"} & first.keys()
    assert "sent" not in second


def test_a_write_refused_by_the_eeprom_ledger_is_recorded_as_not_sent(tmp_path: Path) -> None:
    log = tmp_path / "audit.jsonl"
    line, drive, _ = one(YD1000(1), audit=log, ledger=tmp_path / "ledger")
    drive.write(drive.acceleration_time, 5.0)
    with noted_first(), pytest.raises(WriteForbidden):
        drive.write(drive.acceleration_time, 6.0)
    line.bus.close()
    assert [record["outcome"] for record in read_audit(log)] == ["done", "called", "not sent"]


Noted = list[tuple[str, str | None, str | None]]


class Audited:
    """A bus with one drive and an audit log, and a method that returns the log's records."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.line: SimulatedBus
        self.line, self.drive, _ = one(InvtCHE(1, maximum_frequency=50), audit=path)
        self.bus = self.line.bus

    def noted(self) -> Noted:
        self.bus._records.flush(60)
        return [(entry["write"], entry.get("by"), entry.get("way")) for entry in read_audit(self.path)]


@pytest.fixture
def audited(tmp_path: Path) -> Iterator[Audited]:
    made = Audited(tmp_path / "audit.jsonl")
    with made.bus:
        yield made


def test_the_audit_log_names_the_author_of_every_kind_of_write(audited: Audited) -> None:
    bus, drive = audited.bus, audited.drive
    with written_by("anna", "web, 10.0.0.7"):
        drive.set_frequency(20)
        drive.start()
        drive.stop()
        drive.send_raw(6, 0x1000, b"\0\5")
        bus.broadcast(drive.control, CHEControl.STOP)
        bus.stop_all()
    with written_by("boris"):
        drive.set_frequency(30)
    drive.set_frequency(10)
    noted = audited.noted()
    annas = [entry for entry in noted if entry[1] == "anna"]
    assert {write.partition(" = ")[0] for write, _, _ in annas} >= {"setpoint", "control"}
    assert len(annas) >= 6
    assert {way for _, _, way in annas} == {"web, 10.0.0.7"}
    assert [entry for entry in noted if entry[1] != "anna"] == [
        ("setpoint = 60.00 %", "boris", None),
        ("setpoint = 20.00 %", None, None),
    ]


def test_an_unconfirmed_write_is_recorded_with_its_author(audited: Audited) -> None:
    audited.line.loses = lambda request: request.function == 6
    with written_by("anna"), suppress(Unconfirmed):
        audited.drive.set_frequency(20)
    assert audited.noted() == [("setpoint = 40.00 %", "anna", None)]


def test_stops_after_a_failed_staggered_start_are_recorded_with_the_author(audited: Audited) -> None:
    """The stops run on new threads, but their records name the author that was set in the caller's thread."""
    drive = audited.drive
    drive.set_frequency(20)
    audited.line.loses = lambda request: request.data == b"\0\1"
    with written_by("anna"), pytest.raises(BusError):
        start_staggered([drive], gap=1.0)
    assert [by for _, by, _ in audited.noted()][1:] == ["anna"] * (len(audited.noted()) - 1)
    assert ("stop", "anna", None) in audited.noted()


async def test_a_write_author_applies_only_to_the_current_task_or_thread(audited: Audited) -> None:
    drive, turn = audited.drive, asyncio.Lock()  # the simulated bus serves only one caller at a time

    async def write(name: str, hz: float, mine: asyncio.Event, other: asyncio.Event) -> None:
        with written_by(name, "asyncio"):
            mine.set()
            await other.wait()
            async with turn:
                await asyncio.to_thread(drive.set_frequency, hz)

    first, second = asyncio.Event(), asyncio.Event()
    await asyncio.gather(write("anna", 20, first, second), write("boris", 30, second, first))
    with written_by("carla"):
        thread = threading.Thread(target=drive.set_frequency, args=[10])
        thread.start()
        thread.join()
    assert sorted(audited.noted()[:2]) == [
        ("setpoint = 40.00 %", "anna", "asyncio"),
        ("setpoint = 60.00 %", "boris", "asyncio"),
    ]
    assert audited.noted()[2:] == [("setpoint = 20.00 %", None, None)]


def test_the_innermost_written_by_block_sets_the_author_of_a_write(audited: Audited) -> None:
    with written_by("anna", "web"):
        with written_by("boris"), suppress(ZeroDivisionError):
            audited.drive.set_frequency(20)
            _ = 1 / 0
        audited.drive.set_frequency(30)
    assert [(by, way) for _, by, way in audited.noted()] == [("boris", None), ("anna", "web")]


class Nameless:
    """An object whose `repr` fails."""

    def __repr__(self) -> str:
        raise ZeroDivisionError


# Invalid names for the author of a write, and the text that the audit record of a stop has instead.
NAMES: list[tuple[Any, str | None]] = [
    ("", None),
    ("  ", None),
    ("a\nb", r"a\nb"),
    ("\x1b[2J", r"\x1b[2J"),
    ("\ud800", r"\ud800"),
    ("x" * 201, "x" * 200),
    (7, "7"),
    (None, "None"),
    (Nameless(), "Nameless"),
]


@pytest.mark.parametrize(("who", "noted"), NAMES, ids=range(len(NAMES)))
@pytest.mark.parametrize("is_way", [False, True])
def test_an_invalid_author_prevents_writes_but_not_stops(
    audited: Audited, who: Any, noted: str | None, is_way: bool
) -> None:
    bus, drive = audited.bus, audited.drive
    if is_way and who == "":
        return  # `way` may be empty, but an author may not
    drive.set_frequency(30)
    with written_by(*(("anna", who) if is_way else (who, "web"))):
        for call in (
            lambda: drive.set_frequency(20),
            drive.start,
            lambda: drive.send_raw(6, 0x1000, b"\0\5"),
            lambda: drive.write(drive.setpoint, 20.0),
            lambda: bus.broadcast(drive.setpoint, 0.0),
            lambda: start_staggered([drive], gap=1.0),
        ):
            before = len(audited.noted())
            with pytest.raises((TypeError, ValueError), match=r"is not text|is not 1 to 200 printable"):
                call()
            assert {write for write, *_ in audited.noted()[before:]} <= {"control = STOP", "stop"}
        before = len(audited.noted())
        drive.stop()
        bus.stop_all()
        bus.broadcast(drive.control, CHEControl.STOP)
        drive.write(drive.control, CHEControl.STOP)
        assert drive.state().condition is Condition.STOPPED
    stops = audited.noted()[before:]
    by = ("anna", noted) if is_way else (noted, "web")
    assert sorted(stops) == [("control = STOP", *by)] * 2 + [("stop", *by)] * 4


def test_an_audit_log_of_an_older_version_can_be_extended(audited: Audited) -> None:
    audited.path.write_text('{"time": "2026-01-01T00:00:00.000000000Z", "write": "old", "outcome": "done"}\n')
    with written_by("anna"):
        audited.drive.set_frequency(20)
    assert audited.noted() == [("old", None, None), ("setpoint = 40.00 %", "anna", None)]
