"""A plugin: test as where pandas, polars and DuckDB are not installed.

`PYTHONPATH=tests/support pytest -p without`
"""

from __future__ import annotations

import sys

HIDDEN = {"pandas", "polars", "duckdb"}


class Hiding:
    """A finder that finds that they are not there."""

    @staticmethod
    def find_spec(name: str, *place: object) -> None:
        if name.partition(".")[0] in HIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Hiding)
