"""Fixtures: a server in C that answers immediately, and a minimal client loop in C."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

HERE = Path(__file__).parents[1]


def compiled(source: str, target: Path, *flags: str) -> Path:
    subprocess.run(["cc", "-O2", *flags, str(HERE / source), "-o", str(target)], check=True)
    return target


@pytest.fixture(scope="session")
def responder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Yield the path of a pty on which address 1 immediately answers every request with ten registers."""
    program = compiled("players/responder.c", tmp_path_factory.mktemp("responder") / "responder")
    with subprocess.Popen([program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        assert process.stdin is not None
        process.stdin.close()


@pytest.fixture(scope="session")
def bare(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    library = compiled("masters/bare.c", tmp_path_factory.mktemp("bare") / "bare.so", "-shared", "-fPIC")
    return ctypes.CDLL(str(library))
