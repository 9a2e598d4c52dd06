"""Verbs as data, carried out on simulated drives: what is sent, in which order, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest
from declared_families import NAMES, class_of, document_of
from simulated_bus import SimulatedBus, one

from multidrop.drive import Condition, Direction, Drive
from multidrop.errors import DriveRefused, NotDone, Refused, Unconfirmed, Unsupported
from multidrop.sim.declared import SimulatedDeclared

OPTIONS: dict[str, dict[str, float]] = {"abb": {"reference_maximum": 50}, "fc": {"reference_maximum": 50}}
ADDRESS = 7


def made(name: str, **changes: Any) -> Drive:
    options = OPTIONS.get(name, {}) | {"confirmed": 1} | changes
    return class_of(document_of(name))(ADDRESS, name="pump", **options)


def on_a_bus(monkeypatch: pytest.MonkeyPatch, name: str, **changes: Any) -> tuple[SimulatedBus, Any, Any]:
    line, drive, sim = one(monkeypatch, made(name, **changes))
    assert isinstance(sim, SimulatedDeclared)
    sim.motor.acceleration_time = sim.motor.deceleration_time = 2.0
    return line, drive, sim


def pass_time(line: SimulatedBus, seconds: float) -> None:
    line.sleep(seconds)
    for sim in line.sims:
        sim.pass_time(line.seconds)


def words(line: SimulatedBus) -> list[str]:
    """Return what was written, as address and value in hex."""
    return ["".join(frame.split()[2:4]) + " " + "".join(frame.split()[4:6]) for frame in line.written]


# Words by the documents: of a start at 20 Hz, a stop, a coast and a reset.
SENT: dict[str, dict[str, list[str]]] = {
    "abb": {
        "start": ["0001 1F40", "0000 0476", "0000 0477", "0000 047F"],
        "stop": ["0000 0476"],
        "coast": ["0000 0474"],
        "reset_fault": ["0000 04F6", "0000 0476"],
    },
    "fc": {
        "start": ["C359 199A", "C34F 047C"],
        "stop": ["C34F 043C"],
        "coast": ["C34F 0434"],
        "emergency_stop": ["C34F 042C"],
        "reset_fault": ["C34F 04BC", "C34F 043C"],
    },
    "enum": {
        "start": ["2001 07D0", "2000 0001"],
        "stop": ["2000 0005"],
        "coast": ["2000 0006"],
        "reset_fault": ["2000 0007"],
    },
    "coil": {
        "start": ["0002 00C8", "0000 FF00"],
        "stop": ["0000 0000"],
        "reset_fault": ["0009 FF00"],
    },
}


@pytest.mark.parametrize("name", NAMES)
def test_start_and_stop_send_the_documents_words(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, name)
    assert drive.state().condition is Condition.STOPPED
    drive.set_frequency(20)
    drive.start()
    assert words(line) == SENT[name]["start"]
    pass_time(line, 5)
    assert drive.state().condition is Condition.RUNNING
    assert sim.motor.energised
    assert sim.motor.frequency == pytest.approx(20, abs=0.01)
    line.frames.clear()
    drive.stop()
    assert words(line) == SENT[name]["stop"]
    assert drive.state().condition is Condition.STOPPED
    assert sim.motor.frequency == 0
    assert sim.unknown_words == 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("verb", ["coast", "emergency_stop"])
def test_other_stops_send_the_documents_words(name: str, verb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, name)
    drive.set_frequency(20)
    drive.start()
    pass_time(line, 5)
    line.frames.clear()
    if verb not in SENT[name]:
        with pytest.raises(Unsupported):
            getattr(drive, verb)()
        return
    getattr(drive, verb)()
    assert words(line) == SENT[name][verb]
    assert not sim.motor.energised


@pytest.mark.parametrize("name", NAMES)
def test_a_trip_is_seen_and_reset_before_the_next_start(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, name)
    drive.set_frequency(20)
    drive.start()
    pass_time(line, 5)
    sim.trip(1)
    assert drive.state().condition is Condition.FAULT
    line.frames.clear()
    with pytest.raises(Refused, match="fault"):
        drive.start()
    assert words(line) == []
    drive.reset_fault()
    assert words(line) == SENT[name]["reset_fault"]
    assert not sim.motor.energised
    for _ in range(3):  # the shaft runs out; in ten seconds unheard the drive may have lost its setpoint
        pass_time(line, 5)
        state = drive.state()
    assert state.condition is Condition.STOPPED
    drive.start()
    pass_time(line, 5)
    assert sim.motor.frequency == pytest.approx(20, abs=0.01)


@pytest.mark.parametrize("name", NAMES)
def test_a_reset_is_refused_while_it_runs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, name)
    drive.set_frequency(20)
    drive.start()
    pass_time(line, 5)
    line.frames.clear()
    with pytest.raises(Refused, match=r"runs|turns"):
        drive.reset_fault()
    assert words(line) == []
    assert sim.motor.energised


@pytest.mark.parametrize("name", NAMES)
def test_a_start_without_a_setpoint_is_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _sim = on_a_bus(monkeypatch, name)
    with pytest.raises(Refused, match="set_frequency before start"):
        drive.start()
    assert words(line) == []


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("hz", [-1.0, 50.5, 1e9, float("nan"), float("inf")])
def test_a_setpoint_outside_is_refused(name: str, hz: float, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _sim = on_a_bus(monkeypatch, name)
    with pytest.raises(Refused):
        drive.set_frequency(hz)
    assert words(line) == []


@pytest.mark.parametrize("name", NAMES)
def test_an_unconfirmed_drive_is_moved_by_nothing_and_stopped(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, drive, sim = on_a_bus(monkeypatch, name, confirmed=0)
    moves = [lambda: drive.set_frequency(20), drive.start, drive.reset_fault]
    for move in moves:
        with pytest.raises(Refused, match="confirmed = 1"):
            move()
    assert words(line) == []
    sim.motor.target = 20
    sim.motor.run(1)
    drive.stop()
    assert words(line)[-1:] == SENT[name]["stop"]
    assert not sim.motor.energised


@pytest.mark.parametrize("name", NAMES)
def test_a_start_whose_reply_is_lost_is_sent_once(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _sim = on_a_bus(monkeypatch, name)
    drive.set_frequency(20)
    last = SENT[name]["start"][-1]
    line.loses = lambda request: words(line)[-1:] == [last] and request.function in (5, 6)
    line.frames.clear()
    with pytest.raises(Unconfirmed):
        drive.start()
    assert words(line).count(last) == 1


@pytest.mark.parametrize("name", NAMES)
def test_a_stop_whose_reply_is_lost_thrice_is_sent_again(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, name)
    drive.set_frequency(20)
    drive.start()
    pass_time(line, 5)
    line.frames.clear()
    lost: list[object] = []

    def loses(request: Any) -> bool:
        if request.function in (5, 6) and len(lost) < 3:
            lost.append(request)
            return True
        return False

    line.loses = loses
    drive.stop()
    assert words(line) == SENT[name]["stop"] * 4
    assert not sim.motor.energised


@pytest.mark.parametrize("name", NAMES)
def test_a_trip_while_it_starts_is_told(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, name)
    drive.set_frequency(20)
    last = SENT[name]["start"][-1]
    answer = sim.answer

    def trips(request: Any, now: float) -> Any:
        reply = answer(request, now)
        if request.function in (5, 6) and words(line)[-1:] == [last]:
            sim.trip(1)
        return reply

    sim.answer = trips
    with pytest.raises(NotDone, match="tripped"):
        drive.start()
    assert not sim.motor.energised


@pytest.mark.parametrize("name", NAMES)
def test_after_a_power_cycle_nothing_turns_and_a_start_asks_for_the_setpoint(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, drive, _sim = on_a_bus(monkeypatch, name)
    drive.set_frequency(20)
    drive.start()
    pass_time(line, 5)
    fresh = SimulatedDeclared(drive)
    fresh.motor.now = line.seconds
    line.sims = (fresh,)
    assert drive.state().condition is Condition.STOPPED
    assert not fresh.motor.energised
    setpoint = drive.register(drive.setpoint_name)
    if setpoint.readable:  # else the drive cannot say that it lost its setpoint
        with pytest.raises(Refused, match="set_frequency before start"):
            drive.start()


@pytest.mark.parametrize("name", NAMES)
def test_another_make_at_its_address_is_not_started(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, name)
    identity = type(drive).declared_verbs.identity
    for criterion in identity.criteria:
        sim[criterion.register] = 0
    with pytest.raises(Refused, match="it is no "):
        drive.set_frequency(20)
    assert words(line) == []
    drive.stop()  # a file's `identify` keeps no stop back
    assert words(line) == SENT[name]["stop"]


@pytest.mark.parametrize("name", NAMES)
def test_start_words_are_not_plainly_written(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _sim = on_a_bus(monkeypatch, name)
    last = SENT[name]["start"][-1]
    control = next(register for register in drive.registers.values() if register.harmless)
    raw = 1 if name == "coil" else int(last.split()[1], 16)
    with pytest.raises(Refused, match="verbs alone"):
        line.bus.write(drive, control, control.decode(raw))
    assert words(line) == []


@pytest.mark.parametrize("name", ["abb", "coil"])
def test_a_direction_without_words_is_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _sim = on_a_bus(monkeypatch, name)
    drive.set_frequency(20)
    line.frames.clear()
    with pytest.raises(Refused, match="no words for directions"):
        drive.start(Direction.REVERSE)
    assert words(line) == []


def test_directions_have_their_words(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, "fc")
    drive.set_frequency(20)
    line.frames.clear()
    drive.start(Direction.REVERSE)
    assert words(line) == ["C34F 847C"]
    pass_time(line, 5)
    assert sim.motor.frequency == pytest.approx(-20, abs=0.01)
    with pytest.raises(Refused, match="which way it turns"):
        drive.start()
    assert words(line) == ["C34F 847C"]


def test_without_a_direction_it_goes_on_as_it_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _sim = on_a_bus(monkeypatch, "enum")
    drive.set_frequency(20)
    drive.start(Direction.REVERSE)
    pass_time(line, 5)
    assert drive.state().direction is Direction.REVERSE
    line.frames.clear()
    drive.start()
    assert words(line) == ["2000 0002"]
    drive.stop()
    drive.start()
    assert words(line)[-1] == "2000 0001"


def test_a_jog_names_its_direction_and_ends_by_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, "enum")
    drive.set_frequency(20)
    with pytest.raises(Refused, match="name it"):
        drive.jog()
    drive.jog(Direction.FORWARD)
    pass_time(line, 2)
    assert sim.motor.frequency == pytest.approx(5, abs=0.01)
    line.frames.clear()
    with pytest.raises(Refused, match="may still jog"):
        drive.start()
    with pytest.raises(Refused, match="call stop"):
        drive.jog(Direction.FORWARD)
    assert words(line) == []
    drive.stop()
    drive.start()
    assert words(line)[-1] == "2000 0001"


@pytest.mark.slow
def test_an_else_of_a_stop_is_sent_when_the_motor_turns_on(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, "enum")
    sim.motor.target = 20
    sim.motor.run(1)
    pass_time(line, 5)
    sim.motor.stop = lambda: None  # deaf to 5, and not to 8
    line.loses = lambda request: False
    answer = sim.answer

    def obeys_the_second(request: Any, now: float) -> Any:
        if words(line)[-1:] == ["2000 0008"] and request.function == 6:
            sim.motor.coast()
        return answer(request, now)

    sim.answer = obeys_the_second
    drive.stop()
    assert words(line) == ["2000 0005", "2000 0008"]
    assert not sim.motor.energised


def test_a_start_that_stalls_half_way_takes_its_word_back(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, "abb")
    drive.set_frequency(20)
    sim["status"] = drive.status.decode(0x0231)  # ready, never ready to run
    line.frames.clear()
    with pytest.raises(Unconfirmed, match="ready_run"):
        drive.start()
    assert words(line) == ["0000 0476", "0000 0477", "0000 0476"]
    assert not sim.motor.energised


def test_a_stop_that_is_refused_in_a_fault_has_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, "enum")
    sim.trip(4)
    answer = sim.answer

    def refuses(request: Any, now: float) -> Any:
        if request.function == 6:
            return sim.refused(request, 4)
        return answer(request, now)

    sim.answer = refuses
    drive.stop()
    sim.motor.fault = 0
    sim.motor.target = 20
    sim.motor.run(1)
    pass_time(line, 3)
    with pytest.raises((DriveRefused, Unconfirmed)):
        drive.stop(seconds=2)


def test_a_fault_that_stands_after_a_reset_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, "enum")
    sim.trip(4)
    sim.motor.reset = lambda: None
    with pytest.raises(NotDone, match="oc1"):
        drive.reset_fault()
    assert words(line) == ["2000 0007"]


def test_a_setpoint_in_percent_needs_its_hundred(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = class_of(document_of("abb"))(ADDRESS, name="pump", confirmed=1)
    line, drive, _sim = one(monkeypatch, drive)
    with pytest.raises(Refused, match="declare reference_maximum = HZ"):
        drive.set_frequency(20)
    assert words(line) == []


def test_all_are_stopped_together(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = on_a_bus(monkeypatch, "fc")
    drive.set_frequency(20)
    drive.start()
    pass_time(line, 5)
    assert [str(stopped.seen) for stopped in line.bus.stop_all().values()] != []
    assert not sim.motor.energised
