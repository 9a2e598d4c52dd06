"""Statistics: the guide's counters for each result, quantiles, time spans, buses and pollers."""

from __future__ import annotations

import fcntl
import struct
from collections import Counter
from collections.abc import Callable
from itertools import pairwise

import pytest
from checksums import rtu
from clocked_lines import ClockedLines, ClockedWire
from hypothesis import given
from hypothesis import strategies as st
from line_driver import CHARACTER, MS, READ, SILENCE, WRITE, LineDriver, answer, ask, drive, line, reply
from lines import line as a_line
from lines import plant, polled, rows_of, until
from multidrop._core import lib
from tables import table
from toy import Toy

from multidrop import Bus, Poller
from multidrop.core import Counters, Exchange, Framing, Message, Peer, delay_edge
from multidrop.sim import EncodedDrive, Faults, SimulatedDrive, Simulator, Wire, simulated
from multidrop.transport.statistics import Diagnostics, LineStatistics, Statistics, line_statistics

__all__ = ["drive", "line"]  # fixtures

LEAST_NS, MOST_NS = 1 << 17, 1 << 32  # delays whose quantiles have an error of at most 1/16


def counters_of(delays_ns: list[int]) -> Counters:
    known = Peer(least_timeout=0.02, most_timeout=1)
    for delay in delays_ns:
        lib.md_counters_answer(known.c, delay, 0)
    return known.counters()


@given(st.lists(st.integers(LEAST_NS, MOST_NS - 1), min_size=1))
def test_quantiles_of_delays_have_an_error_of_at_most_one_sixteenth(delays_ns: list[int]) -> None:
    found = Statistics(1.0, counters_of(delays_ns)).delays
    ordered = sorted(delays_ns)
    for told, percent in ((found.p50, 50), (found.p90, 90), (found.p99, 99)):
        true = ordered[-(-percent * len(ordered) // 100) - 1]  # the delay that `percent` % do not exceed
        assert told * 1e9 == pytest.approx(true, rel=1 / 16 + 1e-9)
    assert found.longest == max(delays_ns) / 1e9
    assert found.replies == len(delays_ns)


@table("delay_ns", [0, 1, LEAST_NS - 1, MOST_NS, 10 * MOST_NS, (1 << 63) - 1])
def test_delays_outside_the_range_of_the_buckets_are_counted_too(delay_ns: int) -> None:
    found = Statistics(1.0, counters_of([delay_ns])).delays
    assert (found.replies, found.longest) == (1, delay_ns / 1e9)
    assert 0 <= found.p50 <= found.p99 <= found.longest


def test_delay_histogram_buckets_have_no_gaps() -> None:
    edges = [delay_edge(bucket) for bucket in range(129)]
    assert edges == sorted(set(edges))
    assert edges[0] == 0
    assert edges[128] == MOST_NS
    assert all(high - low <= low / 8 for low, high in pairwise(edges[1:]))


def test_the_delays_are_0_if_there_are_no_replies() -> None:
    found = Statistics(1.0, Counters()).delays
    assert (found.replies, found.p50, found.p99, found.longest) == (0, 0, 0, 0)


def test_a_delay_is_the_response_time_without_the_time_on_the_wire(line: LineDriver, drive: Peer) -> None:
    for delay in (10, 10, 10, 15):
        answer(line, drive, delay * MS)
    found = Statistics(1.0, drive.counters()).delays
    assert found.longest == pytest.approx(0.015)
    assert found.p50 == pytest.approx(0.010, rel=1 / 16)


@pytest.mark.parametrize("delay_ms", [0, 3, 20])
def test_line_utilisation_includes_delays_and_silences(line: LineDriver, drive: Peer, delay_ms: int) -> None:
    for _ in range(10):
        answer(line, drive, delay_ms * MS)
    characters = (8 + 7) * CHARACTER
    assert drive.counters().ideal_ns == pytest.approx(10 * (characters + delay_ms * MS + SILENCE), rel=0.1)


def test_utilisation_is_at_most_1_if_replies_exceed_the_baud_rate(line: LineDriver, drive: Peer) -> None:
    """The whole reply comes after 0.1 ms; on a wire it would take the time of 15 characters."""
    begun = line.now
    for _ in range(100):
        ask(line, drive)
        line.now += MS // 10
        line.receive(reply())
        line.wait_until_done()
    line.now += 8 * CHARACTER  # duration of the last request on the wire
    found = Statistics((line.now - begun) / 1e9, drive.counters())
    assert found.samples == 100
    assert 0.9 < found.utilisation <= 1.0 + 1e-9


def exchange(request: Message, known: Peer, framing: Framing) -> Exchange:
    return Exchange(framing, request, known, baudrate=9600, format="8N1", character=1e-3, silence=4e-3)


GOOD = Counter(bus_messages=1, server_messages=1)
ASKED = Counter(server_messages=1)
DAMAGED = ASKED + Counter(bus_communication_errors=1)
REFUSED = GOOD + Counter(bus_exception_errors=1)
ENDINGS: dict[str, tuple[Message, bytes, Counter[str]]] = {
    "a reply": (READ, rtu("01 03 02 00 07"), GOOD),
    "an exception": (READ, rtu("01 83 02"), REFUSED),
    "busy": (READ, rtu("01 83 06"), REFUSED + Counter(server_busies=1)),
    "negative acknowledge": (READ, rtu("01 83 07"), REFUSED + Counter(server_naks=1)),
    "a confirmation": (WRITE, rtu("01 06 00 02 00 07"), GOOD),
    "another write's": (WRITE, rtu("01 06 00 02 00 08"), GOOD),
    "nothing": (READ, b"", ASKED + Counter(server_no_responses=1)),
    "a bad checksum": (READ, rtu("01 03 02 00 07")[:-1] + b"\0", DAMAGED),
    "half of it": (READ, rtu("01 03 02 00 07")[:4], DAMAGED),
    "another drive's": (READ, rtu("02 03 02 00 07"), ASKED),
    "a broadcast": (Message(0, 6, 2, data=bytes(2)), b"", ASKED + Counter(server_no_responses=1)),
}


def counted(known: Peer) -> Counter[str]:
    found: Diagnostics = Statistics(1.0, known.counters()).diagnostics
    assert found.bus_character_overruns is None
    return +Counter({name: count for name, count in vars(found).items() if count})


@pytest.mark.parametrize("ending", ENDINGS)
def test_each_outcome_is_counted_as_in_the_modbus_guide(line: LineDriver, drive: Peer, ending: str) -> None:
    request, received, expected = ENDINGS[ending]
    line.echo = lib.MD_NO_ECHO
    ask(line, drive, request)
    line.now += 20 * CHARACTER
    line.receive(received)
    line.wait_until_done()
    assert counted(drive) == expected


def test_noise_on_an_ascii_line_is_counted_as_communication_error(line: LineDriver, drive: Peer) -> None:
    line.send(exchange(READ, drive, Framing.ASCII))
    line.receive(b"\xff\xff")
    line.wait_until_done()
    assert counted(drive) == DAMAGED


def test_a_late_reply_is_counted_as_a_separate_message(line: LineDriver, drive: Peer) -> None:
    ask(line, drive)
    line.wait_until_done()
    line.receive(rtu("01 03 02 00 07"))
    assert counted(drive) == GOOD + Counter(server_no_responses=1)
    assert Statistics(1.0, drive.counters()).late_replies == 1


def test_unsent_requests_are_not_counted(line: LineDriver, drive: Peer) -> None:
    line.begin(exchange(READ, drive, Framing.RTU))
    line.lose(5)
    assert counted(drive) == Counter()
    assert Statistics(1.0, drive.counters()).misses == {"port lost": 1}


def test_overruns_are_read_from_the_port_s_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    def counts(fd: int, request: int, answer: bytearray) -> None:
        assert request == 0x545D  # TIOCGICOUNT (asm-generic/ioctls.h)
        # linux/serial.h: cts dsr rng dcd rx tx frame overrun parity brk buf_overrun
        answer[:] = struct.pack("20i", 1, 2, 3, 4, 5, 6, 7, 100, 9, 10, 20, *[0] * 9)

    with Simulator([Wire([simulated(Toy(1))], unpaced=True)]) as sim, Bus(sim.wires[0].path) as bus:
        assert bus.statistics().diagnostics.bus_character_overruns is None  # a pty has no such counter
        with monkeypatch.context() as patched:
            patched.setattr(fcntl, "ioctl", counts)
            assert bus.line.overruns() == 120


def line_of(seconds: float, overruns: int | None = None, **drives: Counters) -> LineStatistics:
    return line_statistics(seconds, drives, overruns)


def test_statistics_of_a_time_span_subtract_two_readings() -> None:
    one = line_of(10, 5, pump=Counters(sent=100, ideal_ns=4 * 10**9, missed=Counter({10: 3})))
    two = line_of(
        12,
        8,
        pump=Counters(sent=150, ideal_ns=5 * 10**9, missed=Counter({10: 3, 3: 1})),
        fan=Counters(sent=10, ideal_ns=10**9),
    )
    found = two.since(one)
    assert (found.seconds, found.exchanges, found.exchanges_per_second) == (2, 60, 30)
    assert found.utilisation == 1.0
    assert found.misses == {"bad checksum": 1}
    assert found.diagnostics.bus_character_overruns == 3
    assert {name: each.exchanges for name, each in found.drives.items()} == {"pump": 50, "fan": 10}
    assert found.drives["pump"].utilisation == 0.5


def test_the_longest_delay_of_a_time_span_is_derived_from_the_buckets() -> None:
    early, late = counters_of([50 * MS]), counters_of([50 * MS, 8 * MS])
    found = line_of(2, pump=late).since(line_of(1, pump=early)).delays
    assert 8e-3 <= found.longest <= 8e-3 * 9 / 8  # upper edge of the bucket for 8 ms
    record = counters_of([50 * MS, 8 * MS, 70 * MS])
    assert line_of(2, pump=record).since(line_of(1, pump=early)).delays.longest == 0.070


@pytest.fixture
def toy() -> SimulatedDrive:
    return simulated(Toy(1, name="pump"))


@pytest.mark.slow
def test_a_bus_counts_exchanges_and_delays(toy: SimulatedDrive) -> None:
    with Simulator([Wire([toy], unpaced=True)]) as sim, Bus(sim.wires[0].path) as bus:
        pump, nobody = bus.attach(Toy, 1, name="pump"), bus.attach(Toy, 2, name="nobody")
        pump.read_many(pump.readings())
        with pytest.raises(TimeoutError):
            nobody.read(Toy.output_current)
        found = bus.statistics()
        asked = found.drives["pump"].exchanges  # includes retries on a slow computer
        assert asked >= found.drives["pump"].delays.replies > 0
        assert found.drives["nobody"].diagnostics.server_no_responses == found.drives["nobody"].exchanges == 3
        assert found.exchanges == asked + 3
        bus.reset_statistics()
        assert bus.statistics().exchanges == 0
        pump.read(Toy.output_current)
        assert bus.statistics().delays.replies == 1
    assert bus.statistics() == bus.statistics()  # constant after the bus is closed
    assert bus.statistics().delays.replies == 1


@pytest.mark.slow
def test_a_poller_counts_its_rows_by_status(toy: SimulatedDrive) -> None:
    toys = [polled(Toy(1, name="pump"), [Toy.output_current]), polled(Toy(9, name="none"), [Toy.fault], 0.01)]
    with Simulator([Wire([toy], unpaced=True)]) as sim:
        poller = Poller(plant(a_line(sim.wires[0].path, *toys)))

        def has(condition: Callable[[LineStatistics], bool]) -> Callable[[], bool]:
            return lambda: condition(poller.statistics()["line"])

        with poller:
            until(has(lambda each: each.drives["none"].misses["not asked: drive is silent"] > 3))
            until(has(lambda each: each.drives["pump"].samples > 100))
    rows = rows_of(poller)
    found = poller.statistics()["line"]
    assert found.samples == sum(row.value is not None for row in rows)
    assert found.misses == Counter(row.status for row in rows if row.value is None)
    assert 0 < found.drives["pump"].utilisation <= found.utilisation
    poller.reset_statistics()
    assert poller.statistics()["line"].exchanges == 0


@pytest.mark.usefixtures("_patient")
def test_a_reset_of_statistics_includes_renamed_and_replaced_drives(toy: SimulatedDrive) -> None:
    """Otherwise a renamed drive would keep earlier counts, and a new drive could have negative counts."""
    others = [simulated(Toy(address, name=f"toy-{address}")) for address in (2, 3)]
    with Simulator([Wire([toy, *others], unpaced=True)]) as simulator, Bus(simulator.wires[0].path) as bus:
        known = [bus.attach(Toy, address=address, name=name) for address, name in ((1, "a"), (2, "b"))]
        for drive, times in zip(known, (7, 3), strict=True):
            for _ in range(times):
                drive.read(Toy.output_current)
        bus.reset_statistics()
        for drive in known:
            bus.detach(drive)
        again = [
            bus.attach(Toy, address=address, name=name) for address, name in ((1, "c"), (2, "a"), (3, "b"))
        ]
        for drive in again:
            drive.read(Toy.output_current)
        found = bus.statistics()
        assert {name: drive.exchanges for name, drive in found.drives.items()} == {"c": 1, "a": 1, "b": 1}
        assert found.exchanges == 3
    assert bus.statistics().exchanges == 3  # the bus is closed, and the counts stay


STEPS = 400


@pytest.mark.long
@table("seconds", [0.001, 0.003, 0.01, 0.03, 0.1])
def test_the_utilisation_of_a_polled_line_is_at_most_1(seconds: float) -> None:
    """An exchange that is in flight while statistics are read is counted only later, with its whole time."""
    pumps = [Toy(address, name=f"pump-{address}") for address in (1, 2)]
    wire = ClockedWire([EncodedDrive(pump) for pump in pumps], Faults())
    drives = [polled(pump, [Toy.output_frequency, Toy.acceleration_time]) for pump in pumps]
    with ClockedLines(wire, drives) as made:
        made.run(2)
        (before,) = made.poller.statistics().values()
        begun, found = before, []
        for _ in range(STEPS):
            made.run(seconds)
            (now,) = made.poller.statistics().values()
            found.append(now.since(before))
            before = now
        assert max(span.utilisation for span in found) <= 1 + 1e-6
        assert max(sum(each.utilisation for each in span.drives.values()) for span in found) <= 1 + 1e-6
        whole = before.since(begun)
        assert whole.utilisation > 0.9
        assert sum(span.used_s for span in found) == pytest.approx(whole.used_s)
        assert sum(span.counted_s or 0 for span in found) == pytest.approx(whole.counted_s, abs=STEPS * 1e-9)
