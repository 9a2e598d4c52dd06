"""Plans: never over a limit, never into what the document forbids, never dearer than brute force."""

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from multidrop.core import Framing, Message
from multidrop.drive import Drive
from multidrop.plan import Block, blocks, duration, write_request
from multidrop.register import COIL, HOLDING, INPUT, Register, Wire, command, reading, setting


class Example(Drive):
    """Room for four registers in a read, reserved addresses readable up to 20."""

    most_registers = {HOLDING: 4, INPUT: 2}
    readable_gaps = {HOLDING: range(0, 21)}
    a = reading(1)
    b = reading(2)
    c = reading(4)
    d = reading(5, wire=Wire.U32)
    far = reading(30)
    farther = reading(32)
    state = reading(1, table=INPUT)
    state_2 = reading(2, table=INPUT)
    state_3 = reading(3, table=INPUT)
    coil = setting(3, table=COIL)
    long = setting(40, wire=Wire.U32)
    swapped = setting(42, wire=Wire.I32_SWAPPED)
    run = command(0x2000)


def spans(drive: Drive, *names: str) -> list[tuple[int, int]]:
    return [(it.start, it.count) for it in blocks(drive, [drive.register(name) for name in names])]


def test_neighbours_are_read_together_up_to_the_limit() -> None:
    drive = Example(1)
    assert spans(drive, "a", "b") == [(1, 2)]
    assert spans(drive, "a", "b", "c") == [(1, 4)]
    assert spans(drive, "a", "b", "c", "d") in ([(1, 2), (4, 3)], [(1, 4), (5, 2)])
    assert spans(drive, "state", "state_2", "state_3") in ([(1, 2), (3, 1)], [(1, 1), (2, 2)])


def test_forbidden_addresses_are_never_read_across() -> None:
    assert spans(Example(1), "far", "farther") == [(30, 1), (32, 1)]


def test_order_and_repetition_do_not_matter() -> None:
    assert spans(Example(1), "c", "a", "b", "a") == [(1, 4)]


def test_what_cannot_be_read_is_refused() -> None:
    with pytest.raises(ValueError, match=r"run of .* cannot be read: it is a command"):
        blocks(Example(1), [Example.run])


def test_requests_are_the_standard_s() -> None:
    (block,) = blocks(Example(7), [Example.a, Example.b])
    assert block.request(7) == Message(7, 3, 1, 2)
    assert write_request(Example(7), Example.coil, 1) == Message(7, 5, 3, data=b"\xff\x00")
    assert write_request(Example(7), Example.run, 2) == Message(7, 6, 0x2000, data=b"\0\2")
    assert write_request(Example(7), Example.long, 0x1_0002) == Message(7, 16, 40, 2, b"\0\1\0\2")
    assert write_request(Example(7), Example.swapped, -2) == Message(7, 16, 42, 2, b"\xff\xfe\xff\xff")
    with pytest.raises(ValueError, match="cannot be written"):
        write_request(Example(7), Example.a, 1)


def test_a_block_takes_its_characters_silence_and_delay() -> None:
    drive = Example(1, baudrate=9600, format="8N1")
    (block,) = blocks(drive, [Example.a])
    characters = 8 + 7
    expected = characters * 10 / 9600 + 3.5 * 10 / 9600 + drive.response_delay
    assert duration(drive, block) == pytest.approx(expected)


def partitions(registers: list[Register[float]]) -> Iterator[list[list[Register[float]]]]:
    if not registers:
        yield []
    for end in range(1, len(registers) + 1):
        for rest in partitions(registers[end:]):
            yield [registers[:end], *rest]


def cheapest_of_all(drive: Drive, registers: list[Register[float]]) -> float:
    """By trying every way to cut the sorted registers into requests."""
    best = float("inf")
    for cut in partitions(sorted(registers, key=lambda it: it.address)):
        total = 0.0
        for group in cut:
            start, end = group[0].address, max(it.address + it.words for it in group)
            declared = {at for it in group for at in range(it.address, it.address + it.words)}
            legal = all(at in declared or at <= 20 for at in range(start, end))
            if len(group) > 1 and (end - start > 4 or not legal):
                break
            total += duration(drive, Block(HOLDING, start, end - start, tuple(group)))
        else:
            best = min(best, total)
    return best


@settings(max_examples=150)
@given(
    st.sets(st.integers(0, 34), min_size=1, max_size=7),
    st.sampled_from([1200, 9600, 38400, 115200]),
    st.sampled_from([Framing.RTU, Framing.ASCII]),
)
def test_no_other_plan_is_cheaper(addresses: set[int], baudrate: int, framing: Framing) -> None:
    registers = {f"r{address}": reading(address) for address in addresses}
    kind = type(
        "Random",
        (Drive,),
        {
            **registers,
            "__doc__": "Drawn by lot.",
            "framings": (framing,),
            "most_registers": {HOLDING: 4},
            "readable_gaps": {HOLDING: range(0, 21)},
        },
    )
    drive = kind(1, baudrate=baudrate)
    planned = blocks(drive, registers.values())
    assert {it for block in planned for it in block.registers} == set(registers.values())
    total = sum(duration(drive, block) for block in planned)
    assert total == pytest.approx(cheapest_of_all(drive, list(registers.values())))
