"""Check that the package states the encoding of every text file and pipe: Windows would guess."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from tables import table

import multidrop

pytestmark = pytest.mark.long  # a rule for the package's authors

SOURCE = Path(multidrop.__file__).parent
TEXT_MODES = frozenset("rwaxt+")


def lacks_encoding(call: ast.Call) -> bool:
    """Return True if the call opens text without an encoding. `x.open()` without a mode is not counted."""
    name = ast.unparse(call.func)
    options = {keyword.arg for keyword in call.keywords}
    modes = {
        mode.value for mode in call.args if isinstance(mode, ast.Constant) and isinstance(mode.value, str)
    }
    if "encoding" in options:
        return False
    if name.endswith(".read_text"):
        return not call.args
    if name.endswith(".write_text"):
        return len(call.args) < 2
    if name in ("open", "os.fdopen"):
        return not any("b" in mode for mode in modes)
    is_text = name.endswith(".open") and any(mode and set(mode) <= TEXT_MODES for mode in modes)
    names_text = not options.isdisjoint({"text", "universal_newlines"})
    return is_text or (names_text and not name.endswith("._replace"))


def lacking(source: str) -> Iterator[int]:
    """Return the line numbers of calls that open text without an encoding."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and lacks_encoding(node):
            yield node.lineno


def test_opened_text_has_an_encoding() -> None:
    found = [
        f"{path.relative_to(SOURCE)}:{line}"
        for path in sorted(SOURCE.rglob("*.py"))
        for line in lacking(path.read_text("utf-8"))
    ]
    assert found == []


@table(
    "call",
    ["p.read_text()", "p.write_text(text)", "open(name)", 'p.open("w")', "subprocess.run([], text=True)"],
)
def test_call_without_encoding_is_detected(call: str) -> None:
    assert list(lacking(call)) == [1]


@table(
    "call",
    [
        'p.read_text("utf-8")',
        'open(name, "rb")',
        "os.open(name, 0)",
        "port.open()",
        'p.open("w", encoding=e)',
    ],
)
def test_call_with_encoding_is_not_reported(call: str) -> None:
    assert list(lacking(call)) == []
