"""Apply parameters: only those that differ, only while the motor is at rest, no communication parameters."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from random import Random
from threading import Timer
from time import monotonic
from typing import Any

import pytest
from commands import BoundProcess
from interruptions import full_at
from killable_client import DRIVE
from simulated_bus import SimulatedBus
from simulated_pumps import factory_reset, obey_the_line, raw_of, set_at_random, with_parameters, writable
from tables import first_in_ci, table, usually

from multidrop import (
    YD1000,
    Bus,
    CancelledByStop,
    DelixiModbus,
    DelixiNative,
    Drive,
    ErmanERG220,
    Unconfirmed,
    WriteForbidden,
    params,
)
from multidrop.control import Ledger, read_audit
from multidrop.families.registry import shipped_family
from multidrop.families.yd1000 import COMMAND
from multidrop.params.apply import _Journal
from multidrop.sim import MotorDrive, Simulator, Wire
from multidrop.sim.drive import Reason, Refusal
from multidrop.sim.memory import MemoryCell

GOODRIVE, DELIXI_E = shipped_family("invt-goodrive"), shipped_family("delixi-e")
EXTRA: dict[type[Drive], list[str]] = {
    YD1000: ["F170", "F240", "F241", "F305"],
    DelixiModbus: ["P00.03", "P00.04", "P01.00", "P01.01"],
    DelixiNative: ["P00.03", "P00.04", "P01.00", "P01.01"],
    ErmanERG220: [],
    GOODRIVE: ["P00.03", "P00.11", "P01.20", "P05.14", "P08.28", "P14.03"],
    DELIXI_E: ["P0.0.08", "P0.0.14", "P1.0.00", "P2.0.00", "P4.1.04"],
}
FAMILIES = [pytest.param(family, id=family.model) for family in EXTRA]


@pytest.fixture(autouse=True)
def _state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


def made(family: type[Drive]) -> Drive:
    """Return a drive of the family; for a family from a file, the user has confirmed the file."""
    return family(1, **({"confirmed": 1} if family.declared_in else {}))


def attached(drive: Drive, extra: list[str]) -> tuple[SimulatedBus, Drive, MotorDrive]:
    sim = with_parameters(drive, extra)
    obey_the_line(sim)
    line = SimulatedBus(sim)
    return line, line.attach(drive), sim


@pytest.mark.parametrize("family", usually(GOODRIVE, *[one for one in EXTRA if one is not GOODRIVE]))
def test_the_saved_parameters_are_restored_after_a_factory_reset(tmp_path: Path, family: type[Drive]) -> None:
    line, drive, sim = attached(made(family), EXTRA[family])
    there = writable(drive, EXTRA[family])
    assert there
    set_at_random(sim, there, Random(7))
    before = [raw_of(sim, one) for one in there]
    params.save(params.read(drive), tmp_path / "drive.toml", family)
    factory_reset(sim, there)
    assert [raw_of(sim, one) for one in there] != before
    saved = params.load(tmp_path / "drive.toml")
    done = params.apply(drive, saved, commissioning=True)
    assert done.ok
    assert not done.plan.left
    assert [raw_of(sim, one) for one in there] == before
    assert params.compare(saved, params.read(drive, saved.values)) == []
    sent = len(line.written)
    again = params.apply(drive, saved)
    assert again.ok
    assert not again.written
    assert line.written[sent:] == []


@pytest.mark.parametrize("family", FAMILIES)
def test_apply_raises_while_the_motor_runs(family: type[Drive]) -> None:
    line, drive, sim = attached(made(family), EXTRA[family])
    first = writable(drive, EXTRA[family])[0]
    sim.motor.target = 50.0
    sim.motor.run()
    line.sleep(20)
    with pytest.raises(WriteForbidden, match="written only while the motor stands"):
        params.apply(drive, {first.code: raw_of(sim, first) + 1})
    assert line.written == []


def test_a_run_command_at_zero_speed_makes_apply_raise() -> None:
    line, drive, sim = attached(YD1000(1), [])
    sim.motor.target = 0.0
    sim.motor.run()
    with pytest.raises(WriteForbidden, match="run command"):
        params.apply(drive, {"0009": 200})
    assert line.written == []


def test_a_stop_is_sent_before_the_writes_if_the_motor_state_is_unknown() -> None:
    line, drive, _ = attached(DelixiModbus(1), ["P01.00"])
    params.plan(drive, {"P01.00": 5})
    assert line.written == []
    assert params.apply(drive, {"P01.00": 5}).ok
    assert line.written == ["01 06 20 00 00 01 43 CA", "01 06 00 64 00 05 08 16"]


@pytest.mark.parametrize("family", [DelixiModbus, DelixiNative])
def test_apply_raises_if_the_panel_may_start_the_motor(family: type[Drive]) -> None:
    line, drive, sim = attached(family(1), ["P01.00"])
    sim["run_source"] = 0
    with pytest.raises(WriteForbidden, match=r"its run_source \(P00\.00\) is KEYPAD"):
        params.plan(drive, {"P01.00": 5})
    assert line.written == []


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"9999": 1}, "yd1000 has no parameter 9999"),
        ({"0009": 65000}, r"0009: acceleration_time = 6500 is outside 0\.1 to 3600 s"),
        ({"0009": 0, "0010": 1}, "has values that may not be written: "),
    ],
)
def test_one_invalid_value_makes_apply_write_nothing(values: dict[str, int], sentence: str) -> None:
    line, drive, _ = attached(YD1000(1), [])
    with pytest.raises(ValueError, match=sentence):
        params.apply(drive, values)
    assert line.written == []


def test_parameters_of_another_model_are_refused() -> None:
    _, drive, _ = attached(YD1000(1), [])
    other = params.ParameterSet("delixi-modbus", {"P01.00": 1}, source="other.toml")
    with pytest.raises(ValueError, match=r"parameters of yd1000, and other\.toml of delixi-modbus"):
        params.apply(drive, other)


def test_communication_parameters_are_written_only_if_the_caller_lists_them() -> None:
    _, drive, sim = attached(YD1000(1), [])
    left = params.apply(drive, {"F803": 30, "F801": 0, "F111": 3}, also=["F801"])
    assert left.plan.left == {"F111": f"{COMMAND} (2 -> 3)"}
    assert [change.parameter.code for change in left.plan.writes] == [
        "F803",
        "F801",
    ]  # F801 (parity) is a communication parameter, so it is written last
    with pytest.raises(ValueError, match="--also F803: F803 is not the drive's address"):
        params.plan(drive, {"F803": 20}, also=["F803"])
    assert list(params.plan(drive, {"F802": 5}).left) == ["F802"]
    assert sim["communication_timeout"] == 30


def test_backup_file_of_the_gd20_tool_is_restored(tmp_path: Path) -> None:
    _, drive, _ = attached(made(GOODRIVE), ["P00.03", "P14.01", "P00.18"])
    rows = ["0;3;6000", "0;18;1", "14;1;3", "7;13;104", "17;0;5000"]
    text = "\n".join(["GRUPO_PARAMETRO;CODIGO_FUNCAO;VALOR_PARAMETRO", *rows])
    (tmp_path / "bkp_result.csv").write_text(text)
    done = params.apply(drive, params.load(tmp_path / "bkp_result.csv"))
    assert [str(change) for change in done.written] == ["P00.03: 0 -> 6000"]
    assert [*done.plan.left] == ["P00.18", "P14.01"]


def test_motor_identification_of_a_delixi_e_is_not_started() -> None:
    _, drive, _ = attached(made(DELIXI_E), ["P0.0.24"])
    assert "identification of the motor" in params.plan(drive, {"P0.0.24": 1}).left["P0.0.24"]


def test_parameters_unknown_to_the_drive_are_left_out() -> None:
    _, drive, _ = attached(YD1000(1), [])
    assert params.plan(drive, {"F240": 5}).left == {"F240": "the drive does not have it"}


@pytest.mark.parametrize(
    ("values", "order"),
    [
        ({"0011": 6000, "0012": 5000, "0013": 1000}, ["0012", "0011", "0013"]),
        ({"0011": 12000, "0012": 10000, "0013": 9000}, ["0011", "0012", "0013"]),
    ],
)
def test_parameters_are_written_in_an_order_that_keeps_their_limits(
    values: dict[str, int], order: list[str]
) -> None:
    _, drive, sim = attached(YD1000(1), [])
    done = params.apply(drive, values)
    assert done.ok
    assert [change.parameter.code for change in done.written] == order
    assert sim["maximum_frequency"] == values["0011"] / 100


def test_a_value_above_its_upper_limit_is_left_out() -> None:
    _, drive, _ = attached(YD1000(1), [])
    left = params.plan(drive, {"0013": 9000}).left
    assert left == {"0013": "90.00 Hz is outside its limits, which are upper_limit_frequency of yd1000@1"}


def test_second_write_within_a_minute_is_refused_without_commissioning(tmp_path: Path) -> None:
    sim = with_parameters(YD1000(1))
    line = SimulatedBus(sim, audit=tmp_path / "audit.jsonl")
    drive = line.attach(sim.drive)
    assert params.apply(drive, {"0009": 200}).ok
    again = params.apply(drive, {"0009": 300, "0010": 300})
    assert [change.parameter.code for change in again.written] == ["0010"]
    assert "params.apply(..., commissioning=True)" in str(again.refused["0009"])
    assert params.apply(drive, {"0009": 300}, commissioning=True).ok
    line.bus.close()
    records = [*read_audit(tmp_path / "audit.jsonl")]
    assert [record.get("commissioning") for record in records] == [None, None, True]
    wear = Ledger(tmp_path / "multidrop" / "wear.sqlite").wear(1.7e9)
    assert {one.cell.register: one.writes for one in wear} == {"acceleration_time": 2, "deceleration_time": 1}


def test_a_refused_write_does_not_prevent_the_other_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    _, drive, sim = attached(DelixiNative(1), ["P01.00", "P01.01"])
    accept = type(sim).accept

    def picky(self: Any, cell: MemoryCell, raw: int) -> int:
        if cell.name == "P01.00":
            raise Refusal(Reason.VALUE)
        return accept(self, cell, raw)

    monkeypatch.setattr(type(sim), "accept", picky)
    done = params.apply(drive, {"P01.00": 5, "P01.01": 6})
    assert [change.parameter.code for change in done.written] == ["P01.01"]
    assert "value out of limits" in str(done.refused["P01.00"])


def test_an_interrupted_apply_is_reported_by_the_next_apply() -> None:
    line, drive, _ = attached(YD1000(1), [])
    line.deafens = lambda request: request.function == 6 and request.start == 0x0010
    first = params.apply(drive, {"0009": 200, "0010": 200, "0018": 100})
    assert isinstance(first.failure, Unconfirmed)
    line.deafens = lambda request: False
    second = params.apply(drive, {"0009": 200, "0010": 200, "0018": 100}, commissioning=True)
    assert second.ok
    assert [change.parameter.code for change in second.written] == ["0010", "0018"]
    assert second.earlier[1:] == ["0009: 100 -> 200: written", "0010: 100 -> 200: may have been sent"]
    assert params.apply(drive, {"0009": 200}).earlier == []


def test_apply_writes_no_more_parameters_after_the_motor_starts() -> None:
    _, drive, sim = attached(YD1000(1), [])

    def start(number: int, total: int, change: params.ParameterChange, not_written: object) -> None:
        sim.motor.target = 50.0
        sim.motor.run()

    done = params.apply(drive, {"0009": 200, "0010": 200}, report=start)
    assert [change.parameter.code for change in done.written] == ["0009"]
    assert isinstance(done.failure, WriteForbidden)


# A Delixi cannot report its state, so `apply` itself sends a stop before the first write.
@pytest.mark.parametrize("family", [YD1000, DelixiModbus])
def test_apply_writes_no_more_parameters_after_a_stop(family: type[Drive]) -> None:
    values = {"0009": 200, "0010": 200} if family is YD1000 else {"P01.00": 5, "P01.01": 6}
    line, drive, _ = attached(family(1), EXTRA[family])
    done = params.apply(drive, values, report=lambda *_: drive.stop())
    assert [change.parameter.code for change in done.written] == [next(iter(values))]
    assert isinstance(done.failure, CancelledByStop)
    sent = len(line.written)
    assert params.apply(drive, values).ok
    assert len(line.written) > sent


def test_a_stop_during_a_journal_write_prevents_the_parameter_write(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = attached(YD1000(1), [])
    note = _Journal.note

    def stop_at_write(journal: _Journal, **record: Any) -> None:
        note(journal, **record)
        if "after" in record:
            drive.stop()

    with monkeypatch.context() as patch:
        patch.setattr(_Journal, "note", stop_at_write)
        done = params.apply(drive, {"0009": 200})
    assert isinstance(done.failure, CancelledByStop)
    assert {frame[6:11] for frame in line.written} == {"10 00"}  # the only writes are stops
    assert "0009: 100 -> 200: not written" in params.apply(drive, {"0009": 200}).earlier


def test_a_stop_while_parameters_are_read_cancels_all_writes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line, drive, _ = attached(made(GOODRIVE), EXTRA[GOODRIVE])
    read = drive.link.read_raw
    monkeypatch.setattr(drive.link, "read_raw", lambda *given: (drive.stop(), read(*given))[1])
    done = params.apply(drive, {"P00.03": 6000})
    assert isinstance(done.failure, CancelledByStop)
    assert {frame[6:11] for frame in line.written} == {"20 00"}  # the only write is the stop


# `room` is the number of free bytes on the disk. Each number lets a different line of the journal fail.
@table("room", [0, 100, 130, 160, 200, 230])
def test_the_next_apply_completes_the_writes_after_a_full_disk(
    monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    line, drive, _ = attached(ErmanERG220(1), [])
    # the EEPROM ledger is not affected by the full disk
    monkeypatch.setattr(Ledger, "enter", lambda *given: "")
    values = {"b.003": 150, "b.004": 160}
    with full_at(room):
        first = params.apply(drive, values)
    assert isinstance(first.failure, OSError)
    second = params.apply(drive, values)
    assert second.ok
    codes = [change.parameter.code for change in (*first.written, *second.written)]
    assert codes == [*values]
    assert len(line.written) == len(values)
    assert {change.parameter.code for change in first.written} <= {
        sentence.partition(":")[0] for sentence in second.earlier
    }
    assert params.apply(drive, values).earlier == []


def test_apply_returns_its_result_if_the_journal_cannot_be_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    _, drive, _ = attached(ErmanERG220(1), [])

    def refuse(*given: object, **options: object) -> None:
        raise PermissionError

    monkeypatch.setattr(Path, "unlink", refuse)
    done = params.apply(drive, {"b.003": 150})
    assert isinstance(done.failure, PermissionError)
    assert [change.parameter.code for change in done.written] == ["b.003"]


def test_the_error_of_a_refused_second_write_suggests_params_apply() -> None:
    _, drive, _ = attached(YD1000(1), [])
    drive.write("acceleration_time", 20.0)
    with pytest.raises(WriteForbidden, match=r"params\.apply") as refusal:
        drive.write("acceleration_time", 30.0)
    way = "wait, set it on the drive's panel, or use `multidrop params apply --commissioning`"
    assert way in refusal.value.for_command_line()


CODES = [f"P0{group}.{index:02}" for group in (1, 2) for index in range(4)]


class Lives:
    """Applies a parameter file repeatedly, each time in a process that is killed after some seconds."""

    def __init__(self, process: subprocess.Popen[str], port: str, file: Path, report: Path) -> None:
        self._process = process
        self._line = f"apply {port} {file} {report}\n"

    def live(self, seconds: float) -> int:
        """Apply the file in a process that is killed after `seconds`; return its status, 0 if complete."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(self._line)
        self._process.stdin.flush()
        life = int(self._process.stdout.readline())
        killer = Timer(seconds, self._kill, [life])
        killer.start()
        status = int(self._process.stdout.readline())
        killer.cancel()
        return status

    @staticmethod
    def _kill(life: int) -> None:
        with suppress(ProcessLookupError):
            os.kill(life, signal.SIGKILL)


@pytest.fixture
def lives(tmp_path: Path) -> Iterator[tuple[Lives, object]]:
    sim = with_parameters(DelixiNative(**DRIVE), CODES)
    there = writable(sim.drive, CODES)
    set_at_random(sim, there, Random(1))
    program = Path(__file__).parents[1] / "support" / "processes" / "killable_client.py"
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path / "state")}
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        port = simulator.wires[0].path
        with Bus(port) as bus:
            saved = params.read(bus.attach(DelixiNative, **DRIVE), [one.code for one in there])
        params.save(saved, tmp_path / "saved.toml")
        with BoundProcess(
            [sys.executable, str(program)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        ) as process:
            yield Lives(process, port, tmp_path / "saved.toml", tmp_path / "report"), (sim, there)
            process.kill()


@pytest.mark.long
@pytest.mark.parametrize("most", first_in_ci(10, 50))
def test_the_next_apply_completes_the_writes_of_a_killed_apply(
    lives: tuple[Lives, object], tmp_path: Path, most: int
) -> None:
    killed, (sim, there) = lives
    random, kills, whole_s = Random(41), 0, 60.0
    wanted = {one.code: raw_of(sim, one) for one in there}
    while kills < most:
        factory_reset(sim, there)
        sim.counters.eeprom_writes.clear()
        differing = {one.code for one in there if raw_of(sim, one) != wanted[one.code]}
        begun = monotonic()
        was_complete = False
        while status := killed.live(random.uniform(0, whole_s) if kills or whole_s < 60 else whole_s):
            assert status == signal.SIGKILL
            kills += 1
            written = {one.code: raw_of(sim, one) for one in there} == wanted
            was_complete = written and not [*tmp_path.glob("state/**/applications/*.jsonl")]
        whole_s = min(whole_s, monotonic() - begun)
        assert {one.code: raw_of(sim, one) for one in there} == wanted
        names = {one.code: one.name for one in there}
        assert {names[code]: 1 for code in differing} == {
            name: count for name, count in sim.counters.eeprom_writes.items() if name in names.values()
        }
        # A killed call may have returned its report. Otherwise the next call reports the writes of both.
        if not was_complete:
            reported = (tmp_path / "report").read_text().splitlines()
            assert differing <= {line.partition(":")[0] for line in reported}
