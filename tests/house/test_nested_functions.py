"""Find tests that define an inner function but never call it: these pass without testing anything."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def never_named(tree: ast.AST) -> list[str]:
    """Return the inner functions that their outer function never names, with line numbers."""
    found = []
    for outer in ast.walk(tree):
        if isinstance(outer, FUNCTIONS):
            named = {node.id for node in ast.walk(outer) if isinstance(node, ast.Name)}
            inner = [node for node in outer.body if isinstance(node, FUNCTIONS)]
            lost = [one for one in inner if one.name not in named and not one.decorator_list]
            found += [f"{one.name} in {outer.name}, line {one.lineno}" for one in lost]
    return found


@pytest.mark.long
def test_inner_functions_are_used() -> None:
    found = {}
    for path in sorted(TESTS.rglob("*.py")):
        if lost := never_named(ast.parse(path.read_text("utf-8"))):
            found[str(path.relative_to(TESTS))] = lost
    assert found == {}


def test_unused_inner_function_is_detected() -> None:
    told = "def test_it():\n    async def main(): assert False\n"
    assert never_named(ast.parse(told)) == ["main in test_it, line 2"]
    assert never_named(ast.parse(told + "    run(main())\n")) == []
