"""A second client on the same line, whose frames collide with ours: sent frames and results.

A drive cannot distinguish the requests of two clients, and a client cannot distinguish replies to its own
reads from replies to the other client's reads. So reads on such a line are not reliable, but commands are: no
start and no pulse is sent twice, no motor starts without a call, and the results of commands are true.
"""

from __future__ import annotations

import os
import random
import selectors
import threading
import tty
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import zip_longest
from pathlib import Path
from time import sleep
from typing import Any

import checksums
import pytest
from checksums import rtu
from lines import line, plant, polled, rows_of, until
from motors import MAKE, REASONS, STARTS, ReceivedRequests, quick
from responder import Responder, ResponderLine
from responder_drives import KINDS, ResponderDrive
from tables import usually

from multidrop.bus import Bus
from multidrop.core import Framing, Message, parse_request, set_settings
from multidrop.drive import Condition, Drive
from multidrop.errors import BusError, DriveException, NotVerified, Unconfirmed, WriteForbidden
from multidrop.families import InvtCHE
from multidrop.plant.model import PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import MotorDrive, Simulator, Wire, simulated
from multidrop.transport import drive_records

SLOT = 2e-3  # s; frames within one slot collide

Collision = Callable[[random.Random, Sequence[bytes]], bytes]


def interleaved(chance: random.Random, said: Sequence[bytes]) -> bytes:
    """Return a collision in which the characters of both frames alternate."""
    columns = zip_longest(*chance.sample(said, len(said)))
    return bytes(character for column in columns for character in column if character is not None)


def overlaid(chance: random.Random, said: Sequence[bytes]) -> bytes:
    """Return a collision of simultaneous frames: a 0 bit wins over a 1, which is driven only weakly."""
    shorter, longer = sorted(said, key=len)
    at = chance.randint(0, len(longer) - len(shorter))
    middle = bytes(one & other for one, other in zip(shorter, longer[at:], strict=False))
    return longer[:at] + middle + longer[at + len(middle) :]


def cut_off(chance: random.Random, said: Sequence[bytes]) -> bytes:
    """Return a collision: the start of one frame, then the rest of the other."""
    first, second = chance.sample(said, 2)
    at = chance.randint(0, len(first))
    return first[:at] + second[chance.randint(0, at) if at else 0 :]


def one_after_another(chance: random.Random, said: Sequence[bytes]) -> bytes:
    """Return both frames complete, without a silence between them."""
    return b"".join(chance.sample(said, len(said)))


COLLISIONS: Sequence[Collision] = (interleaved, overlaid, cut_off, one_after_another)


class SharedPair:
    """The ports `ours` and `theirs` of the two clients; `sent` has our client's bytes before collisions.

    If `holds(said)` returns True for our client's bytes, they are lost, and the other client sends `says`.
    """

    def __init__(self, drives: str, baudrate: int, seed: int) -> None:
        self._chance = random.Random(seed)
        self._drives = os.open(drives, os.O_RDWR | os.O_NOCTTY)
        set_settings(self._drives, baudrate, "8N1")
        (self._our_side, self._our_port), (self._their_side, self._their_port) = os.openpty(), os.openpty()
        self._stop, self._wakeup = os.pipe()
        self.ours, self.theirs = os.ttyname(self._our_port), os.ttyname(self._their_port)
        for fd in (self._our_port, self._their_port):
            tty.setraw(fd)
        for fd in self._sides:
            os.set_blocking(fd, False)
        self._spoke = self._our_side  # `_spoke` is the client that sent last
        self.sent = b""
        self.collisions = 0
        self.holds: Callable[[bytes], bool] = lambda said: False
        self.says = b""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def _sides(self) -> tuple[int, int, int]:
        return self._our_side, self._their_side, self._drives

    def close(self) -> None:
        os.write(self._wakeup, b"!")
        self._thread.join()
        for fd in (*self._sides, self._our_port, self._their_port, self._stop, self._wakeup):
            os.close(fd)

    def _run(self) -> None:
        with selectors.DefaultSelector() as ready:
            for fd in (*self._sides, self._stop):
                ready.register(fd, selectors.EVENT_READ)
            while self._stop not in {key.fd for key, _ in ready.select()}:
                sleep(SLOT)
                self._exchange({fd: said for fd in self._sides if (said := _read(fd))})

    def _exchange(self, said: dict[int, bytes]) -> None:
        """Deliver this slot's frames to all receivers, after the frames have collided."""
        ours = said.get(self._our_side)
        if ours:
            self.sent += ours
            if self.holds(ours):
                del said[self._our_side]
                said[self._their_side] = self.says
        self.collisions += len(said) > 1
        self._spoke = next((side for side in self._sides[:2] if side in said), self._spoke)
        for listener in sorted(self._sides, key=lambda side: side == self._spoke):
            if listener == self._spoke and self._drives in said:
                sleep(SLOT)  # the client that sent no request must receive the reply first
            others = [each for speaker, each in said.items() if speaker != listener]
            received = self._mixed(others)
            if received:
                with suppress(BlockingIOError):
                    os.write(listener, received)

    def _mixed(self, said: Sequence[bytes]) -> bytes:
        if len(said) < 2:
            return b"".join(said)
        return self._chance.choice(COLLISIONS)(self._chance, said)


def _read(fd: int) -> bytes:
    try:
        return os.read(fd, 4096)
    except BlockingIOError:
        return b""


@contextmanager
def shared(drives: str, baudrate: int, seed: int) -> Iterator[SharedPair]:
    pair = SharedPair(drives, baudrate, seed)
    try:
        yield pair
    finally:
        pair.close()


RTU_FAMILIES = [model for model in MAKE if model != "delixi-native"]
# The motor is started ROUNDS times, and then until two requests have collided, but at most MOST_ROUNDS times.
ROUNDS, MOST_ROUNDS = 3, 60


@contextmanager
def shared_line(model: str, seed: int) -> Iterator[tuple[Any, SharedPair, list[ReceivedRequests]]]:
    """Yield our drive 1, the pair of ports, and the requests that drives 1 and 2 receive."""
    ours = MAKE[model](1)
    received = []
    for drive in (ours, MAKE[model](2)):
        sim = simulated(drive)
        assert isinstance(sim, MotorDrive)
        sim.motor.acceleration_time = sim.motor.deceleration_time = 0.2
        received.append(ReceivedRequests(sim))
    wire = Wire([each.sim for each in received], unpaced=True)
    with Simulator([wire]), shared(wire.path, ours.settings.baudrate, seed) as pair, Bus(pair.ours) as bus:
        yield bus.attach(ours), pair, received


def requests(pair: SharedPair) -> list[Message]:
    """Return the requests that were sent on our port."""
    found, sent = [], pair.sent
    while sent:
        used, message = parse_request(Framing.RTU, sent)
        assert message is not None
        found.append(message)
        sent = sent[used:]
    return found


def attempt(act: Callable[[], object]) -> BusError | None:
    """Call `act`; return the BusError that it raised, or None."""
    try:
        act()
    except BusError as failure:
        return failure
    return None


def set_frequency(drive: Any, hz: float) -> None:
    """Set the frequency, and repeat this until it succeeds, because the computer may be busy."""
    until(lambda: attempt(lambda: drive.set_frequency(hz)) is None)


class Stranger:
    """The other client. It reads both drives and writes the second drive's setpoint, but starts no motor."""

    def __init__(self, port: str, model: str, seed: int) -> None:
        self.exchanges = 0
        self._chance = random.Random(seed)
        self._bus = Bus(port)
        self._first, self._second = (self._bus.attach(MAKE[model](address)) for address in (1, 2))
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Stranger:
        self._thread.start()
        return self

    def __exit__(self, *failure: object) -> None:
        self._done.set()
        self._thread.join()
        self._bus.close()

    def _run(self) -> None:
        while not self._done.is_set():
            for act in (self._look, self._second.state, self._set):
                with suppress(BusError):
                    act()
                self.exchanges += 1
                sleep(self._chance.uniform(0.0, 0.04))

    def _look(self) -> None:
        self._first.read(self._first.readings()[0])

    def _set(self) -> None:
        self._second.set_frequency(self._chance.randint(1, 40))


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("model", RTU_FAMILIES)
def test_starts_and_stops_are_correct_while_another_client_sends(model: str) -> None:
    with shared_line(model, seed=1) as (drive, pair, (first, second)), ExitStack() as stack:
        set_frequency(drive, 20)
        stranger = stack.enter_context(Stranger(pair.theirs, model, seed=2))
        for done in range(MOST_ROUNDS):
            if done >= ROUNDS and pair.collisions:
                break
            sent, carried_out = len(starts(pair, model)), len(first.starts)
            failure = attempt(drive.start)
            sent, carried_out = len(starts(pair, model)) - sent, len(first.starts) - carried_out
            assert carried_out <= sent <= 1
            if failure is None:
                assert carried_out == 1
            elif not isinstance(failure, (Unconfirmed, NotVerified)):
                assert carried_out == 0, f"{failure!r}, and it started"
            until(lambda: attempt(drive.stop) is None)
            until(lambda: not first.sim.motor.energised)
        assert second.starts == []
        until(lambda: stranger.exchanges)  # our frames may delay the other client's reads
        assert pair.collisions


def starts(pair: SharedPair, model: str) -> list[Message]:
    return [
        request for request in requests(pair) if request.function in (5, 6, 15, 16) and STARTS[model](request)
    ]


PATIENCE = 0.1  # s; the shortest timeout that is long enough on a busy computer


@pytest.fixture
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drive_records, "LEAST_TIMEOUT", PATIENCE)


patient = pytest.mark.usefixtures("_patient")
START, STOP, RESET, JOG, STOP_JOG = (f"01 06 10 00 00 {command:02X}" for command in (1, 5, 7, 3, 8))
SAYS: dict[str, bytes] = {
    "nothing": b"",
    "noise": bytes.fromhex("00 F8 FF 01 06 10 00 00"),
    "the begin of ours": rtu(START)[:5],
    "ours with one bit turned": rtu(START)[:5] + b"\3" + rtu(START)[6:],
    "a read of the same drive, which it answers": rtu("01 03 10 01 00 01"),
    "a read of ours, answered by both": rtu("01 03 10 01 00 01") + rtu("02 03 10 01 00 01"),
    "a write to the same drive, which it confirms": rtu("01 06 20 00 03 E8"),
    "a write to the other drive": rtu("02 06 20 00 03 E8"),
    "a stop of the other drive": rtu("02 06 10 00 00 05"),
    "a stop of all": rtu("00 06 10 00 00 05"),
    "an exception of the other drive": rtu("02 86 12"),
    "an exception to another function": rtu("01 83 02"),
}
FAILURES = {"ours with one bit turned": DriveException}  # an INVT CHE answers this with exception 11H
PULSES = {"start": START, "jog": JOG, "reset_fault": RESET}


def running(drive: Any, received: ReceivedRequests) -> None:
    """Set a frequency, and start the motor at the drive's keypad."""
    set_frequency(drive, 20)
    received.sim.motor.run(1)


MOMENTS = [("start", says) for says in SAYS] + [
    (verb, says)
    for verb in ("jog", "reset_fault")
    for says in ("nothing", "a read of the same drive, which it answers", "a write to the other drive")
]


@pytest.mark.slow
@patient
@pytest.mark.parametrize(("verb", "says"), usually(*MOMENTS))
def test_another_clients_frame_does_not_confirm_a_start_or_reset(verb: str, says: str) -> None:
    with shared_line("invt-che", seed=3) as (drive, pair, received):
        set_frequency(drive, 20)
        if verb == "reset_fault":
            received[0].sim.trip(4)
        pair.says = SAYS[says]
        pair.holds = lambda said: said == rtu(PULSES[verb])
        with pytest.raises(FAILURES.get(says, Unconfirmed)):
            getattr(drive, verb)()
        assert pair.sent.count(rtu(PULSES[verb])) == 1
        assert not any(each.starts or each.sim.motor.energised for each in received)
        assert received[0].sim.motor.fault == (4 if verb == "reset_fault" else 0)


@pytest.mark.slow
@patient
@pytest.mark.parametrize("says", usually(*SAYS))
def test_another_clients_frame_does_not_confirm_a_stop(says: str) -> None:
    with shared_line("invt-che", seed=3) as (drive, pair, received):
        running(drive, received[0])
        pair.says = SAYS[says]
        pair.holds = lambda said: said in (rtu(STOP), rtu(STOP_JOG))
        with pytest.raises((Unconfirmed, FAILURES.get(says, Unconfirmed))):
            drive.stop(seconds=1)
        assert pair.sent.count(rtu(STOP)) >= 2
        assert rtu(START) not in pair.sent
        assert received[0].sim.motor.energised == (says != "a stop of all")


@patient
def test_an_equal_stop_of_another_client_confirms_our_stop() -> None:
    """The other client's stop looks like the confirmation of our stop. This does no harm: the motor stops."""
    with shared_line("invt-che", seed=3) as (drive, pair, received):
        running(drive, received[0])
        pair.says = rtu(STOP)
        pair.holds = lambda said: said == rtu(STOP)
        drive.stop()
        assert not received[0].sim.motor.energised


@pytest.mark.slow
@patient
@pytest.mark.parametrize("verb", ["stop", "coast"])
def test_a_stop_is_confirmed_although_a_request_looked_like_an_echo(verb: str) -> None:
    """Our read is lost. The other client's equal request looks like our echo. A later stop is confirmed."""
    look = rtu("01 03 10 01 00 01")
    with shared_line("invt-che", seed=3) as (drive, pair, received):
        running(drive, received[0])
        pair.says = look
        pair.holds = lambda said: said == look
        assert drive.state().condition is Condition.RUNNING
        pair.holds = lambda said: False
        getattr(drive, verb)()
        commands = [request for request in received[0].writes if request.start == 0x1000]
        assert len(commands) <= 8  # a stop is repeated until the motor is at rest
        assert not received[0].sim.motor.energised


@pytest.mark.slow
@patient
def test_a_start_detects_a_setpoint_written_by_another_client() -> None:
    with shared_line("invt-che", seed=3) as (drive, pair, received), Bus(pair.theirs) as other:
        set_frequency(drive, 20)
        set_frequency(other.attach(InvtCHE(1, maximum_frequency=50)), 50)
        with pytest.raises(WriteForbidden, match=r"setpoint 100\.00 %, not the written 40\.00 %"):
            drive.start()
        assert not received[0].starts


SEEDS = range(int(os.environ.get("HOSTILE_SEEDS", "1")))
FRAMES = usually(60, 160)  # number of frames that the far end must receive
STRANGER = 99  # address of a drive that is not polled
MOTOR = "yd1000"
REGISTERS = 5  # limit of polled registers of each drive


class Hostile:
    """Distorts one reply in three, in a random way."""

    def __init__(self, seed: int) -> None:
        self.struck: Counter[str] = Counter()
        self._chance = random.Random(seed)
        self._kept = b""
        self._ways = {
            "lost": lambda said: b"",
            "damaged": self._damaged,
            "doubled": lambda said: said + said,
            "merged": self._merged,
            "cut": lambda said: said[: self._chance.randrange(len(said))],
            "foreign before": lambda said: self._foreign() + said,
            "foreign instead": lambda said: self._foreign(),
            "junk": lambda said: self._chance.randbytes(self._chance.randint(1, 40)) + said,
        }

    def mangle(self, said: bytes) -> bytes:
        kept, self._kept = self._kept, b""
        if said and self._chance.random() < 0.33:
            way = self._chance.choice(list(self._ways))
            self.struck[way] += 1
            said = self._ways[way](said)
        return kept + said

    def _damaged(self, said: bytes) -> bytes:
        at, bit = self._chance.randrange(len(said)), self._chance.randrange(8)
        return said[:at] + bytes([said[at] ^ 1 << bit]) + said[at + 1 :]

    def _merged(self, said: bytes) -> bytes:
        """Keep the reply, and send it together with the next one."""
        self._kept = said
        return b""

    def _foreign(self) -> bytes:
        """Return a valid frame of another master's exchange with the drive STRANGER."""
        count, value = self._chance.randint(1, 4), self._chance.randrange(0x10000)
        words = f"{value:04X}" * count
        return self._chance.choice(
            (
                checksums.rtu(f"{STRANGER:02X}03{2 * count:02X}{words}"),
                checksums.rtu(f"{STRANGER:02X}030010{count:04X}"),
                checksums.rtu(f"{STRANGER:02X}061000{value:04X}"),
                checksums.ascii(f"{STRANGER:02X}03{2 * count:02X}{words}"),
                checksums.delixi(f"{STRANGER:02X}0701F40000{value:04X}"),
            )
        )


def responder_drive(kind: str, drive: PolledDrive) -> ResponderDrive:
    """Return a drive with a different number in each polled register; no number occurs in two drives."""
    found = ResponderDrive(KINDS[kind], drive.drive.address)
    for register, (least, _) in drive.drive.known_counts().items():
        found.hold(register.address, least)
    for at, poll in enumerate(drive.polls):
        found.hold(poll.register.address, value(drive.drive.address, at))
    return found


def value(address: int, at: int) -> int:
    return 1000 * address + 100 * at + 7


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("frames", FRAMES)
def test_values_and_starts_stay_correct_on_a_line_with_distorted_replies(frames: int, seed: int) -> None:
    drives: dict[str, Drive] = {
        kind: quick(kind)(address, name=kind, **KINDS[kind].makes) for address, kind in enumerate(KINDS, 1)
    }
    asked = {
        kind: polled(each, [reg for reg in each.readings() if reg.values is None][:REGISTERS])
        for kind, each in drives.items()
    }
    asked[MOTOR] = polled(drives[MOTOR], [])  # not polled: its values change with its motor
    responder_line = ResponderLine([responder_drive(kind, each) for kind, each in asked.items()])
    hostile = Hostile(seed)
    responder_line.mangle = hostile.mangle
    starts: list[str] = []
    over = threading.Event()

    def command() -> None:
        """Start and stop the motor repeatedly."""
        motor = drives[MOTOR]
        while not over.is_set():
            with suppress(BusError):
                motor.set_frequency(20)
            starts.append("called")
            for act in (motor.start, motor.stop):
                with suppress(BusError):
                    act()

    rows: list[Row] = []

    def is_enough() -> bool:
        """Return True if every drive has given a value and the far end has received enough frames."""
        rows.extend(rows_of(poller))
        heard = {row.drive for row in rows if row.value is not None}
        return len(responder_line.log) >= frames and heard == set(drives) - {MOTOR}

    with Responder([responder_line], Path(os.environ["XDG_STATE_HOME"])) as far:
        poller = Poller(plant(line(far.ports[0], *asked.values())))
        with poller:
            commander = threading.Thread(target=command)
            commander.start()
            until(is_enough, patience=120)
            over.set()
            commander.join()
    truth = {
        (kind, poll.register.name): value(each.drive.address, at) * poll.register.scale
        for kind, each in asked.items()
        for at, poll in enumerate(each.polls)
    }
    rows += rows_of(poller)
    samples = [row for row in rows if row.value is not None]
    assert len({*truth.values()}) > len(drives)
    assert [row for row in samples if row.value != float(truth[row.drive, row.register])] == []
    misses = {row.status for row in rows if row.value is None}
    assert {miss for miss in misses if not miss.startswith("exception ")} <= REASONS
    assert [str(each) for each in responder_line.log if each.what == "damaged"] == []
    moves = [str(each) for each in responder_line.log if each.what == "moves"]
    assert len(moves) <= len(starts), "a motor was started that nobody started, or twice"
    assert hostile.struck.total() > frames / 10
