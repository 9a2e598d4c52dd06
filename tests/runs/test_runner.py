"""Test runs on simulated lines. The simulated drives check order and times of writes, aborts and stops."""

from __future__ import annotations

import math
import random
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from commands import MULTIDROP, BoundProcess
from lines import patient, until
from simulated_bus import is_write
from simulated_pumps import CHE, STEPS, far_ends, simulated_test, turning, write_test
from tables import first_in_ci, table

from multidrop.bus import Bus
from multidrop.control import read_audit
from multidrop.core import Completion, Exchange, Message, Names, Peer
from multidrop.drive import Drive
from multidrop.errors import Expired, WriteForbidden
from multidrop.families import MODELS, DelixiModbus, InvtCHE
from multidrop.families.registry import SHIPPED, find_model
from multidrop.planning.prediction import predict
from multidrop.plant.model import Plant, PlantLine, PolledDrive, planned_on
from multidrop.polling.added_rows import AddedRow, JoinedColumns
from multidrop.polling.batch import Batch, Rows
from multidrop.recording import open_recording
from multidrop.runs import RunPlan, RunResult, RunStep, TestRun, load_test, runner
from multidrop.runs.runner import _Session
from multidrop.runs.watch import LimitWatch
from multidrop.sim import MotorDrive, Simulator, Wire, simulated
from multidrop.sim.drive import Reason, Refusal
from multidrop.sim.memory import MemoryCell
from multidrop.sim.receiver import Frame
from multidrop.transport import clock, drive_records
from multidrop.transport.line import Line

SPEED = 5.0


@pytest.mark.slow
def test_all_steps_are_carried_out_in_order_and_recorded_with_their_phases(tmp_path: Path) -> None:
    out, audit = tmp_path / "run.arrows", tmp_path / "audit.jsonl"
    with simulated_test(write_test(tmp_path), speed=SPEED) as (plan, (fan,)):
        result = TestRun(plan, audit=audit, speed=SPEED).run(out)
        assert (result.ok, result.abort, turning([fan])) == (True, "", [])
        assert str(result.stopped["fan"]).startswith("fan: stopped after ")
        setpoints = [write.raw for write in fan.counters.writes if write.name == "setpoint"]
    assert setpoints == [2000, 4000, 6000]  # 10, 20 and 30 Hz in 0.01 % of 50 Hz
    pytest.importorskip("pandas", reason="needs pandas")
    found = open_recording(out).to_pandas().sort_values("monotonic_ns", kind="stable")
    assert [*found["phase"].unique()] in (["", *PHASES], PHASES)
    assert found[found.phase == "steps 2"].value.max() > 0
    assert [record["write"] for record in read_audit(audit)][:2] == [
        "setpoint = 20.00 %",
        "control = FORWARD",
    ]


PHASES = ["start", "steps 1", "steps 2", "stop"]
CYCLE = """
[[phase]]
name = "cycle"
repeat = 2
[[phase.step]]
frequency = { fan = 10.0, pump = 20.0 }
start = ["fan", "pump"]
direction = "reverse"
dwell = "1 s"
[[phase.step]]
stop = ["pump"]
write = { fan = { setpoint = 60.0 } }
dwell = "2 s"
"""


@pytest.mark.slow
def test_all_commands_of_a_phase_are_sent_in_each_repetition(tmp_path: Path) -> None:
    """The simulated drives record each write with its time: `control` 2 is REVERSE, 5 is STOP."""
    with simulated_test(write_test(tmp_path, CYCLE, fan=CHE, pump=CHE), speed=SPEED) as (plan, (fan, pump)):
        assert TestRun(plan, speed=SPEED).run().ok
    written = {sim: [(write.name, write.raw) for write in sim.counters.writes] for sim in (fan, pump)}
    reverse, stop = ("control", 2), ("control", 5)
    assert unrepeated(written[fan]) == [("setpoint", 2000), reverse, ("setpoint", 6000)] * 2 + [stop]
    assert unrepeated(written[pump]) == [("setpoint", 4000), reverse, stop] * 2
    stopped_at = next(write.time for write in pump.counters.writes if write.raw == 5)
    assert any(write.time > stopped_at and write.raw == 6000 for write in fan.counters.writes)


def unrepeated(found: list[Any]) -> list[Any]:
    """Return the list without entries that are equal to the entry before, such as repeated stops."""
    return [one for at, one in enumerate(found) if at == 0 or one != found[at - 1]]


def never(fan: MotorDrive) -> None:
    """Do nothing: this abort needs no event."""


# for each kind of abort: limits in the test file, the event that causes the abort, the reason in the result
ABORTS: dict[str, tuple[str, Callable[[MotorDrive], None], str]] = {
    "limit": (
        '[abort]\nlimits = ["fan.output_current > 30"]',
        lambda fan: fan.__setitem__("output_current", 31.0),
        "fan.output_current > 30: it is 31.0 A",
    ),
    "silence": (
        '[[phase]]\nname = "hold"\n[[phase.step]]\ndwell = "20 s"\n[abort]\nsilence = "1 s"',
        lambda fan: setattr(fan, "deaf_until", fan.now + 3.0 * SPEED),
        "no value of fan",
    ),
    "fault": ("", lambda fan: fan.trip(4), "fan has a fault, "),
    "duration": ('[abort]\nduration = "2 s"', never, "the run took longer than its duration, 2 s"),
    "until": (
        '[[phase]]\nname = "hot"\n[[phase.step]]\nuntil = "fan.output_frequency > 60"\nwithin = "1 s"',
        never,
        "hot: fan.output_frequency > 60 did not hold within 1 s",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ABORTS)
def test_an_abort_stops_all_drives_and_says_why(kind: str, tmp_path: Path) -> None:
    lines, event, reason = ABORTS[kind]
    is_phase = lines.startswith("[[")
    text = f"{STEPS}\n{lines}" if is_phase else f"{lines}\n{STEPS}"
    path = write_test(tmp_path, text, fan=CHE, pump=CHE)
    with simulated_test(path, speed=SPEED) as (plan, sims):
        sims[1].motor.target = 20.0
        sims[1].motor.run()  # this drive gets no command in any step
        happened: list[bool] = []

        def happen(rows: object) -> None:
            # phases without commands: in other phases, a command would fail first
            quiet = {"fault": "steps 1", "silence": "hold"}
            is_due = test.phase == quiet.get(kind, test.phase)
            if sims[0].motor.energised and is_due and not happened:
                happened.append(True)
                event(sims[0])

        test = TestRun(plan, speed=SPEED)
        result = test.run(None, happen)
        assert result.abort.startswith(reason)
        assert not result.ok
        assert {name for name, stopped in result.stopped.items() if stopped.ok} == {"fan", "pump"}
        assert turning(sims) == []


def test_a_test_run_is_refused_if_its_steps_would_wear_eeprom() -> None:
    mixer = PolledDrive(DelixiModbus(1, framing="rtu", name="mixer"), ["output_frequency"])
    plan = RunPlan(Plant([PlantLine("hall", "nowhere", drives=[mixer])]), [RunStep("a", {"mixer": 10.0})])
    with pytest.raises(WriteForbidden, match="EEPROM, which steps would wear out"):
        TestRun(plan).run()


@table(
    "step, sentence",
    [
        (RunStep("b", start=("fan",), stop=("fan",)), "b: fan is stopped and also commanded in this step"),
        (RunStep("b", {"fan": 9.0}, rate=1.0, start=("fan",)), "b: fan cannot be started by a ramp"),
    ],
)
def test_contradictory_commands_in_a_step_are_refused(step: RunStep, sentence: str) -> None:
    fan = PolledDrive(InvtCHE(1, maximum_frequency=50, name="fan"), ["output_frequency"])
    plant = Plant([PlantLine("hall", "nowhere", drives=[fan])])
    with pytest.raises(ValueError, match=sentence):
        TestRun(RunPlan(plant, [RunStep("a", {"fan": 5.0}), step])).run()


class FixedPoller:
    """A fake poller. Each batch has one row: the next current in `currents`."""

    buses: ClassVar[dict[str, Bus]] = {}

    def __init__(self, *currents: float) -> None:
        now = clock.now_ns()
        self.waiting = [
            Batch(
                JoinedColumns(None, [AddedRow(0, now, 0, 0, 0, 0, current)]),
                Names(["fan"]),
                Names(["output_current"]),
            )
            for current in currents
        ]

    def take(self) -> Batch | None:
        return self.waiting.pop(0) if self.waiting else None


def session(folder: Path, limits: str, poller: Any, *takers: Any, writer: Any = None) -> _Session:
    return _Session(
        TestRun(load_test(write_test(folder, f"[abort]\n{limits}\n{STEPS}"))), poller, writer, takers
    )


def test_the_duration_limit_is_checked_while_new_rows_keep_coming(tmp_path: Path) -> None:
    poller = FixedPoller(1.0, 1.0)
    found = session(tmp_path, 'duration = "3 s"', poller)
    found._run._begin_ns = clock.now_ns() - 4 * 10**9
    with pytest.raises(Exception, match="the run took longer than its duration, 3 s"):
        found._look([])
    assert len(poller.waiting) == 1


class HangingWriter:
    """A recording on a disk that hangs until it is released, or for 5 s."""

    path = "run.arrows"

    def __init__(self) -> None:
        self.released = threading.Event()
        self.written: list[str] = []

    def write(self, rows: Rows) -> None:
        self.released.wait(5.0)
        self.written += [row.register for row in rows]

    def close(self) -> None:
        self.written.append("closed")


LIMIT = 'limits = ["fan.output_current > 30"]'


def test_an_abort_does_not_wait_for_a_hanging_disk(tmp_path: Path) -> None:
    """All rows are written once the disk continues."""
    disk, poller = HangingWriter(), FixedPoller(1.0, 31.0)
    found = session(tmp_path, LIMIT, poller, writer=disk)
    found._mark("start")
    found._look([])
    with pytest.raises(Exception, match=r"fan\.output_current > 30: it is 31\.0 A"):
        found._look([])
    assert found._is_stopping
    assert not disk.written
    disk.released.set()
    assert found._end_rows() == []
    assert disk.written == ["phase", "output_current", "phase", "output_current", "closed"]


def test_a_run_is_aborted_if_a_hung_disk_loses_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "MOST_WAITING", 2)
    monkeypatch.setattr(runner, "ENDING_S", 0.01)
    disk = HangingWriter()
    found = session(tmp_path, LIMIT, FixedPoller(*[1.0] * 4), writer=disk)
    for _ in range(4):  # the hanging thread has taken one batch at most
        found.take()
    with pytest.raises(
        Exception, match=r"the recording run\.arrows was too slow: more than 2 batches were waiting"
    ):
        found._look([])
    assert found._end_rows() == [
        "4 rows did not reach the recording run.arrows, which did not end within 0.01 s"
    ]
    disk.released.set()


def test_an_exception_in_a_callback_for_rows_ends_the_run(tmp_path: Path) -> None:
    def fail(rows: Rows) -> None:
        raise ZeroDivisionError

    found = session(tmp_path, LIMIT, FixedPoller(1.0), fail)
    assert found._end_rows() == []
    with pytest.raises(ZeroDivisionError):
        found._look([])


@pytest.mark.slow
def test_a_delay_of_the_run_does_not_shorten_a_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, float] = {}
    original = LimitWatch.add

    def pause(watch: LimitWatch, rows: Rows) -> str:
        if test.phase not in seen:
            seen[test.phase] = test.elapsed
            time.sleep(2.5 * (test.phase == "steps 1"))
        return original(watch, rows)

    monkeypatch.setattr(LimitWatch, "add", pause)
    text = STEPS.replace("[20.0, 30.0]", "[20.0, 30.0, 40.0]").replace('"2 s"', '"1 s"')
    with simulated_test(write_test(tmp_path, text)) as (plan, _):
        test = TestRun(plan)
        assert test.run().abort == ""
    assert seen["steps 3"] - seen["steps 2"] >= 0.8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("silence", "seconds", "why"),
    [
        ("3 s", 4, "no value of fan came for 4"),
        # rows arrive immediately after the sleep, so the limit `silence` is not reached
        ("1 min", 6, "the limits were not checked for 6"),
    ],
)
def test_no_step_is_carried_out_after_the_computer_has_slept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, silence: str, seconds: int, why: str
) -> None:
    text = f'[abort]\nsilence = "{silence}"\n' + STEPS.replace('"2 s"', '"30 s"')
    with simulated_test(write_test(tmp_path, text)) as (plan, sims):
        awake = clock.boottime_ns

        def sleep(rows: object) -> None:
            if test.phase == "steps 1":
                monkeypatch.setattr(clock, "boottime_ns", lambda: awake() + seconds * 10**9)

        test = TestRun(plan)
        result = test.run(None, sleep)
        assert result.abort.startswith(why)
        assert test.number == 1
        assert turning(sims) == []


SETPOINT_AND_START = """
[[phase]]
name = "start"
[[phase.step]]
frequency = { fan = 10.0 }
start = ["fan"]
dwell = "2 s"
"""


@pytest.mark.long
def test_no_start_is_sent_after_a_suspension_between_two_commands_of_a_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process is suspended while the setpoint is written; the run does not notice it before the start."""
    monkeypatch.setattr(runner, "LOOK_S", 0.5)
    with simulated_test(write_test(tmp_path, SETPOINT_AND_START), speed=SPEED) as (plan, (fan,)):
        awake, written = clock.boottime_ns, fan.counters.writes

        def boottime_ns() -> int:
            return awake() + (3_600_000_000_000 if any(write.name == "setpoint" for write in written) else 0)

        monkeypatch.setattr(clock, "boottime_ns", boottime_ns)
        result = TestRun(plan, speed=SPEED).run()
        assert result.abort
        assert {write.name for write in written if write.raw != 5} == {"setpoint"}
        assert turning([fan]) == []


@pytest.mark.slow
def test_a_run_is_not_ok_if_stopping_a_line_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = Bus.stop_all

    def stop_all(bus: Bus) -> Any:
        if bus.drives[0].name == "spare":
            raise RuntimeError("no stops")
        return original(bus)

    monkeypatch.setattr(Bus, "stop_all", stop_all)
    path = write_test(tmp_path, '[[phase]]\nname = "a"\n[[phase.step]]\ndwell = "1 s"')
    spare = PolledDrive(find_model("invt-che")(1, maximum_frequency=50, name="spare"), ["fault"])
    other = PlantLine("other", str(tmp_path / "other"), drives=[spare])
    with simulated_test(path) as (plan, _), Simulator([Wire([simulated(spare.drive)], port=other.port)]):
        plant = replace(plan.plant, lines=[*plan.plant.lines, other])
        result = TestRun(plan.with_plant(plant)).run()
    assert not result.ok
    assert result.stopped["fan"].ok
    assert str(result.stopped["spare"]).startswith("spare: sent but unknown")


@pytest.mark.slow
def test_a_refused_run_stops_no_motor_and_can_be_repeated(tmp_path: Path) -> None:
    out = tmp_path / "run.arrows"
    with simulated_test(write_test(tmp_path, '[abort]\nduration = "8 s"\n' + STEPS)) as (plan, (fan,)):
        out.touch()
        fan.motor.run()
        test = TestRun(plan)
        with pytest.raises(FileExistsError, match="exists already"):
            test.run(out)
        assert fan.motor.energised
        assert not fan.counters.writes
        for _ in range(2):
            assert test.run().abort == ""


@pytest.mark.slow
def test_a_failed_command_aborts_before_any_later_step(tmp_path: Path) -> None:
    with simulated_test(write_test(tmp_path), speed=SPEED) as (plan, (fan,)):
        fan.trip(4)
        result = TestRun(plan, speed=SPEED).run()
        assert result.abort
        assert "fan has a fault" in result.abort
        assert turning([fan]) == []
        assert not [write for write in fan.counters.writes if write.raw == 6000]


@pytest.mark.slow
@pytest.mark.parametrize("is_real", [False, True])
def test_expired_commands_abort_only_the_run_of_a_real_drive(
    is_real: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first three attempts of the first command expire, as on a busy computer."""
    command, attempts = runner._command, count()

    def late(drive: Drive, step: RunStep) -> None:
        if next(attempts) < 3:
            raise Expired(drive.name, "the setpoint", 1.0)
        command(drive, step)

    monkeypatch.setattr(runner, "_command", late)
    with simulated_test(write_test(tmp_path), speed=SPEED) as (plan, _):
        if is_real:
            monkeypatch.setattr(runner, "is_simulated", lambda identity: False)
        result = TestRun(plan, speed=1.0 if is_real else SPEED).run()
    assert bool(result.abort) == is_real
    assert next(attempts) == (1 if is_real else 6)  # 6: three that expired, and one for each step


WAIT = 'dwell = "2 min"'
# The run checks the identities of all drives that it will start. It is aborted before the start.
WAITING = """
[abort]
{limits}
[[phase]]
name = "wait"
[[phase.step]]
{step}
[[phase.step]]
start = ["a", "b", "c"]
"""


LONG_NS = 2_000_000_000  # longest wait for a reply of a busy computer, unless a test is `patient`


class FarEnds:
    """Simulated drives that count requests. An event gives the run a reason to abort. After the event,
    replies come on a simulated clock, which advances by each pause of the main thread. An exchange takes its
    predicted time on this clock. After the abort, a reply also waits until a thread is about to send the
    line's first stop. Timeouts are long from the event to the first stop, and as usual otherwise, because
    some drives do not reply to questions about their identity. So the counts do not depend on the computer's
    load.
    """

    def __init__(self, test: TestRun, monkeypatch: pytest.MonkeyPatch) -> None:
        self.test = test
        self.sims: dict[str, Any] = {}
        self.requests: dict[str, list[Message]] = {}  # received requests by line
        self.cause: dict[str, int] | None = None  # number of requests when the event happened, by line
        self.event: Callable[[FarEnds], object] | None = None  # called after two bus cycles of the first step
        self._left: dict[str, int] = {}  # number of requests until the event, by line
        self._monkeypatch = monkeypatch
        self._clock, self._ticked = 0.0, threading.Condition()
        self._due: dict[str, float] = {}  # simulated time of the next reply, by line
        self._is_stopping = False
        self._is_stop_sent: set[str] = set()  # lines
        self._usual_ns: dict[Peer, int] = {}  # usual timeouts
        sleep, begin_stops, carry_out = clock.sleep, _Session._begin_stops, Line.carry_out

        def counted_sleep(seconds: float) -> None:
            sleep(seconds)
            if threading.current_thread() is threading.main_thread():
                with self._ticked:
                    self._clock += seconds
                    self._ticked.notify_all()
                    self._ticked.wait_for(self._is_caught_up, 3.0)

        def noted_stops(session: _Session) -> None:
            self._is_stopping = True
            begin_stops(session)

        def noted_exchange(line: Line, exchange: Exchange, **details: Any) -> Completion:
            if self._is_stopping:
                with self._ticked:
                    self._is_stop_sent.add(line.port)
                    self._ticked.notify_all()
            return carry_out(line, exchange, **details)

        def noted_peer(**options: float) -> Peer:
            peer = make_peer(**options)
            self._usual_ns[peer] = peer.c.most_timeout_ns
            return peer

        make_peer = drive_records.Peer
        monkeypatch.setattr(drive_records, "Peer", noted_peer)
        monkeypatch.setattr(clock, "sleep", counted_sleep)
        monkeypatch.setattr(_Session, "_begin_stops", noted_stops)
        monkeypatch.setattr(Line, "carry_out", noted_exchange)

    def run(self, event: Callable[[FarEnds], object]) -> RunResult:
        self.event = event
        with ExitStack() as stack:
            for line in self.test.plan.plant.lines:  # one simulator, so one thread, for each line
                sims = [simulated(polled.drive) for polled in line.drives]
                for sim in sims:
                    self._watch(sim, line)
                stack.enter_context(Simulator([Wire(sims, port=line.port, unpaced=True)]))
            return self.test.run()

    def _watch(self, sim: Any, line: PlantLine) -> None:
        """Record this drive's requests, and delay its replies after the event."""
        requests = self.requests.setdefault(line.name, [])
        exchange_s = predict(planned_on(line)).cycle / len(planned_on(line))
        receive, self.sims[sim.drive.name] = sim.receive, sim
        self._left[line.name] = 2 * len(planned_on(line))
        self._due[line.name] = math.inf  # until the event

        def noting(frame: Frame) -> Message | None:
            if frame.message is None or not frame.intact:
                return receive(frame)
            requests.append(frame.message)
            if is_write(frame.message):
                sim._held.clear()  # after a stop, the simulated values are normal again
                if self._is_stopping:
                    self._set_timeouts(0)
            if self.event:
                self._left[line.name] -= bool(self.test.phase)
                if max(self._left.values()) > 0:
                    return receive(frame)
                event, self.event = self.event, None
                self._set_timeouts(LONG_NS)  # from the next request on
                event(self)
                return receive(frame)
            self._await_reply(line, exchange_s)
            return receive(frame)

        vars(sim)["receive"] = noting

    def _set_timeouts(self, least_ns: int) -> None:
        for peer, usual_ns in self._usual_ns.items():
            peer.c.least_timeout_ns = peer.c.most_timeout_ns = max(usual_ns, least_ns)

    def _is_caught_up(self) -> bool:
        """Return True if the run has sent all requests that are due on the simulated clock."""
        return self._is_stopping or min(self._due.values()) > self._clock

    def _await_reply(self, line: PlantLine, exchange_s: float) -> None:
        with self._ticked:
            due = self._due[line.name] = exchange_s + min(self._due[line.name], self._clock)
            self._ticked.notify_all()
            self._ticked.wait_for(
                lambda: line.port in self._is_stop_sent or (self._clock >= due and not self._is_stopping)
            )

    def happen(self) -> None:
        """Record that the run now has a reason to abort; count requests from now on."""
        if self.cause is None:
            self.cause = {line: len(requests) for line, requests in self.requests.items()}

    def show(self, drive: str, register: str) -> None:
        """Call `happen` when this register is read next."""
        sim = self.sims[drive]
        refresh = sim.refresh

        def noting(cell: MemoryCell) -> None:
            refresh(cell)
            if cell.name == register:
                self.happen()

        vars(sim)["refresh"] = noting

    def pass_time(self, seconds: float) -> None:
        """Make the run's clock advance by this time."""
        self.test._begin_ns -= round(seconds * 1e9)
        self.happen()

    def silence(self, seconds: float) -> None:
        """Make the newest values older by this time."""
        awake = clock.boottime_ns
        self._monkeypatch.setattr(clock, "boottime_ns", lambda: awake() + round(seconds * 1e9))
        self.happen()

    def stops_after(self, line: str) -> int:
        """Return the number of requests from the abort's reason to this line's first stop."""
        assert self.cause is not None
        later = self.requests[line][self.cause[line] :]
        return 1 + next(at for at, request in enumerate(later) if is_write(request))


def exceed(ends: FarEnds, drive: str = "a", register: str = "output_current") -> None:
    ends.sims[drive][register] = 60.0
    ends.show(drive, register)


def trip(ends: FarEnds) -> None:
    ends.sims["a"].trip(4)
    ends.show("a", "fault")


def refuse(ends: FarEnds) -> None:
    """Make drive b refuse the setpoint of the second step."""
    accept = ends.sims["b"].accept

    def refusing(cell: MemoryCell, raw: int) -> int:
        if cell.name == "setpoint":
            ends.happen()
            raise Refusal(Reason.VALUE)
        return int(accept(cell, raw))

    vars(ends.sims["b"])["accept"] = refusing
    ends.test._begin_ns -= 120 * 10**9  # the second step is due


# for each kind of abort: limits, first step, event that causes the abort, reason in the result
CAUSES: dict[str, tuple[str, str, Callable[[FarEnds], object], str]] = {
    "limit": ('limits = ["a.output_current >= 60"]', WAIT, exceed, "a.output_current >= 60"),
    "limit on another line": (
        'limits = ["far.output_current >= 60"]',
        WAIT,
        lambda ends: exceed(ends, "far"),
        "far.output_current >= 60",
    ),
    "fault": ("", WAIT, trip, "a has a fault"),
    "silence": ('silence = "3 s"', WAIT, lambda ends: ends.silence(4), "no value of "),
    "duration": ('duration = "30 s"', WAIT, lambda ends: ends.pass_time(40), "the run took longer"),
    "until": (
        "",
        'until = "a.output_frequency > 60"\nwithin = "30 s"',
        lambda ends: ends.pass_time(40),
        "wait 1: a.output_frequency > 60 did not hold",
    ),
    "failed command": (
        "",
        f"{WAIT}\n[[phase.step]]\nfrequency = {{ b = 20.0 }}\n{WAIT}",
        refuse,
        "b refuses: ",
    ),
}
YARD = '[[line]]\nname = "yard"\nport = "{folder}/yard"\n' + "".join(
    f'[[line.drive]]\nname = "{name}"\nmodel = "invt-che"\nmaximum_frequency = 50\naddress = {address}\n'
    f"poll = {CHE['poll']}\n"
    for address, name in enumerate(("far", "far-2", "far-3"), 1)
)


@patient
@pytest.mark.slow
@pytest.mark.parametrize("kind", CAUSES)
def test_each_kind_of_abort_sends_the_first_stop_within_two_bus_cycles(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits, step, event, reason = CAUSES[kind]
    path = write_test(tmp_path, WAITING.format(limits=limits, step=step), a=CHE, b=CHE, c=CHE)
    with (tmp_path / "plant.toml").open("a") as plant:
        plant.write(YARD.format(folder=tmp_path))
    ends = FarEnds(TestRun(path), monkeypatch)
    result = ends.run(event)
    assert result.abort.startswith(reason)
    for line in ends.test.plan.plant.lines:
        assert ends.stops_after(line.name) <= 2 * len(planned_on(line))


OPTIONS = {"maximum_frequency": 50, "confirmed": 1}
FAMILIES = [model for model in (*MODELS, *SHIPPED) if find_model(model).stop is not Drive.stop]


@pytest.mark.long
@pytest.mark.parametrize("model", FAMILIES)
def test_an_abort_stops_each_family_within_two_bus_cycles(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The simulated drives count requests from the read of the high value to the first write."""
    family = find_model(model)
    numbers = [register.name for register in family.readings() if register.values is None and register.step]
    limited = "output_current" if "output_current" in numbers else "output_frequency"
    keys: dict[str, Any] = {name: value for name, value in OPTIONS.items() if name in family.options}
    keys |= {"model": model, "poll": [limited, *(name for name in numbers if name != limited)][:3]}
    waiting = WAITING.format(limits=f'limits = ["a.{limited} >= 60"]', step=WAIT)
    ends = FarEnds(TestRun(write_test(tmp_path, waiting, a=keys, b=keys, c=keys)), monkeypatch)
    result = ends.run(partial(exceed, register=limited))
    assert result.abort.startswith(f"a.{limited} >= 60")
    (line,) = ends.test.plan.plant.lines
    assert ends.stops_after(line.name) <= 2 * len(planned_on(line))


SHORT = STEPS.replace('"2 s"', '"300 ms"')
LONG = SHORT.replace("[20.0, 30.0]", str([20.0, 30.0] * 60))  # a setpoint every 300 ms, for 36 s
FAST = CHE | {"baudrate": 38400}
INTERRUPTED = 10  # number of interrupted processes per seed
INTERRUPTED_TURNING = 8  # number of processes that are interrupted while the motor turns


@pytest.mark.long
@pytest.mark.parametrize("seed", first_in_ci(*range(10)))
def test_no_motor_keeps_running_after_ctrl_c_at_a_random_moment(seed: int, tmp_path: Path) -> None:
    """Each seed interrupts 10 processes: 8 while the motor turns, and 2 at any moment of a short run."""
    chance = random.Random(seed)
    turned = 0
    for number in range(INTERRUPTED):
        while_turning = number < INTERRUPTED_TURNING
        path = write_test(tmp_path, LONG if while_turning else SHORT, fan=FAST)
        with (
            simulated_test(path) as (_plan, sims),
            BoundProcess(
                [*MULTIDROP, "run", str(path), "--yes"],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            ) as process,
        ):
            counters, motor = sims[0].counters, sims[0].motor
            until(lambda: motor.energised if while_turning else counters.requests > 3)  # noqa: B023
            time.sleep(chance.uniform(0.0, 2.0))
            turned += motor.energised
            process.send_signal(chance.choice((signal.SIGINT, signal.SIGTERM)))
            _, errors = process.communicate()
            assert turning(sims) == [], errors
            over = set() if while_turning else {0, -signal.SIGINT, -signal.SIGTERM}
            assert process.returncode in {130, *over}, errors
    assert turned >= INTERRUPTED_TURNING


@pytest.mark.long
@pytest.mark.parametrize("seed", [*range(9), *first_in_ci(*range(9, 20))])
def test_no_motor_keeps_running_after_a_port_was_lost(seed: int, tmp_path: Path) -> None:
    path = write_test(tmp_path, '[abort]\nsilence = "500 ms"\n' + SHORT.replace("300 ms", "2 s"), fan=FAST)
    plan = load_test(path)
    sims, chance = far_ends(plan), random.Random(seed)
    found: list[Any] = []
    has_ended = threading.Event()

    def lose() -> None:
        # on a busy machine, the run may be aborted before the start
        until(lambda: sims[0].motor.energised or has_ended.is_set())
        time.sleep(chance.uniform(0.0, 1.0))
        first.__exit__(None, None, None)
        time.sleep(chance.uniform(0.2, 2.0))
        found.append(Simulator([Wire(sims, port=plan.plant.lines[0].port)]).__enter__())

    first = Simulator([Wire(sims, port=plan.plant.lines[0].port)])
    first.__enter__()
    loser = threading.Thread(target=lose)
    loser.start()
    result = TestRun(plan).run()
    has_ended.set()
    loser.join()
    assert turning(sims) == []
    assert result.stopped["fan"].ok
    found[0].__exit__(None, None, None)


def test_a_simulation_speed_does_not_shorten_waits_of_other_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another thread of the process may ramp a real motor at the same time."""
    waits: list[float] = []
    monkeypatch.setattr(clock, "time", SimpleNamespace(**vars(time) | {"sleep": waits.append}))
    with clock.at_speed(10.0):
        clock.sleep(5.0)
        other = threading.Thread(target=clock.sleep, args=[5.0])
        other.start()
        other.join()
    clock.sleep(5.0)
    assert waits == [0.5, 5.0, 5.0]
