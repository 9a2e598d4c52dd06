"""`stop_all` on a line on which some drives are silent, on simulated time."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from simulated_bus import EXCHANGE_TIME, STOPS, TIMEOUT, Own, SimulatedBus, che_drives, is_write

from multidrop.control.outcome import Seen
from multidrop.control.stops import AT_ONCE, FIRST_PART, PAUSE_S, SHARE
from multidrop.core import Completion, Exchange, Message
from multidrop.drive import Script, read, write
from multidrop.drive.verbs import verb
from multidrop.sim import simulated

MISS = EXCHANGE_TIME + TIMEOUT  # duration in s of a request without a reply
RAMP = 3.0  # s

is_stop = STOPS["invt-che"]


def running(answering: int, silent: int) -> tuple[SimulatedBus, list[tuple[float, Message]]]:
    """Return a line whose last `silent` drives become silent now, and the requests sent from now on.

    Each request is listed with its time in s. All motors run.
    """
    line, drives, sims = che_drives(answering + silent, hz=50, runs_s=20)
    for drive, sim in zip(drives, sims, strict=True):
        sim.motor.deceleration_time = RAMP
        line.bus.check_identity(drive)
    sent: list[tuple[float, Message]] = []

    def is_lost(request: Message) -> bool:
        sent.append((line.seconds, request))
        return request.address > answering

    line.deafens = is_lost
    return line, sent


def stops(sent: list[tuple[float, Message]], address: int) -> list[float]:
    """Return the times at which stops were sent to this drive."""
    return [at for at, request in sent if request.address == address and is_stop(request)]


@pytest.mark.parametrize("silent", [1, 4, 12, 30])
@pytest.mark.parametrize("is_known", [True, False])
def test_standstill_is_seen_soon_however_many_other_drives_are_silent(silent: int, is_known: bool) -> None:
    """If a drive is not known to be silent, its first stop precedes the reads of other stops."""
    line, _ = running(1, silent)
    for sim in line.sims[1:]:
        line.bus.peer(sim.drive).c.failures = 3 if is_known else 0
    found = line.bus.stop_all()
    stopped = found.pop("invt-che@1")
    assert stopped.seen is Seen.STOPPED
    assert stopped.seconds < (RAMP if is_known else max(RAMP, silent * MISS)) + 2 * MISS
    assert {each.seen for each in found.values()} == {Seen.SENT}


def test_each_drive_is_sent_its_stop_before_any_standstill_is_read() -> None:
    line, sent = running(3, 12)
    line.bus.stop_all()
    first = [request for _, request in sent if request.address][:15]  # without the broadcast
    assert [request.address for request in first] == [*range(1, 16)]
    assert all(map(is_stop, first))


def test_a_drive_that_answers_no_reads_gets_no_more_stops_than_silent_drives() -> None:
    line, sent = running(1, 12)
    is_lost = line.deafens
    line.deafens = lambda request: is_lost(request) or not is_write(request)
    line.bus.stop_all()
    fewest = min(len(stops(sent, address)) for address in range(2, 14))
    assert len(stops(sent, 1)) < AT_ONCE + 2 * fewest


def test_a_broadcast_does_not_replace_the_first_stop_of_a_drive() -> None:
    """A first stop has no least timeout: it waits neither for late replies nor for reads of other stops."""
    line, _ = running(3, 12)
    carry_out = line.carry_out
    least_timeouts: dict[int, list[int]] = {}

    def note(exchange: Exchange, **details: Any) -> Completion:
        if is_stop(exchange.request):
            least_timeouts.setdefault(exchange.request.address, []).append(exchange.c.timeout_ns)
        return carry_out(exchange, **details)

    line.carry_out = note  # type: ignore[method-assign]
    line.bus.stop_all()
    assert 0 in least_timeouts  # the broadcast
    for first, *repeated in (least_timeouts[address] for address in range(1, 16)):
        assert first == 0
        assert all(repeated)


class Restless(Own):
    """A drive whose stop reads for 20 s without a pause."""

    model = "restless"
    title = "OWN 3"

    @verb
    def stop(self) -> Script[None]:
        yield from write(self.run, 0)
        for _ in range(round(20 / EXCHANGE_TIME)):
            yield from read(self.speed)


def test_a_stop_that_is_read_back_does_not_wait_for_silent_drives() -> None:
    line = SimulatedBus(simulated(Restless(1)))
    drive = line.attach(Restless(1))
    line.bus.check_identity(drive)
    carry_out, reads = line.carry_out, []

    def note(exchange: Exchange, **details: Any) -> Completion:
        if exchange.request.function == 3:
            reads.append((exchange.request.start, exchange.c.is_stop_read))
        return carry_out(exchange, **details)

    line.carry_out = note  # type: ignore[method-assign]
    drive.stop()
    assert set(reads) == {(Restless.run.address, 1), (Restless.speed.address, 1)}


def test_a_stop_that_reads_without_pause_leaves_half_of_the_line_to_stops_of_silent_drives() -> None:
    line = SimulatedBus(simulated(Restless(1)))
    for address in (1, 2, 3):
        line.attach(Restless(address))
    sent: list[tuple[float, int]] = []

    def is_silent(request: Message) -> bool:
        sent.append((line.seconds, request.address))
        return False

    line.deafens = is_silent
    line.bus.stop_all()
    longest = 2 * (2 * MISS + EXCHANGE_TIME) + PAUSE_S + SHARE * MISS
    for address in (2, 3):
        times = [at for at, asked in sent if asked == address]
        assert max(later - earlier for earlier, later in pairwise(times)) < longest


def test_first_stops_of_silent_drives_hardly_wait_for_reads_of_other_stops() -> None:
    """A silent drive may be back, with a running motor. Stops of drives that answer are sent before."""
    silent, last = range(1, 13), 13
    line = SimulatedBus(simulated(Restless(last)))
    for address in (*silent, last):
        line.attach(Restless(address))
    for drive in line.bus.drives[:-1]:
        line.bus.peer(drive).c.failures = 3
    first: dict[int, float] = {}

    def note(request: Message) -> bool:
        if request.function != 3:
            first.setdefault(request.address, line.seconds)
        return False

    line.deafens = note
    begun = line.seconds
    line.bus.stop_all()
    assert min(first, key=lambda address: first[address]) == last
    step = 2 * MISS  # a read, which checks the drive's family, and the stop
    assert max(first.values()) - begun < len(silent) * ((1 + FIRST_PART) * step + 2 * EXCHANGE_TIME)


def test_drives_that_come_back_are_stopped_within_two_turns() -> None:
    line, sent = running(1, 12)
    back = line.seconds + 8
    is_lost = line.deafens
    line.deafens = lambda request: is_lost(request) and line.seconds < back
    found = line.bus.stop_all()
    assert {each.seen for each in found.values()} == {Seen.STOPPED}
    for address in range(2, 14):
        assert min(at for at in stops(sent, address) if at >= back) < back + 2 * MISS + 13 * 4 * EXCHANGE_TIME


def test_a_lost_reply_to_a_read_does_not_put_a_stop_behind_silent_drives() -> None:
    line, sent = running(1, 12)
    is_lost = line.deafens
    lost: list[Message] = []

    def loses(request: Message) -> bool:
        if request.address == 1 and not is_stop(request) and len(sent) > 13 and not lost:
            lost.append(request)
            return True
        return is_lost(request)

    line.deafens = loses
    found = line.bus.stop_all()
    assert lost
    assert found["invt-che@1"].seconds < 12 * MISS + 5 * MISS
