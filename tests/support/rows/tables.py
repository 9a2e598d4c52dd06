"""Table tests: one test calls a function with every row, and reports all failing rows.

A row costs only its check, whereas each test of `pytest.mark.parametrize` costs some extra milliseconds in
each test process. Use `parametrize` for rows that need a fresh fixture or may be skipped.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import pytest

Test = Callable[..., None]
FAILURES = (Exception, pytest.fail.Exception, pytest.skip.Exception)  # a skipped row counts as failed


def table(
    names: str | Sequence[str], rows: Iterable[Any], ids: Iterable[object] | None = None
) -> Callable[[Test], Test]:
    """Return a decorator that calls a test for each row, with the row's values as the arguments `names`.

    The test reports all rows that fail. Its attribute `rows` has the rows.
    """
    columns = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    several = not isinstance(names, str) or len(columns) > 1
    values = [tuple(row) if several else (row,) for row in rows]
    row_ids = values if ids is None else list(ids)
    assert values, "a table needs rows"
    assert len(row_ids) == len(values), "each row has an id"
    assert all(len(row) == len(columns) for row in values), f"each row has {columns}"

    def decorate(test: Test) -> Test:
        @functools.wraps(test)
        def walked(**others: Any) -> None:
            failed: list[BaseException] = []
            for row, row_id in zip(values, row_ids, strict=True):
                try:
                    test(**dict(zip(columns, row, strict=True)), **others)
                except FAILURES as failure:
                    failure.add_note(f"in the row {row_id!r}")
                    failed.append(failure)
            if failed:
                raise BaseExceptionGroup(f"{len(failed)} of {len(values)} rows failed", failed)

        signature = inspect.signature(test)
        others = [one for name, one in signature.parameters.items() if name not in columns]
        walked.__signature__ = signature.replace(parameters=others)  # type: ignore[attr-defined]
        walked.rows = values  # type: ignore[attr-defined]
        return walked

    return decorate
