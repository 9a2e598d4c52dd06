"""Test cases: tables of rows for one test, and the number of examples and parameters that a run tries.

A row of a table costs only its check, whereas each test of `pytest.mark.parametrize` costs some extra
milliseconds in each test process. Use `parametrize` for rows that need a fresh fixture or may be skipped.
"""

from __future__ import annotations

import functools
import inspect
import os
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


# ---- parts of the examples ----


# a run tries a tenth of the examples by default, all if the environment variable THOROUGH is set
PART = 1 if os.environ.get("THOROUGH") else 10


def examples(number: int) -> int:
    return max(1, number // PART)


def usually(tried: object, *others: object) -> list[Any]:
    """Return the arguments as pytest parameters. Only the first is tried in short test runs."""
    return [tried, *(_marked(other, pytest.mark.long) for other in others)]


def first_in_ci(tried: object, *others: object) -> list[Any]:
    """Return the arguments as pytest parameters. All but the first are tried only at night."""
    return [tried, *(_marked(other, pytest.mark.nightly) for other in others)]


def in_turn(each: Iterable[object], cases: Sequence[object]) -> list[Any]:
    """Return all pairs of `each` and `cases`; short test runs try one pair for each entry of `each`."""
    return [
        (one, case) if number % len(cases) == nth else _marked((one, case), pytest.mark.long)
        for number, one in enumerate(each)
        for nth, case in enumerate(cases)
    ]


def every_third(cases: Sequence[object]) -> list[Any]:
    """Return pytest parameters with numbers as ids; short test runs try every third case."""
    return [
        pytest.param(case, id=str(number), marks=pytest.mark.long if number % 3 else ())
        for number, case in enumerate(cases)
    ]


def every_fourth(each: Iterable[object], cases: Sequence[object], tried: Sequence[object]) -> list[Any]:
    """Return the pairs `tried`, and for long test runs every fourth pair of `each` and `cases`."""
    return [
        pytest.param(one, case, id=f"{one}-{_case_id(case)}", marks=() if is_tried else pytest.mark.long)
        for number, one in enumerate(each)
        for nth, case in enumerate(cases)
        if (is_tried := (one, case) in tried) or (number + nth) % 4 == 0
    ]


def _case_id(case: object) -> str:
    parts = case if isinstance(case, tuple) else (case,)
    return "-".join(getattr(part, "__name__", str(part)) for part in parts)


def _marked(other: object, mark: pytest.MarkDecorator) -> Any:
    values = other if isinstance(other, tuple) else (other,)
    return pytest.param(*values, marks=mark)
