"""A broadcast is sent only if all drives are of one confirmed family. A stop cancels earlier setpoints."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from line_driver import MS, LineDriver
from motors import MAKE, STARTS
from simulated_bus import SimulatedBus, all_stopped, che_drives, is_write, one
from tables import every_third, table
from toy import Status, Toy

from multidrop.control.call import written_before
from multidrop.control.outcome import Seen
from multidrop.control.records import read_audit
from multidrop.core import Completion, Exchange, Message
from multidrop.drive import Condition, Drive, Script, State
from multidrop.drive.register import Kept, command, setting
from multidrop.drive.verbs import verb
from multidrop.errors import (
    BusError,
    CancelledByStop,
    Expired,
    LineError,
    NoReply,
    PortLost,
    Unconfirmed,
    WriteForbidden,
)
from multidrop.families import MODELS, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.families.invt_che import CHEControl
from multidrop.sim import simulated
from multidrop.transport.exchange import Exchanges

BROADCASTING = [model for model, family in MODELS.items() if family.broadcasts]
every_broadcasting = pytest.mark.parametrize("model", BROADCASTING)


def line_of(*models: str) -> tuple[SimulatedBus, list[Any], list[Any]]:
    """Return a line with confirmed drives from address 1 on, and their simulations."""
    sims = [simulated(MAKE[model](address)) for address, model in enumerate(models, 1)]
    line = SimulatedBus(*sims)
    drives = [line.attach(sim.drive) for sim in sims]
    for drive in drives:
        line.bus.check_identity(drive)
    return line, drives, sims


def stop_of(drive: Any) -> Any:
    return drive.control.decode(drive.control.broadcast[0])


def broadcasts(line: SimulatedBus) -> list[Message]:
    return [request for request, _ in line.frames if request.address == 0]


def test_every_family_except_the_erman_declares_a_broadcast() -> None:
    assert set(BROADCASTING) == set(MODELS) - {"erman-er-g-220"}


@every_broadcasting
def test_a_stop_is_not_broadcast_to_drives_of_different_families(model: str) -> None:
    """One family's stop may start a motor of the other family. Both orders of the drives are tested."""
    models = deque(MAKE)
    models.rotate(-models.index(model))
    check_stopped_without_broadcast(*models)


def check_stopped_without_broadcast(*models: str) -> None:
    line, drives, sims = line_of(*models)
    for drive in drives:
        drive.set_frequency(20)
        drive.start()
    assert {each.seen for each in line.bus.stop_all().values()} == {Seen.STOPPED}
    assert broadcasts(line) == []
    assert not any(sim.motor.energised for sim in sims)


@every_broadcasting
def test_a_stop_is_broadcast_if_all_drives_are_of_one_family(model: str) -> None:
    line, drives, _ = line_of(model, model)
    line.bus.stop_all()
    (sent,) = broadcasts(line)
    drives[0].write(drives[0].control, stop_of(drives[0]))
    assert (sent.start, sent.data) == (line.frames[-2][0].start, line.frames[-2][0].data)


def test_a_stop_is_not_broadcast_to_a_family_without_broadcasts() -> None:
    check_stopped_without_broadcast("erman-er-g-220", "erman-er-g-220")


@pytest.mark.parametrize("models", [("erman-er-g-220", "erman-er-g-220"), ("invt-che", "yd1000")])
def test_stop_all_reports_failed_if_the_port_does_not_exist(models: tuple[str, str]) -> None:
    line, _, _ = line_of(*models)

    line.fails = lambda request: PortLost("hall", "there is no such port")
    assert {told.seen for told in line.bus.stop_all(seconds=1.0).values()} == {Seen.FAILED}


@pytest.mark.parametrize("seconds", [0, 0.05])
def test_a_lost_broadcast_stop_is_followed_by_single_stops(seconds: float) -> None:
    """Noise may damage the broadcast, which no drive answers."""
    line, _, sims = che_drives(5, runs_s=20)
    line.deafens = lambda request: request.address == 0
    line.bus.stop_all(seconds)
    assert len(broadcasts(line)) == 1
    line.sleep(60)
    assert all_stopped(line, sims)


class Quiet(Toy):
    """A drive whose only broadcast does not stop the motor."""

    model = "quiet"
    broadcasts = True
    identify = Drive.identify
    control = command(0x14, Status, broadcast=(0,), kept=Kept.RAM)
    frequency = setting(0x15, "Hz", step=0.01, span=(0, 50), broadcast=(0,), kept=Kept.RAM)

    @verb
    def state(self) -> Script[State]:
        yield from ()
        return State(Condition.STOPPED)


@pytest.mark.parametrize("confirmed", [0, 1])
def test_stop_all_does_not_broadcast_a_zero_setpoint(confirmed: int) -> None:
    """A setpoint of 0 is the only broadcast of this family, but does not stop a motor."""
    drives = [Quiet(address, confirmed=confirmed) for address in (1, 2)]
    line = SimulatedBus(*(simulated(drive) for drive in drives))
    for drive in drives:
        line.bus.check_identity(line.attach(drive))
    line.bus.stop_all(seconds=1)
    assert broadcasts(line) == []
    if confirmed:
        line.bus.broadcast(drives[0].frequency, 0.0)
        assert len(broadcasts(line)) == 1
    else:
        with pytest.raises(WriteForbidden, match="confirmed = 1"):
            line.bus.broadcast(drives[0].frequency, 0.0)
        assert broadcasts(line) == []


@every_broadcasting
def test_a_broadcast_stop_does_not_wait_for_late_replies(monkeypatch: pytest.MonkeyPatch, model: str) -> None:
    line, drives, _ = line_of(model, model)
    register = drives[0].control
    insists: list[bool] = []

    def carry_out(*given: Any, **options: Any) -> Completion:
        insists.append(options["insists"])
        return Completion()

    monkeypatch.setattr(Exchanges, "carry_out", carry_out)
    writer, raw = line.bus._writer, register.broadcast[0]
    writer.broadcast(drives[0], register, raw)
    writer.broadcast(drives[0], register, raw, line.bus._performer.call(drives[0]))
    assert insists == [True, False]


@pytest.mark.parametrize("is_sent", [False, True])
def test_a_broadcast_counts_as_sent_if_the_port_fails_after_sending(tmp_path: Path, is_sent: bool) -> None:
    audit = tmp_path / "audit"
    sims = [simulated(InvtCHE(address, maximum_frequency=50)) for address in (1, 2)]
    line = SimulatedBus(*sims, audit=audit)
    drives = [line.attach(sim.drive) for sim in sims]
    for drive in drives:
        line.bus.check_identity(drive)

    def lose(request: Message) -> bytes | None:
        lost = PortLost("hall", "the port was lost (hung up)")
        lost.is_sent = is_sent and request.address == 0
        raise lost

    line.answers = lose
    with pytest.raises(Unconfirmed if is_sent else PortLost):
        line.bus.broadcast(drives[0].control, stop_of(drives[0]))
    assert [entry["outcome"] for entry in read_audit(audit)] == ["unconfirmed"] * is_sent
    (seen,) = {told.seen for told in line.bus.stop_all(seconds=1.0).values()}
    assert seen is (Seen.SENT if is_sent else Seen.FAILED)
    line.bus.close()


@pytest.mark.parametrize("address", [1, 2])
def test_a_broadcast_is_refused_if_one_drive_is_of_another_family(address: int) -> None:
    """At the address of an INVT CHE's control word, a Goodrive has its setpoint."""
    sims = [simulated(InvtCHE(at, maximum_frequency=50)) for at in (1, 2)]
    sims[address - 1]["device"] = 0x010A
    line = SimulatedBus(*sims)
    drives = [line.attach(sim.drive) for sim in sims]
    with pytest.raises(WriteForbidden, match="010AH"):
        line.bus.broadcast(drives[0].control, stop_of(drives[0]))
    assert line.written == []


@every_broadcasting
@pytest.mark.parametrize("frames", every_third(range(1, 12)))
def test_a_broadcast_stop_cancels_a_start_in_progress(model: str, frames: int) -> None:
    line, drives, _ = line_of(model, model)
    drives[0].set_frequency(20)
    begun = len(line.frames)

    def broadcast_meanwhile(request: Message) -> bytes | None:
        if len(line.frames) == begun + frames:
            line.answers = lambda request: None
            line.bus.broadcast(drives[0].control, stop_of(drives[0]))
        return None

    line.answers = broadcast_meanwhile
    with suppress(BusError):
        drives[0].start()
    asked = [request for request, _ in line.frames[begun:]]
    after = [at for at, request in enumerate(asked) if request.address == 0]
    for request in asked[after[0] if after else len(asked) :]:
        assert request.address == 0 or not (is_write(request) and STARTS[model](request))


SETTING = [model for model in BROADCASTING if model.startswith(("inn", "invt", "yd"))]


def setpoint_of(drive: Any) -> Any:
    return drive.register(drive.setpoint_name)


@table("model", SETTING)
def test_only_stops_can_be_broadcast_after_leave_is_called(model: str) -> None:
    line, drives, _ = line_of(model, model)
    assert 0 in setpoint_of(drives[0]).broadcast
    line.bus.leave()
    with pytest.raises(CancelledByStop, match="the bus was closed"):
        line.bus.broadcast(setpoint_of(drives[0]), 0.0)
    line.bus.broadcast(drives[0].control, stop_of(drives[0]))  # stops are broadcast even after `leave`
    (sent,) = broadcasts(line)
    assert sent.start == drives[0].control.address


@pytest.mark.parametrize("moment", ["before it is sent", "while it waits for its turn"])
def test_a_setpoint_broadcast_is_cancelled_by_a_stop(monkeypatch: pytest.MonkeyPatch, moment: str) -> None:
    line, drives, _ = line_of("invt-che", "invt-che")
    line.sleep(60)  # after such a silence, the bus checks the identities again
    carry_out, begun = line.carry_out, len(line.frames)

    def stop_meanwhile(exchange: Exchange, **details: Any) -> Completion:
        waits = exchange.request.address == 0
        if waits if moment == "while it waits for its turn" else len(line.frames) == begun + 1:
            line.bus._latches.rise([drives[0]])
        return carry_out(exchange, **details)

    monkeypatch.setattr(line, "carry_out", stop_meanwhile)
    with pytest.raises(CancelledByStop, match=r"setpoint = 0\.00 %.*a stop was called"):
        line.bus.broadcast(drives[0].setpoint, 0.0)
    assert [request.address for request, _ in line.frames[begun:]] == [1, 2]
    assert line.written == []


def test_an_expired_setpoint_is_not_broadcast(tmp_path: Path) -> None:
    """The audit log must not record the write as possibly sent."""
    audit = tmp_path / "audit"
    sims = [simulated(InvtCHE(address, maximum_frequency=50)) for address in (1, 2)]
    line = SimulatedBus(*sims, audit=audit)
    drives = [line.attach(sim.drive) for sim in sims]
    with written_before(lambda: 0.0), pytest.raises(Expired):
        line.bus.broadcast(drives[0].setpoint, 0.0)
    line.queue_time = 2.0
    with pytest.raises(Expired):
        line.bus.broadcast(drives[0].setpoint, 0.0)
    line.bus.close()
    assert line.written == []
    assert audit.read_text(encoding="utf-8") == ""


def test_a_broadcast_does_not_expire_during_many_identity_checks() -> None:
    """The checks of 20 drives take longer than the expiry of one write."""
    line, drives, _ = line_of(*["invt-che"] * 20)
    line.sleep(60)
    line.queue_time = 0.1
    line.bus.broadcast(drives[0].setpoint, 0.0)
    assert len(broadcasts(line)) == 1


def test_a_setpoint_is_not_broadcast_if_a_drive_may_have_been_replaced() -> None:
    """After a long silence, the second drive is replaced by one of another family."""
    line, drives, sims = line_of("invt-che", "invt-che")
    line.sleep(60)
    sims[1]["device"] = 0x010A
    with pytest.raises(WriteForbidden, match="010AH"):
        line.bus.broadcast(drives[0].setpoint, 0.0)
    assert line.written == []


def test_a_broadcast_stop_counts_as_sent_if_the_port_is_then_lost() -> None:
    """The port is lost after the broadcast, so no stop is sent to a single drive."""
    line, _, _ = line_of("invt-che", "invt-che")
    lost = PortLost("hall", "the port was lost (hung up)")
    line.fails = lambda request: lost if broadcasts(line) and request.address else None
    for told in line.bus.stop_all(seconds=1.0).values():
        assert told.seen is Seen.SENT
        assert "sent 1 times, it was never confirmed" in told.why


def test_keyboard_interrupt_notes_count_the_broadcast_stop() -> None:
    line, _, _ = line_of("invt-che", "invt-che")

    line.fails = lambda request: KeyboardInterrupt() if broadcasts(line) and request.address else None
    with pytest.raises(KeyboardInterrupt) as interruption:
        line.bus.stop_all()
    told = "the stop was sent 1 to 2 times; the motor is not seen to stand"
    assert {*interruption.value.__notes__} == {f"invt-che@1: {told}", f"invt-che@2: {told}"}


def test_only_stops_and_zero_setpoints_can_be_broadcast() -> None:
    """A line with drives of two families allows no broadcast."""
    sims = [simulated(InvtCHE(1)), simulated(InvtCHE(2))]
    line = SimulatedBus(*sims)
    first, _ = (line.attach(sim.drive) for sim in sims)
    for value in set(CHEControl) - {CHEControl.STOP}:
        with pytest.raises(WriteForbidden, match="the manual does not allow it"):
            line.bus.broadcast(first.control, value)
    with pytest.raises(WriteForbidden, match="the manual does not allow it"):
        line.bus.broadcast(first.setpoint, 50.0)
    assert line.written == []
    found = line.bus.broadcast(first.setpoint, 0.0)
    assert line.written == ["00 06 20 00 00 00 83 DB"]
    assert {name: each.condition for name, each in found.items() if isinstance(each, State)} == {
        "invt-che@1": Condition.STOPPED,
        "invt-che@2": Condition.STOPPED,
    }
    line.attach(InnovertIBD(3))
    with pytest.raises(WriteForbidden, match="differ in family"):
        line.bus.broadcast(first.control, CHEControl.STOP)
    assert len(line.written) == 1


def test_a_broadcast_returns_an_error_for_each_silent_drive() -> None:
    sims = [simulated(InvtCHE(1)), simulated(InvtCHE(2))]
    line = SimulatedBus(*sims)
    for sim in sims:
        line.bus.check_identity(line.attach(sim.drive))
    line.deafens = lambda request: request.address == 2
    found = line.bus.broadcast(InvtCHE.control, CHEControl.STOP)
    assert line.written == ["00 06 10 00 00 05 4C D8"]
    (first, second) = found.values()
    assert isinstance(first, State)
    assert first.condition is Condition.STOPPED
    assert isinstance(second, NoReply)
    assert second.drive == "invt-che@2"


def test_a_broadcast_is_followed_by_the_turnaround_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    """The delay is at least 100 ms (serial-line guide V1.02, 2.4.1)."""
    line, _, _ = one(InvtCHE(1))
    made: list[Exchange] = []

    def keep(exchange: Exchange, **times: Any) -> Completion:
        made.append(exchange)
        return SimulatedBus.carry_out(line, exchange, **times)

    monkeypatch.setattr(line, "carry_out", keep)
    line.bus.broadcast(InvtCHE.control, CHEControl.STOP)
    stop, look = made[-2:]
    assert (stop.request.address, look.request.address) == (0, 1)
    driver = LineDriver()
    driver.send(stop)
    over = driver.now + 8 * stop.c.character_ns
    driver.send(look)
    assert driver.now == over + 100 * MS


def test_each_motor_is_seen_to_stop_after_a_broadcast() -> None:
    line, _, sims = che_drives(3, runs_s=1)
    begun = len(line.frames)
    stopped = line.bus.stop_all()
    assert line.frames[begun][1] == "00 06 10 00 00 05 4C D8"
    assert {each.seen for each in stopped.values()} == {Seen.STOPPED}
    assert all(each.seconds < 11 for each in stopped.values())  # all motors ramp down at the same time
    assert all_stopped(line, sims)


def test_each_drive_is_stopped_if_the_broadcast_fails() -> None:
    """The port is lost during the broadcast, and comes back."""
    line, _, sims = che_drives(2, runs_s=0)

    lost = LineError("hall", "the port was lost (hung up)")
    line.fails = lambda request: lost if request.address == 0 else None
    stopped = line.bus.stop_all()
    assert {each.seen for each in stopped.values()} == {Seen.STOPPED}
    assert {frame[:17] for frame in line.written} >= {"01 06 10 00 00 05", "02 06 10 00 00 05"}
    assert all_stopped(line, sims)


def test_stop_all_returns_a_result_for_each_drive() -> None:
    sims: list[Any] = [
        simulated(InvtCHE(1, maximum_frequency=50)),
        simulated(ErmanERG220(2)),
        simulated(InvtCHE(3)),
    ]
    line = SimulatedBus(*sims)
    for sim in sims:
        line.attach(sim.drive)
    sims[2]["device"] = 0x010A
    line.loses = lambda request: request.address == 2
    stopped = line.bus.stop_all()
    assert {name: each.seen for name, each in stopped.items()} == {
        "invt-che@1": Seen.STOPPED,
        "erman-er-g-220@2": Seen.SENT,
        "invt-che@3": Seen.FAILED,
    }
    assert "010AH" in stopped["invt-che@3"].why
    assert not any(frame.startswith("03 06") for frame in line.written)
    assert str(stopped["invt-che@1"]).startswith("invt-che@1: stopped after ")
