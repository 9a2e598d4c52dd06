"""A stop despite late replies, other threads and a closed port, through the real engine and a pty."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from lines import PATIENCE, LateWire, plant, polled, until
from lines import line as declared_line
from motors import MAKE, ReceivedRequests, at_highest_rate
from tables import in_turn, table, usually

from multidrop.bus import Bus
from multidrop.control.records import read_audit
from multidrop.core import Message
from multidrop.drive import Condition
from multidrop.errors import BusError, CancelledByStop, LineError, NoReply, PortLost, Unconfirmed
from multidrop.poller import Poller
from multidrop.polling.polled_line import Reopening
from multidrop.sim import MotorDrive, Simulator, Wire, simulated
from multidrop.transport import clock
from multidrop.transport import exchange as exchanges

every_family = pytest.mark.parametrize("model", MAKE)


class Delayed(LateWire):
    """A wire that delays every reply by `delay` seconds."""

    delay = 0.0

    def distort(self, reply: bytes) -> bytes:
        return self.hold_up(reply, self.delay) if self.delay else reply


@contextmanager
def line(model: str) -> Iterator[tuple[Bus, Any, ReceivedRequests, Delayed]]:
    with at_highest_rate(model):
        drive = MAKE[model](1)
    sim = simulated(drive)
    assert isinstance(sim, MotorDrive)
    sim.motor.acceleration_time = sim.motor.deceleration_time = 0.2
    received, wire = ReceivedRequests(sim), Delayed([sim], unpaced=True)
    with Simulator([wire]) as simulator, Bus(simulator.wires[0].path) as bus:
        yield bus, bus.attach(drive), received, wire


@pytest.mark.slow
@pytest.mark.parametrize("model", usually(*MAKE))
def test_a_stop_is_sent_although_every_reply_is_late(model: str) -> None:
    """Each reply arrives after the next request, so the read before the stop gets an earlier read's reply."""
    with line(model) as (_, drive, received, wire):
        received.sim.motor.run(1)
        wire.delay = 0.6
        with suppress(BusError):
            drive.read(next(register for register in drive.registers.values() if register.readable))
        with suppress(Unconfirmed):  # the drive's late replies may not show the standstill
            drive.stop(seconds=1)
        until(lambda: received.writes and not received.sim.motor.energised)


def in_thread(act: Callable[[], object]) -> tuple[threading.Thread, list[BaseException]]:
    failures: list[BaseException] = []

    def run() -> None:
        try:
            act()
        except BaseException as failure:
            failures.append(failure)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, failures


@pytest.mark.long
@pytest.mark.parametrize(("what", "ending"), in_turn(["start", "write", "raw"], ["close", "detach"]))
def test_closing_or_detaching_makes_a_write_in_flight_unconfirmed(
    monkeypatch: pytest.MonkeyPatch, ending: str, what: str
) -> None:
    """The write is never reported as unsent."""
    monkeypatch.setattr(exchanges, "READ_ATTEMPTS", 1)
    with line("invt-che") as (bus, drive, received, _):
        drive.set_frequency(20)
        acts: dict[str, Callable[[], object]] = {
            "start": drive.start,
            "write": lambda: drive.write(drive.setpoint, 50.0),
            "raw": lambda: drive.send_raw(6, 0x1000, b"\0\1"),
        }
        begun, came = len(received.writes), threading.Event()

        def loses(request: Message) -> bool:
            if len(received.writes) > begun:
                came.set()
            return came.is_set()

        received.loses = loses
        if ending == "close":
            known = bus.peer(drive).c
            known.most_timeout_ns = known.least_timeout_ns = 60_000_000_000
        thread, failures = in_thread(acts[what])
        assert came.wait(PATIENCE)
        bus.close() if ending == "close" else bus.detach(drive)
        thread.join(PATIENCE)
        assert not thread.is_alive()
        assert [type(failure) for failure in failures] == [Unconfirmed]
        assert len(received.writes) == begun + 1


@pytest.mark.long
@every_family
def test_a_stop_of_another_thread_cancels_a_start_that_waits_for_a_reply(model: str) -> None:
    """The start's read is not answered until the stop was answered."""
    with line(model) as (_, drive, received, _):
        drive.set_frequency(20)
        looked, stopped = threading.Event(), threading.Event()

        def loses(request: Message) -> bool:
            if not stopped.is_set() and request not in received.writes:
                looked.set()
            return False

        received.loses = loses
        starting, failures = in_thread(drive.start)
        assert looked.wait(PATIENCE)
        drive.stop()
        stopped.set()
        starting.join(PATIENCE)
        assert [type(failure) for failure in failures] in ([CancelledByStop], [Unconfirmed])
        until(lambda: not received.sim.motor.energised)


@pytest.mark.slow
@pytest.mark.parametrize("model", usually(*MAKE))
def test_a_start_is_sent_once_if_the_reply_is_lost(model: str) -> None:
    with line(model) as (_, drive, received, _):
        drive.set_frequency(20)
        received.loses = lambda request: request in received.starts
        with pytest.raises(Unconfirmed, match="no reply"):
            drive.start()
        assert len(received.starts) == 1
        assert received.sim.motor.energised  # the motor runs, as the error Unconfirmed warned


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(("model", "lost"), in_turn(MAKE, [3, 2, 7]))
def test_a_stop_is_repeated_unchanged_if_replies_are_lost(model: str, lost: int) -> None:
    with line(model) as (_, drive, received, _):
        drive.set_frequency(20)
        drive.start()
        begun = len(received.writes)
        received.loses = lambda request: request in received.writes and len(received.writes) <= begun + lost
        drive.stop()
        stops = received.writes[begun:]
        assert len(stops) > lost
        assert all(stop in stops[lost:] for stop in stops[:lost])
        assert len(received.starts) == 1
        assert not received.sim.motor.energised


def test_closing_a_bus_waits_for_a_stop_in_progress() -> None:
    with line("invt-che") as (bus, drive, received, _):
        drive.set_frequency(20)
        drive.start()
        deaf = threading.Event()
        sent = threading.Event()

        def loses(request: Message) -> bool:
            if request in received.writes:
                sent.set()
            return not deaf.is_set()

        received.loses = loses
        stopping, failures = in_thread(drive.stop)
        assert sent.wait(PATIENCE)
        closing, _ = in_thread(bus.close)
        closing.join(0.1)
        assert closing.is_alive()
        deaf.set()
        for thread in (stopping, closing):
            thread.join(PATIENCE)
        assert failures == []


class Pulled:
    """A line whose port is unplugged while the motor turns, and immediately returns under the same name."""

    def __init__(self, link: Path) -> None:
        self.link = str(link)
        self.drive = MAKE["invt-che"](1)
        sim = simulated(self.drive)
        assert isinstance(sim, MotorDrive)
        sim.motor.acceleration_time = sim.motor.deceleration_time = 0.2
        self.received = ReceivedRequests(sim)

    def plugged_in(self) -> Simulator:
        return Simulator([Wire([self.received.sim], port=self.link, unpaced=True)])

    def starts(self, bus: Bus) -> None:
        drive: Any = self.drive
        drive.set_frequency(20)
        drive.start()

    def until_lost(self, bus: Bus) -> None:
        until(lambda: bus.line.queue is None or bus.line.queue.lost)
        assert self.received.sim.motor.energised
        self.received.requests.clear()


def stands(drive: Any) -> bool:
    try:
        return bool(drive.state().condition is Condition.STOPPED)
    except BusError:  # a busy computer may reply late
        return False


@table("ending", ["close", "stop", "stop_all", "write"])
def test_a_stop_reopens_a_lost_port(tmp_path: Path, ending: str) -> None:
    pulled = Pulled(tmp_path / "port")
    drive: Any = pulled.drive
    with ExitStack() as stack:
        with pulled.plugged_in():
            bus = stack.enter_context(Bus(pulled.link))
            bus.attach(drive)
            pulled.starts(bus)
        pulled.until_lost(bus)
        with pytest.raises(LineError):
            drive.state()
        with pytest.raises(LineError):  # the adapter is still unplugged
            bus.line.regain()
        with pulled.plugged_in():
            with pytest.raises(LineError):
                drive.state()
            if ending == "close":
                bus.stop_on_exit()
            elif ending == "write":
                with suppress(Unconfirmed):  # a busy machine may read the reply late
                    drive.write(drive.control, drive.control.values(5))
                until(lambda: stands(drive))
            else:
                getattr(drive if ending == "stop" else bus, ending)()
            bus.close()
            assert pulled.received.writes
            assert pulled.received.starts == []
            until(lambda: not pulled.received.sim.motor.energised)
    with pytest.raises(LineError, match="it is closed"):
        drive.stop()


@pytest.mark.parametrize("opener", ["the poller", "the stop"])
def test_a_closing_poller_stops_motors_after_reopening_the_port(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, opener: str
) -> None:
    """The motors are stopped whether the poller or the stop reopens the port."""
    if opener == "the stop":
        monkeypatch.setattr(Reopening, "_attempt", lambda failing: failing._bus.note_reopening(False))
    pulled = Pulled(tmp_path / "port")
    drive: Any = pulled.drive
    with ExitStack() as stack:
        with pulled.plugged_in():
            declared = declared_line(pulled.link, polled(drive, [drive.status]))
            poller = stack.enter_context(Poller(plant(declared)))
            poller.stop_on_exit()
            bus = poller.bus("line")
            pulled.starts(bus)
        pulled.until_lost(bus)
        with pulled.plugged_in():
            poller.close()
            assert pulled.received.writes
            assert pulled.received.starts == []
            until(lambda: not pulled.received.sim.motor.energised)
            waits: list[float] = []
            monkeypatch.setattr(clock, "sleep", waits.append)
            with pytest.raises(LineError, match="it is closed"):
                drive.stop()
            assert sum(waits) == 0  # no waits: a closed port does not come back


@pytest.mark.slow
def test_other_commands_are_not_sent_while_a_stop_is_repeated() -> None:
    with line("invt-che") as (_, drive, received, _):
        drive.set_frequency(20)
        received.loses = lambda request: True
        stopping, _ = in_thread(lambda: drive.stop(seconds=1))
        until(lambda: any(write.data == b"\0\5" for write in received.writes))
        for call in (drive.start, lambda: drive.set_frequency(30)):
            with pytest.raises((CancelledByStop, NoReply)):
                call()
        stopping.join(PATIENCE)
        assert received.starts == []


@pytest.mark.long
def test_an_unsent_stop_is_not_recorded_as_sent(tmp_path: Path) -> None:
    """The stop is repeated while it waits for the poller to reopen the port."""
    audit = tmp_path / "audit.jsonl"
    wire = Wire([simulated(MAKE["invt-che"](1))], unpaced=True)
    with Simulator([wire]), Bus(wire.path, audit=audit) as bus:
        drive = bus.attach(MAKE["invt-che"](1))
        drive.set_frequency(20)
        before = [*read_audit(audit)]
        bus.note_reopening(True)
        bus.line.drop()
        with pytest.raises(PortLost):
            drive.stop(seconds=0)
    after = [*read_audit(audit)]
    assert after[: len(before)] == before != []
    called, ended = after[len(before) :]
    assert (called["outcome"], ended["outcome"], ended["frames"]) == ("called", "failed", 0)
    assert not any("sent" in record for record in (called, ended))
