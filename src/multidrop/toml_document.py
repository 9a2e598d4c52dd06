"""Read TOML files."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from multidrop.toml_syntax import syntax_mistake

MOST_PARTS = 100  # most parts that a dotted key may have


class DocumentError(ValueError):
    """Raised for a file that is not TOML.

    Its text does not name the file. `line` is the number of the line with the mistake; 0 if unknown.
    """

    def __init__(self, sentence: str, line: int = 0) -> None:
        super().__init__(sentence)
        self.line = line

    def in_file(self, path: Path) -> str:
        """Return the sentence with the file's path and the line in front."""
        return f"{path}{f':{self.line}' if self.line else ''}: {self}"


def read_document(path: Path, what: str) -> dict[str, Any]:
    """Return the tables of a TOML file. If that fails, raises ValueError; its text does not name the path.

    A byte order mark before the text is skipped, because some editors write one. A device is refused: reading
    a serial port would block forever, and would take bytes from its drives.
    """
    try:
        if path.is_char_device():
            raise DocumentError(f"this is a device, not a {what}")
        data = path.read_bytes()
    except OSError as failure:
        raise DocumentError(f"the {what} cannot be read: {failure.strerror}") from failure
    return parse_document(data)


def read_bounded(path: Path, most: int, what: str) -> bytes:
    """Return a file's bytes, at most `most`. If that fails, raises ValueError; its text lacks the path."""
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as failure:
        raise ValueError(f"the {what} cannot be read: {failure.strerror}") from failure
    if len(data) > most:
        raise ValueError(f"the {what} has more than {most} bytes")
    return data


def parse_document(data: bytes) -> dict[str, Any]:
    """Return the tables of a TOML file's bytes. Raises DocumentError if the bytes are not valid TOML."""
    text = _decoded(data)
    try:
        _check_keys(text)
        document = tomllib.loads(f"{text}\n")
        fits = _fits(document)
    except RecursionError as failure:
        raise DocumentError("the file is nested too deeply") from failure
    except tomllib.TOMLDecodeError as failure:
        line, sentence = syntax_mistake(text, str(failure))
        raise DocumentError(f"the file is not TOML: {sentence}", line) from failure
    except ValueError as failure:
        raise DocumentError(f"the file is not TOML: {failure}") from failure
    if not fits:
        raise DocumentError("the file is not TOML: a number does not fit into 64 bits")
    return document


def _decoded(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")) or data[:4].count(0) == 2:
        raise DocumentError("the file is not text in UTF-8, but in UTF-16; save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        at = failure.start
        sentence = f"the file is not text in UTF-8, from byte {at} on (0x{data[at]:02X}); save it as UTF-8"
        raise DocumentError(sentence, 1 + data[:at].count(b"\n")) from failure


def _check_keys(text: str) -> None:
    """Raise ValueError for a key with very many parts: tomllib's time grows with their number squared."""
    if text.count(".") > MOST_PARTS:
        pieces = re.split(r"[=,{}\[\]\n]+", text)
        if any(piece.count(".") > MOST_PARTS for piece in pieces):
            raise ValueError(f"a key or a text has more than {MOST_PARTS} dots")


def _fits(value: Any) -> bool:
    """Return True if every integer fits into 64 bits, as TOML requires."""
    if isinstance(value, dict):
        return all(map(_fits, value.values()))
    if isinstance(value, list):
        return all(map(_fits, value))
    return not isinstance(value, int) or -(2**63) <= value < 2**63
