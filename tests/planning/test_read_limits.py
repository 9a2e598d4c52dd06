"""Limits of one read: families without a stated limit, tables with one read function, register groups."""

from __future__ import annotations

from typing import Any

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from own_drives import ADDRESSES, Meter, StatedMeter
from tables import table

from multidrop.core import Message, NumberFormat
from multidrop.drive import HOLDING_MULTIPLE, Drive, Framing
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.register import (
    COIL,
    DISCRETE,
    HOLDING,
    INPUT,
    Carrier,
    Register,
    Table,
    command,
    reading,
    setting,
)
from multidrop.drive.request import write_request
from multidrop.families import MODELS
from multidrop.planning.blocks import Block, blocks, planned, sending
from multidrop.planning.bus_time import silence
from multidrop.planning.prediction import predict
from multidrop.sim import SimulatedDrive


def family(**declared: Any) -> type[Drive]:
    return type("Drawn", (Drive,), {"__doc__": "Of this test.", **declared})


def spans(drive: Drive, *names: str) -> list[tuple[int, int]]:
    wanted = [drive.register(name) for name in names] if names else drive.registers.values()
    return [(block.start, block.count) for block in blocks(drive, wanted)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "most", "apart"), [(HOLDING, 125, 1), (INPUT, 125, 1), (COIL, 2000, 8), (DISCRETE, 2000, 8)]
)
def test_adjacent_registers_are_read_up_to_the_modbus_limit(table: Table, most: int, apart: int) -> None:
    drive = family(**{f"r{at}": reading(at, table=table) for at in range(most + 1)})(1)
    asked = [f"r{at}" for at in (*range(0, most, apart), most - 1)]
    assert [count for _, count in spans(drive, *asked)] == [most]
    counts = [count for _, count in spans(drive, *asked, f"r{most}")]
    assert len(counts) == 2
    assert max(counts) <= most


def test_a_read_never_includes_undeclared_addresses_by_default() -> None:
    drive = family(a=reading(1), b=reading(2), c=reading(4), d=reading(5), e=reading(7), order=command(6))(1)
    assert spans(drive, "a", "b", "c", "d", "e") == [(1, 2), (4, 2), (7, 1)]


def test_a_read_may_include_a_declared_register_that_is_not_wanted() -> None:
    drive = family(a=reading(1), b=reading(2), c=reading(3))(1)
    assert spans(drive, "a", "c") == [(1, 3)]


def test_read_limit_of_one_table_does_not_apply_to_other_tables() -> None:
    registers = {f"h{at}": reading(at) for at in range(4)}
    registers |= {f"i{at}": reading(at, table=INPUT) for at in range(4)}
    drive = family(most_registers={HOLDING: 2}, **registers)(1)
    assert spans(drive) == [(0, 2), (2, 2), (0, 4)]


def test_a_delixi_request_reads_one_register() -> None:
    table = Table("parameter", 0x07, 0x05, Carrier.LONG)
    drive = family(framings=(Framing.DELIXI,), a=reading(500, table=table), b=reading(501, table=table))(1)
    assert spans(drive) == [(500, 1), (501, 1)]


# Requests (function, start, count) that read all readings of a family at its default line settings, recorded
# with an earlier version.
REQUESTS = {
    "erman-er-g-220": [(4, 1, 12), (4, 1024, 4)],
    "invt-che": [(3, 0x1001, 1), (3, 0x3000, 14), (3, 0x3010, 7), (3, 0x5000, 2)],
    "innovert-ibd": [(3, 3, 2), (3, 22, 1)],
    "delixi-modbus": [(3, 500 + at, 1) for at in range(32)],
    "delixi-native": [(3, 0, 1), *((7, 500 + at, 1) for at in range(32))],
    "yd1000": [
        *((3, at, 1) for at in (0x1100, *range(0x1200, 0x120A))),
        *((3, at, 1) for at in range(0x1210, 0x1215)),
    ],
}


@table("model", REQUESTS)
def test_requests_that_read_the_built_in_families_are_unchanged(model: str) -> None:
    drive = MODELS[model](3)
    found = [(block.request.function, block.start, block.count) for block in blocks(drive, drive.readings())]
    assert sorted(found) == REQUESTS[model]


def test_meter_of_39_floats_needs_eight_requests_or_four_with_readable_gaps() -> None:
    assert len(ADDRESSES) == 39
    lines = []
    for meter in (Meter, StatedMeter):
        drive = meter(1, baudrate=9600, format="8N1")
        wanted = [(drive.register(name), None) for name in ADDRESSES]
        found = planned(drive, wanted)
        lines.append((len(found), round(predict(found, lateness=0.0).cycle, 3)))
    assert lines == [(8, 0.341), (4, 0.268)]


def test_requests_to_a_meter_include_only_declared_registers_by_default() -> None:
    drive = Meter(1)
    declared = {at for address in ADDRESSES.values() for at in (address, address + 1)}
    asked = [range(one.start, one.start + one.count) for one in blocks(drive, drive.readings())]
    assert all(at in declared or one.start == 0xFC00 for one in asked for at in one)
    assert {at for one in asked for at in one} == declared | {0xFC00, 0xFC01}


class Mixed(Drive):
    """A family in which function 06 writes some registers and 10H writes others. Function 03 reads all."""

    low = setting(1, "", span=(0, 9))
    multiple = setting(2, "", span=(0, 9), table=HOLDING_MULTIPLE)
    read_only = reading(3, table=Table("status", 0x03, None))
    other = reading(4, table=INPUT)


def test_tables_that_are_read_by_the_same_function_share_requests() -> None:
    drive = Mixed(1)
    found = blocks(drive, drive.registers.values())
    assert [(one.request.function, one.start, one.count) for one in found] == [(3, 1, 3), (4, 4, 1)]
    assert (HOLDING_MULTIPLE.read, HOLDING_MULTIPLE.write, HOLDING_MULTIPLE.name) == (3, 16, HOLDING.name)


def test_smallest_limit_applies_to_tables_with_the_same_read_function() -> None:
    class Narrow(Mixed):
        most_registers = {HOLDING_MULTIPLE: 2, HOLDING: 3}

    drive = Narrow(1)
    assert len(blocks(drive, [Narrow.low, Narrow.multiple, Narrow.read_only])) == 2


def test_register_of_one_word_can_be_written_by_function_10h() -> None:
    drive, sim = Mixed(1), SimulatedDrive(Mixed(1))
    request = write_request(drive, Mixed.multiple, 7)
    assert request == Message(1, 0x10, 2, 1, b"\0\7")
    reply = sim.answer(request, 0)
    assert reply is not None
    assert (reply.exception, sim["multiple"]) == (0, 7)
    single = sim.answer(Message(1, 0x06, 2, data=b"\0\1"), 1)
    assert single is not None
    assert single.exception
    (block,) = blocks(drive, [Mixed.low, Mixed.multiple, Mixed.read_only])
    together = sim.answer(block.request, 2)
    assert together is not None
    assert together.data == bytes((0, 0, 0, 7, 0, 0))


LAYOUTS = st.lists(
    st.tuples(st.integers(0, 11), st.sampled_from([NumberFormat.U16, NumberFormat.U32])),
    min_size=1,
    max_size=7,
)


def partitions(registers: list[Register[float]]) -> list[list[list[Register[float]]]]:
    """Return all ways to divide the registers into groups, which need not be neighbours."""
    if not registers:
        return [[]]
    first, *others = registers
    found = []
    for rest in partitions(others):
        found += [[[first], *rest]]
        found += [[*rest[:at], [first, *rest[at]], *rest[at + 1 :]] for at in range(len(rest))]
    return found


def allowed(drive: Drive, group: list[Register[float]], limit: int) -> bool:
    declared = {at for one in drive.registers.values() for at in range(one.address, one.address + one.words)}
    start, stop = min(one.address for one in group), max(one.address + one.words for one in group)
    return stop - start <= max(limit, *(one.words for one in group)) and declared >= set(range(start, stop))


@settings(max_examples=examples(150), deadline=None)
@given(LAYOUTS, st.sampled_from([None, 1, 3]), st.sampled_from([1200, 115200]))
def test_no_other_plan_for_overlapping_registers_takes_less_time(
    layout: list[tuple[int, NumberFormat]], limit: int | None, baudrate: int
) -> None:
    registers = {
        f"r{number}": reading(address, number_format=number_format)
        for number, (address, number_format) in enumerate(layout)
    }
    stated = {} if limit is None else {HOLDING: limit}
    drive = family(most_registers=stated, **registers)(1, baudrate=baudrate)

    def seconds(found: list[Block]) -> float:
        return sum(silence(drive) + sending(drive, one) + drive.response_delay for one in found)

    ours = list(blocks(drive, drive.registers.values()))
    assert sorted(one.name for block in ours for one in block.registers) == sorted(registers)
    assert all(allowed(drive, list(one.registers), limit or 125) for one in ours)
    ways = partitions(list(drive.registers.values()))
    best = min(
        seconds([Block.of(drive, group) for group in way])
        for way in ways
        if all(allowed(drive, group, limit or 125) for group in way)
    )
    assert seconds(ours) == pytest.approx(best)


class Grouped(Drive):
    """A family with an energy in two registers, a state that must be read first, and large readable gaps."""

    most_registers = {HOLDING: 100}
    readable_gaps = {HOLDING: range(200)}
    read_together = (("latch",), ("energy_high", "energy_low"))
    energy_high = reading(0)
    between = reading(30)
    energy_low = reading(60)
    latch = reading(150)
    other = reading(110)


@pytest.mark.parametrize("baudrate", [1200, 9600, 115200])
def test_grouped_registers_share_a_request_even_if_two_requests_are_quicker(baudrate: int) -> None:
    drive = Grouped(1, baudrate=baudrate)
    assert (0, 61) in spans(drive, "energy_high", "energy_low")
    found = [
        block for block in blocks(drive, drive.registers.values()) if Grouped.energy_low in block.registers
    ]
    assert all(Grouped.energy_high in block.registers for block in found)


def test_one_register_of_a_group_can_be_read_without_the_others() -> None:
    assert spans(Grouped(1), "energy_low") == [(60, 1)]
    rates = [(Grouped.energy_high, 1.0), (Grouped.energy_low, None)]
    assert [(one.block.start, one.block.count) for one in planned(Grouped(1), rates)] == [(0, 1), (60, 1)]


def test_groups_in_read_together_come_before_other_registers() -> None:
    order = [block.registers[0].name for block in blocks(Grouped(1), Grouped.registers.values())]
    assert order[:2] == ["latch", "energy_high"]
    assert order[-1] == "other"


@table(
    ("details", "sentence"),
    [
        ({"read_together": (("a", "far"),)}, "between them are addresses that are not declared"),
        ({"read_together": (("a", "b"),), "most_registers": {HOLDING: 1}}, "they take 2 addresses, and one"),
        ({"read_together": (("a", "input_3"),)}, "these are in several"),
        ({"read_together": (("a", "none"),)}, "the name of a readable register"),
        ({"read_together": (("a", "run"),)}, "the name of a readable register"),
        ({"read_together": ("ab",)}, "not a tuple of groups"),
        ({"read_together": (("a", "b"), ("b",))}, "b is in another group too"),
        ({"least_interval": -0.1}, "not a number of s from 0 to 10"),
        ({"least_interval": "100 ms"}, "not a number of s from 0 to 10"),
        ({"most_registers": {HOLDING: 126}}, "not a number from 1 to 125"),
        ({"most_registers": {HOLDING: 0}}, "not a number from 1 to 125"),
    ],
)
def test_invalid_group_limit_or_pause_is_a_declaration_error(details: dict[str, Any], sentence: str) -> None:
    registers = {"a": reading(1), "b": reading(2), "far": reading(9), "input_3": reading(3, table=INPUT)}
    with pytest.raises(DeclarationError, match=sentence):
        family(**registers, run=command(4), **details)
