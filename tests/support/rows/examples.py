"""Limit the number of test examples: a tenth by default, all if the environment variable THOROUGH is set."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import Any

import pytest

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
