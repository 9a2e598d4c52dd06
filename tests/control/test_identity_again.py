"""A drive that did not answer may be another now: the next start looks again; a stop does not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from examples import usually
from lines import line, plant, polled, until
from motors import MAKE, ReceivedRequests
from simulated_bus import SimulatedBus, is_write, one

from multidrop import Bus, Drive, InnovertIBD, InvtCHE, NoReply, Poller, WriteForbidden
from multidrop.control import records
from multidrop.control.outcome import Seen
from multidrop.core import PAUSE_NS, Completion, Exchange, Framing, Message, build_reply
from multidrop.drive import Script, write
from multidrop.drive.register import Kept, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import CheckAgain
from multidrop.sim import MotorDrive, Simulator, Wire, simulated
from multidrop.transport import clock

every_family = pytest.mark.parametrize("model", usually(*MAKE))
GOODRIVE = 0x010A  # what another of INVT's series says it is, where a CHE says 0101H


@contextmanager
def known(model: str) -> Iterator[tuple[Bus, Any, ReceivedRequests]]:
    """One drive on a line of its own, which was found to be what it is said to be."""
    sim = simulated(MAKE[model](1))
    assert isinstance(sim, MotorDrive)
    sim.motor.acceleration_time = sim.motor.deceleration_time = 0.1
    received = ReceivedRequests(sim)
    with Simulator([Wire([sim], unpaced=True)]) as simulator, Bus(simulator.wires[0].path) as bus:
        drive = bus.attach(MAKE[model](1))
        bus.check_identity(drive)
        yield bus, drive, received


def be_silent(bus: Bus, drive: Any, received: ReceivedRequests) -> None:
    received.loses = lambda request: True
    with pytest.raises(NoReply):
        drive.read(next(register for register in drive.registers.values() if register.readable))
    until(lambda: len(received.requests) == bus.statistics().counters.sent)  # the last is heard late perhaps
    received.loses = lambda request: False
    received.requests.clear()


@pytest.mark.slow
def test_another_drive_in_the_place_of_a_known_one_is_not_started() -> None:
    with known("invt-che") as (bus, drive, received):
        drive.set_frequency(10)
        be_silent(bus, drive, received)
        received.sim["device"] = GOODRIVE
        for move in (drive.start, drive.jog, lambda: drive.set_frequency(20)):
            with pytest.raises(WriteForbidden, match="010AH"):
                move()
        assert received.requests
        assert received.writes == []


@pytest.mark.slow
@every_family
def test_a_drive_that_was_silent_is_looked_at_once_before_the_next_write(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "LEAST_INTERVAL", 0.0)  # s between writes of one register to an EEPROM
    with known(model) as (bus, drive, received):
        looks: list[str] = []
        monkeypatch.setattr(type(drive).identify, "_script", lambda drive: iter(looks.append("look") or ()))
        before = bus.peers[drive].silences
        drive.set_frequency(10)
        assert looks == [] or bus.peers[drive].silences > before  # on a busy machine
        looks.clear()
        be_silent(bus, drive, received)
        drive.set_frequency(20)
        assert looks == ["look"]


@every_family
@pytest.mark.usefixtures("_turns_awaited")
@pytest.mark.parametrize("pause", ["idle", "asleep", "read since"])
def test_a_drive_of_which_nothing_was_heard_for_ten_seconds_is_looked_at_once(
    model: str, pause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "LEAST_INTERVAL", 0.0)
    with known(model) as (bus, drive, _received):
        drive.set_frequency(10)
        looks: list[str] = []
        look = type(drive).identify._script
        monkeypatch.setattr(
            type(drive).identify, "_script", lambda drive: looks.append("look") or look(drive)
        )
        if pause == "read since":  # which says nothing of who answers
            bus.peer(drive).c.answered_ns -= 2 * PAUSE_NS
            drive.read(next(register for register in drive.registers.values() if register.readable))
        else:
            for name in ("boottime_ns", "now_ns")[: 1 + (pause == "idle")]:
                at_ns = getattr(clock, name)
                monkeypatch.setattr(clock, name, lambda at_ns=at_ns: at_ns() + 2 * PAUSE_NS)
        drive.set_frequency(20)
        assert looks == ["look"]


@every_family
def test_a_stop_of_a_drive_that_was_idle_asks_nothing_first(model: str) -> None:
    with known(model) as (bus, drive, received):
        bus.peer(drive).c.answered_ns -= 2 * PAUSE_NS
        received.requests.clear()
        drive.stop()
        assert received.requests[0] == received.writes[0]


@pytest.mark.slow
@every_family
def test_a_stop_of_a_drive_that_was_silent_asks_nothing_first(model: str) -> None:
    with known(model) as (bus, drive, received):
        drive.set_frequency(10)
        drive.start()
        be_silent(bus, drive, received)
        drive.stop()
        assert received.requests[0] == received.writes[0]


def _asleep(bus: Bus, drive: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    at_ns = clock.boottime_ns
    monkeypatch.setattr(clock, "boottime_ns", lambda: at_ns() + 2 * PAUSE_NS)


def _idle_and_asleep(bus: Bus, drive: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """For six seconds each."""
    now_ns, boottime_ns = clock.now_ns, clock.boottime_ns
    monkeypatch.setattr(clock, "now_ns", lambda: now_ns() + 6 * PAUSE_NS // 10)
    monkeypatch.setattr(clock, "boottime_ns", lambda: boottime_ns() + 12 * PAUSE_NS // 10)


def _idle(bus: Bus, drive: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bus.peer(drive).c.answered_ns -= 2 * PAUSE_NS
    at_ns = clock.now_ns
    monkeypatch.setattr(clock, "now_ns", lambda: at_ns() + 2 * PAUSE_NS)
    _asleep(bus, drive, monkeypatch)  # both clocks go on


def _read_since(bus: Bus, drive: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bus.peer(drive).c.answered_ns -= 2 * PAUSE_NS
    drive.read(next(register for register in drive.registers.values() if register.readable))


def _on_another_port(bus: Bus, drive: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bus.line.reopen()


@pytest.mark.usefixtures("_turns_awaited")
@pytest.mark.parametrize("model", ["innovert-ibd", "delixi-native"])
@pytest.mark.parametrize("lose", [_asleep, _idle, _idle_and_asleep, _read_since, _on_another_port])
def test_a_setpoint_that_cannot_be_read_is_forgotten_once_the_drive_may_have_lost_its_power(
    model: str, lose: Callable[[Bus, Any, pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asked or not: nobody has seen then whether it was there all the time."""
    with known(model) as (bus, drive, received):
        drive.set_frequency(10)
        received.requests.clear()
        lose(bus, drive, monkeypatch)
        with pytest.raises(WriteForbidden, match="cannot say its setpoint: call set_frequency before start"):
            drive.start()
        assert received.writes == []
        drive.set_frequency(10)
        drive.start()


@pytest.mark.slow
@pytest.mark.parametrize("model", ["innovert-ibd", "delixi-native"])
def test_a_setpoint_is_forgotten_where_the_look_before_start_ends_a_long_silence(model: str) -> None:
    with known(model) as (bus, drive, received):
        drive.set_frequency(10)
        be_silent(bus, drive, received)
        bus.peer(drive).c.answered_ns -= 2 * PAUSE_NS
        with pytest.raises(WriteForbidden, match="cannot say its setpoint: call set_frequency before start"):
            drive.start()
        assert received.writes == []


@pytest.mark.usefixtures("_turns_awaited")
@pytest.mark.parametrize("model", ["innovert-ibd", "delixi-native"])
def test_a_setpoint_that_was_written_through_another_bus_is_not_known(model: str) -> None:
    with known(model) as (bus, drive, received):
        drive.set_frequency(10)
        bus.detach(drive)
        bus.attach(drive)
        received.requests.clear()
        with pytest.raises(WriteForbidden, match="cannot say its setpoint"):
            drive.start()
        assert received.writes == []


@pytest.mark.slow
@pytest.mark.parametrize("model", ["innovert-ibd", "delixi-native"])
def test_a_setpoint_is_kept_where_one_reply_was_lost(model: str) -> None:
    with known(model) as (bus, drive, received):
        drive.set_frequency(10)
        be_silent(bus, drive, received)
        drive.start()


@pytest.mark.slow
def test_what_polling_missed_counts_too() -> None:
    """Also while the drive was interrupted, its line was polled: nobody has to ask by hand."""
    sim = simulated(MAKE["invt-che"](1))
    assert isinstance(sim, MotorDrive)
    received = ReceivedRequests(sim)
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        drive = InvtCHE(1, maximum_frequency=50)
        hall = line(simulator.wires[0].path, polled(drive, [drive.registers["status"]], 0.02))
        with Poller(plant(hall)) as poller:
            bus = poller.bus(hall.name)
            bus.check_identity(drive)
            received.loses = lambda request: True
            until(lambda: bus.peers[drive].silences > 0)
            received.loses = lambda request: False
            sim["device"] = GOODRIVE
            with pytest.raises(WriteForbidden, match="010AH"):
                drive.start()
    assert received.writes == []


# ---- drives that were taken off, and attached again ----


def test_a_drive_that_was_taken_off_is_asked_again_before_it_is_moved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bus, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(10)
    bus.bus.detach(drive)
    bus.attach(drive)
    sim["device"] = GOODRIVE
    with pytest.raises(WriteForbidden, match="010AH"):
        drive.start()
    assert len(bus.written) == 1


def test_a_drive_that_was_taken_off_is_asked_again_before_its_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """That nothing was found against a stop says nothing of what is there now."""
    bus, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    odd = [build_reply(Framing.RTU, Message(1, 3, data=bytes([0, device]))) for device in (3, 4)]
    bus.answers = lambda request: odd.pop(0) if odd else None
    drive.stop()  # no two answers were the same
    begun = len(bus.written)
    bus.bus.detach(drive)
    bus.attach(drive)
    sim["device"] = GOODRIVE
    with pytest.raises(WriteForbidden, match="no stop was sent"):
        drive.stop()
    assert len(bus.written) == begun


def test_a_suspicion_of_a_drive_that_was_taken_off_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    bus, drive, sim = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    sim["device"] = GOODRIVE
    check = bus.bus._writer.identity_check
    for _ in range(2):  # the second one would be proof
        with pytest.raises(CheckAgain):
            check.check_before_stop(drive)
        bus.bus.detach(drive)
        bus.attach(drive)


# ---- the looks themselves ----


class Mute(Drive):
    """A drive of a user's own, whose class cannot tell what it is."""

    model = "mute"
    title = "OWN 5"
    speed = reading(0x10, "rpm")
    run = setting(0x20, kept=Kept.RAM)

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor."""
        yield from write(self.run, 0)


@pytest.mark.parametrize("is_lost", [False, True])
def test_something_is_read_once_before_the_first_stop_and_waits_for_nothing(
    monkeypatch: pytest.MonkeyPatch, is_lost: bool
) -> None:
    """So that an adapter's echo is known before it could pass for the drive's confirmation."""
    bus = SimulatedBus(monkeypatch, simulated(Mute(1)))
    drive, carry_out = bus.attach(Mute(1)), bus.carry_out
    asked: list[tuple[bool, bool]] = []

    def note(exchange: Exchange, **times: Any) -> Completion:
        asked.append((is_write(exchange.request), bool(exchange.c.insists)))
        return carry_out(exchange, **times)

    monkeypatch.setattr(bus, "carry_out", note)
    bus.loses = lambda request: is_lost and len(asked) == 1
    drive.stop()
    assert asked[:2] == [(False, True), (True, True)]
    asked.clear()
    if not is_lost:
        drive.stop()
        assert asked[0] == (True, True)
    bus.queue = object()  # the port was opened again
    drive.read(drive.speed)
    asked.clear()
    drive.stop()
    assert asked[0] == (True, True)  # it has answered since


@pytest.mark.parametrize("is_in_step", [True, False])
def test_the_look_before_a_stop_counts_where_it_can_be_no_other_request_s_answer(
    monkeypatch: pytest.MonkeyPatch, is_in_step: bool
) -> None:
    bus, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))

    def fall_out_of_step(request: Message) -> bytes | None:
        if not is_in_step:
            bus.bus.peer(drive).c.history.ended[10] = 1
        return None

    bus.answers = fall_out_of_step
    drive.stop()
    assert [is_write(request) for request, _ in bus.frames[:2]] == [False, True]
    assert bus.bus.knows_identity(drive) is is_in_step


def test_a_family_that_little_proves_is_no_reason_to_withhold_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """An IBD is recognised by places that its manual does not name."""
    bus = SimulatedBus(monkeypatch, simulated(InnovertIBD(1)))
    bus.attach(InvtCHE(1))

    def refuse(request: Message) -> bytes | None:
        is_look = request.start == InvtCHE.device.address
        refusal = Message(1, request.function, request.start, exception=2)
        return build_reply(Framing.RTU, refusal) if is_look else None

    bus.answers = refuse
    (stopped,) = bus.bus.stop_all(seconds=1).values()
    assert stopped.seen is not Seen.FAILED
    assert bus.written[0].startswith("01 06 10 00 00 05")


@pytest.mark.parametrize(("share", "looks"), [(0.6, 0), (1.1, 1)])
def test_a_drive_that_was_asked_just_now_is_not_looked_at_again(
    monkeypatch: pytest.MonkeyPatch, share: float, looks: int
) -> None:
    bus, drive, _ = one(monkeypatch, InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(10)
    bus.sleep(share * PAUSE_NS / 1e9)
    begun = len(bus.frames)
    drive.set_frequency(20)
    asked = [is_write(request) for request, _ in bus.frames[begun:]]
    assert asked[: looks + 1] == [False] * looks + [True]
