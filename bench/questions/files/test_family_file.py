"""The cost of loading a family from its file, and of loading the unchanged file again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from multidrop.families.files import loader

REGISTERS = 40
HEAD = '[family]\ntitle = "Meter"\nmanual = "M"\ncounts_from = 0\n'
DEFAULT = '[default]\ntable = "input"\nnumber_format = "F32"\n'


@pytest.fixture
def meter(tmp_path: Path) -> Path:
    """Return a family file with 40 float registers, one per line."""
    entries = (f'value_{at} = {{ at = 0x{2 * at:04X}, unit = "V" }}\n' for at in range(REGISTERS))
    path = tmp_path / "meter.toml"
    path.write_text(f"{HEAD}{DEFAULT}[reading]\n{''.join(entries)}")
    return path


def test_load_a_40_register_file(benchmark: Any, meter: Path) -> None:
    def load() -> None:
        loader._loaded.clear()
        loader.load_family(meter)

    benchmark(load)


def test_load_a_meters_file(benchmark: Any) -> None:
    path = Path(__file__).parents[3] / "tests/data/families/sdm630.toml"

    def load() -> None:
        loader._loaded.clear()
        loader.load_family(path)

    benchmark(load)


def test_load_the_same_file_again(benchmark: Any, meter: Path) -> None:
    loader.load_family(meter)
    benchmark(loader.load_family, meter)
