"""Simulated faults: the effect of each fault on the bytes of a line, and the loading of a faults file."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import checksums
import pytest
from lines import timeline, until
from tables import table
from toy import Toy

from multidrop.cli import main
from multidrop.core import STATUSES, Message, Peer
from multidrop.drive.family import Drive
from multidrop.errors import LineError, PortLost
from multidrop.families import MODELS, YD1000
from multidrop.sim import DriveFaults, Faults, FaultyWire, SimulatedDrive, Simulator, load_faults, simulated
from multidrop.sim.faults import overload_code, rates_of
from multidrop.sim.motor import MotorDrive
from multidrop.toml_check import parse_duration
from multidrop.transport.drive_reads import make_exchange
from multidrop.transport.line import Line

READ = checksums.rtu("01 03 00 02 00 01")
REPLY = checksums.rtu("01 03 02 00 00")
START = checksums.rtu("01 06 10 00 C4 00")  # start command of a YD1000
WHOLE = 5.0  # seconds after which every delayed byte has arrived


class LineClient:
    """The client of a line with faults. Simulated time advances with its requests."""

    def __init__(self, *drives: SimulatedDrive, **faults: Any) -> None:
        self.wire = FaultyWire(drives or [SimulatedDrive(Toy(1))], Faults(**faults))
        self.now = 0.0

    def after(self, request: bytes = READ) -> list[tuple[float, bytes]]:
        begun = self.now
        self.wire.receive(request, begun)
        pieces = timeline(self.wire, begun + WHOLE)
        self.now += WHOLE
        return [(at - begun, piece) for at, piece in pieces]

    def bytes_after(self, request: bytes = READ) -> bytes:
        return b"".join(piece for _, piece in self.after(request))


def bits(one: bytes, other: bytes) -> int:
    return (int.from_bytes(one) ^ int.from_bytes(other)).bit_count()


def test_simulated_line_without_faults_delivers_the_plain_reply() -> None:
    assert LineClient().bytes_after() == REPLY


def test_simulated_faults_with_the_same_seed_are_the_same() -> None:
    def story(seed: int) -> list[Any]:
        line = LineClient(seed=seed, drop=0.2, delay=0.3, noise=0.2, merge=0.2, split=0.3)
        return [line.after() for _ in range(50)]

    assert story(1) == story(1) != story(2)


@table(("fault", "length"), [("drop", -1), ("flip", 0), ("repeat", 1)])
def test_damaged_frame_has_exactly_one_simulated_fault(fault: str, length: int) -> None:
    line = LineClient(**{fault: 0.5})
    found = [line.bytes_after() for _ in range(200)]
    damaged = [each for each in found if each not in (REPLY, b"")]
    # in about a quarter of the exchanges, the reply is damaged but not the request
    assert 20 < len(damaged) < 80
    assert {len(each) - len(REPLY) for each in damaged} == {length}
    if fault == "flip":
        assert {bits(each, REPLY) for each in damaged} == {1}
    assert line.wire.struck[fault] >= len(damaged) + found.count(b"")


def test_a_simulated_line_can_send_a_reply_twice() -> None:
    assert LineClient(twice=1).bytes_after() == 2 * REPLY


def test_a_simulated_line_can_delay_a_reply() -> None:
    usual = LineClient().after()[0][0]
    delays = [LineClient(delay=1, late=0.5, seed=seed).after()[0][0] - usual for seed in range(50)]
    assert 0 <= min(delays) < 0.1 < 0.4 < max(delays) <= 0.5


def test_a_simulated_line_can_send_two_replies_together() -> None:
    line = LineClient(SimulatedDrive(Toy(1)), SimulatedDrive(Toy(2)), merge=1, late=4.0)
    line.wire.receive(READ, 0.0)
    assert timeline(line.wire, 0.3) == []
    line.wire.receive(checksums.rtu("02 03 00 02 00 01"), 0.3)
    received = timeline(line.wire, WHOLE)
    assert b"".join(piece for _, piece in received) == REPLY + checksums.rtu("02 03 02 00 00")
    assert received[-1][0] < 0.5


def test_delayed_reply_is_sent_alone_if_no_further_reply_follows() -> None:
    line = LineClient(merge=1, late=0.2)
    received = line.after()
    assert b"".join(piece for _, piece in received) == REPLY
    assert received[-1][0] < 0.4


def test_a_simulated_line_can_pause_inside_a_reply() -> None:
    pauses = []
    for seed in range(50):
        times, pieces = zip(*LineClient(split=1, pause=0.5, seed=seed).after(), strict=True)
        assert b"".join(pieces) == REPLY
        pauses.append(times[-1] - times[0] - 6 * Toy(1).settings.character)
    assert max(pauses) > 0.4


def test_a_simulated_line_can_echo_a_request() -> None:
    assert LineClient(echo=1).bytes_after() == READ + REPLY


def test_a_simulated_line_can_send_noise_before_a_reply() -> None:
    lengths = set()
    line = LineClient(noise=1, burst=9)
    for _ in range(100):
        received = line.bytes_after()
        assert received.endswith(REPLY)
        lengths.add(len(received) - len(REPLY))
    assert lengths == set(range(1, 10))


def test_a_simulated_line_can_send_noise_when_a_motor_starts() -> None:
    line = LineClient(simulated(YD1000(1)), start_noise=1)
    stop = checksums.rtu("01 06 10 00 C0 00")
    assert line.bytes_after(stop) == stop
    assert len(line.bytes_after(START)) > len(START)
    assert line.bytes_after(START) == START  # no noise, because the motor already runs
    assert line.wire.struck["start_noise"] == 1


def two_drives(**faults: Any) -> LineClient:
    """Return the client of a line with two drives; the second drive has these faults."""
    drives = [SimulatedDrive(Toy(1, name="sound")), SimulatedDrive(Toy(2, name="flaky"))]
    return LineClient(*drives, drives={"flaky": DriveFaults(**faults)})


FLAKY_READ, FLAKY_REPLY = checksums.rtu("02 03 00 02 00 01"), checksums.rtu("02 03 02 00 00")


@table("fault", ["loss", "damage", "delay"])
def test_simulated_faults_of_one_drive_affect_only_its_replies(fault: str) -> None:
    line = two_drives(**{fault: 1}, late=3.0)
    usual = LineClient().after()[0][0]
    assert line.bytes_after() == REPLY
    received = line.after(FLAKY_READ)
    data = b"".join(piece for _, piece in received)
    if fault == "loss":
        assert data == b""
    elif fault == "damage":
        assert bits(data, FLAKY_REPLY) == 1
    else:
        assert data == FLAKY_REPLY
        assert received[0][0] > usual + 0.1
    assert line.wire.struck == {fault: 1}


def test_a_simulated_drive_can_be_silent_for_a_set_time() -> None:
    line = two_drives(silence=30.0, silent_for=9.0, first=10.0)
    replies = [line.bytes_after(FLAKY_READ) == FLAKY_REPLY for _ in range(10)]  # one request every 5 s
    assert replies == [True, True, False, False, True, True, True, True, False, False]
    assert line.bytes_after() == REPLY


def test_simulated_faults_can_trip_a_motor_and_change_its_load() -> None:
    sim = simulated(YD1000(1, name="flaky"))
    assert isinstance(sim, MotorDrive)
    line = LineClient(sim, drives={"flaky": DriveFaults(trip=20.0, first=10.0, drift=0.2)})
    loads = set()
    for _ in range(3):
        line.after()  # no trip occurs, because the motor is at rest
        loads.add(sim.motor.load)
    assert sim.motor.fault == 0
    assert len(loads) == 3
    assert all(0.2 <= load <= 0.6 for load in loads)
    for request in (START, READ, READ, READ, READ):
        line.after(request)
    assert sim.motor.fault == overload_code(sim.drive)


@table("model", MODELS.values())
def test_overload_fault_code_of_every_family_is_valid(model: type[Drive]) -> None:
    drive = model(1)
    assert 0 < overload_code(drive) < 0x10000


def test_faults_file_may_not_trip_a_drive_without_a_motor() -> None:
    with pytest.raises(ValueError, match="flaky has no simulated motor: remove its keys `trip` and `drift`"):
        two_drives(trip=1.0)


@pytest.mark.parametrize("port", ["link", "socket://127.0.0.1:0"])
def test_simulated_port_returns_at_the_same_path_after_a_hang_up(port: str, tmp_path: Path) -> None:
    where = str(tmp_path / port) if port == "link" else port
    wire = FaultyWire([simulated(Toy(1))], Faults(hang_up=1, away=0.02, rename=1), port=where, unpaced=True)
    with Simulator([wire]) as sim:
        path = sim.wires[0].path
        names = set()
        while (
            wire.struck["hang_up"] < 5
        ):  # a client that connects while the port closes is disconnected, and not counted
            line = opened(path)
            names.add(Path(path).resolve())
            with pytest.raises(LineError):
                read(line)
            line.close()
        wire.faults = Faults()
        found = b""
        while not found:
            line = opened(path)
            with suppress(PortLost):  # the client had connected while the port was closing
                found = read(line)
            line.close()
        assert found == REPLY
    assert len(names) >= (2 if port == "link" else 1)
    assert not list(tmp_path.iterdir())


def opened(path: str) -> Line:
    found: list[Line] = []

    def is_open() -> bool:
        try:
            found.append(Line(path).open())
        except LineError:
            return False
        return True

    until(is_open)
    return found[0]


def read(line: Line) -> bytes:
    drive = Toy(1)
    asked = make_exchange(drive, Message(1, 3, 2, 1), Peer(least_timeout=5, most_timeout=5))
    found = line.carry_out(asked)
    assert found.result > 0, STATUSES[-found.result]
    return found.raw


def test_simulated_hang_ups_are_refused_for_a_pty_without_a_link() -> None:
    with pytest.raises(ValueError, match=r"^line: with `hang_up`, the port must be a link or a TCP port"):
        FaultyWire([simulated(Toy(1))], Faults(hang_up=0.1))


def test_every_key_of_a_faults_file_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text("\n".join([*(f"{name} = 0.25" for name in rates_of(Faults)), 'late = "2 s"', "seed = 3"]))
    assert load_faults(path) == Faults(**dict.fromkeys(rates_of(Faults), 0.25), late=2.0, seed=3)


def test_all_mistakes_in_a_faults_file_are_reported_together(tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text('drop = 1.5\nflips = 0.1\nlate = "soon"\nburst = 0\nseed = "x"\naway = 3\ndelay = true\n')
    with pytest.raises(ValueError, match=re.escape(str(path))) as mistake:
        load_faults(path)
    with pytest.raises(ValueError, match="is not a duration") as soon:
        parse_duration("soon")
    assert str(mistake.value).splitlines() == [
        f"{path}:{line}: {sentence}"
        for line, sentence in (
            (2, "unknown key 'flips'; did you mean flip?"),
            (5, "seed = 'x' is not right; write seed = 7"),
            (7, "delay = True is not right; write delay = 0.01"),
            (6, 'away = 3 is not right; write away = "1 s"'),
            (3, f"late = {soon.value}"),
            (1, "drop = 1.5 is not a rate; write one from 0 to 1, such as 0.01"),
            (4, "burst = 0 is not a number of characters from 1 to 4096"),
        )
    ]


def test_a_faults_file_can_describe_the_faults_of_single_drives(tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text('drop = 0.1\n[drive.pump-1]\nloss = 0.2\nsilence = "1 min"\n')
    pump = DriveFaults(loss=0.2, silence=60.0)
    assert load_faults(path, {"pump-1"}) == load_faults(path) == Faults(drop=0.1, drives={"pump-1": pump})
    path.write_text("[drive.pump-2]\n[drive.pump-1]\nloss = 3\n")
    with pytest.raises(ValueError, match="unknown key") as mistake:
        load_faults(path, {"pump-1"})
    assert str(mistake.value).splitlines() == [
        f"{path}:1: [drive]: unknown key 'pump-2'; did you mean pump-1?",
        f'{path}:3: drive "pump-1": loss = 3 is not a rate; write one from 0 to 1, such as 0.01',
    ]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("drive = 1", "drive is not a table"),
        (None, r"the faults' file cannot be read: No such file"),
        ("drop =", "the file is not TOML: "),
    ],
)
def test_invalid_faults_file_is_refused(text: str | None, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=rf"^{re.escape(str(path))}(:1)?: {sentence}"):
        load_faults(path)


def test_help_of_simulate_lists_the_keys_of_a_faults_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--help"]) == 0
    printed = capsys.readouterr().out
    keys = {*rates_of(Faults), *rates_of(DriveFaults), "seed", "late", "silence", "trip"}
    assert {name for name in keys if not re.search(rf"^  {name} = ", printed, re.MULTILINE)} == set()


def test_simulate_reports_a_faults_file_mistake(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    plant, faults = tmp_path / "plant.toml", tmp_path / "faults.toml"
    plant.write_text(
        '[[line]]\nname = "a"\nport = "a"\n[[line.drive]]\nname = "b"\nmodel = "yd1000"\naddress = 1\n'
    )
    faults.write_text("drop = 2\n")
    words = ["simulate", str(plant), "--ports", str(tmp_path / "ports"), "--faults", str(faults)]
    assert main(words) == 2
    assert capsys.readouterr().err == (
        f"multidrop: {faults}:1: drop = 2 is not a rate; write one from 0 to 1, such as 0.01\n"
    )
    assert not (tmp_path / "ports").exists()
