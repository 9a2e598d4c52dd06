"""Requests that a drive does not answer as a whole are split, and an invalid value counts as missing."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from clocked_lines import ClockedLines, ClockedWire
from hypothesis import example, given, settings
from hypothesis import strategies as st
from lines import line, patient, plant, polled, rows_of, until
from profile_families import shipped
from tables import examples, table, usually
from toy import Picky, Toy, expected_values, family

from multidrop.core import Message, NumberFormat
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, INPUT, reading
from multidrop.planning.blocks import blocks, halves
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.polling import refusals
from multidrop.polling.batch import Row
from multidrop.sim import Faults, SimulatedDrive, Simulator, Wire, simulated
from multidrop.sim.drive import Reason, Refusal

WIDE = 24


def clocked_line_of(drive: Drive, sim: Picky, every: float | None = None) -> ClockedLines:
    return ClockedLines(ClockedWire([sim], Faults()), [polled(drive, drive.registers.values(), every)])


def values(rows: list[Row]) -> dict[str, float]:
    return {row.register: row.value for row in rows if row.value is not None}


def test_registers_that_must_be_read_together_are_never_separated() -> None:
    class Kind(Drive):
        read_together = (("high", "low"),)
        a = reading(0)
        same = reading(0)
        b = reading(1)
        high = reading(2)
        between = reading(3)
        low = reading(4)
        long = reading(1, number_format=NumberFormat.U32)

    (whole,) = blocks(Kind(1), Kind.registers.values())
    todo, ends, made = [whole], [], 0
    while todo:
        parts = halves(Kind(1), block := todo.pop())
        made += len(parts)
        todo += parts
        if not parts:
            ends.append({register.name for register in block.registers})
    assert sorted(map(sorted, ends)) == [["a", "same"], ["b"], ["between"], ["high", "low"], ["long"]]
    assert made == 2 * len(ends) - 2


@pytest.mark.slow
@pytest.mark.parametrize("every", [None, 0.5])
def test_one_refused_register_hardly_delays_its_neighbours(every: float | None) -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, refused={7})
    with clocked_line_of(drive, sim, every) as clocked:
        clocked.run(15)
        sim.asked.clear()
        rows = clocked.run(10)
        told = clocked.poller.summary()["lines"]["line"]["set_aside"]
    assert values(rows) == expected_values(set(range(WIDE)) - {7})
    assert told == ["pump-1.r7"]
    asked = {span for span in sim.asked if span != (7, 1)}
    # 24 registers are halved 5 times to find r7, which leaves at most 5 blocks without r7
    assert len(asked) <= 5
    assert all(row.value is not None for row in rows if row.register != "r7")


@pytest.mark.slow
def test_a_device_with_a_smaller_read_limit_gets_shorter_requests() -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, most=8)
    with clocked_line_of(drive, sim) as clocked:
        clocked.run(10)
        sim.asked.clear()
        rows = clocked.run(5)
        assert clocked.poller.summary()["lines"]["line"]["set_aside"] == []
    assert values(rows) == expected_values(range(WIDE))
    assert {row.status for row in rows} == {"ok"}
    assert {count for _, count in sim.asked} == {6}


@pytest.mark.slow
def test_a_split_request_is_merged_again_once_the_drive_accepts_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refusals, "SET_ASIDE_NS", 2_000_000_000)
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive)
    with clocked_line_of(drive, sim) as clocked:
        clocked.run(3)
        sim.missing = set(range(WIDE))
        clocked.run(10)
        assert len(clocked.poller.summary()["lines"]["line"]["set_aside"]) == WIDE
        sim.missing = set()
        clocked.run(10)
        sim.asked.clear()
        rows = clocked.run(3)
        assert clocked.poller.summary()["lines"]["line"]["set_aside"] == []
    assert values(rows) == expected_values(range(WIDE))
    assert set(sim.asked) == {(0, WIDE)}


@pytest.mark.slow
def test_a_retry_of_a_split_request_adds_no_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refusals, "SET_ASIDE_NS", 1_000_000_000)
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, most=12)
    with clocked_line_of(drive, sim) as clocked:
        clocked.run(5)
        sim.asked.clear()
        rows = clocked.run(10)
    assert 5 <= Counter(sim.asked)[0, WIDE] <= 12
    assert {row.status for row in rows} == {"ok"}


@pytest.mark.long
@pytest.mark.parametrize("every", [None, 0.5])
@pytest.mark.parametrize("longest", usually(10, 1))
def test_a_device_that_ignores_long_requests_gets_shorter_ones(longest: int, every: float | None) -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, silent_beyond=longest)
    with clocked_line_of(drive, sim, every) as clocked:
        clocked.run(120)
        sim.asked.clear()
        rows = clocked.run(10)
    assert values(rows) == expected_values(range(WIDE))
    assert {row.status for row in rows} == {"ok"}
    assert {count for _, count in sim.asked} == ({1} if longest == 1 else {6})


@pytest.mark.long
def test_extra_reads_stay_rare_if_a_drive_ignores_long_requests() -> None:
    """The poller then also reads a single register, with the period of the block."""
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, silent_beyond=1)
    with clocked_line_of(drive, sim, every=5.0) as clocked:
        rows = clocked.run(600)
    assert len(values(rows)) == WIDE
    assert max(Counter(sim.asked).values()) <= 2 * 600 / 5  # r0 is read by the probe, and later in a block


@pytest.mark.slow
@pytest.mark.parametrize("answered_s", [0, 3])
def test_requests_to_a_silent_drive_are_not_split(answered_s: int) -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive)
    sim.deaf_until = 0.0 if answered_s else float("inf")
    with clocked_line_of(drive, sim) as clocked:
        clocked.run(answered_s)
        sim.deaf_until = float("inf")
        clocked.run(120)
        sim.deaf_until = 0.0
        clocked.run(10)
        sim.asked.clear()
        rows = clocked.run(5)
    assert set(sim.asked) == {(0, WIDE)}
    assert values(rows) == expected_values(range(WIDE))


@pytest.mark.long
def test_a_previously_answered_request_is_not_split_if_the_drive_falls_silent() -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive)
    with ClockedLines(ClockedWire([sim], Faults()), [polled(drive, drive.registers.values())]) as clocked:
        clocked.run(3)
        sim.silent_beyond = 1
        clocked.run(60)
        counts = {count for _, count in sim.asked}
        assert counts <= {WIDE, 1}  # a single register is read only to prove that no late reply is due
        (line,) = clocked.poller._lines
        assert len(line._maker._made) == 1


@pytest.mark.long
@settings(max_examples=examples(4), deadline=None)
@example({2, 4}, 5, 1)
@given(st.sets(st.integers(1, 5), max_size=3), st.integers(1, 6), st.integers(1, 6))
def test_every_register_that_can_be_read_alone_is_polled(refused: set[int], most: int, silent: int) -> None:
    """Register 0 is never refused: its reply shows that no late reply is due."""
    drive = family(6)(1, name="pump-1")
    sim = Picky(drive, refused, most, silent)
    with clocked_line_of(drive, sim, every=5.0) as clocked:
        clocked.run(900)
        sim.asked.clear()
        rows = clocked.run(20)
        (line,) = clocked.poller._lines
        assert len(line._maker._made) <= 2 * 6
    assert values(rows) == expected_values(set(range(6)) - refused)


POLLED = ("output_frequency", "output_current", "mystery", "fault", "status")
REFUSED = Toy.mystery


@pytest.mark.slow
@patient
def test_a_refused_register_is_skipped_and_its_neighbours_are_polled() -> None:
    with Simulator([Wire([Picky(Toy(1), {REFUSED.address})], unpaced=True)]) as simulator:
        drive = Toy(1, name="pump-1")
        polls = tuple(Polled(drive.register(name), None) for name in POLLED)
        line = PlantLine("hall-1", simulator.wires[0].path, drives=(PolledDrive(drive, polls),))
        seen: dict[str, int] = {}
        refused = 0
        with Poller(Plant((line,), Path("hall.toml"))) as poller:
            for batch in poller.batches():
                for row in batch:
                    if row.value is None:
                        assert row.status == "exception 02"
                        refused += 1
                    else:
                        seen[row.register] = seen.get(row.register, 0) + 1
                if len(seen) == len(POLLED) - 1 and min(seen.values()) > 10:
                    break
            told = poller.summary()["lines"]["hall-1"]
    assert set(seen) == set(POLLED) - {REFUSED.name}
    assert told["set_aside"] == ["pump-1.mystery"]
    queued_ahead = 256 * len(POLLED)
    # at most the rows of two full queues of requests, with 256 requests each
    assert refused <= 2 * queued_ahead


class Moody(SimulatedDrive):
    """A drive that answers every read with the exception `says`, unless it is None."""

    says: Reason | None = None

    def read(self, function: int, start: int, count: int) -> list[int]:
        if self.says:
            raise Refusal(self.says)
        return super().read(function, start, count)


@table(("says", "is_set_aside"), [(Reason.BUSY, False), (Reason.READ_ADDRESS, True)], ids=["busy", "refused"])
@table("registers", [[Toy.output_current, Toy.fault], [Toy.fault]], ids=["two", "one"])
def test_polling_recovers_when_refused_registers_become_readable(
    says: Reason, is_set_aside: bool, registers: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refusals, "SET_ASIDE_NS", 1_000_000_000)
    drive, moody = Toy(1, name="pump-1"), Moody(Toy(1))
    with ClockedLines(ClockedWire([moody], Faults()), [polled(drive, registers)]) as clocked:
        before = len(clocked.run(1.0))
        moody.says = says
        clocked.run(2.0)
        line = clocked.poller.summary()["lines"]["line"]
        assert bool(line["set_aside"]) is is_set_aside
        moody.says = None
        clocked.run(2.0)
        rows = clocked.run(1.0)
        assert clocked.poller.summary()["lines"]["line"]["set_aside"] == []
    assert {row.status for row in rows} == {"ok"}
    assert len(rows) > before / 4


ANSWERED = ("ok", "no valid value")  # statuses of rows with a reply; on a busy computer, some have none


class Meter(Drive):
    """A meter whose registers are all read by one request."""

    most_registers = {INPUT: 40, HOLDING: 40}

    voltage = reading(0, "V", number_format=NumberFormat.F32, order="CDAB", table=INPUT)
    energy = reading(2, "kWh", number_format=NumberFormat.U64, table=INPUT, invalid=2**64 - 1)
    probe = reading(
        6, "degC", step=0.1, offset=-40, number_format=NumberFormat.I16, invalid=0x7FFF, table=INPUT
    )
    tariff = reading(7, part=(0, 3), invalid=0xFFFF, table=INPUT)
    runs = reading(7, part=(8, 8), table=INPUT)
    power = reading(8, "W", number_format=NumberFormat.I16, scale_register="power_scale", table=INPUT)
    power_scale = reading(9, number_format=NumberFormat.I16, table=INPUT)
    count = reading(10, number_format=NumberFormat.BCD16, table=INPUT)


def rows_by_register(sim: SimulatedDrive) -> tuple[dict[str, Row], Poller, list[Row]]:
    """Poll until each register is answered; return the last row of each, the poller, and all rows."""
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        drives = polled(Meter(1, name="em"), Meter.readings())
        with Poller(plant(line(simulator.wires[0].path, drives))) as poller:
            rows: list[Row] = []

            def all_there() -> bool:
                rows.extend(rows_of(poller))
                return len({row.register for row in rows if row.status in ANSWERED}) == len(Meter.registers)

            until(all_there)
        rows += rows_of(poller)  # rows queued before the poller was closed
        return {row.register: row for row in rows if row.status in ANSWERED}, poller, rows


def test_registers_of_all_number_formats_are_read_by_one_request() -> None:
    (block,) = blocks(Meter(1), Meter.readings())
    assert (block.start, block.count, len(block.registers)) == (0, 11, 8)


def test_registers_that_are_bit_fields_of_one_word_share_one_request() -> None:
    class Single(Drive):
        """A device with a limit of one register per request."""

        most_registers = {INPUT: 1}
        first = reading(7, part=(0, 3), table=INPUT)
        second = reading(7, part=(4, 7), table=INPUT)
        whole = reading(7, table=INPUT)
        other = reading(8, table=INPUT)

    found = blocks(Single(1), Single.readings())
    assert [(block.start, block.count, len(block.registers)) for block in found] == [(7, 1, 3), (8, 1, 1)]


def test_a_value_and_its_scale_are_read_by_one_request() -> None:
    (block,) = blocks(Meter(1), [Meter.power])
    assert (block.start, block.count, block.offset(Meter.power)) == (8, 2, 0)


def test_polled_values_of_all_number_formats_are_correct() -> None:
    sim = SimulatedDrive(Meter(1))
    sim["voltage"], sim["energy"], sim["probe"], sim["tariff"] = 230.5, 2**53, 21.5, 3
    sim["runs"], sim["power_scale"] = 1, -2
    sim["power"], sim["count"] = -12.34, 1234
    last, _, _ = rows_by_register(sim)
    assert {name: row.value for name, row in last.items()} == {
        "voltage": 230.5,
        "energy": 2.0**53,
        "probe": 21.5,
        "tariff": 3,
        "runs": 1,
        "power": -12.34,
        "power_scale": -2,
        "count": 1234,
    }
    assert {row.status for row in last.values()} == {"ok"}


def test_an_invalid_value_gives_a_row_with_status_no_valid_value() -> None:
    sim = SimulatedDrive(Meter(1))
    sim["voltage"], sim["energy"], sim["probe"], sim["tariff"] = math.nan, None, None, None
    sim["power_scale"] = -32768
    sim.memory.set_raw(Meter.count, 0x12A4)
    last, poller, rows = rows_by_register(sim)
    lacking = {name for name, row in last.items() if row.status == "no valid value"}
    assert lacking == {"voltage", "energy", "probe", "tariff", "power", "count"}
    assert all(last[name].value is None and last[name].uncertainty_ns is None for name in lacking)
    assert (last["runs"].value, last["power_scale"].value) == (1, -32768)  # bit 8 of FFFFH is 1
    (statistics,) = poller.statistics().values()
    counted = sum(row.status == "no valid value" for row in rows)
    assert statistics.misses["no valid value"] == counted > 0
    assert statistics.samples == sum(row.status == "ok" for row in rows)


ILLEGAL_ADDRESS, ILLEGAL_VALUE = 2, 3


class Choosy:
    """A simulated drive that refuses some reads with an exception."""

    def __init__(self, drive: Drive, refusal: Callable[[Message], int]) -> None:
        self.sim: Any = simulated(drive)
        self._answer = self.sim.answer
        self._refusal = refusal
        self.read: list[tuple[int, int]] = []
        vars(self.sim)["answer"] = self.answer

    def answer(self, request: Message, now: float) -> Message | None:
        self.read.append((request.start, request.count))
        if code := self._refusal(request):
            return Message(request.address, request.function, request.start, exception=code)
        reply: Message | None = self._answer(request, now)
        return reply


def more_than_four(request: Message) -> int:
    return ILLEGAL_VALUE if request.count > 4 else 0


def at_210b(request: Message) -> int:
    return ILLEGAL_ADDRESS if request.start <= 0x210B < request.start + request.count else 0


def registers_with_values(rows: list[Row]) -> set[str]:
    return {row.register for row in rows if row.value is not None}


@table(
    "name, refusal, lost",
    [("yaskawa-a1000", more_than_four, set()), ("delta-cp2000", at_210b, {"output_torque"})],
)
def test_only_refused_registers_have_missing_values(
    name: str, refusal: Callable[[Message], int], lost: set[str]
) -> None:
    drive = shipped(name, 1)
    choosy = Choosy(drive, refusal)
    readings = drive.readings()
    with ClockedLines(ClockedWire([choosy.sim], Faults()), [polled(drive, readings, 0.5)]) as clocked:
        clocked.run(8)
        choosy.read.clear()
        rows = clocked.run(4)
    assert registers_with_values(rows) == {register.name for register in readings} - lost
    refused = [each for each in choosy.read if refusal(Message(1, 3, *each))]
    assert not refused, "the drive is asked again only after a minute"
    assert len(set(choosy.read)) < len(readings), "registers are still read together"
