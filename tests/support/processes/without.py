"""A pytest plugin that hides pandas, polars and DuckDB.

Usage: `PYTHONPATH=tests/support/processes pytest -p without`
"""

from __future__ import annotations

import importlib.util
import sys
from importlib.machinery import ModuleSpec

HIDDEN = {"pandas", "polars", "duckdb"}
_find_spec = importlib.util.find_spec


class Hiding:
    """An import finder that raises for the hidden modules."""

    @staticmethod
    def find_spec(name: str, *place: object) -> None:
        if name.partition(".")[0] in HIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def find_spec(name: str, package: str | None = None) -> ModuleSpec | None:
    return None if name.partition(".")[0] in HIDDEN else _find_spec(name, package)


sys.meta_path.insert(0, Hiding)
importlib.util.find_spec = find_spec
