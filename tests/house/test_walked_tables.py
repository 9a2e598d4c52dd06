"""Check that a table test tries every row and names the rows that fail."""

from __future__ import annotations

import pytest
from tables import table


def notes(caught: pytest.ExceptionInfo[BaseExceptionGroup[BaseException]]) -> list[list[str]]:
    return [failure.__notes__ for failure in caught.value.exceptions]


def test_every_failing_row_is_reported() -> None:
    tried = []

    @table("number", range(5))
    def is_even(number: int) -> None:
        tried.append(number)
        assert number % 2 == 0

    with pytest.raises(BaseExceptionGroup, match="2 of 5 rows failed") as caught:
        is_even()
    assert tried == [0, 1, 2, 3, 4]
    assert notes(caught) == [["in the row (1,)"], ["in the row (3,)"]]


def test_row_fails_if_it_is_skipped_or_an_expected_error_is_missing() -> None:
    @table(("one", "other"), [(1, 2), (2, 2), (3, 3)], ids=["a", "b", "c"])
    def differ(one: int, other: int) -> None:
        if one == 3:
            pytest.skip("three")
        with pytest.raises(ZeroDivisionError):
            _ = 1 / (one - other + 1)

    with pytest.raises(BaseExceptionGroup, match="2 of 3 rows failed") as caught:
        differ()
    assert notes(caught) == [["in the row 'b'"], ["in the row 'c'"]]


@table("left", [0, 1])
@table("right", [0, 1])
@pytest.mark.parametrize("sum_", [0, 1, 2])
def test_tables_of_tables_and_fixtures(left: int, right: int, sum_: int, tmp_path: object) -> None:
    assert (left + right == sum_) is (sum_ - left == right)


@table("rows", [[], [(1, 2)]], ids=["none", "too wide"])
def test_empty_or_ill_formed_table_is_rejected(rows: list[tuple[int, int]]) -> None:
    with pytest.raises(AssertionError):
        table(["only"], rows)
