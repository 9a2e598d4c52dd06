"""`Poller.adopt` during polling, on simulated lines: motors, pending calls and stops, memory."""

from __future__ import annotations

import gc
import socket
import threading
import time
import tracemalloc
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from types import SimpleNamespace

import pytest
from commands import descriptors, threads
from lines import PATIENCE, line, plant, polled, until
from serial.urlhandler import protocol_socket
from tables import examples
from toy import QuickToy, Toy
from two_lines import (
    CURRENT,
    Blocked,
    TwoLines,
    note_writes,
    quick,
    runs,
    samples,
    until_sampled,
)

from multidrop.bus import Bus
from multidrop.control.outcome import Seen, Stopped
from multidrop.drive import Drive
from multidrop.errors import CancelledByStop, LineError, NoReply, NotAttached, PortLost
from multidrop.plant.model import PlantLine, PolledDrive
from multidrop.poller import Poller


@pytest.fixture
def both() -> Iterator[TwoLines]:
    with TwoLines() as made:
        yield made


def test_motors_keep_running_when_their_line_is_removed(both: TwoLines) -> None:
    with Poller(plant(both.hall(), both.yard())) as poller:
        poller.bus("yard").drives[0].start()
        poller.adopt(plant(both.hall()))
        assert list(poller.buses) == ["hall"]
    assert runs(both.fans[1])


def test_a_removed_drive_is_stopped_first_with_stop_on_exit(both: TwoLines) -> None:
    with Poller(plant(both.hall(), both.yard())) as poller:
        poller.stop_on_exit()
        for bus in poller.buses.values():
            for drive in bus.drives:
                drive.start()
        poller.adopt(plant(both.hall(1)))
        assert runs(both.pumps[1])
        assert not runs(both.pumps[2])
        assert not runs(both.fans[1])
        assert not runs(both.fans[2])
        poller.adopt(plant(both.hall(1), both.yard()))
        poller.bus("yard").drives[0].start()  # `stop_on_exit` must apply to this new line too
    assert not runs(both.pumps[1])
    assert not runs(both.fans[1])


def test_a_drive_cannot_be_started_during_its_removal(both: TwoLines) -> None:
    """Otherwise its motor would keep running, because no further stop is sent to a removed drive."""
    with Poller(plant(both.hall())) as poller:
        poller.stop_on_exit()
        bus = poller.bus("hall")
        pump_1, pump_2 = bus.drives
        detach = bus.detach

        def start_the_other(drive: Drive) -> None:
            if drive is pump_1:
                with pytest.raises(CancelledByStop):
                    pump_2.start()
            detach(drive)

        vars(bus)["detach"] = start_the_other
        poller.adopt(plant(line(both.hall().port, name="hall")))
        assert not runs(both.pumps[2])


def test_stop_on_exit_also_applies_to_a_line_during_its_opening(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Poller(plant(both.hall())) as poller:
        with Blocked() as opening:
            monkeypatch.setattr(Bus, "__init__", opening.blocking(Bus.__init__))
            opening.start(poller.adopt, plant(both.hall(), both.yard()))
            opening.await_call()
            poller.stop_on_exit()
        assert {name: bus.stops_on_exit for name, bus in poller.buses.items()} == {"hall": True, "yard": True}


class Other(QuickToy):
    """A drive of another family, which may interpret the first family's stop as a different command."""

    model = "other"


def test_no_stop_of_the_old_family_is_sent_after_a_family_change(both: TwoLines) -> None:
    with Poller(plant(both.hall(), both.yard())) as poller:
        poller.stop_on_exit()
        for name in ("hall", "yard"):
            poller.bus(name).drives[0].start()
        writes: list[int] = []
        for sim in (both.pumps[1], both.fans[1]):
            note_writes(sim, writes)
        other = polled(Other(1, name="pump-1"), [Other.registers["status"]], 0.02)
        yard = both.yard()
        reopened = PlantLine(
            "yard", yard.port, drives=(polled(Other(1, name="fan-1"), [], None),), echo="off"
        )
        poller.adopt(plant(line(both.hall().port, other, quick("pump-2", 2), name="hall"), reopened))
        assert writes == []
        assert runs(both.pumps[1])
        assert runs(both.fans[1])
    assert not runs(both.pumps[1])  # stopped at exit, by the stop of its new family
    assert not runs(both.fans[1])


def blocked_stop(
    bus: Bus, monkeypatch: pytest.MonkeyPatch, stop: Callable[[], object], of: Drive | None = None
) -> Blocked:
    """Call `stop` on a thread. Block the steps of every stop of the bus, or only those of the drive `of`."""
    made, step = Blocked(), bus._stopper.do
    monkeypatch.setattr(
        bus._stopper, "do", made.blocking(step, lambda attempt, _: of in (None, attempt.drive))
    )
    made.start(stop)
    made.await_call()
    return made


def waited_for(bus: Bus, monkeypatch: pytest.MonkeyPatch, drive: Drive | None = None) -> threading.Event:
    """Return an event that is set when any thread waits for stops of the bus, or of this drive."""
    found, await_stops = threading.Event(), bus._latches.await_stops

    def note_and_wait(drives: Collection[Drive] | None = None) -> None:
        if drive is None or drive in (drives or ()):
            found.set()
        await_stops(drives)

    monkeypatch.setattr(bus._latches, "await_stops", note_and_wait)
    return found


def test_a_line_is_removed_only_after_a_running_stop_ends(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Poller(plant(both.hall(), both.yard())) as poller:
        bus = poller.bus("yard")
        bus.drives[0].start()
        found: dict[str, Stopped] = {}
        with blocked_stop(bus, monkeypatch, lambda: found.update(bus.stop_all())) as stopping:
            adopting = stopping.start(poller.adopt, plant(both.hall()))
            before = samples(poller, "pump-1")
            until(lambda: samples(poller, "pump-1") > before + 10)  # the other line is still polled
            assert adopting.is_alive()
            assert "yard" in poller.buses
        assert {name: stopped.seen for name, stopped in found.items()} == {
            "fan-1": Seen.STOPPED,
            "fan-2": Seen.STOPPED,
        }
        assert not runs(both.fans[1])
        assert list(poller.buses) == ["hall"]


def test_a_drive_can_be_removed_while_another_drive_is_being_stopped(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Poller(plant(both.hall())) as poller:
        pump_1, _ = poller.bus("hall").drives
        with blocked_stop(poller.bus("hall"), monkeypatch, pump_1.stop) as stopping:
            poller.adopt(plant(both.hall(1)))
            assert stopping.is_blocking
        assert poller.bus("hall").drives == [pump_1]


def test_a_drive_can_be_stopped_while_its_replacement_is_pending(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The new drives have the names of the old ones, which can still be stopped."""
    replacements = [polled(QuickToy(address, name=f"pump-{address}", silence=0.01), []) for address in (1, 2)]
    with Poller(plant(both.hall())) as poller:
        bus = poller.bus("hall")
        pump_1, pump_2 = bus.drives
        pump_1.start()
        with blocked_stop(bus, monkeypatch, pump_2.stop, pump_2) as stopping:
            is_waited_for = waited_for(bus, monkeypatch, pump_2)
            stopping.start(poller.adopt, plant(line(both.hall().port, *replacements, name="hall")))
            assert is_waited_for.wait(PATIENCE)
            pump_1.stop()
            assert not runs(both.pumps[1])
        assert [drive.name for drive in bus.drives] == ["pump-1", "pump-2"]
        assert not {pump_1, pump_2} & {*bus.drives}


@pytest.mark.slow
def test_a_drive_can_be_stopped_while_its_renaming_is_pending(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While `adopt` waits for a stop on the other line, the drive's motor can still be stopped."""
    hall, yard = both.hall(1), both.yard(1)
    names = ("fan-1", "pump-1")
    renamed = [
        line(each.port, quick(name, 1), name=each.name)
        for each, name in zip((hall, yard), names, strict=True)
    ]
    with Poller(plant(hall, yard)) as poller:
        (pump,), (fan,) = (poller.bus(name).drives for name in ("hall", "yard"))
        pump.start()
        bus = poller.bus("yard")
        with blocked_stop(bus, monkeypatch, fan.stop) as stopping:
            is_waited_for = waited_for(bus, monkeypatch)
            stopping.start(poller.adopt, plant(*renamed))
            assert is_waited_for.wait(PATIENCE)
            assert poller.bus("hall").drives == [pump]
            pump.stop()
            assert not runs(both.pumps[1])
        found = [drive.name for name in ("hall", "yard") for drive in poller.bus(name).drives]
        assert found == list(names)
        for name in names:
            until_sampled(poller, name)


def test_a_slow_stop_on_one_line_does_not_delay_changes_of_other_lines(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Poller(plant(both.hall(), both.yard())) as poller:
        bus = poller.bus("yard")
        with blocked_stop(bus, monkeypatch, bus.stop_all) as stopping:
            stopping.start(poller.remove_line, "yard")
            until(lambda: bus._latches.is_shut)
            poller.remove_line("hall")
            poller.add_line(both.hall(1))
            assert stopping.is_blocking
            assert sorted(poller.buses) == ["hall", "yard"]
        assert list(poller.buses) == ["hall"]


def test_two_concurrent_removals_remove_a_line_once(both: TwoLines) -> None:
    """Two callers wait for the line's stops; only one caller then removes the line."""
    with Poller(plant(both.hall(), both.yard())) as poller:
        bus = poller.bus("yard")
        both_wait, part = threading.Barrier(2), bus.part

        def wait_and_part() -> None:
            with suppress(threading.BrokenBarrierError):
                both_wait.wait(PATIENCE)
            both_wait.abort()  # a later caller must not wait here
            part()

        vars(bus)["part"] = wait_and_part
        with Blocked() as removing:
            for _ in range(2):
                removing.start(poller.remove_line, "yard")
        assert list(poller.buses) == ["hall"]


def test_every_call_on_a_removed_line_or_drive_raises(both: TwoLines) -> None:
    with Poller(plant(both.hall(), both.yard())) as poller:
        pump_1, pump_2 = poller.bus("hall").drives
        fan, _ = poller.bus("yard").drives
        poller.adopt(plant(both.hall(1)))
        with pytest.raises(LineError, match="its line is no longer polled"):
            fan.read(CURRENT)
        with pytest.raises(CancelledByStop):
            fan.start()
        with pytest.raises(NotAttached, match="pump-2 is not attached to this bus"):
            pump_2.read(CURRENT)
        assert pump_1.read(CURRENT) >= 0
    assert not runs(both.fans[1])


def test_a_pending_read_on_a_removed_line_raises(both: TwoLines) -> None:
    both.fans[1].deaf_until = float("inf")
    slow = polled(SlowToy(1, name="fan-1"), [], None)
    with Poller(plant(both.hall(), line(both.yard().port, slow, name="yard"))) as poller:
        found: list[BaseException] = []

        def read() -> None:
            try:
                slow.drive.read(CURRENT)
            except LineError as failure:
                found.append(failure)

        reading = threading.Thread(target=read)
        reading.start()
        until(lambda: poller.statistics()["yard"].counters.sent or _is_asking(poller, slow))
        poller.remove_line("yard")
        reading.join(PATIENCE)
    assert ["its line is no longer polled" in str(failure) for failure in found] == [True]


class SlowToy(Toy):
    """A drive with a timeout of a minute."""

    response_timeout = 60.0
    response_delay = 15.0


def _is_asking(poller: Poller, of: PolledDrive) -> bool:
    bus = poller.bus("yard")
    return bus.is_asking(bus.peer(of.drive))


def test_a_poller_closes_only_after_a_change_of_plant_has_ended(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    poller = Poller(plant(both.hall()))
    poller.__enter__()
    with Blocked() as opening:
        monkeypatch.setattr(Bus, "__init__", opening.blocking(Bus.__init__))
        opening.start(poller.adopt, plant(both.hall(), both.yard()))
        opening.await_call()
        opening.start(poller.close)
        until(lambda: poller._closing)
    assert not any(bus.is_open for bus in poller.buses.values())


def test_the_servers_of_a_new_plant_are_connected_in_parallel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two calls of `create_connection` wait for each other. Closing never sleeps."""
    with TwoLines("socket://127.0.0.1:0") as both:
        lines = both.hall(), both.yard()
        all_asked = threading.Barrier(2)
        connect = socket.create_connection

        def connect_together(*arguments: object, **details: object) -> socket.socket:
            all_asked.wait(PATIENCE)
            return connect(*arguments, **details)  # type: ignore[arg-type]

        def sleep(seconds: float) -> None:
            raise AssertionError(f"slept for {seconds} s")

        monkeypatch.setattr(protocol_socket, "time", SimpleNamespace(**vars(time) | {"sleep": sleep}))
        monkeypatch.setattr(socket, "create_connection", connect_together)
        with Poller(plant(*lines)) as poller:
            until_sampled(poller, "fan-1")
            poller.adopt(plant())
            poller.adopt(plant(*lines))
            until_sampled(poller, "fan-1")


def test_a_slow_port_does_not_delay_the_other_ports_of_a_new_plant(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    nowhere = line("socket://127.0.0.1:1", quick("far", 1), name="far")
    found: dict[str, LineError] = {}
    with Poller(plant(both.hall())) as poller:
        with Blocked() as opening:
            is_slow = opening.blocking(Bus.__init__, lambda _, port: port.startswith("socket"))
            monkeypatch.setattr(Bus, "__init__", is_slow)
            opening.start(lambda: found.update(poller.adopt(plant(nowhere, both.hall(), both.yard()))))
            until_sampled(poller, "fan-1")
            until_sampled(poller, "pump-1")
            assert opening.is_blocking
        assert list(poller.buses) == ["far", "hall", "yard"]
    assert {name: str(failure) for name, failure in found.items()} == {
        "far": "socket://127.0.0.1:1: nothing listens there"
    }


def test_a_drive_can_be_stopped_while_a_port_opens(both: TwoLines, monkeypatch: pytest.MonkeyPatch) -> None:
    replacement = polled(QuickToy(1, name="pump-1", silence=0.01), [])
    with Poller(plant(both.hall())) as poller, Blocked() as opening:
        poller.bus("hall").drives[0].start()
        monkeypatch.setattr(Bus, "__init__", opening.blocking(Bus.__init__))
        adopting = opening.start(
            poller.adopt, plant(line(both.hall().port, replacement, name="hall"), both.yard())
        )
        opening.await_call()
        poller.bus("hall").drives[0].stop()
        assert not runs(both.pumps[1])
        assert adopting.is_alive()


@pytest.mark.long
@pytest.mark.slow
def test_a_hundred_plant_changes_leak_no_threads_descriptors_or_memory(both: TwoLines) -> None:
    """During the adoptions, threads read drives, statistics and batches. No value is misattributed."""
    held_by = {"pump-1": 1.0, "pump-2": 2.0, "fan-1": 3.0, "fan-2": 4.0}
    sims = [*both.pumps.values(), *both.fans.values()]
    for value, sim in zip(held_by.values(), sims, strict=True):
        sim["output_current"] = value
    with Poller(plant(both.hall(), both.yard(every=None))) as poller:
        pump = poller.bus("hall").drives[0]
        is_over = threading.Event()
        failures: list[BaseException] = []

        def go_on(do: object) -> None:
            try:
                while not is_over.is_set():
                    do()  # type: ignore[operator]
            except BaseException as failure:
                failures.append(failure)

        def look() -> None:
            poller.summary(), poller.statistics(), poller.plant, repr(poller)

        def read_one() -> None:
            # a changed line closes its port for a moment; on a busy computer, a reply may be late
            with suppress(PortLost, NoReply):
                pump.read(CURRENT)

        def read_all() -> None:
            for bus in poller.buses.values():
                for drive in bus.drives:
                    with suppress(LineError, NotAttached, NoReply):
                        drive.read(CURRENT)

        def take() -> None:
            for batch in poller.batches(seconds=0.05):
                for row in batch:
                    if row.value is not None and row.register == "output_current":
                        assert row.value == held_by[row.drive], row

        def adopt_some(number: int) -> None:
            second = (both.hall(1), both.hall(1, 2), both.hall(1, 2, every=0.03))[number % 3]
            third = [(), (both.yard(),), (both.yard(2),), (both.yard(1, 2, every=None),)][number % 4]
            assert poller.adopt(plant(second, *third)) == {}

        beside = [threading.Thread(target=go_on, args=[do]) for do in (look, read_one, read_all, take)]
        for thread in beside:
            thread.start()
        try:
            for number in range(12):
                adopt_some(number)
            held = descriptors(), threads()
            gc.collect()
            tracemalloc.start()
            before = tracemalloc.take_snapshot()
            for number in range(examples(40)):
                adopt_some(number)
            gc.collect()
            grown = tracemalloc.take_snapshot().compare_to(before, "filename")
            tracemalloc.stop()
            assert failures == []
            assert (descriptors(), threads()) == held
        finally:
            is_over.set()
            for thread in beside:
                thread.join(PATIENCE)
        assert failures == []
        ours = sum(each.size_diff for each in grown if "multidrop" in each.traceback[0].filename)
        assert ours < 200_000, [str(each) for each in grown[:8]]
        before_end = samples(poller, "pump-1")
        until(lambda: samples(poller, "pump-1") > before_end + 10)
