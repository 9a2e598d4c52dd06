"""Read and write corpus.txt, the fuzzers' corpora. Each line has a parser, an input's name, and the input's
bytes in hex.
"""

from __future__ import annotations

from pathlib import Path

CORPUS = Path(__file__).resolve().with_name("corpus.txt")


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
