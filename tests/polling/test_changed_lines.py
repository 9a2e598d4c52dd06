"""A line that another plant changes closes its port and opens it again: stops, motors and other calls."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from lines import line, plant, polled, until
from toy import PatientToy, QuickToy, Toy
from two_lines import CURRENT, Blocked, TwoLines, note_writes, quick, runs, until_sampled

from multidrop.bus import Bus
from multidrop.control.outcome import Seen
from multidrop.errors import LineError
from multidrop.plant.model import Plant, PlantLine, PolledDrive
from multidrop.poller import Poller
from multidrop.transport.line import Line
from multidrop.transport.open_port import OpenPort


@pytest.fixture
def both() -> Iterator[TwoLines]:
    with TwoLines() as made:
        yield made


def reopening_of(poller: Poller, name: str, monkeypatch: pytest.MonkeyPatch) -> Blocked:
    """Block the opening of this line's port, after it was closed."""
    changed, made = poller.bus(name).line, Blocked()
    monkeypatch.setattr(Line, "regain", made.blocking(Line.regain, lambda each: each is changed))
    return made


def test_a_stop_in_progress_continues_on_the_reopened_port(both: TwoLines) -> None:
    with Poller(plant(both.hall())) as poller, Blocked() as stopping:
        pump = poller["pump-1"]
        pump.start()
        both.pumps[1].deaf_until = float("inf")
        found: list[Any] = []
        stopping.start(lambda: found.append(pump.stop()))
        until(poller.bus("hall").stops_under_way)
        opened = poller.bus("hall").line.queue
        assert poller.adopt(plant(both.hall(every=0.03))) == {}
        assert poller.bus("hall").line.queue is not opened
        assert stopping.is_blocking
        assert runs(both.pumps[1])
        both.pumps[1].deaf_until = 0.0
        until(lambda: found)
        assert found[0].ok
        assert not runs(both.pumps[1])
        assert poller["pump-1"] is pump


def test_a_stop_of_all_drives_continues_on_the_reopened_port(both: TwoLines) -> None:
    with Poller(plant(both.hall())) as poller, Blocked() as stopping:
        bus = poller.bus("hall")
        for drive in bus.drives:
            drive.start()
        for sim in both.pumps.values():
            sim.deaf_until = float("inf")
        found: list[Any] = []
        stopping.start(lambda: found.append(bus.stop_all()))
        until(lambda: len(bus.stops_under_way()) == 2)
        poller.adopt(plant(both.hall(every=0.03)))
        for sim in both.pumps.values():
            sim.deaf_until = 0.0
        until(lambda: found)
        assert {stopped.seen for stopped in found[0].values()} == {Seen.STOPPED}
        assert not any(map(runs, both.pumps.values()))


@pytest.mark.parametrize("way", ["drive", "bus"])
def test_a_stop_while_the_port_is_closed_is_sent_once_it_is_open(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    """The program still uses the drive and the bus of the earlier plant."""
    with Poller(plant(both.hall())) as poller:
        bus, pump = poller.bus("hall"), poller["pump-1"]
        pump.start()
        found: list[Any] = []
        stop = pump.stop if way == "drive" else lambda: bus.stop_all()["pump-1"]
        with reopening_of(poller, "hall", monkeypatch) as reopening:
            reopening.start(poller.adopt, plant(both.hall(every=0.03)))
            reopening.await_call()
            reopening.start(lambda: found.append(stop()))
            until(bus.stops_under_way)
            assert runs(both.pumps[1])
        assert found[0].ok
        assert not runs(both.pumps[1])
        until_sampled(poller, "pump-1")


def test_a_stop_is_repeated_until_the_port_can_be_opened_again(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Poller(plant(both.hall(), both.yard())) as poller, Blocked() as stopping:
        pump = poller["pump-1"]
        pump.start()
        with monkeypatch.context() as patch:
            patch.setattr(OpenPort, "open", lambda port: (_ for _ in ()).throw(LineError(port.name, "busy")))
            failures = poller.adopt(plant(both.hall(every=0.03), both.yard()))
            assert {name: failure.reason for name, failure in failures.items()} == {"hall": "busy"}
            found: list[Any] = []
            stopping.start(lambda: found.append(pump.stop()))
            until(poller.bus("hall").stops_under_way)
            until_sampled(poller, "fan-1")
            assert runs(both.pumps[1])
            assert stopping.is_blocking
        until(lambda: found)
        assert found[0].ok
        assert not runs(both.pumps[1])
        until_sampled(poller, "pump-1")


def test_a_start_while_the_port_is_closed_raises_and_is_never_sent(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Poller(plant(both.hall())) as poller:
        pump = poller["pump-1"]
        with reopening_of(poller, "hall", monkeypatch) as reopening:
            reopening.start(poller.adopt, plant(both.hall(every=0.03)))
            reopening.await_call()
            with pytest.raises(LineError, match="it is being opened again, because its line was changed"):
                pump.start()
        until_sampled(poller, "pump-1")
        assert not runs(both.pumps[1])
        pump.start()
        assert runs(both.pumps[1])


def test_a_running_motor_gets_no_request_but_reads_when_its_line_is_changed(both: TwoLines) -> None:
    """Even with `stop_on_exit`, only drives that the new plant lacks are stopped."""
    with Poller(plant(both.hall())) as poller:
        poller.stop_on_exit()
        bus, pump = poller.bus("hall"), poller["pump-1"]
        pump.start()
        writes: list[int] = []
        note_writes(both.pumps[1], writes)
        for every in (0.03, 0.02, None):
            assert poller.adopt(plant(both.hall(1, every=every))) == {}
            assert not bus.knows_identity(pump)  # it is checked again before the next write
            until_sampled(poller, "pump-1")
        assert (writes, poller["pump-1"]) == ([], pump)
        assert runs(both.pumps[1])
    assert not runs(both.pumps[1])


def test_a_programs_own_drive_stays_on_a_changed_line(both: TwoLines) -> None:
    with Poller(plant(both.hall(1))) as poller:
        bus = poller.bus("hall")
        own = bus.attach(QuickToy, 2, name="own")
        own.start()
        poller.adopt(plant(both.hall(1, every=0.03)))
        assert own.read(CURRENT) >= 0
        assert own.stop().ok
        poller.adopt(plant(line(both.hall().port, quick("taken", 2), name="hall")))
        assert [drive.name for drive in bus.drives] == ["taken"]
        assert own.bus is None


def test_a_changed_line_locks_its_port_again(both: TwoLines) -> None:
    with Poller(plant(both.hall())) as poller:
        poller.adopt(plant(both.hall(1)))
        with pytest.raises(LineError):
            Bus(both.hall().port)
        until_sampled(poller, "pump-1")


def test_a_port_that_is_slow_to_open_does_not_delay_another_changed_line(
    both: TwoLines, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Poller(plant(both.hall(), both.yard())) as poller:
        with reopening_of(poller, "hall", monkeypatch) as reopening:
            reopening.start(poller.adopt, plant(both.hall(1), both.yard(1)))
            reopening.await_call()
            until_sampled(poller, "fan-1")
            assert reopening.is_blocking
        until_sampled(poller, "pump-1")


def test_a_pending_request_without_a_reply_does_not_hold_up_a_change(both: TwoLines) -> None:
    """The new plant is polled, although the request to the silent drive could be pending for a minute."""
    both.pumps[2].deaf_until = float("inf")
    silent = polled(PatientToy(2, name="pump-2"), [CURRENT], None)
    with Poller(plant(line(both.hall().port, silent, name="hall"))) as poller, Blocked() as adopting:
        bus = poller.bus("hall")
        until(lambda: bus.is_asking(bus.peer(silent.drive)))
        adopting.start(poller.adopt, plant(both.hall(1)))
        until(lambda: "pump-1" in poller)
        until_sampled(poller, "pump-1")


def test_a_drive_in_python_keeps_its_own_settings_if_its_line_loses_them() -> None:
    with Poller(
        Plant([PlantLine("hall", "loop://", baudrate=19200, drives=[PolledDrive(Toy(1))])])
    ) as poller:
        made = Plant([PlantLine("hall", "loop://", drives=[PolledDrive(Toy(1, baudrate=19200))])])
        assert poller.adopt(made) == {}
        assert str(poller["toy@1"].settings) == "19200 8N1"


def test_a_drive_in_python_takes_the_settings_of_its_changed_line() -> None:
    drive = Toy(1)
    with Poller(Plant([PlantLine("hall", "loop://", baudrate=19200, drives=[PolledDrive(drive)])])) as poller:
        made = Plant([PlantLine("hall", "loop://", drives=[PolledDrive(drive)])])
        assert str(drive.settings) == "19200 8N1"  # until `adopt`, because the drive is polled
        assert poller.adopt(made) == {}
        assert str(drive.settings) == "9600 8N1"
