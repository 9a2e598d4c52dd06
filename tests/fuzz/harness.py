"""Builds a C harness, to fuzz it or to replay what was kept."""

from __future__ import annotations

from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
SYSTEM = ("engine", "port", "waiter", "wakeup", "row_queue")  # parts of the core that need one


def command(name: str, program: Path, companion: str, *compiler: str) -> list[str]:
    """Return the command that compiles harness, companion (mutator.c, replay.c) and the pure core."""
    core = [str(path) for path in sorted((ROOT / "csrc").glob("*.c")) if not path.stem.startswith(SYSTEM)]
    sources = [str(HERE / f"fuzz_{name}.c"), str(HERE / companion), *core]
    options = ["-std=c11", "-D_DEFAULT_SOURCE", "-g", "-O1", f"-I{ROOT / 'csrc'}"]
    return [*compiler, *options, *sources, "-lm", "-o", str(program)]
