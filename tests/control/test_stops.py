"""A stop is sent despite earlier calls, locked ledgers, hung logs and lines on which no drive answers."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from motors import MAKE, STARTS
from simulated_bus import (
    EXCHANGE_TIME,
    STOPS,
    TIMEOUT,
    Meanwhile,
    Own,
    SimulatedBus,
    che_drives,
    first,
    is_write,
    one,
    plain_stop,
    started_while,
    writes,
)

from multidrop.control.commands import stop_drive
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.outcome import UNSEEN, Seen
from multidrop.control.ramp import ramp, start_staggered
from multidrop.control.stops import AT_ONCE, LEAST_S, PAUSE_S
from multidrop.core import Completion, Exchange, Message
from multidrop.drive import Condition, Drive, Script, read, wait, write
from multidrop.drive.register import reading
from multidrop.drive.verbs import verb
from multidrop.errors import BusError, CancelledByStop, DriveException, LineError, PortLost, Unconfirmed
from multidrop.families import YD1000, DelixiModbus, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.sim import simulated
from multidrop.transport import clock
from multidrop.transport.aside_log import flush_log

every_family = pytest.mark.parametrize("model", MAKE)


ACTS: dict[str, Callable[[SimulatedBus, Any], object]] = {
    "stop": lambda line, drive: drive.stop(),
    "stop_all": lambda line, drive: line.bus.stop_all(),
    "a plain stop": lambda line, drive: drive.write(*plain_stop(drive)),
    "leave": lambda line, drive: line.bus.leave(),
    "close": lambda line, drive: line.bus.close(),
    "detach": lambda line, drive: line.bus.detach(drive),
}

# The long run combines each family with each call in ACTS; the short run has a third of the pairs.
EACH_AND_EACH = [
    pytest.param(model, act, marks=pytest.mark.long if (number + nth) % 3 else ())
    for number, model in enumerate(MAKE)
    for nth, act in enumerate(ACTS)
]


@pytest.mark.parametrize(("model", "act"), EACH_AND_EACH)
def test_the_motor_is_stopped_if_a_stop_is_called_during_a_start(
    tmp_path: Path, model: str, act: str
) -> None:
    """A start that was sent is followed by the stop, and is never reported as unsent."""
    for frames in range(1, 100):
        line, drive, meanwhile, begun, failure = started_while(tmp_path, model, frames, ACTS[act])
        if not meanwhile.has_come:
            break
        assert meanwhile.failure is None
        start = first(line, begun, STARTS[model])
        assert start is None or start < frames
        assert isinstance(failure, CancelledByStop if start is None else Unconfirmed), (frames, failure)
        if act in ("stop", "stop_all"):
            stop = first(line, begun, STOPS[model])
            assert stop is not None
            assert start is None or start < stop
            assert drive.state().condition in (Condition.STOPPED, Condition.UNKNOWN)
    assert frames > 3


@pytest.mark.parametrize("verb_name", ["coast", "emergency_stop"])
@every_family
def test_a_coast_or_an_emergency_stop_also_cancels_a_start(
    tmp_path: Path, model: str, verb_name: str
) -> None:
    if getattr(type(MAKE[model](1)), verb_name) is getattr(Drive, verb_name):
        return

    def act(line: SimulatedBus, drive: Any) -> None:
        getattr(drive, verb_name)()

    line, _, _, begun, failure = started_while(tmp_path, model, 1, act)
    assert isinstance(failure, CancelledByStop)
    assert "a stop was called; nothing more was sent" in str(failure)
    assert first(line, begun, STARTS[model]) is None


def test_a_stop_does_not_delay_other_drives() -> None:
    sims: list[Any] = [simulated(InvtCHE(address, maximum_frequency=50)) for address in (1, 2)]
    line = SimulatedBus(*sims)
    one_of_them, other = (line.attach(sim.drive) for sim in sims)
    other.set_frequency(20)
    Meanwhile(line, 2, one_of_them.stop)
    other.start()
    assert sims[1].motor.energised


def test_a_start_during_a_stop_is_not_sent() -> None:
    line, (drive,), (sim,) = che_drives(runs_s=0)
    begun = len(line.frames)
    meanwhile = Meanwhile(line, 2, drive.start)
    drive.stop()
    assert isinstance(meanwhile.failure, CancelledByStop)
    assert first(line, begun, STARTS["invt-che"]) is None
    assert not sim.motor.energised


def test_a_stop_cancels_a_ramp_in_progress() -> None:
    line, drive, _ = one(YD1000(1))
    drive.set_frequency(10)
    begun = len(line.frames)
    meanwhile = Meanwhile(line, 8, drive.stop)
    with pytest.raises(CancelledByStop):
        ramp(drive, 60.0)
    assert meanwhile.has_come
    stop = first(line, begun, STOPS["yd1000"])
    assert stop is not None
    after = [write for write in writes(line, begun + stop) if write.start == 0x1001]
    assert after == []


def test_a_stop_of_all_drives_cancels_a_staggered_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stop between two starts prevents the second start."""
    line, drives, sims = che_drives(2)
    perform = drives[1].perform

    def stop_meanwhile(script: Script[Any]) -> Any:
        line.bus.stop_all()
        return perform(script)

    monkeypatch.setattr(drives[1], "perform", stop_meanwhile)
    with pytest.raises(CancelledByStop):
        start_staggered(drives, 1.0)
    assert not any(sim.motor.energised for sim in sims)


def test_no_call_moves_a_motor_after_the_bus_is_closed() -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    line.bus.close()
    begun = len(line.frames)
    for call in (
        drive.start,
        drive.jog,
        lambda: drive.set_frequency(30),
        lambda: drive.write(drive.setpoint, 10.0),
        lambda: drive.send_raw(6, 0x1000, b"\0\1"),
    ):
        with pytest.raises(CancelledByStop, match="the bus was closed"):
            call()
    assert writes(line, begun) == []


@every_family
@pytest.mark.parametrize("seconds", [None, 12.0])
def test_repeating_a_stop_uses_at_most_half_of_the_line_time(model: str, seconds: float | None) -> None:
    """Only the first frames of the stop are sent without delay. The total time of the stop stays the same."""
    line, drive, _ = one(MAKE[model](1))
    line.bus.check_identity(drive)
    sent: list[float] = []

    def note(request: Message) -> bool:
        sent.append(line.seconds)  # the request was sent; its timeout starts
        return True

    line.deafens = note
    begun = line.seconds
    with pytest.raises(Unconfirmed):
        drive.stop(seconds=seconds)
    limit = LEAST_S if seconds is None else seconds
    assert limit <= line.seconds - begun + 1e-6 < limit + 2
    assert sent[AT_ONCE] - begun < (AT_ONCE + 1) * (TIMEOUT + EXCHANGE_TIME) + 3 * PAUSE_S
    shared = [at for at in sent if sent[AT_ONCE] <= at < begun + limit - 1]
    assert len(shared) * (TIMEOUT + EXCHANGE_TIME) < 0.45 * (shared[-1] - shared[0])
    assert all(later - earlier < 1.2 for earlier, later in pairwise(shared))


@pytest.mark.slow
def test_a_stop_raises_unconfirmed_after_the_time_limit() -> None:
    line, (drive,), _ = che_drives(hz=50, runs_s=20)
    begun = line.seconds
    with pytest.raises(Unconfirmed, match=r"the motor was not seen to stop within 2 s"):
        drive.stop(seconds=2)
    assert 2 <= line.seconds - begun < 2.2
    line.deafens = lambda request: True
    begun = line.seconds
    with pytest.raises(Unconfirmed, match=r"sent \d+ times, it was never confirmed: .*no reply") as failure:
        drive.stop()
    assert "control = STOP took effect" in str(failure.value.__cause__)
    assert LEAST_S <= line.seconds - begun < LEAST_S + 2
    begun = line.seconds
    with pytest.raises(Unconfirmed):
        drive.stop(seconds=100)
    assert 100 <= line.seconds - begun < 102
    sent = len(writes(line))
    with pytest.raises(Unconfirmed):
        drive.stop(seconds=0)  # with 0 s, the stop is sent only once
    assert len(writes(line)) == sent + 1


SENSELESS = [-1, float("nan"), float("-inf"), Decimal(12), True, "5", [5], 5j]


@pytest.mark.parametrize("seconds", SENSELESS, ids=map(repr, SENSELESS))
@pytest.mark.parametrize("stops", ["stop", "coast", "stop_all"])
def test_an_invalid_stop_time_is_ignored(caplog: pytest.LogCaptureFixture, stops: str, seconds: Any) -> None:
    line, (drive,), (sim,) = che_drives(hz=50, runs_s=20)
    deaf_until = line.seconds + LEAST_S - 5
    line.deafens = lambda request: line.seconds < deaf_until
    if stops == "stop_all":
        assert line.bus.stop_all(seconds=seconds)[drive.name].seen is Seen.STOPPED
    else:
        getattr(drive, stops)(seconds=seconds)
    assert not sim.motor.energised
    flush_log(60)
    assert (
        "is not a time for a stop: the stop is repeated for at least 30 s, as without this argument"
        in caplog.text
    )


def test_a_stop_with_wrong_arguments_is_sent_before_type_error_is_raised() -> None:
    line, drive, sim = one(InvtCHE(1, maximum_frequency=50))
    stop: Any = drive.stop
    for wrong, options in (((5,), {}), ((), {"second": 5}), ((drive, 1), {"seconds": -1})):
        drive.set_frequency(50)
        drive.start()
        line.sleep(20)
        with pytest.raises(TypeError, match=r"^stop of invt-che@1: .*argument") as failure:
            stop(*wrong, **options)
        assert "stop of invt-che@1 was sent all the same" in "".join(failure.value.__notes__)
        assert not sim.motor.energised
    drive.start()
    line.bus.stop_all(60)
    assert not sim.motor.energised


class Patient(Own):
    """A drive whose stop always waits for the duration of its ramp before it reads."""

    model = "patient"
    title = "OWN 2"

    @verb
    def stop(self) -> Script[None]:
        yield from write(self.run, 0)
        yield from wait(20)
        yield from read(self.speed)


def test_waits_in_a_stop_script_end_at_the_time_limit() -> None:
    line = SimulatedBus(simulated(Patient(1)))
    drive = line.attach(Patient(1))
    begun = line.seconds
    with pytest.raises(Unconfirmed, match="the motor was not seen to stop within 2 s"):
        drive.stop(seconds=2)
    assert 2 <= line.seconds - begun < 2.5
    assert len(line.written) == 1


def test_stop_all_repeats_stops_for_the_given_time() -> None:
    sims: list[Any] = [simulated(InvtCHE(1, maximum_frequency=50)), simulated(ErmanERG220(2))]
    line = SimulatedBus(*sims)
    for sim in sims:
        drive = line.attach(sim.drive)
        drive.set_frequency(20)
        drive.start()
    line.sleep(10)
    line.deafens = lambda request: request.address == 2
    begun = line.seconds
    found = line.bus.stop_all(seconds=12)
    assert line.seconds - begun == pytest.approx(12, abs=0.5)
    assert {name: each.seen for name, each in found.items()} == {
        "invt-che@1": Seen.STOPPED,
        "erman-er-g-220@2": Seen.SENT,
    }


def test_a_stop_waiting_for_a_busy_drive_does_not_delay_other_stops() -> None:
    """The other motor ramps down and is read in the meantime."""
    line, _, sims = che_drives(2, hz=50, runs_s=20)
    ready_at = line.seconds + 3
    line.bus.peer(sims[0].drive).c.ready_ns = round(ready_at * 1e9)
    asked: list[tuple[int, float]] = []

    def note(request: Message) -> bytes | None:
        asked.append((request.address, line.seconds))
        return None

    line.answers = note
    line.bus.stop_all()
    of_others = [seconds for address, seconds in asked if address == 2]
    rested = [seconds for address, seconds in asked if address == 1]
    assert of_others[0] < ready_at - 2 < ready_at <= rested[0] < ready_at + 0.5 < of_others[-1]


def test_a_stop_is_sent_again_immediately_after_a_lost_read() -> None:
    line, drive, _ = one(YD1000(1))
    line.bus.check_identity(drive)
    begun = len(line.frames)
    line.loses = lambda request: not is_write(request) and len(line.frames) == begun + 2
    drive.stop()
    assert [is_write(request) for request, _ in line.frames[begun : begun + 3]] == [True, False, True]


def test_a_stop_waits_for_late_replies_only_after_the_first_write(monkeypatch: pytest.MonkeyPatch) -> None:
    """Waiting lets a stop be confirmed if replies are late. It does not delay other drives' first stops."""
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    line.bus.check_identity(drive)
    carry_out, waits = line.carry_out, list[float]()

    def note(exchange: Exchange, **times: Any) -> Completion:
        if is_write(exchange.request):
            waits.append(exchange.c.timeout_ns / 1e9)
        return carry_out(exchange, **times)

    monkeypatch.setattr(line, "carry_out", note)
    line.loses = lambda request: is_write(request) and len(waits) < 3
    drive.stop()
    assert waits[:3] == [0.0, 1.0, 1.0]


@pytest.mark.slow
def test_a_repeated_stop_logs_one_warning_and_one_result(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "multidrop.control")
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    deaf_until = line.seconds + 20
    line.deafens = lambda request: line.seconds < deaf_until
    drive.stop()
    flush_log(60)
    told = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(told) == 1
    assert told[0].startswith("the stop is repeated for 30 s at least: invt-che@1: it is not known whether")
    ends = [record.getMessage() for record in caplog.records if "stopped after" in record.getMessage()]
    assert len(ends) == 1
    assert ends[0].startswith("invt-che@1: stopped after 2")


def test_an_emergency_stop_is_sent_only_once_if_the_drive_trips() -> None:
    line, drive, sim = one(YD1000(1))
    drive.set_frequency(20)
    drive.start()
    begun = len(line.frames)
    hears_at = line.seconds + 10
    line.deafens = lambda request: line.seconds < hears_at
    drive.emergency_stop()
    pulses = [write for write in writes(line, begun) if write.start == 0x1000 and write.data[0] & 0x10]
    assert len(pulses) == 1
    assert not sim.motor.energised


@pytest.mark.parametrize("tended", [True, False])
def test_a_stop_reopens_a_lost_port_unless_a_poller_does(tended: bool) -> None:
    line, (drive,), (sim,) = che_drives(runs_s=0)
    back_at = line.seconds + 5
    opened: list[float] = []

    def regain() -> None:
        opened.append(line.seconds)
        if line.seconds < back_at:
            raise PortLost("hall", "there is no such port")
        line.is_lost = False

    def lost(request: Message) -> bytes | None:
        if tended and line.seconds >= back_at:
            line.is_lost = False
        if line.is_lost:
            raise PortLost("hall", "the port was lost (hung up)")
        return None

    line.is_lost, line.answers, vars(line)["regain"] = True, lost, regain
    line.bus.note_reopening(tended)
    with pytest.raises(LineError):
        drive.read(drive.status)
    opened.clear()  # the read has tried to open the port: not counted
    with pytest.raises(LineError):
        drive.stop(seconds=1)
    drive.stop()
    assert not sim.motor.energised
    assert bool(opened) is not tended
    assert all(later - earlier >= 0.5 for earlier, later in pairwise(opened))


def test_a_stop_is_sent_as_soon_as_the_poller_has_reopened_the_port(monkeypatch: pytest.MonkeyPatch) -> None:
    line, (drive,), _ = che_drives(runs_s=0)
    back_at, begun = line.seconds + 0.05, len(line.frames)
    sent_at: list[float] = []

    def sleep(seconds: float) -> None:
        line.sleep(seconds)
        if line.seconds >= back_at:
            line.is_lost = False
            line.bus.note_reopening(False)

    def answer(request: Message) -> None:
        if line.is_lost:
            raise PortLost("hall", "it is closed")
        sent_at.append(line.seconds)

    line.is_lost, line.answers = True, answer
    line.bus.note_reopening(True)
    monkeypatch.setattr(clock, "sleep", sleep)
    drive.stop()
    assert first(line, begun, STOPS["invt-che"]) == 0
    assert sent_at[0] - back_at < 0.05


def test_a_stop_on_a_closed_port_raises_immediately() -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))

    line.fails = lambda request: LineError("hall", "it is closed")
    begun = line.seconds
    with pytest.raises(LineError, match="it is closed"):
        drive.stop()
    assert line.seconds - begun < 0.1


def test_stops_of_twenty_drives_share_one_wait_for_a_lost_port(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A server that is switched off may delay each attempt to connect for five seconds."""
    line, _, _ = che_drives(20)
    begun = line.seconds

    def regain() -> None:
        line.sleep(5)
        raise PortLost("hall", "timed out")

    line.is_lost, line.fails = True, lambda request: PortLost("hall", "it is closed")
    monkeypatch.setattr(line, "regain", regain)
    assert {stopped.seen for stopped in line.bus.stop_all().values()} == {Seen.FAILED}
    assert line.seconds - begun < LEAST_S + 2 * 5


def test_a_start_stays_cancelled_if_the_drive_is_attached_again() -> None:
    line, (drive,), (sim,) = che_drives()
    seen = drive.stops_called[0]
    drive.stop()
    line.bus.detach(drive)
    line.attach(drive)
    call = drive.begin_call("start", seen)
    with pytest.raises(CancelledByStop):
        drive.carry_out_move(drive.start.script(), call)
    assert not sim.motor.energised
    drive.start()
    assert sim.motor.energised


class Careless(Own):
    """A drive whose stop ignores every failure."""

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor."""
        with suppress(BusError):
            yield from write(self.run, 0)


@pytest.mark.parametrize("failure", [PortLost("hall", "unplugged"), None])
def test_a_stop_is_not_reported_as_done_if_the_script_ignores_failures(failure: BaseException | None) -> None:
    """The stop is repeated, although its script has ended."""
    line = SimulatedBus(simulated(Careless(1)))
    drive = line.attach(Careless(1))
    line.fails, line.loses = lambda request: failure, lambda request: True
    found = line.bus.stop_all(seconds=2)
    assert found[drive.name].seen is (Seen.FAILED if failure else Seen.SENT)
    assert "the drive has confirmed no write" in found[drive.name].why
    assert failure or len(writes(line)) > 2
    line.fails, line.loses = lambda request: None, lambda request: False
    assert drive.stop().ok


def test_a_stop_result_mentions_that_standstill_was_not_read() -> None:
    line = SimulatedBus(simulated(Own(1)))
    drive = line.attach(Own(1))
    assert drive.stop().text == f"stopped: {UNSEEN}"
    assert str(line.bus.stop_all()[drive.name]).endswith(f"stopped after 0.0 s: {UNSEEN}")


def test_a_stop_is_sent_without_a_writable_ledger(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("")
    line = SimulatedBus(simulated(Own(1)), simulated(Own(2)), ledger=tmp_path / "file" / "wear")
    drives = [line.attach(Own(address)) for address in (1, 2)]
    drives[0].stop()
    assert len(writes(line)) == 1
    found = line.bus.stop_all()
    assert [each.seen for each in found.values()] == [Seen.STOPPED] * 2
    line.bus.close()
    flush_log(60)
    assert "stops were not counted" in caplog.text


def test_a_stop_is_sent_again_before_reads_if_replies_are_lost() -> None:
    """Although the value could be read back, the stop is sent again first."""
    line = SimulatedBus(simulated(Own(1)))
    drive = line.attach(Own(1))
    lost: list[Message] = []

    def loses(request: Message) -> bool:
        """Lose the replies to the first two writes."""
        if is_write(request) and len(lost) < 2:
            lost.append(request)
        return is_write(request) and lost[-1] is request

    line.loses = loses
    drive.stop()
    assert len(lost) == 2
    asked = [is_write(request) for request, _ in line.frames]
    sent = asked.index(True)  # reads of the identity come first
    assert asked[sent : sent + 3] == [True, True, True]


def test_a_stop_is_sent_and_counted_although_the_eeprom_budget_is_spent(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "wear", budget=1)
    line = SimulatedBus(simulated(Own(1)), ledger=ledger)
    drive = line.attach(Own(1, confirmed=1))
    drive.start()
    for _ in range(3):
        drive.stop()
    assert [write.data for write in writes(line)] == [b"\0\1", b"\0\0", b"\0\0", b"\0\0"]
    line.bus._records.flush(60)
    (wear,) = ledger.wear(1_700_000_000 + line.seconds)
    assert wear.writes == 4


def test_the_eeprom_ledger_does_not_count_cancelled_writes(tmp_path: Path) -> None:
    for frames in range(1, 100):
        ledger = Ledger(tmp_path / f"wear-{frames}")
        line, drive, sim = one(DelixiModbus(1), ledger=ledger)
        meanwhile = Meanwhile(line, frames, lambda drive=drive: drive.stop())
        with suppress(CancelledByStop):
            drive.write(drive.frequency, 12.0)
        written = sim.counters.eeprom_writes["frequency"]
        assert sum(wear.writes for wear in ledger.wear(line.seconds)) == written
        if written:
            break
        assert meanwhile.has_come
    assert frames > 2


def test_other_drives_are_stopped_if_a_stop_script_raises() -> None:
    class Broken(Own):
        """A drive whose stop fails before it sends anything."""

        @verb
        def stop(self) -> Script[None]:
            raise KeyError("speed")
            yield

    class Breaks(Own):
        """A drive whose stop fails after it was sent."""

        @verb
        def stop(self) -> Script[None]:
            yield from write(self.run, 0)
            raise ZeroDivisionError("division by zero")

    line = SimulatedBus(*(simulated(Own(address)) for address in (1, 2, 3)))
    for drive in (Broken(1, name="broken"), Breaks(2, name="breaks"), Own(3, name="own")):
        line.attach(drive)
    found = line.bus.stop_all()
    assert {name: each.seen for name, each in found.items()} == {
        "broken": Seen.FAILED,
        "breaks": Seen.SENT,
        "own": Seen.STOPPED,
    }
    assert "KeyError: 'speed'" in found["broken"].why
    assert "division by zero" in found["breaks"].why


def test_a_stop_of_one_write_is_repeated_until_the_drive_answers() -> None:
    line = SimulatedBus(simulated(Own(1)))
    drive = line.attach(Own(1))
    line.deafens = lambda request: line.seconds < 1010
    drive.stop()
    assert len(writes(line)) > 3


class Hanging(logging.Handler):
    """A log handler that hangs, as on a hung disk."""

    def __init__(self, hang: Callable[[], None]) -> None:
        super().__init__()
        self._hang = hang

    def emit(self, record: logging.LogRecord) -> None:
        self._hang()


def test_a_stop_is_sent_even_if_a_log_handler_hangs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The audit log and the EEPROM ledger hang too. The second drive's stop does not wait for them."""
    line = SimulatedBus(*(simulated(Own(number)) for number in (1, 2)), audit=tmp_path / "audit")
    first, second = (line.attach(Own(address)) for address in (1, 2))
    hangs, released = threading.Event(), threading.Event()

    def hang(*_: object) -> None:
        hangs.set()
        released.wait(60)

    records: Any = line.bus._records
    handler = Hanging(hang)
    monkeypatch.setattr(records.audit, "add", hang)
    monkeypatch.setattr(records._ledger, "note", hang)
    logging.getLogger("multidrop").addHandler(handler)
    stopping = threading.Thread(target=lambda: (first.stop(), second.stop(), line.bus.stop_all()))
    try:
        stopping.start()
        stopping.join(60)
        assert not stopping.is_alive()
        assert hangs.wait(60)  # now the log hangs, on another thread
        assert len(writes(line)) == 4
    finally:
        released.set()
        logging.getLogger("multidrop").removeHandler(handler)
        line.bus.close()


def noting(line: SimulatedBus) -> list[str]:
    """Return a list to which each request appends the present texts of `stops_under_way`."""
    told: list[str] = []

    def note(request: Message) -> bool:
        for text in line.bus.stops_under_way().values():
            if text not in told[-1:]:
                told.append(text)
        return False

    line.deafens = note
    return told


def test_a_stop_reports_its_progress_while_the_motor_slows_down() -> None:
    line, drive, _ = one(YD1000(1))
    drive.set_frequency(20)
    drive.start()
    line.sleep(10)
    told = noting(line)
    drive.stop()
    assert told == [
        f"{drive.name}: no stop was sent yet",
        f"{drive.name}: the stop was confirmed, but the motor is not yet seen to stand",
    ]
    assert line.bus.stops_under_way() == {}


def test_a_stop_without_reply_is_reported_as_sent() -> None:
    line, drive, _ = one(YD1000(1))
    told = noting(line)
    line.loses = is_write
    assert line.bus.stop_all(seconds=5)[drive.name].seen is Seen.SENT
    assert told[:2] == [
        f"{drive.name}: no stop was sent yet",
        f"{drive.name}: the stop was sent, but is not yet confirmed",
    ]
    assert all(text.startswith(told[1]) for text in told[2:])
    assert "it is not known whether" in told[2]


def test_a_finished_stop_is_no_longer_reported_as_in_progress() -> None:
    line = SimulatedBus(simulated(YD1000(1)), simulated(YD1000(2)))
    names = [line.attach(sim.drive).name for sim in line.sims]
    line.loses = lambda request: request.address == 2
    under_way: list[set[str]] = []

    def note(request: Message) -> bool:
        under_way.append(set(line.bus.stops_under_way()))
        return False

    line.deafens = note
    line.bus.stop_all(seconds=20)
    assert set(names) in under_way
    assert under_way[-1] == {names[1]}


def test_a_refused_stop_is_not_reported_as_unsent() -> None:
    line, drive, _ = one(InnovertIBD(1))
    told: list[str] = []

    def refuse(request: Message) -> int:
        told.extend(line.bus.stops_under_way().values())
        return 1 if is_write(request) else 0

    line.refuses = refuse
    found = line.bus.stop_all(seconds=2)[drive.name]
    assert found.seen is Seen.REFUSED
    assert str(found).startswith(f"{drive.name}: refused by the drive after 2.")
    with pytest.raises(DriveException):
        drive.stop(seconds=1)
    assert any(text.startswith(f"{drive.name}: the stop was sent, but is not yet confirmed") for text in told)


class Meter(Drive):
    has_motor = False
    power = reading(1, "W")


def test_stop_all_skips_devices_without_a_motor(
    caplog: pytest.LogCaptureFixture,
) -> None:
    flush_log(60)
    caplog.clear()  # removes log records of earlier tests
    line = SimulatedBus(simulated(YD1000(1)), simulated(Meter(2)))
    line.attach(YD1000(1, name="pump"))
    meter = line.attach(Meter(2, name="meter"))
    line.bus.stop_on_exit()
    results = line.bus.stop_all()
    assert results["pump"].seen is Seen.STOPPED
    assert (str(results["meter"]), results["meter"].ok) == ("meter: has no motor", True)
    assert str(stop_drive(meter, None)["meter"].outcome) == "done"
    line.bus.close()
    flush_log(1.0)
    assert not [request for request, _ in line.frames if request.address == 2]
    assert caplog.text == ""
