"""Parse the project's sources, once, for tests of the project's code rules."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "src" / "multidrop"
ROOMS = ("src", "csrc", "tests", "bench", "docs")
BUILT = {"_build", "__pycache__"}


def files(*rooms: str, suffixes: tuple[str, ...] = (".py",)) -> list[Path]:
    """Return the files below these directories with these suffixes, except build products."""
    return [
        path
        for room in rooms
        for path in sorted((ROOT / room).rglob("*"))
        if path.suffix in suffixes and not BUILT & set(path.parts)
    ]


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"), str(path))


def place(path: Path, line: int) -> str:
    return f"{path.relative_to(ROOT)}:{line}"


def run_time_imports(path: Path) -> set[str]:
    """Return the modules that a file imports at run time, including imports in functions."""
    at_run_time, for_types = _imports(path)
    return at_run_time - for_types


def type_imports(path: Path) -> set[str]:
    """Return the modules that a file imports only for type checkers."""
    return _imports(path)[1]


@cache
def _imports(path: Path) -> tuple[set[str], set[str]]:
    found: tuple[set[str], set[str]] = set(), set()
    for node, for_types in _import_nodes(parsed(path), False):
        if isinstance(node, ast.Import):
            found[for_types].update(alias.name for alias in node.names)
        elif node.module:
            found[for_types].add(node.module)
            if node.module == "multidrop":
                found[for_types].update(f"multidrop.{alias.name}" for alias in node.names)
    return found


def _import_nodes(node: ast.AST, for_types: bool) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Yield each import statement below `node`, with True if only a type checker sees it."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child, for_types
        elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
            for part in child.body:
                yield from _import_nodes(ast.Module([part], []), True)
            for part in child.orelse:
                yield from _import_nodes(ast.Module([part], []), for_types)
        elif isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
            yield from _import_nodes(child, for_types)


def loop_variables(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and name of each variable that a loop or a comprehension binds."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.For | ast.AsyncFor | ast.comprehension):
            for name in ast.walk(node.target):
                if isinstance(name, ast.Name):
                    yield name.lineno, name.id


def comments(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of each comment in a C file; consecutive // lines are one comment."""
    before = -1
    text = path.read_text("utf-8")
    for match in re.finditer(r"/\*+(.*?)\*/|//+([^\n]*)", text, re.DOTALL):
        line = text.count("\n", 0, match.start()) + 1
        alone = not text[text.rfind("\n", 0, match.start()) + 1 : match.start()].strip()
        if match[2] is None or line != before + 1 or not alone:
            yield line, (match[1] or match[2] or "").strip()
        before = line if match[2] is not None else -1
