"""Drives are added to, and removed from, a running poller and a bus."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from lines import line, plant, polled, rows_of, until
from toy import Toy

from multidrop.bus import Bus
from multidrop.errors import NoReply
from multidrop.families import YD1000, InvtCHE
from multidrop.plant.loader import load_plant
from multidrop.plant.model import PolledDrive
from multidrop.poller import Poller
from multidrop.polling.jobs import AHEAD_NS
from multidrop.sim import EncodedDrive, Simulator, Wire, proof, simulated

ROOT = Path(__file__).parents[2]
CURRENT = Toy.registers["output_current"]
EVERY_S = 0.02
QUEUED = round(AHEAD_NS / 1e9 / EVERY_S) + 2  # highest number of queued requests of one drive


def pump(address: int, name: str = "", every: float | None = None) -> PolledDrive:
    return polled(Toy(address, name=name or f"pump-{address}"), [CURRENT], every)


@pytest.fixture
def port() -> Iterator[str]:
    """Return the port of a line on which the addresses 1 and 2 answer."""
    with Simulator([Wire([EncodedDrive(Toy(1)), EncodedDrive(Toy(2))], unpaced=True)]) as sim:
        yield sim.wires[0].path


class Seen:
    """Collects a poller's rows, by drive."""

    def __init__(self, poller: Poller) -> None:
        self._poller = poller
        self.values: dict[str, list[float]] = {}
        self.last_asked_ns: dict[str, int] = {}
        self.statuses: set[str] = set()

    def of(self, name: str) -> list[float]:
        for row in rows_of(self._poller):
            self.statuses.add(row.status)
            if row.value is not None:
                self.values.setdefault(row.drive, []).append(row.value)
                self.last_asked_ns[row.drive] = row.monotonic_ns
        return self.values.get(name, [])


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("every", [None, EVERY_S])
def test_a_drive_is_added_and_removed_while_others_are_polled(port: str, every: float | None) -> None:
    second = pump(2, every=every)
    with Poller(plant(line(port, pump(1, every=every)))) as poller:
        seen = Seen(poller)
        until(lambda: seen.of("pump-1"))
        for _ in range(3):
            before = len(seen.of("pump-2"))
            poller.add("line", second)
            until(lambda before=before: len(seen.of("pump-2")) > before)
            poller.remove("line", "pump-2")
            assert "pump-2" not in poller.summary()["lines"]["line"]["drives"]
            first = len(seen.of("pump-1"))
            until(lambda first=first: len(seen.of("pump-1")) > first + QUEUED)
            settled_ns = time.monotonic_ns()  # by now, all earlier requests are over
            until(lambda first=first: len(seen.of("pump-1")) > first + 2 * QUEUED)
            assert seen.last_asked_ns["pump-2"] < settled_ns
    assert {*seen.of("pump-1")} == {proof(Toy(1), CURRENT)}
    assert {*seen.of("pump-2")} == {proof(Toy(2), CURRENT)}


def test_a_drive_added_after_all_drives_were_removed_is_polled(port: str) -> None:
    first = pump(1)
    with Poller(plant(line(port, first))) as poller:
        seen = Seen(poller)
        until(lambda: seen.of("pump-1"))
        poller.remove("line", "pump-1")
        before = len(seen.of("pump-1"))
        poller.add("line", first)
        until(lambda: len(seen.of("pump-1")) > before + 20)
        assert poller.summary()["samples"] > before


@pytest.mark.slow
def test_removing_a_silent_drive_does_not_disturb_other_drives(port: str) -> None:
    with Poller(plant(line(port, pump(1), pump(3, "dead")))) as poller:
        seen = Seen(poller)
        until(lambda: "not asked: drive is silent" in (seen.of("dead") and ()) or len(seen.statuses) > 1)
        poller.remove("line", "dead")
        before = len(seen.of("pump-1"))
        until(lambda: len(seen.of("pump-1")) > before + 50)


def test_invalid_additions_and_removals_are_errors(port: str) -> None:
    with Poller(plant(line(port, pump(1)))) as poller:
        for polled_drive, sentence in (
            (pump(1, "other"), "address 1 is taken by pump-1"),
            (pump(2, "pump-1"), "two drives are called pump-1; give each its own name"),
            (polled(InvtCHE(3), [CURRENT]), "this output_current is not a register of invt-che@3"),
        ):
            with pytest.raises(ValueError, match=sentence):
                poller.add("line", polled_drive)
        with pytest.raises(ValueError, match="there is no line 'hall'; there are line"):
            poller.add("hall", pump(2))
        with pytest.raises(ValueError, match="there is no drive 'pump-2' on line 'line'"):
            poller.remove("line", "pump-2")
        assert list(poller.summary()["lines"]["line"]["drives"]) == ["pump-1"]
    with pytest.raises(ValueError, match="polling has ended"):
        poller.add("line", pump(2))


@pytest.mark.slow
def test_an_unpolled_drive_does_not_disturb_other_drives(port: str) -> None:
    with Poller(plant(line(port, pump(1), polled(Toy(3, name="pump-3"), [])))) as poller:
        seen = Seen(poller)
        until(lambda: len(seen.of("pump-1")) > 50)
        assert seen.of("pump-3") == []


def test_calls_of_a_detached_drive_raise_and_send_nothing(port: str) -> None:
    with Bus(port) as bus:
        ours = bus.attach(Toy, address=1, name="pump-1")
        assert ours.read(CURRENT) == proof(Toy(1), CURRENT)
        peer = bus.peer(ours)
        proofs = peer.proofs
        bus.detach(ours)
        assert bus.drives == []
        for do in (lambda: ours.read(CURRENT), ours.stop, lambda: bus.detach(ours)):
            with pytest.raises(ValueError, match="pump-1 is not attached to this bus"):
                do()
        again = bus.attach(Toy, address=1, name="pump-1")
        assert bus.peer(again) is peer  # the peer that knows which late replies are due
        assert peer.proofs is proofs  # the core may still be using them


@pytest.mark.slow
def test_a_drive_attached_at_a_used_address_expects_late_replies_to_the_old_one(port: str) -> None:
    with Bus(port) as bus:
        gone = bus.attach(Toy, address=9)
        with pytest.raises(NoReply):
            gone.read(CURRENT)
        due_ns = bus.peer(gone).late_until_ns
        assert due_ns > 0
        bus.detach(gone)
        new = bus.attach(InvtCHE, address=9)
        assert bus.peer(new).late_until_ns == due_ns


def test_no_drive_is_detached_during_stop_all(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with Bus(port) as bus:
        ours = bus.attach(Toy, address=1, name="pump-1")
        begun, go_on = threading.Event(), threading.Event()
        step = bus._stopper.do

        def slow(*arguments: object) -> object:
            begun.set()
            assert go_on.wait(120)
            return step(*arguments)

        monkeypatch.setattr(bus._stopper, "do", slow)
        stopping = threading.Thread(target=bus.stop_all)
        stopping.start()
        assert begun.wait(120)
        leaving = threading.Thread(target=bus.detach, args=(ours,))
        leaving.start()
        leaving.join(0.05)
        assert leaving.is_alive()
        assert bus.drives == [ours]
        go_on.set()
        stopping.join(120)
        leaving.join(120)
        assert bus.drives == []


@pytest.mark.slow
@pytest.mark.long
def test_many_threads_can_read_poll_and_change_lines_concurrently() -> None:
    """A short run of the benchmark many_at_once, which normally takes ten minutes with 64 lines."""
    program = [
        sys.executable,
        "-m",
        "bench.questions.safety.many_at_once",
        "--lines=6",
        "--drives=5",
        "--minutes=0.08",
        "--rounds=3",
    ]
    done = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("\nnothing misattributed, nothing lost, nothing grows\n")


def test_statistics_can_be_read_while_drives_leave(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading statistics does not fail if another thread removes a drive at the same time."""
    with Bus(port) as bus:
        ours = [bus.attach(Toy, address=address, name=f"pump-{address}") for address in (1, 2)]
        counters = bus.peer(ours[0]).counters

        def leave_and_tell() -> object:
            bus.detach(ours[1])
            return counters()

        monkeypatch.setattr(bus.peer(ours[0]), "counters", leave_and_tell)
        assert list(bus.statistics().drives) == ["pump-1", "pump-2"]
        monkeypatch.undo()
        assert list(bus.statistics().drives) == ["pump-1"]


PLANT = """
[[line]]
name = "a"
port = "{port}"

[[line.drive]]
name = "pump"
model = "yd1000"
address = 1
poll = ["output_frequency"]
"""


@pytest.mark.slow
def test_a_drive_attached_to_the_bus_can_also_be_polled(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    with Simulator([Wire([simulated(YD1000(1)), simulated(YD1000(9))])]) as simulator:
        path.write_text(PLANT.format(port=simulator.wires[0].path))
        poller = Poller(load_plant(path))
        extra = poller.bus("a").attach(YD1000, 9)
        with poller:
            assert extra.read(extra.output_frequency) == 0
            until(lambda: any(row.drive == "pump" for row in poller.take() or ()))
            with pytest.raises(ValueError, match="is not polled here; there are pump"):
                poller.set_rate(extra, None, 1.0)
