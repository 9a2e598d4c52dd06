"""Late replies to requests sent before the port was reopened, or by another process, are recognised."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from lines import PATIENCE, line, patient, plant, polled, rows_of, until
from motors import LINES, of_one_variant
from stories import PathWire, bus_over, constant, read_truly
from tables import table
from toy import QuickToy, Toy

from multidrop import Bus, NoReply, Poller
from multidrop.core import build_request
from multidrop.drive import Drive
from multidrop.planning.blocks import blocks
from multidrop.sim import EncodedDrive, Faults, SimulatedDrive, Simulator, Wire, simulated
from multidrop.transport import peers


class Successor(QuickToy):
    """A drive of another family at the same address."""

    model = "successor"


class HoldingWire(Wire):
    """A line that, once `holds` is set, sends the next reply only together with the reply after it."""

    holds = False
    _kept = b""

    def distort(self, reply: bytes) -> bytes:
        if self.holds:
            self.holds = False
            self._kept = reply
            return b""
        kept, self._kept = self._kept, b""
        return kept + reply


@pytest.fixture
def sim() -> SimulatedDrive:
    sim = simulated(QuickToy(1))
    sim["output_current"], sim["mystery"] = 1.11, 7777
    return sim


@pytest.fixture
def wire(sim: SimulatedDrive) -> Iterator[HoldingWire]:
    wire = HoldingWire([sim], unpaced=True)
    with Simulator([wire]):
        yield wire


def leave_a_reply_behind(wire: HoldingWire, port: str) -> None:
    """Send a request whose reply is held back, and close the bus."""
    with Bus(port) as bus:
        pump = bus.attach(QuickToy, 1)
        assert pump.read(QuickToy.output_current) == 1.11
        wire.holds = True
        with pytest.raises(NoReply):
            bus._exchanges.values(pump, [QuickToy.mystery], 1)
        assert bus.peer(pump).owes


@pytest.mark.parametrize("family", [QuickToy, Successor])
def test_a_late_reply_on_a_reopened_port_is_not_read_as_another_register(
    wire: HoldingWire, family: type[Toy], monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_a_reply_behind(wire, wire.path)
    monkeypatch.setattr(QuickToy, "response_timeout", PATIENCE)  # long enough for a busy computer
    with Bus(wire.path) as bus:
        pump = bus.attach(family, 1)
        assert bus.peer(pump).owes
        assert pump.read(family.output_current) == 1.11
        assert bus.peer(pump).late >= 1  # a busy computer may make another reply late


def test_no_polled_value_comes_from_a_late_reply_on_a_reopened_port(wire: HoldingWire) -> None:
    leave_a_reply_behind(wire, wire.path)
    drive = QuickToy(1, name="pump")
    values: set[float] = set()
    with Poller(plant(line(wire.path, polled(drive, [QuickToy.output_current])))) as poller:
        until(lambda: values.update(row.value for row in rows_of(poller) if row.value is not None) or values)
    assert values == {1.11}


def test_late_replies_are_recognised_under_another_port_name(wire: HoldingWire, tmp_path: Path) -> None:
    link = tmp_path / "hall"
    link.symlink_to(wire.path)
    leave_a_reply_behind(wire, str(link))
    with Bus(wire.path) as bus:
        assert bus.peer(bus.attach(QuickToy, 1)).owes


def test_a_new_pseudo_terminal_with_a_used_number_has_another_identity() -> None:
    def made() -> set[str]:
        ours, theirs = os.openpty()
        try:
            return peers.identities_of(os.ttyname(theirs))
        finally:
            os.close(theirs)
            os.close(ours)

    first = made()
    until(lambda: made() != first)  # the creation times differ after some ms


@patient  # on a busy computer, the reply to the first attempt would come late
def test_a_drive_without_late_replies_is_not_remembered(wire: HoldingWire) -> None:
    with Bus(wire.path) as bus:
        bus.attach(QuickToy, 1).read(QuickToy.output_current)
    assert not peers.identities_of(wire.path) & peers._former.keys()


def test_a_drive_is_remembered_exactly_as_long_as_late_replies_are_expected(
    wire: HoldingWire, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_a_reply_behind(wire, wire.path)
    names = peers.identities_of(wire.path)
    assert names <= peers._former.keys()
    now_ns = peers.clock.now_ns
    later: Callable[[], int] = lambda: now_ns() + peers.KEPT_NS  # noqa: E731
    monkeypatch.setattr(peers.clock, "now_ns", later)
    peers.remember_former_peers(["elsewhere"], [])
    assert not names & peers._former.keys()


BEGIN = 1000.0  # s; start of the simulated clock

DELAY = 0.1  # s; delay of the network between line and drive


def answer_to_another(drive: Drive) -> bytes:
    """Return a drive's reply to a read of its second register."""
    wire = PathWire([EncodedDrive(drive)], Faults())
    wire.delay = constant(0.0)
    wire.open()
    (block,) = blocks(drive, [drive.readings()[1]])
    wire.advance(BEGIN)
    wire.receive(build_request(drive.framing, block.request), BEGIN, drive.settings.baudrate)
    said = b""
    for step in range(2000):
        said += wire.advance(BEGIN + step / 1000)
    assert said
    return said


@pytest.mark.long
@table("name", LINES)
def test_a_late_reply_to_an_earlier_process_is_never_the_value_of_a_register(name: str) -> None:
    """Every value read belongs to its register, from the first read on."""
    drives = of_one_variant(LINES[name])
    wire = PathWire([EncodedDrive(drive) for drive in drives], Faults())
    wire._path.append((BEGIN + DELAY / 2, answer_to_another(drives[0])))
    with pytest.MonkeyPatch.context() as patch:
        opened, line = bus_over(wire, constant(DELAY), [EncodedDrive(drive) for drive in drives], patch)
        read_truly(opened, line, drives)
