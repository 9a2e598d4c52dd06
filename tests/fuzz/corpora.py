"""The fuzzers' corpora: each line of corpus/PARSER.txt is an input, with its name and its bytes in hex."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).resolve().parent / "corpus"


def load(parser: str) -> dict[str, bytes]:
    """Return the inputs in a parser's corpus, by name; {} if the parser has no corpus yet."""
    path = FOLDER / f"{parser}.txt"
    if not path.exists():
        return {}
    lines = (line.partition(" ") for line in path.read_text("ascii").splitlines())
    return {name: bytes.fromhex(text) for name, _, text in lines}


def save(parser: str, inputs: dict[str, bytes]) -> None:
    """Replace a parser's corpus by these inputs."""
    lines = (f"{name} {data.hex()}\n" for name, data in sorted(inputs.items()))
    (FOLDER / f"{parser}.txt").write_text("".join(lines), "ascii")


def unpack(parser: str, folder: Path) -> None:
    """Write each input of a parser's corpus into a file of a new folder, as libFuzzer needs them."""
    folder.mkdir()
    for name, data in load(parser).items():
        (folder / name).write_bytes(data)
