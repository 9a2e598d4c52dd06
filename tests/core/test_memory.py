"""The memory of the structs that each exchange uses: adjacent, and freed only with their owner."""

from __future__ import annotations

import gc
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import pytest
from multidrop._core import ffi

from multidrop.core import Exchange, Field, Framing, Message, NumberFormat, Peer, RowLayout, memory
from multidrop.core.memory import CACHE_LINE, new_beside

SIZE = -(-ffi.sizeof("struct md_drive") // CACHE_LINE) * CACHE_LINE


def new_drive(number: int) -> tuple[Any, Any]:
    return new_beside("struct md_drive", {"delay_ns": number})


def place(made: tuple[Any, Any]) -> int:
    return int(ffi.cast("uintptr_t", made[0]))


def read_of(peer: Peer, rows: RowLayout | None) -> Exchange:
    request = Message(1, 3, 0, 1)
    line = {"baudrate": 9600, "format": "8N1"}
    return Exchange(Framing.RTU, request, peer, **line, character=1e-3, silence=0.0, block=rows)


def delays(*made: tuple[Any, Any]) -> list[int]:
    return [int(drive.delay_ns) for drive, _ in made]


@pytest.fixture(autouse=True)
def new_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_chunks", memory.Chunks())


def test_structs_created_one_after_another_are_adjacent_in_memory() -> None:
    first, second = new_drive(1), new_drive(2)
    block = new_beside("struct md_block", {"count": 3})
    assert place(first) % CACHE_LINE == 0
    assert place(second) == place(first) + SIZE
    assert place(block) == place(second) + SIZE
    assert delays(first, second) == [1, 2]
    assert block[0].count == 3


def test_memory_of_a_struct_is_not_reused_while_it_is_referenced() -> None:
    made = [new_drive(number) for number in range(100)]
    kept = made[::7]
    del made
    gc.collect()
    more = [new_drive(-1) for _ in range(100)]
    assert delays(*kept) == list(range(0, 100, 7))
    assert len({place(each) for each in [*kept, *more]}) == len(kept) + len(more)


@pytest.mark.slow
def test_structs_created_in_different_threads_do_not_overlap() -> None:
    with ThreadPoolExecutor(8) as threads:
        made = list(threads.map(new_drive, range(4000)))
    places = sorted(map(place, made))
    assert all(after - before >= SIZE for before, after in pairwise(places))
    assert delays(*made) == list(range(4000))


def test_struct_created_in_a_signal_handler_has_separate_memory() -> None:
    """The handler may stop a motor while the interrupted code allocates memory."""
    before = new_drive(1)
    with memory._chunks._lock:
        made = new_drive(2)
    after = new_drive(3)
    assert place(made) % CACHE_LINE == 0
    assert place(after) == place(before) + SIZE
    assert delays(before, made, after) == [1, 2, 3]


def test_a_struct_larger_than_a_chunk_of_memory_can_be_created(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "CHUNK_BYTES", CACHE_LINE)
    assert delays(*map(new_drive, range(3))) == [0, 1, 2]


def last_line(name: str, *fields: str) -> int:
    """Return which cache line of this struct contains the end of the last field; the first line is 1."""
    places = dict(ffi.typeof(f"struct {name}").fields)
    end = max(places[field].offset + ffi.sizeof(places[field].type) for field in fields)
    return -(-end // CACHE_LINE)


def test_the_fields_used_by_every_exchange_are_in_five_cache_lines() -> None:
    """Two cache lines of the drive, two of the exchange, and one of the next exchange's drive."""
    assert last_line("md_drive", "most_timeout_ns", "ready_ns", "failures", "owed_count", "is_doubted") == 1
    assert last_line("md_drive", "counters", "answered_ns") == 2
    assert last_line("md_exchange", "values", "period_ns", "insists", "frame") == 2
    assert ffi.offsetof("struct md_exchange", "request", "data") <= 2 * CACHE_LINE


def test_polled_exchanges_of_a_drive_are_adjacent_in_memory() -> None:
    """Exchanges that are not polled may be anywhere in memory."""
    peer = Peer(least_timeout=0.02, most_timeout=1.0)
    peer.prove_by([read_of(peer, None), read_of(peer, None)])
    rows = RowLayout(0, [Field(0, NumberFormat.U16, 0, 1, 1)])
    polled = read_of(peer, rows)
    assert place((rows.c, None)) == place((peer.c, None)) + SIZE
    assert place((polled.c, None)) == place((rows.c, None)) + CACHE_LINE
