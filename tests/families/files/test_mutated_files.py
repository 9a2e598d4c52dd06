"""Damaged family files either load or are refused with sentences."""

from __future__ import annotations

import random
import tempfile
import time
from pathlib import Path

import pytest
import seeds
from examples import examples, usually
from hypothesis import given, settings
from hypothesis import strategies as st
from readers import read

SEEDS = list(seeds.family())
WORDS = (
    *(b"-1", b"0", b"65535", b"65536", b"1e400", b"-inf", b"nan", b"true", b'""', b"[]", b"{}", b"[[]]"),
    *(b"9223372036854775807", b"1979-05-27", b"'NaN'", b'"40001"', b'"1E10"', b"0x7FFF", b"[1, 2]", b'["a"]'),
    *(
        b"{ a = 1 }",
        b'{ a = "b" }',
        b"[family]",
        b"[reading]",
        b"[option]",
        b"[[line]]",
        b"= 1",
        b"\xff",
        b"\0",
    ),
    *(b"at = ", b"values = ", b"bits = ", b"table = ", b"unit = ", b"span = ", b"steps = ", b"await = "),
)

ENOUGH = 20.0  # s, limit for one file


def mutated(data: bytes, chosen: random.Random) -> bytes:
    """Return the file with up to four pieces replaced, doubled, moved or removed."""
    for _ in range(chosen.randint(1, 4)):
        begin = chosen.randrange(len(data) + 1)
        end = min(len(data), begin + chosen.choice((0, 1, 3, 10, 40)))
        other = chosen.randrange(len(data) + 1)
        piece = chosen.choice(
            (chosen.choice(WORDS), b"", data[other : other + 30], data[begin:end] * 2, chosen.randbytes(2))
        )
        if chosen.random() < 0.4:  # replace a whole value, so that the file stays valid TOML
            begin = data.find(b"= ", begin) + 2
            ends = [at for at in (data.find(mark, begin) for mark in (b",", b" }", b"\n")) if at > 0]
            end = min(ends, default=begin)
        data = data[:begin] + piece + data[end:]
    return data


@pytest.mark.slow
@settings(max_examples=examples(300))
@given(st.sampled_from(SEEDS), st.integers(0, 2**32))
def test_damaged_file_loads_or_is_refused_with_sentences(seed: bytes, number: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        read("family", mutated(seed, random.Random(number)), Path(folder))


def wide(count: int) -> bytes:
    head = b'[family]\ntitle = "T"\nmanual = "M"\ncounts_from = 0\n[setting]\n'
    return head + b"".join(b"a%d = { at = %d }\n" % (at, at) for at in range(count))


LARGE = {
    "many": lambda: wide(1990),
    "deep": lambda: b"a = " + b"[" * 100_000,
    "dotted": lambda: b"a." * 100_000 + b"b = 1",
    "large": lambda: b"#" * 5_000_000,
    "too many": lambda: wide(20_000),
    "long csv": lambda: b'[family]\nregisters = ["fuzzed.csv"]\n\n\0\nname,at\n' + b"a,1\n" * 100_000,
}


@pytest.mark.long
@pytest.mark.parametrize("name", [*list(LARGE)[:4], *usually(*list(LARGE)[4:])])
def test_large_file_loads_in_time(tmp_path: Path, name: str) -> None:
    """The limit is generous; a loader that compares every register with every other would take minutes."""
    large = LARGE[name]()
    begun = time.process_time()
    read("family", large, tmp_path)
    assert time.process_time() - begun < ENOUGH
