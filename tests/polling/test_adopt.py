"""`Poller.adopt` replaces the polled plant by another one during polling, on a simulated clock."""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from types import FrameType

import pytest
from clocked_lines import ClockedLines, ClockedWire, S
from lines import line, plant, polled, rows_of
from tables import table, usually
from toy import Toy

from multidrop.core import Echo
from multidrop.drive import Drive
from multidrop.errors import LineError, NoSuchPort
from multidrop.families import InnovertIBD, InvtCHE
from multidrop.plant.loader import PlantError
from multidrop.plant.model import Plant, PlantLine, PolledDrive
from multidrop.poller import Poller
from multidrop.polling import adoption
from multidrop.polling.batch import Row
from multidrop.sim import EncodedDrive, Faults, proof

CURRENT, FREQUENCY, FAULT, STATUS = (
    Toy.registers[name] for name in ("output_current", "output_frequency", "fault", "status")
)
ALL = (CURRENT, FREQUENCY, FAULT, STATUS)


def toy(name: str, address: int, every: float | None = 0.1) -> PolledDrive:
    return polled(Toy(address, name=name), ALL, every)


def wire(*drives: Drive) -> ClockedWire:
    return ClockedWire([EncodedDrive(drive) for drive in drives], Faults())


def toys() -> ClockedWire:
    """A wire with a `Toy` drive at each of the addresses 1 to 4."""
    return wire(*(Toy(address) for address in range(1, 5)))


def hall(*drives: PolledDrive, name: str = "hall") -> PlantLine:
    return line(f"port of {name}", *drives, name=name)


def yard(*drives: PolledDrive) -> PlantLine:
    return hall(*drives, name="yard")


def pumps(every: float | None = 0.1) -> tuple[PolledDrive, ...]:
    return tuple(toy(f"pump-{address}", address, every) for address in (1, 2))


def fans(every: float | None = 0.1) -> tuple[PolledDrive, ...]:
    return tuple(toy(f"fan-{address}", address, every) for address in (1, 2))


def clocked(*lines: PlantLine) -> ClockedLines:
    """Return a polled plant with simulated wires, for its lines and for lines that are added later."""
    names = {*(each.name for each in lines), "hall", "yard", "roof"}
    return ClockedLines.of_lines({f"port of {name}": toys() for name in names}, plant(*lines))


def values(rows: Sequence[Row]) -> Counter[tuple[str, str]]:
    return Counter((row.drive, row.register) for row in rows if row.value is not None)


def statuses(rows: Sequence[Row], drive: str) -> set[str]:
    return {row.status for row in rows if row.drive == drive}


def check_rates(made: ClockedLines, wait: float = 1.0, **periods: float) -> list[Row]:
    """Wait for `wait` s, then poll for 5 s; return the rows and check each drive's period in s."""
    if wait:
        made.run(wait)
    rows = made.run(5)
    for name, period in periods.items():
        drive, due = name.replace("_", "-"), round(5 / period)
        counts = {values(rows)[drive, register.name] for register in ALL}
        assert counts <= {due - 1, due, due + 1}, (drive, counts)
    return rows


OTHERS = (
    (yard(toy("fan-1", 1), toy("fan-3", 3)),),
    (),
    (yard(*fans(None)), hall(toy("vent-1", 1, None), name="roof")),
    (yard(toy("fan-1", 4, 0.3)), hall(toy("vent-1", 2), name="roof")),
    (replace(yard(*fans()), echo=Echo.ON),),
)


@pytest.mark.long
@pytest.mark.parametrize("every", usually(None, 0.1, 0.08), ids=str)
def test_a_change_of_other_lines_does_not_delay_an_unchanged_line(every: float | None) -> None:
    """An unchanged line's requests are sent at exactly the same times as without a call of `adopt`."""

    def exchanges(*, adopts: bool) -> list[tuple[int, str, str]]:
        with clocked(hall(*pumps(every)), yard(*fans(every))) as made:
            rows = made.run(5)
            for others in OTHERS * 2:
                if adopts:  # the plant is equal, but has new drive objects
                    adopting = made.beside(lambda o=others: made.poller.adopt(plant(hall(*pumps(every)), *o)))
                rows += made.run(1.7)
                if adopts:
                    made.finish(adopting)  # on a busy computer, the adopting thread may start late
            rows += made.run(2)
        return [(row.monotonic_ns, row.register, row.status) for row in rows if row.drive.startswith("pump")]

    alone, beside = exchanges(adopts=False), exchanges(adopts=True)
    assert len(alone) > 1000
    assert {status for _, _, status in alone} == {"ok"}
    assert beside[: len(alone)] == alone


def test_a_change_to_an_equal_plant_keeps_drive_objects_and_ports() -> None:
    with clocked(hall(*pumps()), yard(*fans())) as made:
        made.run(2)
        before = made.poller.plant
        assert made.poller.adopt(plant(hall(*pumps()), yard(*fans()))) == {}
        made.run(2)
        assert made.poller.plant == before
        assert sorted(made.opened) == ["port of hall", "port of yard"]
        pump, _ = made.poller.bus("hall").drives
        assert pump is before.lines[0].drives[0].drive


@pytest.mark.slow
def test_a_change_of_rates_and_registers_keeps_the_drives() -> None:
    with clocked(hall(*pumps())) as made:
        made.run(2)
        first, second = made.poller.bus("hall").drives
        slow = replace(hall(), drives=(toy("pump-1", 1, 0.5), toy("pump-2", 2)))
        assert made.poller.adopt(plant(slow)) == {}
        check_rates(made, pump_1=0.5, pump_2=0.1)
        few = hall(polled(Toy(1, name="pump-1"), [CURRENT], 0.1), polled(Toy(2, name="pump-2"), [], None))
        made.poller.adopt(plant(few))
        made.run(1)
        assert {key: count in (49, 50, 51) for key, count in values(made.run(5)).items()} == {
            ("pump-1", "output_current"): True
        }
        made.poller.adopt(plant(hall(*pumps())))
        check_rates(made, pump_1=0.1, pump_2=0.1)
        assert made.poller.bus("hall").drives == [first, second]


@pytest.mark.slow
def test_a_new_plant_adds_and_removes_drives_and_changes_addresses() -> None:
    with clocked(hall(*pumps())) as made:
        made.run(2)
        stays = made.poller.bus("hall").drives[0]
        made.poller.adopt(plant(hall(toy("pump-1", 1), toy("pump-3", 3))))
        rows = check_rates(made, pump_1=0.1, pump_3=0.1)
        assert statuses(rows, "pump-2") == set()
        made.poller.adopt(plant(hall(toy("pump-1", 1), toy("pump-3", 4), toy("pump-2", 3))))
        rows = check_rates(made, pump_1=0.1, pump_2=0.1, pump_3=0.1)
        for name, address in (("pump-1", 1), ("pump-2", 3), ("pump-3", 4)):
            found = {row.value for row in rows if row.drive == name and row.register == "output_current"}
            assert found == {proof(Toy(address), CURRENT)}
        assert made.poller.bus("hall").drives[0] is stays


@pytest.mark.slow
def test_a_drive_can_be_replaced_by_one_of_another_family() -> None:
    drives = [InnovertIBD(7, name="pump"), InvtCHE(7, name="pump")]
    registers = [drive.readings()[:4] for drive in drives]
    wires = {"port of hall": wire(drives[0], Toy(1))}
    with ClockedLines.of_lines(
        wires, plant(hall(polled(drives[0], registers[0], 0.1), toy("fan", 1)))
    ) as made:
        rows = made.run(3)
        assert statuses(rows, "pump") == {"ok"}
        made.wires["port of hall"] = wire(drives[1], Toy(1))
        made.wires["port of hall"].open()
        made.poller.adopt(plant(hall(polled(drives[1], registers[1], 0.1), toy("fan", 1))))
        rows = check_rates(made, 2, fan=0.1)
    assert {
        row.value == proof(drives[1], drives[1].register(row.register)) for row in rows if row.drive == "pump"
    } == {True}


@pytest.mark.slow
def test_a_renamed_line_keeps_its_bus_and_its_drives() -> None:
    with clocked(hall(*pumps()), yard(*fans())) as made:
        made.run(2)
        before = made.poller.buses
        names = replace(hall(*pumps()), name="yard"), replace(yard(*fans()), name="hall")
        assert made.poller.adopt(plant(*names)) == {}
        check_rates(made, 0, pump_1=0.1)
        assert list(made.poller.statistics()) == ["yard", "hall"]
        assert [drive.name for drive in made.poller.bus("hall").drives] == ["fan-1", "fan-2"]
        assert made.poller.buses == {"yard": before["hall"], "hall": before["yard"]}


@pytest.mark.long
def test_a_new_plant_adds_and_removes_lines() -> None:
    with clocked(hall(*pumps())) as made:
        made.run(2)
        assert made.poller.adopt(plant(yard(*fans()))) == {}
        rows = check_rates(made, 0, fan_1=0.1)
        assert statuses(rows, "pump-1") <= {"ok", "poll ended"}
        assert list(made.poller.buses) == ["yard"]
        assert made.ports["port of hall"] is None
        assert made.poller.adopt(plant(hall(*pumps()), yard(*fans()))) == {}
        check_rates(made, 0, pump_1=0.1, fan_1=0.1)
        assert sorted(made.opened) == ["port of hall", "port of hall", "port of yard"]


def test_polls_due_before_the_removal_of_a_line_have_rows() -> None:
    with clocked(hall(*pumps()), yard(*fans())) as made:
        rows = made.run(2.05)
        made.poller.remove_line("yard")
        rows += made.run(3)
    times = [row.monotonic_ns for row in rows if row.drive == "fan-1" and row.register == "output_current"]
    gaps = [later - at for at, later in pairwise(times)]
    assert max(gaps) < 0.12 * S
    assert (made.now - times[-1]) / S > 2.9


@pytest.mark.slow
def test_a_line_is_added_polled_and_removed() -> None:
    with clocked(hall(*pumps())) as made:
        made.run(1)
        made.poller.add_line(yard(*fans()))
        check_rates(made, fan_1=0.1)
        made.poller.remove_line("yard")
        rows_of(made.poller)
        assert statuses(made.run(2), "fan-1") == set()
        assert list(made.poller.statistics()) == ["hall"]
        with pytest.raises(ValueError, match="there is no line 'yard'; there are hall"):
            made.poller.remove_line("yard")
        with pytest.raises(PlantError, match=r'^line "hall": another line already has this name[^\n]*$'):
            made.poller.add_line(replace(yard(toy("fan-3", 3)), name="hall"))
        assert list(made.poller.buses) == ["hall"]
        made.poller.add_line(yard(toy("fan-1", 3)))
        made.run(1)
        rows = made.run(5)
        assert {row.value for row in rows if (row.drive, row.register) == ("fan-1", "output_current")} == {
            proof(Toy(3), CURRENT)
        }


def test_all_lines_can_be_replaced_by_other_lines() -> None:
    with clocked(hall(*pumps())) as made:
        made.run(1)
        assert made.poller.adopt(plant()) == {}
        rows_of(made.poller)
        assert made.run(2) == []
        made.poller.adopt(plant(yard(*fans(None))))
        assert values(made.run(2))["fan-2", "status"] > 20


@pytest.mark.slow
def test_a_poller_can_change_to_another_plant_before_polling_starts() -> None:
    made = clocked(hall(*pumps()))
    made.poller.adopt(plant(hall(toy("pump-1", 1, 0.2)), yard(*fans())))
    with made:
        rows = check_rates(made, pump_1=0.2, fan_1=0.1)
    assert statuses(rows, "pump-2") == set()


def calls_to_add_one_to(count: int) -> int:
    """Return how many functions of adoption.py are called when one line is added to `count` lines."""
    lines = [hall(toy(f"pump-{number}", 1), name=f"hall-{number}") for number in range(count)]
    calls = 0

    def note(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += event == "call" and frame.f_code.co_filename == adoption.__file__

    with clocked(*lines) as made:
        sys.setprofile(note)
        threading.setprofile(note)  # also counts calls in threads that `adopt` starts
        try:
            made.poller.adopt(plant(*lines, yard(*fans())))
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
        check_rates(made, 0, fan_1=0.1)
    return calls


@pytest.mark.slow
def test_the_cost_of_adding_a_line_grows_linearly_with_the_lines() -> None:
    assert calls_to_add_one_to(24) < 2 * calls_to_add_one_to(12)


def test_late_replies_are_still_expected_after_a_new_plant_reopens_a_port() -> None:
    """The port options change too, so the line gets a new bus, with new records of its drives."""
    wires = {"port of hall": wire(Toy(1))}
    with ClockedLines.of_lines(wires, plant(hall(toy("pump-1", 1), toy("gone", 5)))) as made:
        made.run(2)
        ours = made.poller.bus("hall")
        late_until_ns = [ours.peer(drive).late_until_ns for drive in ours.drives]
        assert late_until_ns[1] > 0
        made.poller.adopt(plant(replace(hall(toy("pump-1", 1), toy("gone", 5)), echo=Echo.OFF)))
        now = made.poller.bus("hall")
        assert now is not ours
        assert [now.peer(drive).late_until_ns for drive in now.drives] == late_until_ns
        check_rates(made, pump_1=0.1)


def test_a_new_drive_expects_late_replies_of_the_drive_that_it_replaces() -> None:
    """The new drive is attached once the old drive's last request has ended."""
    wires = {"port of hall": wire(Toy(1))}
    with ClockedLines.of_lines(wires, plant(hall(toy("pump-1", 1), toy("deaf", 5, 0.05)))) as made:
        made.run(0.2)
        ours = made.poller.bus("hall")
        before = ours.peer(ours.drives[1])
        adopting = made.beside(
            lambda: made.poller.adopt(plant(hall(toy("pump-1", 1), polled(InvtCHE(5, name="new"), [], None))))
        )
        made.run(2)
        made.finish(adopting)
        new = ours.peer(ours.drives[1])
        assert new is not before
        assert new.late_until_ns == before.late_until_ns > 0


@pytest.mark.slow
def test_an_absent_port_of_a_new_plant_is_opened_once_it_appears() -> None:
    with clocked(hall(*pumps())) as made:
        made.run(1)
        del made.wires["port of yard"]
        failures = made.poller.adopt(
            plant(hall(toy("pump-1", 1)), yard(*fans()), hall(toy("v", 1), name="roof"))
        )
        assert list(failures) == ["yard"]
        assert isinstance(failures["yard"], LineError)
        assert str(failures["yard"]) == "port of yard: it is not there"
        rows = check_rates(made, 0, pump_1=0.1, v=0.1)
        assert statuses(rows, "fan-1") == {"port lost"}
        made.wires["port of yard"] = toys()
        made.wires["port of yard"].open()
        check_rates(made, 2, fan_1=0.1)


def test_a_line_with_an_absent_port_cannot_be_added() -> None:
    with clocked(hall(*pumps())) as made:
        made.run(1)
        del made.wires["port of yard"]
        with pytest.raises(LineError, match="port of yard: it is not there"):
            made.poller.add_line(yard(*fans()))
        assert list(made.poller.buses) == ["hall"]
        rows = check_rates(made, 0, pump_1=0.1)
        assert statuses(rows, "fan-1") == set()


def broken() -> dict[str, tuple[Plant, str]]:
    pump, other = pumps()
    alien = polled(InvtCHE(3, name="alien"), [CURRENT])
    return {
        "line twice": (
            plant(hall(pump), replace(yard(), name="hall")),
            'line "hall": another line already has this name; each line needs its own',
        ),
        "port twice": (
            plant(hall(pump), replace(yard(other), port="port of hall")),
            'line "yard": port port of hall is already used by line "hall"; make them one line',
        ),
        "drive twice": (
            plant(hall(pump), yard(toy("pump-1", 2))),
            'line "yard", drive "pump-1": another drive already has this name; each drive needs its own',
        ),
        "address twice": (
            plant(hall(pump, toy("pump-3", 1))),
            'line "hall", drive "pump-3": address 1 is already used by line "hall", drive "pump-1"',
        ),
        "another's register": (
            plant(hall(alien)),
            'line "hall", drive "alien": this output_current is not a register of alien, which is a INVT CHE',
        ),
        "not readable": (
            plant(yard(*fans(0.5)), hall(polled(Toy(1, name="pump-1"), (*ALL, Toy.control), 0.1), other)),
            'line "hall", drive "pump-1": control of pump-1 cannot be read: it is declared as a command',
        ),
    }


@pytest.mark.long
@table("mistake", broken())
def test_an_invalid_new_plant_changes_nothing(mistake: str) -> None:
    wrong, sentence = broken()[mistake]
    with clocked(hall(*pumps()), yard(*fans())) as made:
        made.run(2)
        before = made.poller.plant
        with pytest.raises(PlantError) as found:
            made.poller.adopt(wrong)
        assert any(told.startswith(sentence) for told in found.value.mistakes), found.value.mistakes
        assert made.poller.plant == before
        rows = check_rates(made, 0, pump_1=0.1, pump_2=0.1, fan_1=0.1, fan_2=0.1)
        assert {row.status for row in rows} == {"ok"}
        assert sorted(made.opened) == ["port of hall", "port of yard"]


def test_all_mistakes_of_a_new_plant_are_reported_together() -> None:
    pump, _ = pumps()
    with clocked(hall(*pumps())) as made, pytest.raises(PlantError) as found:
        made.poller.adopt(plant(hall(pump, toy("pump-1", 1)), hall(toy("v", 3))))
    assert len(found.value.mistakes) == 4


def test_an_invalid_port_name_in_a_new_plant_changes_nothing() -> None:
    with clocked(hall(*pumps())) as made:
        made.run(1)
        with pytest.raises(NoSuchPort, match="the URL needs a host and a port number"):
            made.poller.adopt(plant(line("socket://nowhere", toy("v", 1))))
        assert list(made.poller.buses) == ["hall"]


def test_an_unopenable_audit_log_raises_and_changes_nothing() -> None:
    with clocked(hall(*pumps())) as made:
        made.poller._lines._audit = "/proc/none/audit"
        with pytest.raises(OSError, match="No such file"):
            made.poller.adopt(plant(yard(*fans())))
        check_rates(made, pump_1=0.1)


def test_a_plant_with_drives_of_another_open_poller_is_refused() -> None:
    with clocked(hall(*pumps())) as made:
        sentence = "it is on another bus: detach it there first, or create another drive object"
        with clocked(hall(*pumps())) as other, pytest.raises(PlantError, match=sentence):
            made.poller.adopt(other.poller.plant)
        assert list(made.poller.buses) == ["hall"]


def test_a_plant_with_too_many_new_drive_names_is_refused() -> None:
    with clocked(hall(*pumps())) as made:
        for number in range(65534):
            made.poller._lines.names.drives.number(f"gone-{number}")
        assert made.poller.adopt(plant(hall(*pumps()))) == {}
        with pytest.raises(ValueError, match="at most 65536 different names of drives during its life"):
            made.poller.adopt(plant(hall(toy("pump-1", 1), toy("one-more", 3))))
        check_rates(made, pump_2=0.1)


def test_the_plant_cannot_be_changed_after_polling_has_ended() -> None:
    poller = Poller(plant())
    poller.close()
    for change in (
        lambda: poller.adopt(plant()),
        lambda: poller.add_line(hall()),
        lambda: poller.remove_line("hall"),
    ):
        with pytest.raises(ValueError, match="polling has ended"):
            change()


def test_an_object_that_is_not_a_plant_is_refused() -> None:
    poller = Poller(plant())
    with pytest.raises(TypeError, match=r"Poller takes a Plant or a plant file such as 'plant.toml', not 5"):
        poller.adopt(5)  # type: ignore[arg-type]
    poller.close()


def test_rows_are_distinguished_by_time_if_drives_swap_names() -> None:
    """Three drives on two lines swap their names. Each drive has a different value."""
    wires = {"port of hall": toys(), "port of yard": wire(*(Toy(address) for address in (5, 6)))}

    def named(*names: str) -> Plant:
        addresses = (1, 2, 5)
        drives = [toy(name, address, None) for name, address in zip(names, addresses, strict=True)]
        return plant(hall(*drives[:2]), yard(drives[2], toy("stays", 6, None)))

    with ClockedLines.of_lines(wires, named("a", "b", "c")) as made:
        rows = made.run(1)
        adopting = made.beside(lambda: made.poller.adopt(named("b", "c", "a")))
        rows += made.run(2)
        made.finish(adopting)
        since_ns = made.poller.polled_since
    before = {"a": 1, "b": 2, "c": 5, "stays": 6}
    after = {"a": 5, "b": 1, "c": 2, "stays": 6}
    told = {
        (row.drive, row.value == proof(Toy(drives[row.drive]), CURRENT))
        for row in rows
        for drives in [after if row.monotonic_ns >= since_ns[row.drive] else before]
        if row.register == "output_current" and row.value is not None
    }
    assert told == {(name, True) for name in before}


@pytest.mark.slow
def test_a_new_drive_with_a_used_name_has_its_own_statistics() -> None:
    with clocked(hall(*pumps())) as made:
        made.run(20)
        first = made.poller.statistics()["hall"]
        made.poller.adopt(plant(hall(toy("pump-1", 3), toy("pump-2", 2))))
        made.run(5)
        second = made.poller.statistics()["hall"]
        before, after, span = (one.drives for one in (first, second, second.since(first)))
        assert span["pump-1"].exchanges == after["pump-1"].exchanges > 0
        assert span["pump-2"].exchanges == after["pump-2"].exchanges - before["pump-2"].exchanges > 0
        made.poller.adopt(plant(replace(hall(*pumps()), port="port of roof")))
        made.run(5)
        third = made.poller.statistics()["hall"]
        found = third.since(second)
        assert found.seconds == third.seconds == pytest.approx(5, abs=0.5)
        assert found.exchanges == third.exchanges > 0
        made.poller.reset_statistics()
        made.run(2)
        last = made.poller.statistics()["hall"]
        assert last.since(third).seconds == last.seconds == pytest.approx(2, abs=0.5)


@pytest.mark.slow
def test_a_drive_name_keeps_its_code_in_all_batches() -> None:
    with clocked(hall(*pumps())) as made:
        made.run(1)
        meant: dict[int, str] = {}
        for others in (*OTHERS, (yard(toy("pump-2", 3)),)):
            adopting = made.beside(lambda o=others: made.poller.adopt(plant(hall(pumps()[0]), *o)))
            made.finish(adopting)
            with made._turn:
                made._limit += S
                made._turn.notify_all()
                assert made._turn.wait_for(lambda: made._failure or made._rests, 60)
            while batch := made.poller.take():
                columns = batch.columns()
                for code in set(columns.drive):
                    assert meant.setdefault(code, columns.drives[code]) == columns.drives[code]
        assert {"pump-1", "fan-1", "vent-1", "pump-2"} <= set(meant.values())
