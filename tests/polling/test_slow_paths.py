"""Network paths that delay replies, such as modems or stalled networks, on a clock that the test sets.

No value is assigned to the wrong register, and polling continues. Over Modbus TCP, a reply is recognised by
its request's id. A gateway that replies with its own ids is treated like an RTU line.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import pytest
from lines import proof
from motors import LINES, MAKE, ReceivedRequests, of_all_variants, of_one_variant
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
from tables import every_fourth, table, usually

from multidrop.bus import Bus
from multidrop.control.outcome import Effect
from multidrop.core import Framing, Message, Status, TransactionIds
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, Table, reading
from multidrop.errors import BusError
from multidrop.families import YD1000, DelixiModbus, DelixiNative, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.sim import EncodedDrive, Faults, MotorDrive, SimulatedDrive, simulated

PathOf = Callable[..., tuple[Bus, PathLine]]

pytestmark = pytest.mark.story

PATHS = [
    (path, seconds)
    for path, delays in (
        (constant, (0.0, 0.1, 0.3, 0.45, 0.6, 1.5, 4.0, 10.0)),
        (jittering, (0.3, 0.6, 10.0)),
    )
    for seconds in delays
]
FRAMINGS = ("innovert-ibd rtu", "innovert-ibd ascii", "delixi-native delixi")
STORIES = every_fourth(LINES, PATHS, [(name, (constant, 0.6)) for name in FRAMINGS])
STALLS = every_fourth(LINES, (0.9, 0.1, 0.3, 3.0, 15.0, 60.0), [("innovert-ibd rtu", 0.9)])
READS = every_fourth(LINES, PATHS, [(name, (constant, 0.6)) for name in LINES])
ASKED = [pair for pair in READS if "native" not in pair.values[0]]


def check_story(story: Path, slow: tuple[Callable[[float], Delay], float]) -> None:
    """Poll over a slow path, and check that each drive is read and no value is misattributed."""
    path, seconds = slow
    answering = story.run_over(path(seconds), TAIL + TURNS * seconds)
    assert answering == {drive.name for drive in story.drives}


def check_writes(opened: Bus, line: PathLine, sim: SimulatedDrive, name: str) -> None:
    """Check that the reported outcome of each of thirty writes is true."""
    (drive,) = opened.drives
    done = 0
    with opened:
        for turn in range(30):
            asked = float(10 + turn % 3)
            try:
                outcome = drive.try_write(drive.register(name), asked)
            except BusError:
                line.sleep(0.05)
                continue
            if outcome.effect is Effect.UNCONFIRMED:
                continue
            assert outcome.effect is Effect.DONE
            assert (outcome.held, sim[name]) == (asked, asked)
            done += 1
    assert done > 10


def check_stop(opened: Bus, line: PathLine, sim: SimulatedDrive, seconds: float) -> int:
    """Check that a stop is sent immediately and confirmed; return how often it was sent."""
    assert isinstance(sim, MotorDrive)
    sim.motor.acceleration_time = sim.motor.deceleration_time = 0.2
    received = ReceivedRequests(sim)
    sent_after: list[float] = []
    begun = line.now

    def note(request: Message) -> bool:
        if request in received.writes:
            sent_after.append((line.now - begun) / S)
        return False

    received.loses = note
    with opened:
        line.wire.advance(line.now / S)  # the clock of the wire follows that of the line
        sim.motor.run(1)
        opened.drives[0].stop()
    assert not sim.motor.energised
    assert sent_after[0] < 1  # s; includes the identity check, in which one read may get no reply
    assert (line.now - begun) / S < 8 * seconds + 3
    return len(sent_after)


@pytest.mark.long
@pytest.mark.parametrize(("name", "slow"), STORIES)
def test_no_value_is_misattributed_over_a_slow_path(
    name: str, slow: tuple[Callable[[float], Delay], float]
) -> None:
    check_story(Path(of_one_variant(LINES[name])), slow)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(("name", "longest"), STALLS)
def test_no_value_is_misattributed_over_a_stalled_path(name: str, longest: float) -> None:
    Path(of_one_variant(LINES[name])).run_over(stalling(longest))


class OneByOne(Drive):
    """A device whose registers are read one at a time, so that all its replies look alike."""

    title = "a user's device"
    framings = (Framing.RTU,)
    most_registers: ClassVar[Mapping[Table, int]] = {HOLDING: 1}
    power = reading(0x10)
    energy = reading(0x40)


@pytest.mark.parametrize("delay", usually(constant(4.0), constant(0.6), stalling(0.9), stalling(15.0)))
def test_late_replies_that_look_alike_are_never_taken_for_each_other(delay: Delay) -> None:
    """A reply to a read of another table, even an exception, proves that no earlier reply is still due."""
    drives = [OneByOne(address, name=f"meter-{address}") for address in (1, 2)]
    story = Path(drives)
    assert story.run_over(delay, TAIL + TURNS * 15) == {drive.name for drive in story.drives}


@pytest.fixture
def path_of(monkeypatch: pytest.MonkeyPatch) -> PathOf:
    def made(sims: list[SimulatedDrive], delay: Delay) -> tuple[Bus, PathLine]:
        return bus_over(PathWire(sims, Faults()), delay, sims, monkeypatch)

    return made


@pytest.mark.slow
@pytest.mark.parametrize(("name", "slow"), READS)
def test_a_read_over_a_slow_path_returns_the_right_value(
    name: str, slow: tuple[Callable[[float], Delay], float], path_of: PathOf
) -> None:
    """A client reads four registers of each of two drives in turn, and retries failed reads."""
    path, seconds = slow
    drives = of_one_variant(LINES[name])
    opened, line = path_of([EncodedDrive(drive) for drive in drives], path(seconds))
    read_truly(opened, line, drives)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "slow"), ASKED)
def test_a_raw_read_over_a_slow_path_returns_the_right_value(
    name: str, slow: tuple[Callable[[float], Delay], float], path_of: PathOf
) -> None:
    """Raw reads alternate with similar reads of other addresses. No raw read is retried."""
    path, seconds = slow
    drives = [drive for drive in of_one_variant(LINES[name]) if drive.framing is not Framing.DELIXI]
    opened, line = path_of([EncodedDrive(drive) for drive in drives], path(seconds))
    plain = {
        drive: [each for each in drive.readings() if each.words == 1 and each not in drive.known_counts()][:5]
        for drive in drives
    }
    read: Counter[str] = Counter()
    with opened:
        for _ in range(24):
            for drive, registers in plain.items():
                for turn, register in enumerate(registers):
                    try:
                        if turn % 2:
                            assert drive.read(register) == proof(drive, register)
                            continue
                        data = drive.read_raw(register.table.read, register.address, 1, expiry=30.0)
                    except BusError:
                        line.sleep(0.05)
                    else:
                        assert register.number_in(data, 0) == proof(drive, register)
                        read[drive.name] += 1
    assert set(read) == {drive.name for drive in drives}


WRITTEN = {
    "setpoint": InvtCHE(1),
    "frequency": YD1000(1),
    "acceleration_time": InnovertIBD(1, ram=["acceleration_time"]),
    "deceleration_time": ErmanERG220(1, ram=["deceleration_time"]),
}


@pytest.mark.parametrize("seconds", usually(0.6, 0.0, 0.3, 4.0))
@pytest.mark.parametrize("name", WRITTEN)
def test_the_reported_outcomes_of_writes_over_a_slow_path_are_true(
    name: str, seconds: float, path_of: PathOf
) -> None:
    sim = simulated(WRITTEN[name])
    check_writes(*path_of([sim], constant(seconds)), sim, name)


@pytest.mark.parametrize("name", WRITTEN)
def test_the_bus_waits_for_a_write_reply_that_is_slower_than_reads(
    name: str, path_of: PathOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the reply to the write is slow. The bus waits for it, and does not read the value back."""
    drive = WRITTEN[name]
    sim = simulated(drive)
    opened, line = path_of([sim], constant(0.0))
    register = drive.register(name)
    write, slow = sim.write, iter([0.25])

    def write_slowly(function: int, start: int, raws: list[int]) -> None:
        write(function, start, raws)
        line.wire.delay = lambda now: next(slow, 0.0)

    monkeypatch.setattr(sim, "write", write_slowly)
    with opened:
        for _ in range(12):
            drive.read(register)
        assert opened.peer(drive).timeout < 0.15
        assert drive.try_write(register, 11.0).effect is Effect.DONE
        assert not any(slow)
        assert (opened.peer(drive).counters().late, opened.peer(drive).silences) == (0, 0)


def test_the_timeout_of_a_delixi_drive_is_never_shorter_than_80_ms(path_of: PathOf) -> None:
    for drive in (DelixiModbus(1), DelixiNative(1)):
        opened, _ = path_of([simulated(drive)], constant(0.0))
        with opened:
            for _ in range(30):
                drive.read(drive.register("fault"))
            assert opened.peer(drive).timeout == 0.08


@pytest.mark.parametrize("seconds", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("model", MAKE)
def test_a_stop_over_a_slow_path_is_confirmed(model: str, seconds: float, path_of: PathOf) -> None:
    """The stop's first frame is sent immediately. The reads after it wait for slow replies."""
    sim = simulated(MAKE[model](1))
    assert check_stop(*path_of([sim], constant(seconds)), sim, seconds) <= 6


@pytest.mark.long
@pytest.mark.parametrize("kind", usually("drop", "flip", "split", "noise"))
def test_no_value_is_misattributed_over_a_slow_path_with_other_faults(kind: str) -> None:
    story = Path(of_all_variants())
    story.wire.faults = Faults(**{kind: 0.1})
    story.run_over(stalling(3.0))


TCP = "tcp://test-line:502"
FAMILIES = {family.model: family for family in (ErmanERG220, InvtCHE, InnovertIBD, DelixiModbus, YD1000)}
TCP_PATHS = [
    (path, seconds)
    for path, delays in ((constant, (0.0, 0.3, 0.6, 1.5, 10.0)), (jittering, (0.6, 10.0)))
    for seconds in delays
]
ON_TCP_PATHS = every_fourth(FAMILIES, TCP_PATHS, [("innovert-ibd", (constant, 0.6))])
KINDS = ("delay", "twice", "merge")  # faults after which each frame of the stream is still complete


class TrueIds(PathWire):
    """A path behind a gateway whose replies have the ids of their requests, after arbitrary delays."""

    most_late = 2.0


class OwnIds(PathWire):
    """A path behind a gateway that numbers its replies itself, regardless of the requests' ids."""

    ids = TransactionIds.IGNORE
    most_late = 0.25  # s; without ids, a reply that comes after three timeouts cannot be recognised
    count = 0

    def distort(self, reply: bytes) -> bytes:
        self.count += 1
        return (self.count & 0xFFFF).to_bytes(2) + reply[2:]


class TrueIdsPath(Path):
    wires = TrueIds


class OwnIdsPath(Path):
    wires = OwnIds


every_gateway = pytest.mark.parametrize("story_of", usually(OwnIdsPath, TrueIdsPath))


def two_of(name: str) -> list[Drive]:
    return [FAMILIES[name](address, name=f"drive-{address}") for address in (1, 2)]


@pytest.mark.long
@every_gateway
@pytest.mark.parametrize(("name", "slow"), ON_TCP_PATHS)
def test_no_value_is_misattributed_over_a_slow_gateway(
    name: str, slow: tuple[Callable[[float], Delay], float], story_of: type[Path]
) -> None:
    story = story_of(two_of(name), port=TCP)
    assert {drive.framing for drive in story.drives} == {Framing.TCP}
    check_story(story, slow)


@pytest.mark.long
@every_gateway
@pytest.mark.parametrize("kind", usually(*KINDS))
def test_late_doubled_or_reordered_tcp_replies_are_not_misattributed(kind: str, story_of: type[Path]) -> None:
    story = story_of([family(at) for at, family in enumerate(FAMILIES.values(), 1)], port=TCP)
    story.wire.faults = Faults(**{kind: 0.2, "late": story.wire.most_late})
    story.run_over(stalling(1.0))
    assert story.wire.struck[kind] > 50


@pytest.mark.long
@pytest.mark.parametrize("story_of", usually(TrueIdsPath, OwnIdsPath))
def test_no_value_is_misattributed_over_a_stalled_gateway(story_of: type[Path]) -> None:
    story_of([family(at) for at, family in enumerate(FAMILIES.values(), 1)], port=TCP).run_over(
        stalling(15.0)
    )


@pytest.mark.long
def test_a_late_tcp_reply_with_a_known_id_delays_no_request() -> None:
    """No request waits for a late reply, and no extra request is sent to prove that no late reply is due."""
    story = TrueIdsPath(two_of("innovert-ibd"), port=TCP)
    story.run_over(stalling(3.0))
    told = story.clocked.poller.summary()["lines"]["line"]
    assert told["late_replies"] > 0
    assert str(Status.LATE_ANSWER_DUE) not in told["misses"]
    assert {drive for drive, peer in story.clocked.poller.bus("line").peers.items() if peer.proofs} == set()


@pytest.fixture(params=[TrueIds, OwnIds])
def gateway_path_of(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> PathOf:
    def made(sims: Sequence[SimulatedDrive], delay: Delay) -> tuple[Bus, PathLine]:
        return bus_over(request.param(sims, Faults(), port=TCP), delay, sims, monkeypatch)

    return made


@pytest.mark.slow
@pytest.mark.parametrize(("name", "slow"), ON_TCP_PATHS)
def test_a_read_over_a_slow_gateway_returns_the_right_value(
    name: str, slow: tuple[Callable[[float], Delay], float], gateway_path_of: PathOf
) -> None:
    path, seconds = slow
    drives = two_of(name)
    read_truly(*gateway_path_of([EncodedDrive(drive) for drive in drives], path(seconds)), drives)


@pytest.mark.slow
@table("seconds", [0.0, 0.6, 4.0])
def test_the_reported_outcomes_of_writes_over_a_slow_gateway_are_true(
    seconds: float, gateway_path_of: PathOf
) -> None:
    sim = simulated(InnovertIBD(1, ram=["acceleration_time"]))
    check_writes(*gateway_path_of([sim], constant(seconds)), sim, "acceleration_time")


@pytest.mark.slow
@table("seconds", [0.0, 0.6])
@table("model", FAMILIES)
def test_a_stop_over_a_slow_gateway_is_confirmed(model: str, seconds: float, gateway_path_of: PathOf) -> None:
    sim = simulated(DelixiModbus(1) if model == "delixi-modbus" else MAKE[model](1))
    check_stop(*gateway_path_of([sim], constant(seconds)), sim, seconds)
