"""The poller on simulated lines: its rates and rows, faults, and a close that leaves no thread or
descriptor.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import select
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import checksums
import pytest
from clocked_lines import ClockedLines, ClockedWire
from commands import descriptors, threads
from lines import HOST_LATE, PATIENCE, Faulty, line, plant, polled, proofs, rows_of, until
from serial import Serial
from toy import Toy

from multidrop import poller as poller_module
from multidrop.core import RowQueue, Status
from multidrop.drive.register import Register
from multidrop.errors import LineError, Unconfirmed
from multidrop.plant.model import PlantLine, PolledDrive
from multidrop.poller import Poller
from multidrop.polling import line_set
from multidrop.polling.batch import Row
from multidrop.polling.polled_line import PolledLine
from multidrop.sim import EncodedDrive, Faults, SimulatedDrive, Simulator, Wire, simulated
from multidrop.transport import clock, open_port

NOT_SENT = {str(Status.NOT_ASKED), str(Status.LATE_ANSWER_DUE)}


class Quick(Toy):
    """A fast drive with a short timeout."""

    baudrates = (115_200,)
    response_delay = 0.001
    response_timeout = 0.05


class Slow(Toy):
    """A drive at a realistic baud rate."""

    baudrates = (9600,)


class Brisk(Toy):
    """A drive at a baud rate at which the standard's silence is longer than 3.5 characters."""

    baudrates = (38_400,)


READINGS = Quick.readings()
NAMES = {reading.name for reading in READINGS}
ONE = [Quick.output_current]


class Polling:
    """A poller, and all rows taken from it so far."""

    def __init__(self, *lines: PlantLine) -> None:
        self.poller = Poller(plant(*lines))
        self.rows: list[Row] = []
        self.began_ns = time.monotonic_ns()

    def __enter__(self) -> Polling:
        self.poller.__enter__()
        return self

    def __exit__(self, *failure: Any) -> None:
        self.poller.__exit__(*failure)
        self.look()

    def look(self) -> list[Row]:
        self.rows += rows_of(self.poller)
        return self.rows

    def statuses(self, drive: str | None = None) -> Counter[str]:
        return Counter(row.status for row in self.look() if drive in (None, row.drive))

    def until(self, status: str, count: int = 1, drive: str | None = None) -> None:
        """Wait for `count` more rows with this status."""
        before = self.statuses(drive)[status]
        until(lambda: self.statuses(drive)[status] >= before + count)

    def check(self, *statuses: str) -> None:
        """Check that the summary equals the rows, whose statuses may only be `statuses` and late ones."""
        assert not statuses or self.statuses().keys() <= {*statuses, *HOST_LATE}
        summary = self.poller.summary()
        misses = Counter(row.status for row in self.rows if row.value is None)
        assert summary["samples"] == sum(1 for row in self.rows if row.value is not None)
        assert summary["misses"] == misses.total()
        assert summary["dropped"] == 0
        told: Counter[str] = Counter()
        for each in summary["lines"].values():
            told.update(each["misses"])
            assert each["samples"] == sum(drive["samples"] for drive in each["drives"].values())
            for name, drive in each["drives"].items():
                rows = [row for row in self.rows if row.drive == name]
                assert drive["samples"] == sum(1 for row in rows if row.value is not None)
                seen = Counter(row.status for row in rows if row.value is None)
                assert drive["misses"] == seen
        assert told == misses
        assert self.began_ns <= min(row.monotonic_ns for row in self.rows)
        assert max(row.monotonic_ns for row in self.rows) <= time.monotonic_ns()


def drive(address: int = 1, name: str = "pump-1") -> Quick:
    return Quick(address, name=name)


@pytest.fixture
def pump() -> SimulatedDrive:
    """Return a simulated drive at address 1."""
    found = simulated(drive())
    found["output_current"] = 3.25
    return found


@pytest.fixture
def port(pump: SimulatedDrive) -> Iterator[str]:
    """Return the port of a line with only the drive `pump`."""
    with Simulator([Wire([pump], unpaced=True)]) as sim:
        yield sim.wires[0].path


@pytest.mark.slow
def test_periodic_requests_are_sent_on_time_and_without_bursts(port: str) -> None:
    periods = {"output_current": 0.02, "output_frequency": 0.05}
    polls = [polled(drive(), [Quick.registers[name]], every).polls for name, every in periods.items()]
    before_ns = clock.now_ns()
    with Polling(line(port, PolledDrive(drive(), (*polls[0], *polls[1])))) as polling:
        polling.until("ok", 100)
    for name, every in periods.items():
        mine = [row for row in polling.rows if row.register == name]
        # A set, because a late reply adds another row with the time of its request.
        sent = sorted({row.monotonic_ns for row in mine if row.status not in NOT_SENT})
        # The n-th request is not sent before it is due.
        assert all(at >= before_ns + number * every * 1e9 for number, at in enumerate(sent))
    left_out = polling.poller.summary()["lines"]["line"]["overrun_slots"]
    # Each poll that was due before the last row has a row, or is counted as skipped.
    times = [row.monotonic_ns for row in polling.rows]
    polled_s = (max(times) - min(times)) / 1e9
    slots = sum((polled_s - 0.5) // every for every in periods.values())
    assert len(polling.rows) + left_out >= slots


def test_registers_without_a_rate_are_polled_continuously(port: str) -> None:
    with Polling(line(port, polled(drive(), READINGS))) as polling:
        polling.until("ok", 100 * len(READINGS))
    assert len({row.register for row in polling.rows}) == len(READINGS)
    assert polling.poller.summary()["lines"]["line"]["overrun_slots"] == 0


def test_registers_with_and_without_a_rate_are_both_polled(port: str) -> None:
    polls = polled(drive(), READINGS).polls[1:] + polled(drive(), READINGS[:1], 0.01).polls
    with Polling(line(port, PolledDrive(drive(), polls))) as polling:
        until(lambda: {row.register for row in polling.look() if row.value is not None} == NAMES)
        polling.until("ok", 100)


@pytest.mark.parametrize(
    "kinds",
    [[{"baudrate": 9600}, {"baudrate": 19_200}], [{"silence": None}, {"silence": 0.01}]],
    ids=["two baud rates", "two silences"],
)
def test_drives_with_equal_line_settings_are_polled_in_a_row(kinds: list[dict[str, Any]]) -> None:
    drives = [Toy(at, name=f"drive-{at}", **kinds[at % 2]) for at in range(1, 7)]
    wire = ClockedWire([simulated(drive) for drive in drives], Faults())
    with ClockedLines(wire, [polled(drive, [Toy.fault]) for drive in drives]) as clocked:
        rows = clocked.run(1)[: len(drives)]
    asked = [int(row.drive.removeprefix("drive-")) for row in rows]
    assert sorted(asked) == [1, 2, 3, 4, 5, 6]
    assert len(list(itertools.groupby(asked, lambda at: at % 2))) == 2


def test_the_method_batches_yields_rows_for_the_given_seconds(port: str) -> None:
    with Poller(plant(line(port, polled(drive(), READINGS)))) as poller:
        rows: list[Row] = []
        while not any(row.register == "output_current" and row.status == "ok" for row in rows):
            rows += [row for batch in poller.batches(0.3, every=0.05) for row in batch]
        samples = [row for row in rows if row.value is not None]
        assert {row.value for row in samples if row.register == "output_current"} == {3.25}
        assert all(row.time_ns > row.monotonic_ns > 0 for row in rows)
        assert all(row.uncertainty_ns is not None and row.uncertainty_ns > 0 for row in samples)


def test_a_loop_over_a_poller_raises_before_the_with_block(port: str) -> None:
    async def first(poller: Poller) -> None:
        async for _ in poller:
            break

    poller = Poller(plant(line(port, polled(drive(), READINGS))))
    for iterate in (iter, Poller.batches, lambda poller: asyncio.run(first(poller))):
        with pytest.raises(ValueError, match="does not poll yet: iterate over it inside `with poller:`"):
            iterate(poller)
    poller.close()
    assert list(poller) == []


def test_a_loop_over_batches_can_be_left_early(port: str) -> None:
    with Poller(plant(line(port, polled(drive(), READINGS)))) as poller:
        assert len(next(poller.batches())) > 0


def test_an_asyncio_program_can_wait_for_rows_with_fileno(port: str) -> None:
    async def three() -> list[Row]:
        loop = asyncio.get_running_loop()
        batches: asyncio.Queue[Any] = asyncio.Queue()
        with Poller(plant(line(port, polled(drive(), READINGS)))) as poller:
            loop.add_reader(poller.fileno(), lambda: batches.put_nowait(poller.take()))
            found = [await batches.get() for _ in range(3)]
            loop.remove_reader(poller.fileno())
        return [row for batch in found if batch for row in batch]

    rows = asyncio.run(three())
    assert {row.value for row in rows if row.register == "output_current"} - {None} == {3.25}


def test_dropped_rows_of_the_bounded_queue_are_counted(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(poller_module, "RowQueue", lambda: RowQueue(chunk_rows=200, most_chunks=2))
    with Poller(plant(line(port, polled(drive(), READINGS)))) as poller:
        until(lambda: poller.dropped > 0)
    rows = rows_of(poller)
    summary = poller.summary()
    assert len(rows) <= 400
    assert len(rows) + summary["dropped"] == summary["samples"] + summary["misses"]


@contextmanager
def sixteen_lines(
    registers: Sequence[Register[Any]], every: float | None = None
) -> Iterator[tuple[list[PolledDrive], list[PlantLine]]]:
    """Yield sixteen polled drives and the declarations of sixteen lines, with one drive each."""
    with Simulator([Wire([EncodedDrive(Quick(at))], unpaced=True) for at in range(1, 17)]) as sim:
        drives = [polled(Quick(at, name=f"drive-{at}"), registers, every) for at in range(1, 17)]
        pairs = zip(sim.wires, drives, strict=True)
        yield drives, [line(wire.path, each, name=each.drive.name) for wire, each in pairs]


@pytest.mark.long
def test_sixteen_lines_are_polled_concurrently() -> None:
    with sixteen_lines(READINGS) as (drives, lines):
        before = threads()
        with Polling(*lines) as polling:
            assert threads() == before + 1
            for drive in drives:
                polling.until("ok", 3 * len(READINGS), drive.drive.name)
    truth = proofs(*drives)
    assert {(row.drive, row.register): row.value for row in polling.rows if row.value is not None} == truth
    polling.check("ok")
    assert list(polling.poller.summary()["lines"]) == [f"drive-{at}" for at in range(1, 17)]


@pytest.mark.long
def test_events_of_one_line_do_not_cause_checks_of_other_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A line with a rate is checked once per interval, however often other lines have events."""
    looks: list[int] = []
    is_steady = PolledLine.is_steady

    def noted(polled_line: PolledLine, now_ns: int) -> bool:
        looks.append(now_ns)
        return is_steady(polled_line, now_ns)

    monkeypatch.setattr(PolledLine, "is_steady", noted)
    with sixteen_lines(READINGS[:1], 0.02) as (drives, lines):
        begun = clock.now_ns()
        with Polling(*lines) as polling:
            for each in drives:
                polling.until("ok", 10, each.drive.name)
        seconds = (clock.now_ns() - begun) / 1e9
    assert len(looks) <= len(lines) * (seconds * 1e9 / poller_module.LOOK_NS + 2)


@pytest.mark.usefixtures("_patient")
def test_commands_are_carried_out_while_the_line_is_polled(port: str, pump: SimulatedDrive) -> None:
    with Polling(line(port, polled(drive(), READINGS), name="hall-1")) as polling:
        bus = polling.poller.bus("hall-1")
        (ours,) = bus.drives
        for hz in (10.0, 20.0, 30.0):
            polling.until("ok")
            with suppress(Unconfirmed):  # raised if this computer read the reply too late
                ours.write(Quick.frequency, hz)
            assert pump["frequency"] == hz
        assert ours.read(Quick.output_current) == 3.25
        with pytest.raises(ValueError, match=r"^there is no line 'hall-2'; there are hall-1$"):
            polling.poller.bus("hall-2")
    polling.check("ok")


def reply_of(address: int, reply: bytes) -> bytes:
    """Return the same reply with another address."""
    return checksums.rtu(f"{address:02X} {reply[1:-2].hex()}")


OTHER = checksums.rtu("02 03 02 12 34")
NOISE = bytes(at * 151 % 256 for at in range(4096))

FAULTS = {  # for each fault: the bytes sent instead of the reply, and the statuses of the polled rows
    "cut off": (lambda reply: reply[:-1], {"reply cut short"}),
    "damaged": (lambda reply: reply[:-1] + bytes([reply[-1] ^ 1]), {"bad checksum"}),
    "twice": (lambda reply: 2 * reply, {"ok"}),
    "of another drive": (lambda reply: OTHER, {"reply from another address"}),
    "of another drive, then its own": (lambda reply: OTHER + reply, {"ok"}),
    "for the wrong address": (lambda reply: reply_of(2, reply), {"reply from another address"}),
    "to another function": (lambda reply: checksums.rtu("01 04 02 12 34"), {"reply to another function"}),
    "of another length": (lambda reply: checksums.rtu("01 03 04 12 34 56 78"), {"reply of another length"}),
    "a stray byte before": (lambda reply: b"\0" + reply, {"ok"}),
    "noise before": (lambda reply: NOISE + reply, {"ok"}),
    "lost": (lambda reply: b"", {"no reply"}),
    "an exception": (lambda reply: checksums.rtu("01 83 02"), {"exception 02"}),
}
PIECES = {  # further possible statuses, if this computer is too slow to deliver a reply as one piece
    "noise before": {"bad checksum", "reply from another address", "reply to another function"},
    "of another drive, then its own": {"reply from another address"},
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_kind_of_faulty_reply_gives_rows_with_a_specific_status(
    fault: str, pump: SimulatedDrive
) -> None:
    fate, said = FAULTS[fault]
    # A socket, because a pty's buffer is too small for the noise.
    wire = Faulty([pump], fate, unpaced=True, port="socket://127.0.0.1:0")
    with Simulator([wire]) as sim, Polling(line(sim.wires[0].path, polled(drive(), ONE))) as polling:
        # two rows are enough: after three refusals, the register is polled only once a minute
        until(lambda: all(polling.statuses()[status] >= 2 for status in said))
    assert {row.value for row in polling.rows if row.status == "ok"} == ({3.25} if "ok" in said else set())
    polling.check(*said, *PIECES.get(fault, ()))


@pytest.mark.slow
def test_values_are_still_read_if_every_second_reply_is_lost(pump: SimulatedDrive) -> None:
    turns = itertools.cycle([True, False])
    wire = Faulty([pump], lambda reply: reply if next(turns) else b"", unpaced=True)
    with Simulator([wire]) as sim, Polling(line(sim.wires[0].path, polled(drive(), ONE))) as polling:
        for _ in range(3):
            polling.until("ok")
            polling.until("not asked: late reply due")
    polling.check("ok")


@pytest.mark.slow
def test_values_are_missing_if_the_silence_is_too_short_for_the_drive() -> None:
    """The drive needs a longer silence, and appends a request that comes too soon to the previous frame."""
    strict = simulated(Brisk(1, name="pump-1"))
    strict.needs_silence = True
    hasty = polled(Brisk(1, name="pump-1", silence=400e-6), ONE)
    with Simulator([Wire([strict])]) as sim, Polling(line(sim.wires[0].path, hasty)) as polling:
        polling.until("ok")
        until(lambda: strict.counters.early > 0)  # may take a while on a busy computer
        polling.until("not asked: late reply due", 2)
        polling.until("ok")
    polling.check("ok")


def test_no_request_is_sent_too_early_at_9600_baud(pump: SimulatedDrive) -> None:
    """At 9600 baud, the poller keeps the silences between frames, so the drive receives no early request."""
    slow = simulated(Slow(1, name="pump-1"))
    asked = polled(Slow(1, name="pump-1"), Slow.readings())
    with Simulator([Wire([slow])]) as sim, Polling(line(sim.wires[0].path, asked)) as polling:
        polling.until("ok", 10 * len(Slow.readings()))
    misses = polling.statuses().total() - polling.statuses()["ok"]
    assert slow.counters.damaged == 0
    # A request only interrupts the silence after a reply if the reply was late, which is a miss.
    assert slow.counters.early <= misses
    polling.check("ok")


@pytest.mark.long
def test_a_port_lost_during_a_reply_gives_rows_with_status_port_lost() -> None:
    master, slave = os.openpty()
    with Polling(line(os.ttyname(slave), polled(drive(), READINGS))) as polling:
        os.read(master, 1024)
        os.write(master, b"\x01\x03\x0a\0")
        os.close(master)
        polling.until("port lost", 2 * len(READINGS))
    os.close(slave)  # only now, so that no other test gets this pty while it is polled
    assert polling.statuses().keys() == {"port lost"}
    polling.check()


@pytest.mark.long
def test_a_lost_port_is_reopened_when_its_device_link_returns(tmp_path: Path) -> None:
    link = tmp_path / "by-id"
    asked = [polled(drive(), ONE), polled(drive(2, "pump-2"), ONE, 0.05)]
    targets: set[Path] = set()
    with ExitStack() as stack:
        for number in range(2):
            wires = [Wire([simulated(each.drive) for each in asked], port=str(link), unpaced=True)]
            with Simulator(wires):
                targets.add(link.readlink())
                # Keeps the pty open, so that its number is not used again.
                stack.callback(os.close, os.open(link, os.O_RDONLY | os.O_NOCTTY))
                if number == 0:
                    polling = stack.enter_context(Polling(line(str(link), *asked)))
                for each in asked:
                    polling.until("ok", 3, each.drive.name)
            for each in asked:
                polling.until("port lost", 2, each.drive.name)
    assert len(targets) == 2
    polling.check("ok", "port lost")


def queued_before_a_stop(hall: PolledLine) -> int:
    """Reopen the port before the poller does, as a stop does. Return the number of polls still queued."""
    with hall._lock:  # keeps the poller's thread from refilling the queue
        core, noted, queued = hall.bus.line.queue, hall._queue._done, len(hall._queue.slots())
        assert core
        until(lambda: core.done >= noted + min(3, queued))
        hall.bus.line.drop()
        hall.bus.line.regain()
        return queued - (core.done - noted)


@pytest.mark.slow
def test_polling_continues_after_a_stop_reopened_the_port(port: str) -> None:
    """The poller may not have noticed that the port was lost. It sends the queued requests again."""
    every = 0.01
    with Polling(line(port, polled(drive(), ONE, every))) as polling:
        (hall,) = polling.poller._lines
        queued = 0
        while not queued:  # on a busy computer, all queued requests may be over already
            polling.until("ok", 3)
            queued = queued_before_a_stop(hall)
        polling.until("ok", 100)  # more than the queued requests can give
    assert polling.statuses().keys() <= {"ok"} | HOST_LATE
    assert hall._ended_ns
    slots = (hall._ended_ns - hall.started_ns) / 1e9 // every
    left_out = polling.poller.summary()["lines"]["line"]["overrun_slots"]
    assert len(polling.rows) + left_out >= slots  # each queued request has a row or was counted as skipped
    polling.check()


@pytest.mark.slow
def test_a_line_with_a_lost_port_does_not_disturb_other_lines(port: str, tmp_path: Path) -> None:
    link = tmp_path / "hall-2"
    lines = [
        line(port, polled(drive(), ONE), name="hall-1"),
        line(str(link), polled(drive(1, "fan-1"), ONE), name="hall-2"),
    ]
    with ExitStack() as stack:
        with Simulator([Wire([simulated(drive())], port=str(link), unpaced=True)]):
            polling = stack.enter_context(Polling(*lines))
            polling.until("ok", 1, "fan-1")
        polling.until("port lost", 1, "fan-1")
        polling.until("ok", 100, "pump-1")
    assert polling.statuses("pump-1").keys() <= {"ok", *HOST_LATE}
    polling.check()


@pytest.mark.long
@pytest.mark.parametrize("slow", ["close", "open"])
def test_a_slow_reopening_or_closing_does_not_delay_other_lines(
    port: str, slow: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, is_held_up, may_go_on = tmp_path / "hall-2", threading.Event(), threading.Event()
    act = getattr(Serial, slow)

    def hold_up(serial: Serial) -> None:
        if serial.port == str(link):
            is_held_up.set()
            assert may_go_on.wait(PATIENCE)
        act(serial)

    with ExitStack() as stack:
        lines = [
            line(port, polled(drive(), ONE, 0.02), name="hall-1"),
            line(str(link), polled(drive(1, "fan-1"), ONE), name="hall-2"),
        ]
        with Simulator([Wire([simulated(drive())], port=str(link), unpaced=True)]):
            polling = stack.enter_context(Polling(*lines))
            polling.until("ok", 1, "fan-1")
            monkeypatch.setattr(Serial, slow, hold_up)
        stack.callback(may_go_on.set)
        assert is_held_up.wait(PATIENCE)
        late = threading.Thread(target=polling.poller.add, args=("hall-2", polled(drive(2, "fan-2"), ONE)))
        late.start()
        polling.until("ok", 50, "pump-1")  # more than the queued requests can give
        may_go_on.set()
        late.join(PATIENCE)
        polling.until("port lost", 1, "fan-2")
    assert polling.statuses("pump-1").keys() <= {"ok"} | HOST_LATE


@pytest.mark.long
@pytest.mark.slow
def test_polling_resumes_when_a_silent_drive_answers_again(pump: SimulatedDrive) -> None:
    other = simulated(drive(2, "pump-2"))
    asked = [polled(drive(), ONE), polled(drive(), READINGS[:1], 0.05), polled(drive(2, "pump-2"), ONE)]
    with Simulator([Wire([pump, other], unpaced=True)]) as sim:
        both = PolledDrive(asked[0].drive, asked[0].polls + asked[1].polls)
        with Polling(line(sim.wires[0].path, both, asked[2])) as polling:
            polling.until("ok", 3, "pump-1")
            missed = polling.statuses("pump-1")["no reply"]
            pump.deaf_until = float("inf")
            until(lambda: polling.statuses("pump-1")["no reply"] >= missed + 2)
            polling.until("not asked: drive is silent", 3, "pump-1")
            polling.until("ok", 50, "pump-2")
            pump.deaf_until = 0.0
            polling.until("ok", 50, "pump-1")
    polling.check("ok")


def test_a_plant_without_lines_can_be_polled() -> None:
    with Poller(plant()) as poller:
        assert poller.fileno() >= 0
        assert poller.take() is None
    assert poller.summary()["lines"] == {}


@pytest.mark.parametrize("end", ["polled", "lost", "never entered"])
def test_a_closed_poller_leaves_no_descriptor_or_thread(port: str, end: str) -> None:
    Poller(plant(line(port, polled(drive(), ONE)))).close()  # opens descriptors that are created on first use
    before = descriptors(), threads()
    if end == "never entered":
        Poller(plant(line(port, polled(drive(), ONE)))).close()
    elif end == "polled":
        with Polling(line(port, polled(drive(), ONE))) as polling:
            polling.until("ok")
    else:
        master, slave = os.openpty()
        with Polling(line(os.ttyname(slave), polled(drive(), ONE))) as polling:
            os.close(master)
            polling.until("port lost")
        os.close(slave)
    assert (descriptors(), threads()) == before


class Patient(Toy):
    """A drive with a timeout of a minute."""

    response_timeout = 60.0
    response_delay = 15.0


def patient(every: float | None) -> PolledDrive:
    """Return a polled drive with one register."""
    polls = polled(Patient(1, name="pump-1"), [Patient.fault]).polls
    return PolledDrive(Patient(1, name="pump-1"), tuple(replace(poll, every=every) for poll in polls))


@pytest.fixture
def responder() -> Iterator[tuple[int, str]]:
    """Return the descriptor of the line's far end, where the test answers, and the path of the port."""
    master, slave = os.openpty()
    yield master, os.ttyname(slave)
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize("every", [None, 1.0], ids=["in turn", "at a rate"])
def test_a_poller_closes_only_after_exchanges_in_flight_end(
    responder: tuple[int, str], every: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    master, path = responder
    answers = [checksums.rtu("01 03 02 00 01")]

    def answer(seconds: float) -> None:
        while answers:
            os.write(master, answers.pop())
        time.sleep(seconds)

    monkeypatch.setattr(line_set, "ENDING_NS", round(PATIENCE * 1e9))
    with Polling(line(path, patient(every))) as polling:
        assert os.read(master, 1024) == checksums.rtu("01 03 00 04 00 01")
        monkeypatch.setattr(clock, "sleep", answer)  # `close` sleeps while it waits for exchanges in flight
    assert [(row.value, row.status) for row in polling.rows] == [(1.0, "ok")]
    polling.check()


def test_an_unanswered_request_has_a_row_when_polling_ends(
    responder: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A queued poll has a row only if its period has already ended when polling ends."""
    monkeypatch.setattr(line_set, "ENDING_NS", 10_000_000)
    master, path = responder
    short = polled(Patient(2, name="pump-2"), [Patient.fault], 0.0002)
    waiting = polled(Patient(3, name="pump-3"), [Patient.fault], 60.0)
    with Polling(line(path, patient(0.0001), short, waiting)) as polling:
        assert os.read(master, 1024) == checksums.rtu("01 03 00 04 00 01")
    told = {(row.drive, row.value, row.status) for row in polling.rows}
    assert told == {("pump-1", None, "poll ended"), ("pump-2", None, "poll ended")}
    assert all(row.monotonic_ns > 0 for row in polling.rows)
    polling.check()


@pytest.mark.slow
@pytest.mark.parametrize("leaves", ["the poll", "the drive"])
def test_a_due_but_unsent_poll_has_no_row_when_polling_ends(responder: tuple[int, str], leaves: str) -> None:
    """Such a poll is not counted as a missing value either."""
    master, path = responder
    first = polled(Patient(1, name="pump-1"), [Patient.fault], 60.0)
    second = polled(Patient(2, name="pump-2"), [Patient.fault], 60.0)
    with Polling(line(path, first, second)) as polling:
        assert os.read(master, 1024)  # the request to pump-1; the one to pump-2 is still queued
        if leaves == "the drive":
            polling.poller.remove("line", "pump-2")
        os.write(master, checksums.rtu("01 03 02 00 01"))
    is_asked, _, _ = select.select([master], [], [], 0)  # whether pump-2's request was sent before the end
    missed = [("pump-2", "poll ended")] if is_asked else []
    assert [(row.drive, row.status) for row in polling.rows] == [("pump-1", "ok"), *missed]
    polling.check()
    assert polling.poller.summary()["misses"] == len(missed)


def test_motors_are_stopped_before_the_port_is_closed(port: str, pump: SimulatedDrive) -> None:
    with Polling(line(port, polled(drive(), ONE))) as polling:
        bus = polling.poller.bus("line")
        bus.stop_on_exit()
        bus.drives[0].start()
        assert pump["control"] == 1
        polling.until("ok")
    assert pump["control"] == 0


def test_an_unopenable_port_raises_and_leaves_no_descriptor_or_thread(port: str) -> None:
    Poller(plant(line(port, polled(drive(), ONE)))).close()
    before = descriptors(), threads()
    good, bad = (
        line(port, polled(drive(), ONE)),
        line("/dev/null", polled(drive(1, "fan-1"), ONE), name="hall-2"),
    )
    for _ in range(2):
        with pytest.raises(LineError, match=r"^/dev/null: it is not a serial port$"):
            Poller(plant(good, bad))
    assert (descriptors(), threads()) == before


def test_rows_can_be_taken_after_the_poller_is_closed(port: str) -> None:
    with Poller(plant(line(port, polled(drive(), ONE)))) as poller:
        until(lambda: poller.summary()["samples"])
    poller.close()  # a second call is allowed
    told = poller.summary()
    assert len(rows_of(poller)) == told["samples"] + told["misses"]
    assert poller.take() is None


def test_a_line_can_be_closed_right_after_its_port_was_reopened() -> None:
    """The queue of the new port is empty, even if exchanges were queued on the earlier port."""
    sim = simulated(drive())
    with ClockedLines(ClockedWire([sim], Faults()), [polled(drive(), READINGS, 0.1)]) as clocked:
        clocked.run(1.0)
        (tended,) = clocked.poller._lines
        assert tended._queue._done
        assert clocked.port
        tended._lose(clocked.port, clocked.now)
        tended.bus.line.reopen()


MOST_MB = 30.0
POLLER = """
import os, re, tempfile
from pathlib import Path
from multidrop import InnovertIBD, Plant, Poller, open_writer
from multidrop.plant.model import PlantLine, Polled, PolledDrive

_, slave = os.openpty()
drives = [InnovertIBD(address, name=f"drive-{address}") for address in range(1, 32)]
polled = tuple(PolledDrive(each, tuple(Polled(r, None) for r in each.readings())) for each in drives)
plant = Plant((PlantLine("hall", os.ttyname(slave), drives=polled),), Path())
with tempfile.TemporaryDirectory() as folder, Poller(plant) as poller:
    with open_writer(Path(folder, "run.arrows"), plant.metadata()) as out:
        for batch in poller.batches(2.0):
            out.write(batch)
print(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.long
@pytest.mark.uncounted
@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the kernel tells the memory")
def test_a_recording_poller_of_31_drives_uses_at_most_30_mb() -> None:
    ran = subprocess.run([sys.executable, "-c", POLLER], capture_output=True, text=True, check=True)
    assert 5.0 < int(ran.stdout) / 1024 <= MOST_MB


@pytest.mark.long
def test_a_closing_poller_waits_once_for_all_stalled_adapters(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Each adapter has the same 0.75 s from the end of polling, not 0.75 s after the previous one."""
    waits: list[float] = []

    def close(fd: int, other: int, seconds: float) -> None:
        waits.append(seconds)
        time.sleep(seconds)
        os.dup2(other, fd)

    ends = [os.openpty() for _ in range(3)]
    try:
        with Poller(plant(*(line(os.ttyname(end), name=str(end)) for _, end in ends))):
            monkeypatch.setattr(Serial, "out_waiting", 8)
            monkeypatch.setattr(open_port, "close_behind", close)
    finally:
        for end in (end for both in ends for end in both):
            os.close(end)
    assert len(waits) == len(ends)
    assert sum(waits) <= open_port.CLOSING_S
    assert waits[-1] == 0
    assert "its adapter takes no bytes; they are discarded" in caplog.text
