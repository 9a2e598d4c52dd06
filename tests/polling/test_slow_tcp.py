"""Modbus TCP on a path that delays: late, doubled and reordered replies, on a clock that the test sets.

A reply with its request's id needs no proof. A gateway that replies with its own ids is treated like RTU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
from examples import every_fourth, usually
from motors import MAKE, ReceivedRequests
from stories import (
    TAIL,
    TURNS,
    Delay,
    Path,
    PathLine,
    PathWire,
    S,
    bus_over,
    constant,
    jittering,
    read_truly,
    stalling,
)
from tables import table

from multidrop.bus import Bus
from multidrop.control.outcome import Effect
from multidrop.core import Framing, Message, Status, TransactionIds
from multidrop.drive import Drive
from multidrop.errors import BusError
from multidrop.families import YD1000, DelixiModbus, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.sim import EncodedDrive, Faults, MotorDrive, SimulatedDrive, simulated

pytestmark = pytest.mark.story

TCP = "tcp://test-line:502"
FAMILIES = {family.model: family for family in (ErmanERG220, InvtCHE, InnovertIBD, DelixiModbus, YD1000)}
PATHS = [
    (path, seconds)
    for path, delays in ((constant, (0.0, 0.3, 0.6, 1.5, 10.0)), (jittering, (0.6, 10.0)))
    for seconds in delays
]
ON_PATHS = every_fourth(FAMILIES, PATHS, [("innovert-ibd", (constant, 0.6))])
KINDS = ("delay", "twice", "merge")  # faults of a gateway that keep the stream in step


class TrueIds(PathWire):
    """A path behind a gateway that replies with the requests' ids, late as it likes."""

    most_late = 2.0


class OwnIds(PathWire):
    """A path behind a gateway that counts its replies, whatever their requests' ids were."""

    ids = TransactionIds.IGNORE
    most_late = 0.25  # s out of order: beyond the window of three time-outs no rule holds without ids
    count = 0

    def distort(self, reply: bytes) -> bytes:
        self.count += 1
        return (self.count & 0xFFFF).to_bytes(2) + reply[2:]


class TrueIdsPath(Path):
    wires = TrueIds


class OwnIdsPath(Path):
    wires = OwnIds


STORIES = pytest.mark.parametrize("story_of", usually(OwnIdsPath, TrueIdsPath))


def two_of(name: str) -> list[Drive]:
    return [FAMILIES[name](address, name=f"drive-{address}") for address in (1, 2)]


@pytest.mark.long
@STORIES
@pytest.mark.parametrize(("name", "slow"), ON_PATHS)
def test_a_slow_path_costs_time_and_no_truth(
    name: str, slow: tuple[Callable[[float], Delay], float], story_of: type[Path]
) -> None:
    path, seconds = slow
    story = story_of(two_of(name), port=TCP)
    assert {drive.framing for drive in story.drives} == {Framing.TCP}
    answering = story.run_over(path(seconds), TAIL + TURNS * seconds)
    assert answering == {drive.name for drive in story.drives}


@pytest.mark.long
@STORIES
@pytest.mark.parametrize("kind", usually(*KINDS))
def test_replies_late_doubled_and_in_another_order_cost_no_truth(kind: str, story_of: type[Path]) -> None:
    story = story_of([family(at) for at, family in enumerate(FAMILIES.values(), 1)], port=TCP)
    story.wire.faults = Faults(**{kind: 0.2, "late": story.wire.most_late})
    story.run_over(stalling(1.0))
    assert story.wire.struck[kind] > 50


@pytest.mark.long
@pytest.mark.parametrize("story_of", usually(TrueIdsPath, OwnIdsPath))
def test_a_stall_costs_no_truth(story_of: type[Path]) -> None:
    story_of([family(at) for at, family in enumerate(FAMILIES.values(), 1)], port=TCP).run_over(
        stalling(15.0)
    )


@pytest.mark.long
def test_what_is_provably_late_holds_nothing_up() -> None:
    """No request waits for a late reply, and none is sent to prove anything."""
    story = TrueIdsPath(two_of("innovert-ibd"), port=TCP)
    story.run_over(stalling(3.0))
    told = story.clocked.poller.summary()["lines"]["line"]
    assert told["late_replies"] > 0
    assert str(Status.LATE_ANSWER_DUE) not in told["misses"]
    assert {drive for drive, peer in story.clocked.poller.bus("line").peers.items() if peer.proofs} == set()


# ---- by hand ----


@pytest.fixture(params=[TrueIds, OwnIds])
def path_of(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[Bus, PathLine]]:
    def made(sims: Sequence[SimulatedDrive], delay: Delay) -> tuple[Bus, PathLine]:
        return bus_over(request.param(sims, Faults(), port=TCP), delay, sims, monkeypatch)

    return made


@pytest.mark.slow
@pytest.mark.parametrize(("name", "slow"), ON_PATHS)
def test_what_a_bus_reads_over_a_slow_path_is_true(
    name: str,
    slow: tuple[Callable[[float], Delay], float],
    path_of: Callable[..., tuple[Bus, PathLine]],
) -> None:
    path, seconds = slow
    drives = two_of(name)
    opened, line = path_of([EncodedDrive(drive) for drive in drives], path(seconds))
    read_truly(opened, line, drives)


@pytest.mark.slow
@table("seconds", [0.0, 0.6, 4.0])
def test_what_became_of_a_write_over_a_slow_path_is_true(
    seconds: float, path_of: Callable[..., tuple[Bus, PathLine]]
) -> None:
    drive = InnovertIBD(1, ram=["acceleration_time"])
    sim = simulated(drive)
    opened, line = path_of([sim], constant(seconds))
    done = 0
    with opened:
        for turn in range(30):
            asked = float(10 + turn % 3)
            try:
                outcome = drive.try_write(drive.acceleration_time, asked)
            except BusError:
                line.sleep(0.05)
                continue
            if outcome.effect is Effect.UNCONFIRMED:
                continue
            assert outcome.effect is Effect.DONE
            assert (outcome.held, sim["acceleration_time"]) == (asked, asked)
            done += 1
    assert done > 10


@pytest.mark.slow
@table("seconds", [0.0, 0.6])
@table("model", FAMILIES)
def test_a_stop_over_a_slow_path_is_seen_to_be_done(
    model: str, seconds: float, path_of: Callable[..., tuple[Bus, PathLine]]
) -> None:
    drive = DelixiModbus(1) if model == "delixi-modbus" else MAKE[model](1)
    sim = simulated(drive)
    assert isinstance(sim, MotorDrive)
    sim.motor.acceleration_time = sim.motor.deceleration_time = 0.2
    opened, line = path_of([sim], constant(seconds))
    received = ReceivedRequests(sim)
    sent_after: list[float] = []
    begun = line.now

    def note(request: Message) -> bool:
        if request.function > 4:
            sent_after.append((line.now - begun) / S)
        return False

    received.loses = note
    with opened:
        line.wire.advance(line.now / S)  # its clock starts
        sim.motor.run(1)
        opened.drives[0].stop()
    assert not sim.motor.energised
    assert sent_after[0] < 1
    assert (line.now - begun) / S < 8 * seconds + 3
