"""A stop always wins: against what was called before it, against looks that fail, ledgers and deaf lines."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from time import sleep
from typing import Any

import pytest
from motors import MAKE, STARTS
from simulated_bus import EXCHANGE_TIME, TIMEOUT, SimulatedBus, is_write, one
from tables import table

from multidrop.bus import Bus
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.outcome import Effect, Seen
from multidrop.control.ramp import ramp, start_staggered
from multidrop.control.stops import AT_ONCE, LEAST_S, PAUSE_S
from multidrop.core import Completion, Exchange, Framing, Message, build_reply
from multidrop.drive import Condition, Direction, Drive, Script, State, insist, read, wait, write
from multidrop.drive.register import Kept, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import (
    BusError,
    CancelledByStop,
    Expired,
    LineError,
    NoReply,
    NotAttached,
    PortLost,
    Unconfirmed,
    WriteForbidden,
)
from multidrop.families import YD1000, DelixiModbus, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.families.invt_che import CHEControl
from multidrop.sim import simulated
from multidrop.transport.aside_log import flush

every_family = pytest.mark.parametrize("model", MAKE)

STOPS: dict[str, Callable[[Message], bool]] = {  # in the documents' words
    "erman-er-g-220": lambda each: each.function == 5 and each.start == 1 and each.data != b"\0\0",
    "invt-che": lambda each: each.start == 0x1000 and each.data[-1] == 5,
    "innovert-ibd": lambda each: each.start == 0x2000 and each.data[-1] == 1,
    "delixi-modbus": lambda each: each.start == 0x2000 and each.data[-1] == 1,
    "delixi-native": lambda each: each.function == 2 and each.start == 1,
    "yd1000": lambda each: each.start == 0x1000 and each.data[0] == 0xC0,
}


class Own(Drive):
    """A drive of a user's own, stopped by a setting that wears."""

    model = "own"
    title = "OWN 1"
    speed = reading(0x10, "rpm")
    run = setting(0x20, kept=Kept.EEPROM)
    ratio = setting(0x21, kept=Kept.RAM)

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor."""
        yield from read(self.speed)
        yield from write(self.run, 1)

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor."""
        yield from write(self.run, 0)

    @verb
    def state(self) -> Script[State]:
        """Return the state that the drive reports."""
        speed = yield from read(self.speed)
        return State(Condition.RUNNING if speed else Condition.STOPPED)


def writes(line: SimulatedBus, begun: int = 0) -> list[Message]:
    return [request for request, _ in line.frames[begun:] if is_write(request)]


def first(line: SimulatedBus, begun: int, met: Callable[[Message], bool]) -> int | None:
    """Count the frames before the first write of this kind."""
    wanted = (at for at, (each, _) in enumerate(line.frames[begun:]) if is_write(each) and met(each))
    return next(wanted, None)


class Meanwhile:
    """Has another thread do something when so many more frames were sent, and waits for that thread."""

    def __init__(self, line: SimulatedBus, frames: int, act: Callable[[], object]) -> None:
        self.failure: BaseException | None = None
        self.has_come = False
        self._left = frames
        self._act = act
        self._carry_out = line.carry_out
        vars(line)["carry_out"] = self.carry_out

    def carry_out(self, exchange: Exchange, **times: Any) -> Completion:
        completion = self._carry_out(exchange, **times)
        self._left -= 1
        if self._left == 0:
            self.has_come = True
            thread = threading.Thread(target=self._run)
            thread.start()
            thread.join(120)
            assert not thread.is_alive()
        return completion

    def _run(self) -> None:
        try:
            self._act()
        except BaseException as failure:
            self.failure = failure


# ---- against what was called before ----


def started_while(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    model: str,
    frames: int,
    act: Callable[[SimulatedBus, Any], object],
) -> tuple[SimulatedBus, Any, Meanwhile, int, BaseException | None]:
    """A start, in which another thread acts after so many frames; and how the start ended."""
    line, drive, _ = one(monkeypatch, MAKE[model](1), ledger=tmp_path / f"wear-{frames}")
    drive.set_frequency(20)
    begun = len(line.frames)
    meanwhile = Meanwhile(line, frames, lambda: act(line, drive))
    failure = None
    try:
        drive.start()
    except BusError as error:
        failure = error
    return line, drive, meanwhile, begun, failure


ACTS: dict[str, Callable[[SimulatedBus, Any], object]] = {
    "stop": lambda line, drive: drive.stop(),
    "stop_all": lambda line, drive: line.bus.stop_all(),
    "a plain stop": lambda line, drive: drive.write(*plain_stop(drive)),
    "leave": lambda line, drive: line.bus.leave(),
    "close": lambda line, drive: line.bus.close(),
    "detach": lambda line, drive: line.bus.detach(drive),
}


def plain_stop(drive: Drive) -> tuple[Any, Any]:
    register = drive.registers.get("control") or drive.register("stop_coil")
    assert register.harmless
    return register, register.decode(register.harmless[-1])


# Each family with two acts, and each act with two families; the rest takes long.
EACH_AND_EACH = [
    pytest.param(model, act, marks=pytest.mark.long if (number + nth) % 3 else ())
    for number, model in enumerate(MAKE)
    for nth, act in enumerate(ACTS)
]


@pytest.mark.parametrize(("model", "act"), EACH_AND_EACH)
def test_nothing_moves_after_a_stop_wherever_it_came_in_a_start(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: str, act: str
) -> None:
    """At every frame of it; what was sent before is followed by the stop, and never told as not sent."""
    for frames in range(1, 100):
        line, drive, meanwhile, begun, failure = started_while(
            monkeypatch, tmp_path, model, frames, ACTS[act]
        )
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
def test_the_other_stops_win_too(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: str, verb_name: str
) -> None:
    if getattr(type(MAKE[model](1)), verb_name) is getattr(Drive, verb_name):
        return

    def act(line: SimulatedBus, drive: Any) -> None:
        getattr(drive, verb_name)()

    line, _, _, begun, failure = started_while(monkeypatch, tmp_path, model, 1, act)
    assert isinstance(failure, CancelledByStop)
    assert "a stop was called; nothing more was sent" in str(failure)
    assert first(line, begun, STARTS[model]) is None


def test_other_drives_are_not_held_up_by_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    sims: list[Any] = [simulated(InvtCHE(address, maximum_frequency=50)) for address in (1, 2)]
    line = SimulatedBus(monkeypatch, *sims)
    one_of_them, other = (line.attach(sim.drive) for sim in sims)
    other.set_frequency(20)
    Meanwhile(line, 2, one_of_them.stop)
    other.start()
    assert sims[1].motor.energised


def test_what_is_called_after_a_stop_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    _, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    drive.stop()
    drive.start()
    assert sim.motor.energised


def test_what_is_called_while_a_stop_is_under_way_is_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    drive.start()
    begun = len(line.frames)
    meanwhile = Meanwhile(line, 2, drive.start)
    drive.stop()
    assert isinstance(meanwhile.failure, CancelledByStop)
    assert first(line, begun, STARTS["invt-che"]) is None
    assert not sim.motor.energised


def test_a_ramp_ends_with_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, YD1000(1))
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


def test_a_staggered_start_ends_with_a_stop_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where it came between two starts: the second one is not called after it by anybody."""
    sims: list[Any] = [simulated(InvtCHE(address, maximum_frequency=50)) for address in (1, 2)]
    line = SimulatedBus(monkeypatch, *sims)
    drives = [line.attach(sim.drive) for sim in sims]
    for drive in drives:
        drive.set_frequency(20)
    perform = drives[1].perform

    def stop_meanwhile(script: Script[Any]) -> Any:
        line.bus.stop_all()
        return perform(script)

    monkeypatch.setattr(drives[1], "perform", stop_meanwhile)
    with pytest.raises(CancelledByStop):
        start_staggered(drives, 1.0)
    assert not any(sim.motor.energised for sim in sims)


def test_after_closing_nothing_that_moves_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
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
        with pytest.raises(CancelledByStop, match="the bus was left"):
            call()
    assert writes(line, begun) == []


# ---- looks ----

REFUSALS = [
    ("invt-che", 0x11),
    ("invt-che", 0x06),
    ("delixi-native", 0xFF),
    ("yd1000", 0x04),
    ("innovert-ibd", 0x06),
    ("erman-er-g-220", 0x02),
]


@pytest.mark.parametrize(("model", "code"), REFUSALS)
def test_an_exception_to_the_look_keeps_no_stop_back(
    monkeypatch: pytest.MonkeyPatch, model: str, code: int
) -> None:
    line, drive, sim = one(monkeypatch, MAKE[model](1))
    sim.motor.energised = True

    def refuse(request: Message) -> bytes | None:
        if is_write(request) or writes(line):
            return None
        return build_reply(
            drive.framing, Message(1, request.function, request.start, exception=code, data=bytes(4))
        )

    line.answers = refuse
    begun = line.seconds
    drive.stop()
    stop = first(line, 0, STOPS[model])
    assert stop is not None
    assert line.seconds - begun < 60
    assert STOPS[model](writes(line)[0])  # nothing else was written


@every_family
def test_the_first_look_of_a_stop_and_the_stop_itself_wait_for_no_late_answer(
    monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    line, drive, _ = one(monkeypatch, MAKE[model](1))
    insisted: list[bool] = []
    carry_out = line.carry_out

    def watched(exchange: Any, **times: Any) -> Any:
        if not writes(line):
            insisted.append(bool(exchange.c.insists))
        return carry_out(exchange, **times)

    monkeypatch.setattr(line, "carry_out", watched)
    drive.stop()
    assert len(insisted) >= 2
    assert all(insisted)


@every_family
def test_a_look_that_is_lost_is_not_repeated_before_the_stop(
    monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    line, drive, _ = one(monkeypatch, MAKE[model](1))
    line.loses = lambda request: not writes(line)
    drive.stop()
    assert first(line, 0, STOPS[model]) == 1


def test_one_odd_answer_is_no_proof_of_another_family(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    odd = build_reply(Framing.RTU, Message(1, 3, data=b"\0\3"))
    line.answers = lambda request: odd if len(line.frames) == 1 else None
    drive.stop()
    assert first(line, 0, STOPS["invt-che"]) is not None


def test_two_odd_answers_that_differ_are_no_proof_of_another_family(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    odd = [build_reply(Framing.RTU, Message(1, 3, data=bytes([0, device]))) for device in (3, 4)]
    line.answers = lambda request: odd.pop(0) if odd else None
    drive.stop()
    assert odd == []
    assert STOPS["invt-che"](writes(line)[0])


def test_a_drive_that_ever_failed_to_answer_proves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its reply may be the answer to an earlier request."""
    line, drive, sim = one(monkeypatch, InvtCHE(1))
    sim["device"] = 0x010A
    line.bus.peer(drive).c.history.ended[10] = 1
    drive.stop()
    assert line.frames[0][1] == "01 06 10 00 00 05 4D 09"  # without a look


def test_a_stop_that_is_withheld_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = one(monkeypatch, InvtCHE(1))
    sim["device"] = 0x010A
    with pytest.raises(
        WriteForbidden, match=r"no stop was sent .* said twice .*010AH.* Use the hard-wired stop"
    ):
        drive.stop()
    assert line.written == []
    sim["device"] = 0x0101
    drive.stop()  # it is looked at again
    assert line.written != []


OTHERS: Sequence[tuple[Drive, Drive]] = (  # declared, and there: of one framing and baud rate
    (InvtCHE(1, maximum_frequency=50), YD1000(1)),
    (InnovertIBD(1, confirmed=0), InvtCHE(1)),
    (YD1000(1), InvtCHE(1)),
    (DelixiModbus(1, framing="rtu", format="8E1"), YD1000(1, format="8E1")),
)


@pytest.mark.parametrize("pair", OTHERS, ids=lambda pair: f"{pair[0].model} for {pair[1].model}")
def test_the_stop_of_the_family_that_it_looks_like_is_offered(
    monkeypatch: pytest.MonkeyPatch, pair: tuple[Drive, Drive]
) -> None:
    declared, there = pair
    sim = simulated(there)
    line = SimulatedBus(monkeypatch, sim)
    drive = line.attach(declared)
    with pytest.raises(WriteForbidden, match=f"multidrop stop PORT {there.model} 1"):
        drive.stop()
    assert line.written == []
    line.bus.detach(drive)
    line.attach(type(there)(1, format=there.settings.format)).stop()
    assert line.written != []


OUT_OF_DATE = [  # a register of `identify`, and a count that the family's own drive may hold for a while
    ("delixi-modbus", "baudrate_setting", 4),
    ("delixi-modbus", "address_setting", 7),
    ("delixi-modbus", "fault", 99),
    ("delixi-native", "baudrate_setting", 4),
    ("delixi-native", "address_setting", 7),
    ("innovert-ibd", "baudrate_setting", 3),
    ("innovert-ibd", "address_setting", 7),
    ("invt-che", "device", 0x0103),
    ("invt-che", "device", 0x0001),
    ("yd1000", "address_setting", 7),
    ("yd1000", "maximum_frequency", 800),
]


def shows(line: SimulatedBus, drive: Drive, name: str, count: int) -> None:
    """Let each read of this register return `count`, whatever the simulated drive holds."""
    register = drive.register(name)
    data = count.to_bytes(4 if drive.framing is Framing.DELIXI else 2, "big")
    start = register.address if drive.framing is Framing.DELIXI else 0
    reply = build_reply(drive.framing, Message(1, register.table.read, start, data=data))
    line.answers = lambda request: reply if request.start == register.address else None


@pytest.mark.parametrize(("model", "name", "count"), OUT_OF_DATE)
@pytest.mark.parametrize("how", ["stop", "stop_all", "write"])
def test_one_value_that_does_not_fit_its_family_withholds_a_start_and_no_stop(
    monkeypatch: pytest.MonkeyPatch, model: str, name: str, count: int, how: str
) -> None:
    line, drive, _ = one(monkeypatch, MAKE[model](1))
    shows(line, drive, name, count)
    with pytest.raises(WriteForbidden):
        drive.set_frequency(20)
    assert line.written == []
    if how == "stop":
        drive.stop()
    elif how == "stop_all":
        line.bus.detach(drive)
        line.bus.attach(drive)
        (stopped,) = line.bus.stop_all().values()
        assert stopped.seen is Seen.STOPPED
    else:
        drive.write(drive.control, drive.control.decode(drive.control.broadcast[0]))
    assert STOPS[model](writes(line)[0])


@every_family
def test_a_stop_is_sent_to_a_drive_that_refuses_what_its_family_answers(
    monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    """Some other makes answer function 04 too, which is all that an ERMAN's identity check asks."""
    line, drive, _ = one(monkeypatch, MAKE[model](1))

    def refuse(request: Message) -> bytes | None:
        if is_write(request) or request.function == 4:
            return None
        return build_reply(drive.framing, Message(1, request.function, request.start, exception=2))

    if drive.framing is Framing.RTU:
        line.answers = refuse
    with suppress(BusError):
        drive.stop(seconds=1)
    assert STOPS[model](writes(line)[0])


# ---- until it stands ----


@every_family
def test_a_stop_is_repeated_as_long_as_the_line_is_deaf(monkeypatch: pytest.MonkeyPatch, model: str) -> None:
    line, drive, sim = one(monkeypatch, MAKE[model](1))
    drive.set_frequency(20)
    drive.start()
    hears_at = line.seconds + 20
    line.deafens = lambda request: line.seconds < hears_at
    drive.stop()
    assert not sim.motor.energised


@every_family
@pytest.mark.parametrize("seconds", [None, 12.0])
def test_the_stop_of_a_silent_drive_leaves_its_neighbours_more_than_half_of_the_line(
    monkeypatch: pytest.MonkeyPatch, model: str, seconds: float | None
) -> None:
    """But for its first frames, which nothing delays; and its time is no longer for that."""
    line, drive, _ = one(monkeypatch, MAKE[model](1))
    line.bus.check_identity(drive)
    sent: list[float] = []

    def note(request: Message) -> bool:
        sent.append(line.seconds)  # its reply is waited for from now on
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
def test_a_stop_gives_up_when_its_caller_says_so_and_tells_what_is_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(50)
    drive.start()
    line.sleep(20)
    begun = line.seconds
    with pytest.raises(Unconfirmed, match=r"it was not seen to stop within its 2 s"):
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
        drive.stop(seconds=0)  # once, and no more
    assert len(writes(line)) == sent + 1


SENSELESS = [-1, float("nan"), float("-inf"), Decimal("sNaN"), True, "5", [5], 5j]


@pytest.mark.parametrize("seconds", SENSELESS, ids=map(repr, SENSELESS))
@pytest.mark.parametrize("stops", ["stop", "coast", "stop_all"])
def test_a_stop_with_a_senseless_time_is_sent_as_one_without_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, stops: str, seconds: Any
) -> None:
    line, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(50)
    drive.start()
    line.sleep(20)
    deaf_until = line.seconds + LEAST_S - 5
    line.deafens = lambda request: line.seconds < deaf_until
    if stops == "stop_all":
        assert line.bus.stop_all(seconds=seconds)[drive.name].seen is Seen.STOPPED
    else:
        getattr(drive, stops)(seconds=seconds)
    assert not sim.motor.energised
    flush(60)
    assert "is not a time for a stop: it is repeated for 30 s at least, as without one" in caplog.text


def test_a_stop_that_is_called_wrongly_is_sent_before_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    stop: Any = drive.stop
    for wrong, options in (((5,), {}), ((), {"second": 5}), ((drive, 1), {"seconds": -1})):
        drive.set_frequency(50)
        drive.start()
        line.sleep(20)
        with pytest.raises(TypeError, match="argument") as failure:
            stop(*wrong, **options)
        assert "stop of invt-che@1 was sent all the same" in "".join(failure.value.__notes__)
        assert not sim.motor.energised
    drive.start()
    line.bus.stop_all(60)
    assert not sim.motor.energised


class Patient(Own):
    """One whose stop waits for as long as its ramp takes, whatever the drive says."""

    model = "patient"
    title = "OWN 2"

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor."""
        yield from write(self.run, 0)
        yield from wait(20)
        yield from read(self.speed)


def test_a_stop_s_own_waits_take_no_longer_than_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    line = SimulatedBus(monkeypatch, simulated(Patient(1)))
    drive = line.attach(Patient(1))
    begun = line.seconds
    with pytest.raises(Unconfirmed, match="it was not seen to stop within its 2 s"):
        drive.stop(seconds=2)
    assert 2 <= line.seconds - begun < 2.5
    assert len(line.written) == 1


def test_stop_all_takes_seconds_too(monkeypatch: pytest.MonkeyPatch) -> None:
    sims: list[Any] = [simulated(InvtCHE(1, maximum_frequency=50)), simulated(ErmanERG220(2))]
    line = SimulatedBus(monkeypatch, *sims)
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


def test_no_stop_waits_for_a_second_look_at_another_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor for the first one, of a drive that is known."""
    others = [YD1000(1), InvtCHE(2, maximum_frequency=50), InvtCHE(3, maximum_frequency=50)]
    line = SimulatedBus(monkeypatch, *(simulated(drive) for drive in others))
    line.attach(InvtCHE(1, maximum_frequency=50))
    for drive in others[1:]:
        line.attach(drive)
    line.bus.check_identity(others[2])
    begun = len(line.frames)
    found = line.bus.stop_all()
    addresses = [request.address for request, _ in line.frames[begun:]]
    assert [request.address for request in writes(line, begun)][:2] == [3, 2]
    assert addresses[0] == 3
    before = first(line, begun, lambda each: each.address == 2)
    assert before is not None
    assert addresses[:before].count(1) == 1
    assert found["invt-che@1"].seen is Seen.FAILED
    assert all(write.address != 1 for write in writes(line, begun))


def test_a_stop_whose_drive_must_rest_holds_up_no_other_and_is_sent_as_it_may(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The motor of the other one runs out meanwhile, and is looked at."""
    sims: list[Any] = [simulated(InvtCHE(address, maximum_frequency=50)) for address in (1, 2)]
    line = SimulatedBus(monkeypatch, *sims)
    for sim in sims:
        drive = line.attach(sim.drive)
        drive.set_frequency(50)
        drive.start()
    line.sleep(20)
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


def test_a_look_that_is_lost_is_not_repeated_before_the_stop_is_sent_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line, drive, _ = one(monkeypatch, YD1000(1))
    line.bus.check_identity(drive)
    begun = len(line.frames)
    line.loses = lambda request: not is_write(request) and len(line.frames) == begun + 2
    drive.stop()
    assert [is_write(request) for request, _ in line.frames[begun : begun + 3]] == [True, False, True]


def test_a_stop_s_first_write_waits_for_no_late_answer_and_its_later_ones_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is confirmed thus on a line with late answers; the stops of others wait for no first write."""
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
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
def test_that_a_stop_is_repeated_is_told_once_and_so_is_its_end(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "multidrop.control")
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    deaf_until = line.seconds + 20
    line.deafens = lambda request: line.seconds < deaf_until
    drive.stop()
    flush(60)
    told = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(told) == 1
    assert told[0].startswith("the stop is repeated for 30 s at least: invt-che@1: it is not known whether")
    ends = [record.getMessage() for record in caplog.records if "stopped after" in record.getMessage()]
    assert len(ends) == 1
    assert ends[0].startswith("invt-che@1: stopped after 2")


@pytest.mark.parametrize("suspicions", [1, 2])
def test_a_plain_stop_is_withheld_where_another_family_answers_twice(
    monkeypatch: pytest.MonkeyPatch, suspicions: int
) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    odd = build_reply(Framing.RTU, Message(1, 3, data=b"\x01\x0a"))  # a Goodrive300L
    line.answers = lambda request: odd if len(line.frames) <= suspicions else None
    if suspicions == 1:
        drive.write(drive.control, CHEControl.STOP)
    else:
        with pytest.raises(WriteForbidden, match="no stop was sent"):
            drive.write(drive.control, CHEControl.STOP)
    assert len(line.written) == 2 - suspicions


def test_an_emergency_stop_that_is_a_pulse_is_sent_once_however_long_it_takes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line, drive, sim = one(monkeypatch, YD1000(1))
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
def test_a_port_that_was_lost_is_waited_for_and_opened_where_nobody_else_does(
    monkeypatch: pytest.MonkeyPatch, tended: bool
) -> None:
    line, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    drive.start()
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
    line.bus.tended(tended)
    with pytest.raises(LineError):
        drive.read(drive.status)
    opened.clear()  # a read opens it too
    with pytest.raises(LineError):
        drive.stop(seconds=1)
    drive.stop()
    assert not sim.motor.energised
    assert bool(opened) is not tended
    assert all(later - earlier >= 0.5 for earlier, later in pairwise(opened))


def test_a_stop_on_a_port_that_was_closed_is_an_error_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))

    def closed(request: Message) -> bytes | None:
        raise LineError("hall", "it is closed")

    line.answers = closed
    begun = line.seconds
    with pytest.raises(LineError, match="it is closed"):
        drive.stop()
    assert line.seconds - begun < 0.1


# ---- a user's own drive ----


def test_an_unwritable_ledger_keeps_no_stop_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    line = SimulatedBus(monkeypatch, simulated(Own(1)), simulated(Own(2)), ledger=tmp_path / "file" / "wear")
    drives = [line.attach(Own(address)) for address in (1, 2)]
    drives[0].stop()
    assert len(writes(line)) == 1
    found = line.bus.stop_all()
    assert [each.seen for each in found.values()] == [Seen.STOPPED] * 2
    line.bus.close()
    flush(60)
    assert "stops were not counted" in caplog.text


def test_a_stop_whose_reply_is_lost_is_sent_again_before_anything_is_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Though the drive could be asked what it holds."""
    line = SimulatedBus(monkeypatch, simulated(Own(1)))
    drive = line.attach(Own(1))
    lost: list[Message] = []

    def loses(request: Message) -> bool:
        """The first two replies to a stop."""
        if is_write(request) and len(lost) < 2:
            lost.append(request)
        return is_write(request) and lost[-1] is request

    line.loses = loses
    drive.stop()
    assert len(lost) == 2
    asked = [is_write(request) for request, _ in line.frames]
    sent = asked.index(True)  # its identity is read before
    assert asked[sent : sent + 3] == [True, True, True]


def test_a_spent_budget_keeps_no_stop_back_and_it_is_counted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ledger = Ledger(tmp_path / "wear", budget=1)
    line = SimulatedBus(monkeypatch, simulated(Own(1)), ledger=ledger)
    drive = line.attach(Own(1, confirmed=1))
    drive.start()
    for _ in range(3):
        drive.stop()
    assert [write.data for write in writes(line)] == [b"\0\1", b"\0\0", b"\0\0", b"\0\0"]
    line.bus._records.flush(60)
    (wear,) = ledger.wear(1_700_000_000 + line.seconds)
    assert wear.writes == 4


def test_a_write_that_a_stop_keeps_back_is_not_counted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for frames in range(1, 100):
        ledger = Ledger(tmp_path / f"wear-{frames}")
        line, drive, sim = one(monkeypatch, DelixiModbus(1), ledger=ledger)
        meanwhile = Meanwhile(line, frames, lambda drive=drive: drive.stop())
        with suppress(CancelledByStop):
            drive.write(drive.frequency, 12.0)
        written = sim.counters.eeprom_writes["frequency"]
        assert sum(wear.writes for wear in ledger.wear(line.seconds)) == written
        if written:
            break
        assert meanwhile.has_come
    assert frames > 2


def test_stop_all_goes_on_past_whatever_a_script_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(Own):
        """Its author made a mistake."""

        @verb
        def stop(self) -> Script[None]:
            """Stop the motor."""
            raise KeyError("speed")
            yield

    class Breaks(Own):
        """After its stop was sent."""

        @verb
        def stop(self) -> Script[None]:
            """Stop the motor."""
            yield from write(self.run, 0)
            raise ZeroDivisionError("division by zero")

    line = SimulatedBus(monkeypatch, *(simulated(Own(address)) for address in (1, 2, 3)))
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


def test_a_stop_that_is_a_plain_write_is_sent_once_the_drive_hears(monkeypatch: pytest.MonkeyPatch) -> None:
    line = SimulatedBus(monkeypatch, simulated(Own(1)))
    drive = line.attach(Own(1))
    line.deafens = lambda request: line.seconds < 1010
    drive.stop()
    assert len(writes(line)) > 3


# ---- expiry ----


def check_not_sent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: str, hold_up: Callable[[SimulatedBus], None]
) -> None:
    """Check that no start is sent that was held up at any of its looks."""
    for frames in range(1, 100):
        line, _, meanwhile, begun, failure = started_while(
            monkeypatch, tmp_path, model, frames, lambda line, drive: hold_up(line)
        )
        start = first(line, begun, STARTS[model])
        if not meanwhile.has_come or (start is not None and start < frames):
            break
        assert start is None
        assert isinstance(failure, Expired)
    assert frames > 2


@every_family
def test_a_start_that_was_held_up_in_its_looks_is_not_sent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: str
) -> None:
    """The process is stopped by a signal, as Ctrl-Z does, at each of them."""
    check_not_sent(monkeypatch, tmp_path, model, lambda line: line.sleep(5))


@every_family
def test_a_start_in_whose_looks_the_machine_slept_is_not_sent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: str
) -> None:
    """CLOCK_MONOTONIC stands still meanwhile: for that clock the start is not late."""

    def sleep_for_a_night(line: SimulatedBus) -> None:
        line.slept += 8 * 3600

    check_not_sent(monkeypatch, tmp_path, model, sleep_for_a_night)


def test_looks_that_take_their_time_are_no_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    class Sleepy(Own):
        """It is waited for."""

        @verb
        def start(self, direction: Direction | None = None) -> Script[None]:
            """Start the motor."""
            for _ in range(20):
                yield from wait(1.0)
                yield from read(self.speed)
            yield from write(self.ratio, 1)

    line = SimulatedBus(monkeypatch, simulated(Sleepy(1)))
    line.attach(Sleepy(1, confirmed=1)).start()
    assert len(writes(line)) == 1


class Looking(Own):
    """One whose start looks at it twenty times."""

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor."""
        for _ in range(20):
            yield from read(self.speed)
        yield from write(self.ratio, 1)


@pytest.mark.parametrize(("more", "is_sent"), [(0.25, True), (0.35, False)])
def test_looks_may_take_as_long_as_their_silences_and_their_characters_do(
    monkeypatch: pytest.MonkeyPatch, more: float, is_sent: bool
) -> None:
    """Twice the silence of 100 ms, and 64 characters, beside the time-out: twenty that take more are late."""
    line = SimulatedBus(monkeypatch, simulated(Looking(1)))
    drive = line.attach(Looking(1, confirmed=1, silence=0.1))
    line.bus.check_identity(drive)
    line.queue_time = drive.response_timeout + more - EXCHANGE_TIME
    if is_sent:
        drive.start()
    else:
        with pytest.raises(Expired):
            drive.start()
    assert len(line.written) == is_sent


class Resting(Own):
    """One that is given rests of five seconds."""

    least_interval = 5.0


@pytest.mark.parametrize(("waits", "is_sent"), [(5.9, True), (6.1, False)])
def test_the_rest_of_a_drive_makes_no_write_late(
    monkeypatch: pytest.MonkeyPatch, waits: float, is_sent: bool
) -> None:
    line = SimulatedBus(monkeypatch, simulated(Resting(1)))
    drive = line.attach(Resting(1, confirmed=1))
    line.bus.check_identity(drive)
    line.queue_time = waits
    if is_sent:
        drive.write(drive.ratio, 3.0)
    else:
        with pytest.raises(Expired):
            drive.write(drive.ratio, 3.0)
    assert len(line.written) == is_sent


def test_writes_that_take_their_time_are_no_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ramp has more of them than one after another take in the time of one call."""
    line, drive, _ = one(monkeypatch, YD1000(1))
    drive.set_frequency(1)
    before = len(writes(line))
    ramp(drive, 51, rate=0.5, every=1)
    assert len(writes(line)) - before == 100
    assert 100 * EXCHANGE_TIME > 1.0  # the expiry of a call


@table("expiry", [0, -1, float("nan"), float("inf"), 10**30, True, "1"])
def test_an_expiry_that_is_none_is_refused(expiry: Any) -> None:
    with pytest.raises(ValueError, match=r"expiry = .* is not a number of seconds above 0"):
        Bus("/dev/none", expiry=expiry)


# ---- what is said of what was sent ----


def test_a_port_that_is_lost_after_a_confirmed_start(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)

    def lost(request: Message) -> bytes | None:
        if first(line, 0, STARTS["invt-che"]) is not None and not is_write(request):
            raise LineError("hall", "the port was lost (hung up)")
        return None

    line.answers = lost
    with pytest.raises(Unconfirmed, match=r"control = FORWARD took effect: it was confirmed, but .*lost"):
        drive.start()


def test_a_port_that_is_lost_when_a_write_is_read_back(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    line.bus.check_identity(drive)

    def lost(request: Message) -> bytes | None:
        if writes(line) and not is_write(request):
            raise LineError("hall", "the port was lost (hung up)")
        return None

    line.answers = lost
    outcome = drive.try_write(drive.setpoint, 10.0)
    assert outcome.effect is Effect.UNCONFIRMED
    with pytest.raises(Unconfirmed, match="confirmed, but not read back"):
        assert outcome.value


def test_a_drive_that_is_taken_off_while_it_is_written_to(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    line.bus.check_identity(drive)
    Meanwhile(line, 1, lambda: line.bus.detach(drive))
    with pytest.raises(Unconfirmed, match=r"confirmed, but not read back: .*not attached"):
        drive.write(drive.setpoint, 10.0)


# ---- interruptions ----

OF_TWO_WRITES = ("erman-er-g-220", "invt-che")  # START is taken back too, or a jog stopped


@every_family
@pytest.mark.parametrize("all_of_them", [False, True])
def test_a_stop_that_is_interrupted_is_sent_once_more(
    monkeypatch: pytest.MonkeyPatch, model: str, all_of_them: bool
) -> None:
    line, drive, _ = one(monkeypatch, MAKE[model](1))
    drive.set_frequency(20)
    drive.start()
    begun = len(line.frames)
    pressed: list[Message] = []

    def press(request: Message) -> bytes | None:
        if len(line.frames) > begun and not pressed:
            pressed.append(request)
            raise KeyboardInterrupt
        return None

    line.answers = press
    with pytest.raises(KeyboardInterrupt) as interruption:
        line.bus.stop_all() if all_of_them else drive.stop()
    stops = [write for write in writes(line, begun) if STOPS[model](write)]
    assert len(stops) == 2
    assert interruption.value.__notes__ == [
        f"{drive.name}: the stop was sent {'2 to 3' if model in OF_TWO_WRITES else '1 to 2'} times; "
        "the motor is not seen to stand"
    ]


def test_an_interrupted_stop_ends_a_jog_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """That the motor turns is not looked at any more: nothing says that it does not jog."""
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.jog()
    begun = len(writes(line))

    def press(request: Message) -> bytes | None:
        if len(writes(line)) == begun + 1:
            raise KeyboardInterrupt
        return None

    line.answers = press
    with pytest.raises(KeyboardInterrupt):
        drive.stop()
    sent = writes(line)[begun:]
    assert [write.data for write in sent] == [b"\0\5", b"\0\5", b"\0\x08"]
    assert [request for request, _ in line.frames[-3:]] == sent


class Careful(Own):
    """One whose stop looks at it before, and waits before the last write."""

    model = "careful"
    title = "OWN 3"

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor."""
        ratio = yield from read(self.ratio)
        yield from write(self.run, 7 if ratio else 0)
        yield from wait(2)
        yield from write(self.run, 9)


class Restless(Own):
    """One whose stop reads without a wait, and never sees it stand."""

    model = "restless"
    title = "OWN 4"

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor."""
        yield from insist(self.run, 0)
        while (yield from read(self.ratio)) >= 0:
            pass


def test_a_stop_that_reads_without_a_wait_keeps_no_other_one_from_being_repeated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sims: list[Any] = [simulated(Restless(1)), simulated(InvtCHE(2, maximum_frequency=50))]
    line = SimulatedBus(monkeypatch, *sims)
    restless, other = (line.attach(sim.drive) for sim in sims)
    other.set_frequency(20)
    other.start()
    line.bus.check_identity(restless)
    begun, heard = len(line.frames), line.seconds + 1.0
    line.deafens = lambda request: request.address == 2 and line.seconds < heard
    found = line.bus.stop_all(seconds=12)
    assert {name: stopped.seen for name, stopped in found.items()} == {
        restless.name: Seen.SENT,
        other.name: Seen.STOPPED,
    }
    assert [request.address for request in writes(line, begun)][:4] == [1, 2, 2, 2]


def test_an_interrupted_stop_that_looks_first_is_sent_and_what_it_waits_for_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line = SimulatedBus(monkeypatch, simulated(Careful(1)))
    drive = line.attach(Careful(1))
    drive.write(drive.ratio, 3.0)
    line.bus.check_identity(drive)
    begun, pressed = len(line.frames), [KeyboardInterrupt()]

    def press(request: Message) -> bytes | None:
        if pressed:
            raise pressed.pop()
        return None

    line.answers = press
    with pytest.raises(KeyboardInterrupt) as interruption:
        drive.stop()
    assert [write.data for write in writes(line, begun)] == [b"\0\7"]
    assert interruption.value.__notes__ == [
        f"{drive.name}: the stop was sent 1 times; the motor is not seen to stand"
    ]


def test_a_second_interruption_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    line.bus.check_identity(drive)

    def press(request: Message) -> bytes | None:
        raise KeyboardInterrupt

    line.answers = press
    with pytest.raises(KeyboardInterrupt) as interruption:
        drive.stop()
    assert len(writes(line)) == 2
    assert interruption.value.__notes__ == [
        f"{drive.name}: the stop was sent 0 to 2 times; the motor is not seen to stand"
    ]


@pytest.mark.parametrize(
    ("moment", "note"),
    [
        ("look", "the start was not sent"),
        ("start", "control = FORWARD may have been sent; its effect is unknown"),
        ("after", "control = FORWARD was sent and confirmed, but its effect was not seen"),
    ],
)
def test_a_start_that_is_interrupted_says_what_was_sent(
    monkeypatch: pytest.MonkeyPatch, moment: str, note: str
) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)

    def press(request: Message) -> bytes | None:
        is_start = is_write(request) and STARTS["invt-che"](request)
        was_sent = first(line, 0, STARTS["invt-che"]) is not None
        if {"look": True, "start": is_start, "after": was_sent and not is_start}[moment]:
            raise KeyboardInterrupt
        return None

    line.answers = press
    with pytest.raises(KeyboardInterrupt) as interruption:
        drive.start()
    assert interruption.value.__notes__ == [f"{drive.name}: {note}"]


# ---- one drive, one bus ----


def test_a_drive_is_on_one_bus_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    other = SimulatedBus(monkeypatch)
    with pytest.raises(ValueError, match=r"invt-che@1 is on the bus at hall: detach it there first"):
        other.attach(drive)
    assert other.bus.drives == []
    drive.state()  # its verbs still go over the first
    line.bus.detach(drive)
    other.attach(drive)
    other.bus.close()
    line.attach(drive)  # the other one is closed


def test_a_drive_is_attached_to_the_next_bus_while_its_last_one_closes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """That one lets go of it afterwards: it stays on the next."""
    line, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    before = line.bus
    free = before._attached.free
    monkeypatch.setattr(before._attached, "free", lambda: None)
    before.close()
    after = SimulatedBus(monkeypatch, sim)
    after.attach(drive)
    free()
    assert drive.bus is after.bus
    with pytest.raises(ValueError, match="is on the bus at hall: detach it there first"):
        SimulatedBus(monkeypatch).attach(drive)
    drive.stop()
    assert line.written == []
    assert len(after.written) == 1


def test_a_drive_that_another_thread_takes_off_meanwhile_is_not_taken_off_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    latches = line.bus._latches
    await_stops = latches.await_stops

    def detach_meanwhile(drives: Any = None) -> None:
        monkeypatch.setattr(latches, "await_stops", await_stops)
        line.bus.detach(drive)

    monkeypatch.setattr(latches, "await_stops", detach_meanwhile)
    with pytest.raises(NotAttached, match="is not attached"):
        line.bus.detach(drive)
    line.attach(drive)


def test_drives_of_a_bus_that_was_closed_are_on_none(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1))
    line.bus.close()
    assert drive.bus is None


def test_many_threads_attach_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    line = SimulatedBus(monkeypatch)
    together = threading.Barrier(8)
    add, inside, most = line.bus._exchanges.add, set[str](), 0

    def slow(drive: Drive) -> None:
        nonlocal most
        inside.add(drive.name)
        most = max(most, len(inside))
        sleep(0.001)  # the others may go on meanwhile
        inside.discard(drive.name)
        add(drive)

    monkeypatch.setattr(line.bus._exchanges, "add", slow)
    outcomes: list[str] = []

    def attach(address: int) -> None:
        together.wait(120)
        try:
            line.attach(InvtCHE(address))
            outcomes.append("attached")
        except ValueError:
            outcomes.append("taken")

    for _ in range(20):
        outcomes.clear()
        threads = [threading.Thread(target=attach, args=[1 + number % 4]) for number in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(120)
        assert sorted(outcomes) == ["attached"] * 4 + ["taken"] * 4
        assert sorted(drive.address for drive in line.bus.drives) == [1, 2, 3, 4]
        for drive in line.bus.drives:
            line.bus.detach(drive)
    assert most == 1


def test_a_silent_drive_may_not_be_started_however_it_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    line.deafens = lambda request: True
    with pytest.raises(Unconfirmed):
        drive.stop(seconds=1)
    with pytest.raises(NoReply):
        drive.start()
    assert first(line, 0, STARTS["invt-che"]) is None


class Hanging(logging.Handler):
    """A handler whose disk hangs."""

    def __init__(self, hang: Callable[[], None]) -> None:
        super().__init__()
        self._hang = hang

    def emit(self, record: logging.LogRecord) -> None:
        self._hang()


def test_a_log_that_hangs_keeps_no_stop_back(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nor a ledger that others hold: one drive's records do not stand in another one's way."""
    line = SimulatedBus(monkeypatch, *(simulated(Own(number)) for number in (1, 2)), audit=tmp_path / "audit")
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
        assert hangs.is_set()
        assert len(writes(line)) == 4
    finally:
        released.set()
        logging.getLogger("multidrop").removeHandler(handler)
        line.bus.close()
