"""Calls of a process that is not, or no longer, the master of the line send nothing and raise NotMaster."""

from __future__ import annotations

import logging
import os
import select
import sys
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from batches import new_completion
from lines import PATIENCE, until
from tables import usually
from toy import Status, Toy

from multidrop import NotMaster
from multidrop.bus import Bus
from multidrop.control import Seen, read_audit
from multidrop.core import Completion, Exchange, Failure, Mastership
from multidrop.core import Status as Missed
from multidrop.drive import Script, insist, read, verb, write
from multidrop.errors import LineError, NoReply, NoSuchPort, Unconfirmed
from multidrop.sim import Simulator, Wire, simulated

if sys.platform != "linux":
    pytest.skip("masterships are Linux's", allow_module_level=True)

S = 1_000_000_000
LISTENING = 256 * 10 / 9600  # s; the longest RTU frame at 9600 baud


def now_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class Brief(Toy):
    """A drive with a timeout that is long enough for its simulator on a busy computer."""

    response_timeout = 0.5


class Slow(Toy):
    """A drive whose timeout is longer than any delay of the other master on a busy computer."""

    response_timeout = 1.5


class Watched(Brief):
    """A drive whose stop reads the status after its write."""

    @verb
    def stop(self) -> Script[None]:
        yield from insist(Toy.control, Status(0))
        yield from read(Toy.status)


def halt() -> Script[None]:
    yield from insist(Toy.control, Status(0))


class Scene:
    """A bus with a mastership, and one simulated drive that counts the requests it receives."""

    def __init__(self, audit: Path) -> None:
        self.audit = audit
        self.sim = simulated(Brief(1))
        self.simulator = Simulator([Wire([self.sim], unpaced=True)])
        self.simulator.__enter__()
        self.mastership = Mastership()
        path = self.simulator.wires[0].path
        self.become_master()
        self.bus = Bus(path, mastership=self.mastership, audit=audit, ledger=audit.with_name("ledger"))
        self.drive = self.bus.attach(Brief(1, name="pump"))
        self.mastership.end()

    def close(self) -> None:
        self.bus.close()
        self.mastership.end()
        self.simulator.__exit__(None, None, None)

    def become_master(self) -> None:
        self.mastership.extend(now_ns() + 1000 * S)

    @property
    def requests(self) -> int:
        return self.sim.counters.requests + self.sim.counters.damaged


@contextmanager
def ended(mastership: Mastership) -> Iterator[None]:
    """End the mastership even if the test fails, because its timer would kill the test process."""
    try:
        yield
    finally:
        mastership.end()


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    made = Scene(tmp_path / "audit.jsonl")
    yield made
    made.close()


CALLS: dict[str, Callable[[Scene], object]] = {
    "read": lambda scene: scene.drive.read(Toy.output_current),
    "write": lambda scene: scene.drive.write(Toy.acceleration_time, 20.0),
    "ask": lambda scene: scene.drive.read_raw(3, 1, 1),
    "raw": lambda scene: scene.drive.send_raw(6, 0x15, b"\x00\x01"),
    "start": lambda scene: scene.drive.start(),
    "stop": lambda scene: scene.drive.stop(),
    "step of a stop": lambda scene: scene.drive.perform(halt()),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_calls_send_nothing_before_mastership_starts(scene: Scene, call: Callable[[Scene], object]) -> None:
    begun = time.monotonic()
    with pytest.raises(NotMaster) as failure:
        call(scene)
    assert time.monotonic() - begun < 25  # a stop would otherwise be repeated for 30 s
    assert not failure.value.is_sent
    assert not failure.value.heard
    assert scene.requests == 0
    assert scene.bus.statistics().counters.sent == 0
    # stops are recorded as called, not as sent
    assert not any("sent" in record for record in read_audit(scene.audit))


@pytest.mark.slow
@pytest.mark.parametrize("call", usually("start", *(call for call in CALLS if call != "start")))
def test_calls_send_nothing_after_mastership_ends(scene: Scene, call: str) -> None:
    scene.become_master()
    scene.drive.read(Toy.output_current)
    before = scene.requests
    scene.mastership.end()
    with pytest.raises(NotMaster):
        CALLS[call](scene)
    assert scene.requests == before


def test_requests_without_mastership_do_not_count_as_drive_failures(scene: Scene) -> None:
    for _ in range(3):
        with pytest.raises(NotMaster):
            scene.drive.read(Toy.output_current)
    assert scene.bus.peer(scene.drive).failures == 0
    assert scene.bus.statistics().counters.ended == {Missed.NOT_MASTER: 3}


@pytest.mark.long
def test_nothing_is_sent_after_mastership_expires(scene: Scene) -> None:
    """The mastership ends by the clock alone, without a call of `end`."""
    mastership = Mastership(guard_s=8)
    path = scene.simulator.wires[0].path
    scene.bus.close()
    mastership.extend(until_ns := now_ns() + 11 * S)
    with Bus(path, mastership=mastership) as bus, ended(mastership):
        drive = bus.attach(Brief(1, name="pump"))
        drive.read(Toy.output_current)
        assert now_ns() < until_ns, "the machine is too busy for this"
        reads = (drive.read(Toy.output_current) for _ in count())
        with pytest.raises(NotMaster):
            deque(reads, maxlen=0)
        assert now_ns() >= until_ns
        sent = bus.statistics().counters.sent  # includes a request whose reply was late
        for _ in range(3):
            with pytest.raises(NotMaster):
                drive.read(Toy.output_current)
        assert bus.statistics().counters.sent == sent
        assert scene.requests <= sent


def test_the_error_of_an_unsent_stop_says_that_the_motor_runs_on(
    scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    port = scene.bus.line.port
    sentence = (
        "pump: the stop was NOT sent, and the motor continues as it is: this process is not the master of "
        f"{port}, and another one may be. Stop it through the line's present master, or at the drive itself"
    )
    with caplog.at_level(logging.INFO, "multidrop.control"):
        with pytest.raises(NotMaster) as failure:
            scene.drive.stop()
        until(lambda: any(record.levelno == logging.CRITICAL for record in caplog.records))
    assert str(failure.value) == sentence
    assert [record.getMessage() for record in caplog.records if record.levelno == logging.CRITICAL] == [
        sentence
    ]


def test_stop_all_reports_failed_for_each_unsent_stop(scene: Scene) -> None:
    other = scene.bus.attach(Brief(2, name="fan"))
    found = scene.bus.stop_all()
    assert {name: stopped.seen for name, stopped in found.items()} == {
        "pump": Seen.FAILED,
        "fan": Seen.FAILED,
    }
    assert all("the stop was NOT sent, and the motor continues" in stopped.why for stopped in found.values())
    assert scene.requests == 0
    assert other.bus is scene.bus


@pytest.mark.slow
def test_a_read_after_a_start_raises_if_the_process_is_no_longer_master(scene: Scene) -> None:
    scene.become_master()
    scene.drive.start()
    scene.mastership.end()
    with pytest.raises(NotMaster, match=r"^pump: not sent: not master: this process is not the master of "):
        scene.drive.state()


@pytest.mark.slow
def test_a_command_can_be_sent_once_the_process_is_master_again(scene: Scene) -> None:
    scene.become_master()
    scene.drive.start()
    scene.mastership.end()
    with pytest.raises(NotMaster):
        scene.drive.stop()
    scene.become_master()
    scene.drive.stop()
    assert scene.requests > 0


def hold_back(monkeypatch: pytest.MonkeyPatch, scene: Scene, *, sent_ns: int, after: int) -> None:
    """After `after` writes, refuse each write as NOT_MASTER; sent in part if `sent_ns` is not 0."""
    carry_out, writes = scene.bus.line.carry_out, count()

    def held_back(exchange: Exchange, **details: Any) -> Completion:
        if exchange.request.function == 6 and next(writes) >= after:
            return Completion(new_completion(result=Failure.NOT_MASTER, begun_ns=1, sent_ns=sent_ns))
        return carry_out(exchange, **details)

    monkeypatch.setattr(scene.bus.line, "carry_out", held_back)


@pytest.mark.slow
def test_a_partly_sent_write_is_unconfirmed(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    scene.become_master()
    hold_back(monkeypatch, scene, sent_ns=1, after=0)
    with pytest.raises(Unconfirmed, match="it is not known whether acceleration_time = 20"):
        scene.drive.write(Toy.acceleration_time, 20.0)
    (entry,) = read_audit(scene.audit)
    assert "this process is not the master of " in str(entry)


@pytest.mark.slow
def test_a_script_raises_if_the_second_write_is_not_sent(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first write is done and recorded; the second write was not sent."""
    scene.become_master()
    hold_back(monkeypatch, scene, sent_ns=0, after=1)

    def both() -> Script[None]:
        yield from write(Toy.frequency, 5.0)
        yield from write(Toy.frequency, 6.0)

    with pytest.raises(NotMaster):
        scene.drive.perform(both())
    assert len([*read_audit(scene.audit)]) == 1


def test_a_stop_counts_as_sent_if_mastership_ends_afterwards(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stop was sent, so it is not reported as unsent."""
    scene.become_master()
    carry_out = scene.bus.line.carry_out

    def end_after_write(exchange: Exchange, **details: Any) -> Completion:
        found = carry_out(exchange, **details)
        if exchange.request.function == 6:
            scene.mastership.end()
        return found

    monkeypatch.setattr(scene.bus.line, "carry_out", end_after_write)
    scene.bus.detach(scene.drive)
    scene.bus.attach(Watched(1, name="pump"))
    found = scene.bus.stop_all()["pump"]
    assert found.seen is not Seen.FAILED
    assert "NOT sent" not in found.why


@pytest.fixture
def shared() -> Iterator[tuple[int, Bus, Mastership]]:
    """Yield the far end of a line without drives, and the line's bus and mastership."""
    far, near = os.openpty()
    tty.setraw(near)
    os.set_blocking(far, False)
    mastership = Mastership()
    mastership.extend(now_ns() + 1000 * S)
    with Bus(os.ttyname(near), mastership=mastership) as bus:
        yield far, bus, mastership
    mastership.end()
    os.close(far)
    os.close(near)


class Babbler:
    """Another master, which sends requests until the test stops it."""

    def __init__(self, far: int) -> None:
        self._far, self._is_over = far, threading.Event()
        self._thread = threading.Thread(target=self._ask)
        self._thread.start()

    def _ask(self) -> None:
        while not self._is_over.wait(0.02):
            os.write(self._far, b"\x07\x03\x00\x01\x00\x01\xd5\xac")

    def stop(self) -> None:
        self._is_over.set()
        self._thread.join()


def sent_on(far: int) -> bytes:
    try:
        return os.read(far, 4096)
    except BlockingIOError:
        return b""


def waits(far: int, bus: Bus, drive: Slow) -> float:
    """Read once; return the seconds until the request was on the line."""

    def ask() -> None:
        with suppress(NoReply):
            drive.read_raw(3, 1, 1, expiry=60)

    begun = time.monotonic()
    asking = threading.Thread(target=ask)
    asking.start()
    assert select.select([far], [], [], PATIENCE)[0]
    seconds = time.monotonic() - begun
    asking.join()
    assert sent_on(far)
    return seconds


@pytest.mark.long
def test_a_new_master_listens_before_its_first_request(shared: tuple[int, Bus, Mastership]) -> None:
    far, bus, mastership = shared
    # The drives are new, because a request to a drive with a late reply would wait longer.
    drives = [bus.attach(Slow(address)) for address in (1, 2, 3)]
    listening = LISTENING + Slow.response_timeout
    assert waits(far, bus, drives[0]) >= listening
    assert waits(far, bus, drives[1]) < listening
    mastership.end()
    with pytest.raises(NotMaster):
        drives[1].read_raw(3, 1, 1, expiry=60)
    mastership.extend(now_ns() + 1000 * S)
    assert waits(far, bus, drives[2]) >= listening


@pytest.mark.long
def test_a_call_raises_before_sending_if_another_master_is_heard(
    shared: tuple[int, Bus, Mastership], caplog: pytest.LogCaptureFixture
) -> None:
    far, bus, _ = shared
    drive = bus.attach(Slow(1, name="pump"))
    other = Babbler(far)
    try:
        for call in (lambda: drive.read_raw(3, 1, 1, expiry=60), lambda: drive.write(Toy.frequency, 5.0)):
            with pytest.raises(NotMaster) as failure:
                call()
            assert failure.value.heard
            assert "as from another master (" in str(failure.value)
            assert b"\x07\x03\x00\x01\x00\x01\xd5\xac" in failure.value.heard
        assert sent_on(far) == b""
        until(lambda: "another master: " in caplog.text)
        assert bus.line.foreign > 0
    finally:
        other.stop()

    def is_asked() -> bool:
        try:
            drive.read_raw(3, 1, 1, expiry=60)
        except NotMaster:  # the last bytes of the other master were not read yet
            return False
        except NoReply:
            return True
        return False

    until(is_asked)  # the request is sent once the other master has been silent
    assert sent_on(far)


def test_a_stop_is_sent_although_another_master_is_heard(shared: tuple[int, Bus, Mastership]) -> None:
    far, bus, _ = shared
    drive = bus.attach(Slow(1, name="pump"))
    other = Babbler(far)
    try:
        with pytest.raises(Unconfirmed, match=r"^pump: it is not known whether the stop took effect"):
            drive.stop(seconds=0)
    finally:
        other.stop()
    assert b"\x01\x06\x00\x14\x00\x00" in sent_on(far)


@pytest.mark.slow
@pytest.mark.parametrize("port", ["tcp://127.0.0.1:0", "socket://127.0.0.1:0"])
def test_network_ports_send_only_while_the_process_is_master(port: str) -> None:
    mastership, sim = Mastership(), simulated(Brief(1))
    mastership.extend(now_ns() + 1000 * S)
    simulator = Simulator([Wire([sim], unpaced=True, port=port)])
    with simulator, Bus(simulator.wires[0].path, mastership=mastership) as bus:
        drive = bus.attach(Brief(1))
        begun = time.monotonic()
        drive.read(Toy.output_current)
        # a Modbus TCP gateway is the only master of its line, and forwards no bytes of others
        assert port.startswith("tcp") or time.monotonic() - begun >= LISTENING
        asked = sim.counters.requests
        mastership.end()
        with pytest.raises(NotMaster):
            drive.read(Toy.output_current)
        assert sim.counters.requests == asked > 0


def test_only_the_master_opens_the_port(scene: Scene) -> None:
    path = scene.simulator.wires[0].path
    scene.bus.close()
    with pytest.raises(LineError, match=r": it is not opened: this process is not its master"):
        Bus(path, mastership=scene.mastership)


def test_a_stop_on_a_closed_port_reports_that_nothing_was_sent(scene: Scene) -> None:
    scene.bus.line.drop()
    with pytest.raises(NotMaster, match="the stop was NOT sent"):
        scene.drive.stop()
    assert scene.bus.line.is_lost
    scene.become_master()
    scene.drive.stop()  # the stop reopens the port
    assert scene.requests > 0


@pytest.mark.parametrize("port", ["rfc2217://127.0.0.1:4001", "loop://", "spy:///dev/null"])
def test_pyserial_ports_cannot_be_used_with_a_mastership(port: str) -> None:
    """A `Mastership` is the right to send on a line that several processes share."""
    with pytest.raises(NoSuchPort, match="a port of this kind cannot be used with a mastership"):
        Bus(port, mastership=Mastership())
    with pytest.raises(NoSuchPort):
        Bus.awaiting(port, mastership=Mastership())


def test_a_mastership_of_another_type_raises_type_error() -> None:
    with pytest.raises(TypeError, match=r"^mastership takes a multidrop\.core\.Mastership, not 0\.7$"):
        Bus("/dev/null", mastership=0.7)  # type: ignore[arg-type]
