"""Read plans: never above a limit, never across forbidden addresses, never slower than another plan."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import permutations
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from own_drives import ADDRESSES, Meter, StatedMeter
from tables import examples, table

from multidrop.core import Framing, Message, NumberFormat, build_request, reply_length
from multidrop.drive import HOLDING_MULTIPLE, Drive
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
from multidrop.drive.request import read_request, write_request
from multidrop.families import MODELS
from multidrop.planning.blocks import Block, blocks, plan, planned, sending
from multidrop.planning.bus_time import gap, in_order, silence
from multidrop.planning.prediction import predict
from multidrop.sim import SimulatedDrive


class Example(Drive):
    """A family that reads at most four registers at once, and may read reserved addresses up to 20."""

    most_registers = {HOLDING: 4, INPUT: 2}
    readable_gaps = {HOLDING: range(0, 21)}
    a = reading(1)
    b = reading(2)
    c = reading(4)
    d = reading(5, number_format=NumberFormat.U32)
    far = reading(30)
    farther = reading(32)
    state_1 = reading(1, table=INPUT)
    state_2 = reading(2, table=INPUT)
    state_3 = reading(3, table=INPUT)
    coil = setting(3, table=COIL)
    long = setting(40, number_format=NumberFormat.U32)
    swapped = setting(42, number_format=NumberFormat.I32, order="CDAB")
    run = command(0x2000)


def duration(drive: Drive, block: Block, delay: float | None = None) -> float:
    """Return the seconds of silence, request, response delay and reply together."""
    return silence(drive) + sending(drive, block) + (drive.response_delay if delay is None else delay)


def spans(drive: Drive, *names: str) -> list[tuple[int, int]]:
    wanted = [drive.register(name) for name in names] if names else drive.registers.values()
    return [(block.start, block.count) for block in blocks(drive, wanted)]


def test_neighbouring_registers_are_read_together_up_to_the_read_limit() -> None:
    drive = Example(1)
    assert spans(drive, "a", "b") == [(1, 2)]
    assert spans(drive, "a", "b", "c") == [(1, 4)]
    assert spans(drive, "a", "b", "c", "d") in ([(1, 2), (4, 3)], [(1, 4), (5, 2)])
    assert spans(drive, "state_1", "state_2", "state_3") in ([(1, 2), (3, 1)], [(1, 1), (2, 2)])


def test_a_read_never_includes_forbidden_addresses() -> None:
    assert spans(Example(1), "far", "farther") == [(30, 1), (32, 1)]


def test_a_read_plan_does_not_depend_on_order_or_repetition_of_registers() -> None:
    assert spans(Example(1), "c", "a", "b", "a") == [(1, 4)]


def test_a_write_only_register_in_a_read_plan_is_refused() -> None:
    with pytest.raises(ValueError, match=r"run of .* cannot be read: it is declared as a command"):
        blocks(Example(1), [Example.run])


def test_planned_reads_and_writes_are_standard_modbus_requests() -> None:
    (block,) = blocks(Example(7), [Example.a, Example.b])
    assert block.request == Message(7, 3, 1, 2)
    assert write_request(Example(7), Example.coil, 1) == Message(7, 5, 3, data=b"\xff\x00")
    assert write_request(Example(7), Example.run, 2) == Message(7, 6, 0x2000, data=b"\0\2")
    assert write_request(Example(7), Example.long, 0x1_0002) == Message(7, 16, 40, 2, b"\0\1\0\2")
    assert write_request(Example(7), Example.swapped, -2) == Message(7, 16, 42, 2, b"\xff\xfe\xff\xff")
    with pytest.raises(ValueError, match="cannot be written"):
        write_request(Example(7), Example.a, 1)


def test_the_duration_of_a_read_includes_characters_silence_and_response_delay() -> None:
    drive = Example(1, baudrate=9600, format="8N1")
    (block,) = blocks(drive, [Example.a])
    characters = 8 + 7
    silence = 3.5 * 10 / 9600 + 1 / 9600  # one bit is added in case the drive sends a second stop bit
    expected = characters * 10 / 9600 + silence + drive.response_delay
    assert duration(drive, block) == pytest.approx(expected)


def test_a_read_may_include_other_readable_registers_but_never_a_command() -> None:
    class Sparse(Drive):
        """A family whose undeclared addresses must not be read."""

        most_registers = {HOLDING: 10}
        low = reading(1)
        between = reading(2)
        high = reading(3)
        order = command(4)
        beyond = reading(5)

    assert spans(Sparse(1), "low", "high") == [(1, 3)]
    assert spans(Sparse(1), "high", "beyond") == [(3, 1), (5, 1)]


def test_registers_with_different_polling_rates_share_no_request() -> None:
    drive = Example(1)
    found = planned(drive, [(Example.a, 0.1), (Example.b, None), (Example.c, 0.1)])
    assert [(each.block.start, each.block.count, each.every) for each in found] == [(1, 4, 0.1), (2, 1, None)]


def partitions(registers: list[Register[float]]) -> Iterator[list[list[Register[float]]]]:
    if not registers:
        yield []
    for end in range(1, len(registers) + 1):
        for rest in partitions(registers[end:]):
            yield [registers[:end], *rest]


def cheapest_of_all(drive: Drive, registers: list[Register[float]], delay: float | None = None) -> float:
    """Return the shortest time in s of all ways to divide the sorted registers of one table into requests."""
    table = registers[0].table
    limit, gaps = drive.most_registers.get(table, 1), drive.readable_gaps.get(table, range(0))
    readable = {
        at
        for register in drive.registers.values()
        if register.table == table and register.readable
        for at in span(register)
    }
    best = float("inf")
    for cut in partitions(sorted(registers, key=lambda each: each.address)):
        total = 0.0
        for group in cut:
            start, end = group[0].address, max(each.address + each.words for each in group)
            legal = all(at in readable or at in gaps for at in range(start, end))
            if len(group) > 1 and (end - start > limit or not legal):
                break
            total += duration(drive, Block.of(drive, group), delay)
        else:
            best = min(best, total)
    return best


def span(register: Register[float]) -> range:
    return range(register.address, register.address + register.words)


@settings(max_examples=examples(150))
@given(
    st.dictionaries(st.integers(0, 17).map(lambda half: 2 * half), st.booleans(), min_size=1, max_size=7),
    st.sampled_from([1200, 9600, 38400, 115200]),
    st.sampled_from([Framing.RTU, Framing.ASCII]),
)
def test_no_other_read_plan_takes_less_time(pairs: dict[int, bool], baudrate: int, framing: Framing) -> None:
    """Registers have one or two words. Some are neighbours, and reserved addresses lie between others."""
    registers = {
        f"r{address}": reading(address, number_format=NumberFormat.U32 if pair else NumberFormat.U16)
        for address, pair in pairs.items()
    }
    kind = type(
        "Random",
        (Drive,),
        {
            **registers,
            "__doc__": "Drawn by lot.",
            "framings": (framing,),
            "most_registers": {HOLDING: 5},
            "readable_gaps": {HOLDING: range(0, 21)},
        },
    )
    drive = kind(1, baudrate=baudrate)
    found = blocks(drive, registers.values())
    assert sorted(register.name for block in found for register in block.registers) == sorted(registers)
    assert all(block.start <= register.address for block in found for register in block.registers)
    assert all(
        register.address + register.words <= block.start + block.count
        for block in found
        for register in block.registers
    )
    total = sum(duration(drive, block) for block in found)
    assert total == pytest.approx(cheapest_of_all(drive, list(registers.values())))


class Scattered(Drive):
    """A family with readable gaps of many lengths between its registers."""

    framings = (Framing.RTU, Framing.ASCII)
    most_registers = {HOLDING: 90}
    readable_gaps = {HOLDING: range(2000)}
    addresses_of = (0, 1, 9, 40, 41, 60, 61, 62, 90, 140)
    r0, r1, r2, r3, r4, r5, r6, r7, r8, r9 = (reading(address) for address in addresses_of)


@pytest.mark.long
@settings(max_examples=examples(200))
@given(
    st.sets(st.sampled_from(list(Scattered.registers.values())), min_size=1, max_size=8),
    st.sampled_from([1200, 9600, 38400, 115200]),
    st.sampled_from([Framing.RTU, Framing.ASCII]),
    st.floats(0, 0.2),
    st.floats(0, 1),
)
def test_a_read_plan_is_fastest_only_within_its_range_of_response_delays(
    wanted: set[Register[float]], baudrate: int, framing: Framing, delay: float, part: float
) -> None:
    drive = Scattered(1, baudrate=baudrate, framing=framing)
    registers = sorted(wanted, key=lambda register: register.address)
    found = plan(drive, [(register, None) for register in registers], delay)

    def excess(at: float) -> float:
        """Return by how many seconds the best plan is quicker than `found` at this response delay."""
        own = sum(duration(drive, one.block, at) for one in found.planned)
        return own - cheapest_of_all(drive, registers, at)

    assert found.suits(delay)
    most = min(found.most, 10.0)
    for inside in (found.least, found.least + part * (most - found.least), most):
        assert excess(inside) == pytest.approx(0, abs=1e-9)
    for outside in (found.least - 1e-4, found.most + 1e-4):
        if 0 <= outside < math.inf:
            assert not found.suits(outside)
            assert excess(outside) > 1e-6


def test_the_delay_range_of_a_read_plan_fits_every_polling_rate() -> None:
    drive = Scattered(1, baudrate=9600)
    rates = {0.1: [Scattered.r0, Scattered.r2], None: [Scattered.r3, Scattered.r5]}
    apart = [
        plan(drive, [(register, every) for register in registers], 0.02) for every, registers in rates.items()
    ]
    together = plan(
        drive, [(register, every) for every, registers in rates.items() for register in registers], 0.02
    )
    assert len({(one.least, one.most) for one in apart}) == 2
    assert together.least == max(one.least for one in apart)
    assert together.most == min(one.most for one in apart)


@table("framing", list(Framing))
@table("table", [HOLDING, INPUT, COIL, DISCRETE])
def test_predicted_frame_lengths_equal_those_of_built_frames(framing: Framing, table: Table) -> None:
    drive = Example(1)
    drive.framing = framing
    for count in range(1, 126):
        request = read_request(drive, table, 0, count)
        block = Block(table, 0, count, (), request)
        if framing is Framing.DELIXI:
            request = Message(1, 7, 0, data=bytes(4))
        # the framing on the serial line behind a TCP gateway
        wire = Framing.RTU if framing is Framing.TCP else framing
        frames = len(build_request(wire, request)) + reply_length(wire, request)
        assert sending(drive, block) == pytest.approx(frames * drive.settings.character)


FORBIDDEN = {  # addresses that the document does not declare as readable, by family
    "erman-er-g-220": {"holding register": (89, 0xFFFF), "input register": (0x1000, 0xFFFF)},
    "invt-che": {"holding register": (0x1000, 0x1000, 0x3017, 0x4FFF, 0x5002, 0xFFFF)},
    "innovert-ibd": {"holding register": (0, 2, 5, 21, 0x2000, 0x2001)},
}


@pytest.mark.slow
@settings(max_examples=examples(300))
@given(st.data())
def test_no_other_plan_for_a_built_in_family_takes_less_time(data: st.DataObject) -> None:
    model = data.draw(st.sampled_from(sorted(MODELS)))
    family = MODELS[model]
    tables: dict[Table, list[Register[float]]] = {}
    for register in family.registers.values():
        if register.readable:
            tables.setdefault(register.table, []).append(register)
    registers = data.draw(st.sampled_from([*tables.values()]))
    first = data.draw(st.integers(0, len(registers) - 1))
    near = registers[first : first + 12]  # neighbouring registers; some can share a request
    wanted = data.draw(st.lists(st.sampled_from(near), unique=True, min_size=1, max_size=8))
    drive = family(
        1,
        framing=data.draw(st.sampled_from(family.framings)),
        baudrate=data.draw(st.sampled_from(family.baudrates)),
    )
    found = blocks(drive, wanted)
    assert {each.name for block in found for each in block.registers} == {each.name for each in wanted}
    assert sum(duration(drive, each) for each in found) == pytest.approx(cheapest_of_all(drive, wanted))
    for block in found:
        bounds = FORBIDDEN.get(model, {}).get(block.table.name, ())
        forbidden = [range(low, high + 1) for low, high in zip(bounds[::2], bounds[1::2], strict=True)]
        asked = range(block.start, block.start + block.count)
        assert not any(at in part for at in asked for part in forbidden)
        # the documents of Delixi and YD1000 only describe reads of one register
        if model.startswith(("delixi", "yd1000")):
            assert len(block.registers) == 1


def silences(order: list[Drive], switching: float = 0.0) -> float:
    return sum(gap(order[at - 1], drive, switching) for at, drive in enumerate(order))


@st.composite
def companies(draw: st.DrawFn) -> list[Drive]:
    """Return up to six drives of any family with any line settings."""
    kinds = draw(st.lists(st.sampled_from(sorted(MODELS)), min_size=1, max_size=6))
    return [
        MODELS[kind](
            address,
            framing=draw(st.sampled_from(MODELS[kind].framings)),
            baudrate=draw(st.sampled_from(MODELS[kind].baudrates)),
        )
        for address, kind in enumerate(kinds, 1)
    ]


@settings(max_examples=examples(100))
@given(companies())
def test_no_other_polling_order_of_the_drives_has_less_silence(drives: list[Drive]) -> None:
    order = in_order(drives)
    assert sorted(each.address for each in order) == [drive.address for drive in drives]
    least = min(silences([drives[0], *rest]) for rest in permutations(drives[1:]))
    assert silences(order) == pytest.approx(least, abs=1e-8)


def test_drives_with_equal_line_settings_are_polled_in_a_row_if_switching_takes_time() -> None:
    families = ("invt-che", "delixi-modbus", "innovert-ibd")
    drives = [
        MODELS[model](address, baudrate=baudrate)
        for address, (model, baudrate) in enumerate(
            ((model, baudrate) for baudrate in (9600, 19200, 38400) for model in families), 1
        )
    ]
    order = in_order(drives, switching=0.05)
    switches = [each.settings != order[at - 1].settings for at, each in enumerate(order)]
    assert sum(switches) == len({drive.settings for drive in drives})
    assert silences(order, 0.05) < silences(drives, 0.05)


def test_the_pause_between_two_drives_is_the_longer_silence_plus_the_switching_time() -> None:
    slow, fast = MODELS["yd1000"](1), MODELS["erman-er-g-220"](2)
    longer = 24 * 11 / 9600 + 1 / 9600
    assert gap(slow, fast) == gap(fast, slow) == pytest.approx(longer)
    assert gap(fast, slow, switching=0.002) == pytest.approx(longer + 0.002)
    assert gap(fast, fast, switching=0.002) == pytest.approx(1.75e-3 + 1 / 38400)


def test_a_register_table_without_a_read_function_cannot_be_read() -> None:
    table = Table("command word", None, 0x06)
    with pytest.raises(ValueError, match=r"^a command word cannot be read$"):
        read_request(Example(1), table, 0, 1)


# ---- limits of reads, and groups of registers ----


def family(**declared: Any) -> type[Drive]:
    return type("Drawn", (Drive,), {"__doc__": "Of this test.", **declared})


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


def test_the_read_limit_of_one_table_does_not_apply_to_other_tables() -> None:
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
def test_the_requests_for_the_built_in_families_are_unchanged(model: str) -> None:
    drive = MODELS[model](3)
    found = [(block.request.function, block.start, block.count) for block in blocks(drive, drive.readings())]
    assert sorted(found) == REQUESTS[model]


def test_reading_undeclared_addresses_reduces_the_requests_for_a_meter() -> None:
    assert len(ADDRESSES) == 39
    lines = []
    for meter in (Meter, StatedMeter):
        drive = meter(1, baudrate=9600, format="8N1")
        wanted = [(drive.register(name), None) for name in ADDRESSES]
        found = planned(drive, wanted)
        lines.append((len(found), round(predict(found, lateness=0.0).cycle, 3)))
    assert lines == [(8, 0.341), (4, 0.268)]


def test_a_request_includes_no_undeclared_addresses_by_default() -> None:
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


def test_two_tables_with_the_same_read_function_share_requests() -> None:
    drive = Mixed(1)
    found = blocks(drive, drive.registers.values())
    assert [(one.request.function, one.start, one.count) for one in found] == [(3, 1, 3), (4, 4, 1)]
    assert (HOLDING_MULTIPLE.read, HOLDING_MULTIPLE.write, HOLDING_MULTIPLE.name) == (3, 16, HOLDING.name)


def test_the_smallest_limit_applies_to_tables_with_the_same_read_function() -> None:
    class Narrow(Mixed):
        most_registers = {HOLDING_MULTIPLE: 2, HOLDING: 3}

    drive = Narrow(1)
    assert len(blocks(drive, [Narrow.low, Narrow.multiple, Narrow.read_only])) == 2


def test_a_register_of_one_word_can_be_written_by_function_10h() -> None:
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


def groupings(registers: list[Register[float]]) -> list[list[list[Register[float]]]]:
    """Return all ways to divide the registers into groups, which need not be neighbours."""
    if not registers:
        return [[]]
    first, *others = registers
    found = []
    for rest in groupings(others):
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
        return sum(duration(drive, one) for one in found)

    ours = list(blocks(drive, drive.registers.values()))
    assert sorted(one.name for block in ours for one in block.registers) == sorted(registers)
    assert all(allowed(drive, list(one.registers), limit or 125) for one in ours)
    ways = groupings(list(drive.registers.values()))
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


def test_registers_that_must_be_read_together_are_read_first() -> None:
    order = [block.registers[0].name for block in blocks(Grouped(1), Grouped.registers.values())]
    assert order[:2] == ["latch", "energy_high"]
    assert order[-1] == "other"


@table(
    ("details", "sentence"),
    [
        ({"read_together": (("a", "far"),)}, "there are undeclared addresses between these registers"),
        (
            {"read_together": (("a", "b"),), "most_registers": {HOLDING: 1}},
            "these registers span 2 addresses, but one",
        ),
        ({"read_together": (("a", "input_3"),)}, "these registers must be in one table"),
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
def test_an_invalid_group_limit_or_interval_is_a_declaration_error(
    details: dict[str, Any], sentence: str
) -> None:
    registers = {"a": reading(1), "b": reading(2), "far": reading(9), "input_3": reading(3, table=INPUT)}
    with pytest.raises(DeclarationError, match=sentence):
        family(**registers, run=command(4), **details)
