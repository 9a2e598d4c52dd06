"""Build a C harness for fuzzing, or for replaying its corpus. Read and write the corpora."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
NEEDING_A_SYSTEM = {"api", "engine", "mastership", "port", "realtime", "row_queue", "rs485", "turn"}
OPTIONS = ("-std=c11", "-D_DEFAULT_SOURCE", "-g", "-O1", f"-I{ROOT / 'csrc'}")


def command(
    name: str, program: Path, companion: str, *compiler: str, core: Sequence[Path] | None = None
) -> list[str]:
    """Return the command that compiles a harness with mutator.c or replay.c and the core's pure C files. To
    compile the core once for several harnesses, pass the objects that `compiled` returned for the same
    compiler as `core`.
    """
    parts = [HERE / f"fuzz_{name}.c", HERE / companion, *(_core() if core is None else core)]
    return [*compiler, *OPTIONS, *map(str, parts), "-lm", "-o", str(program)]


def compiled(folder: Path, *compiler: str) -> list[Path]:
    """Compile the pure C files of the core into a folder; return the object files."""
    subprocess.run([*compiler, *OPTIONS, "-c", *map(str, _core())], cwd=folder, check=True)
    return sorted(folder.glob("*.o"))


def _core() -> list[Path]:
    return [path for path in sorted((ROOT / "csrc").glob("*.c")) if path.stem not in NEEDING_A_SYSTEM]


# ---- corpora ----

# each line: a parser, the name of an input, and the bytes of the input in hex
CORPUS = HERE / "corpus.txt"


def load(parser: str) -> dict[str, bytes]:
    """Return the inputs in a parser's corpus, by name; {} if the parser has no corpus yet."""
    inputs = (line.split(" ") for line in CORPUS.read_text("ascii").splitlines())
    return {name: bytes.fromhex(text) for owner, name, text in inputs if owner == parser}


def save(parser: str, inputs: dict[str, bytes]) -> None:
    """Replace the corpus of a parser by these inputs."""
    lines = CORPUS.read_text("ascii").splitlines(keepends=True)
    others = [line for line in lines if not line.startswith(f"{parser} ")]
    own = [f"{parser} {name} {data.hex()}\n" for name, data in inputs.items()]
    CORPUS.write_text("".join(sorted(others + own)), "ascii")


def unpack(parser: str, folder: Path) -> None:
    """Write each input of a parser's corpus into a file of a new folder, as libFuzzer needs them."""
    folder.mkdir()
    for name, data in load(parser).items():
        (folder / name).write_bytes(data)
