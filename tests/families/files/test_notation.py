"""Addresses in a family file: each notation is converted to the right address on the wire."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest
from tables import table

from multidrop.families.files.notation import Counting, sent_as


@table(
    ("given", "counts_from", "table", "sent"),
    [
        (0x2000, 0, None, (0x2000, "holding")),
        (8192, 1, None, (8191, "holding")),
        (65536, 1, None, (65535, "holding")),
        ("2000H", 0, None, (0x2000, "holding")),
        ("2000h", 1, None, (0x1FFF, "holding")),
        ("0x2000", 0, "input", (0x2000, "input")),
        ("40001", None, None, (0, "holding")),
        ("40001", 1, None, (0, "holding")),
        ("49999", None, None, (9998, "holding")),
        ("400001", None, None, (0, "holding")),
        ("465536", None, None, (65535, "holding")),
        ("30001", None, None, (0, "input")),
        ("300001", None, "input", (0, "input")),
        ("10017", None, None, (16, "discrete")),
        ("00001", None, None, (0, "coil")),
        ("000065", None, "coil", (64, "coil")),
        (50200, 1, None, (50199, "holding")),  # Danfoss' status word; the first digit 5 names no table
        # Danfoss' output frequency; the first digit 1 names another table
        (16130, 1, None, (16129, "holding")),
        (40001, 0, "input", (40001, "input")),
    ],
)
def test_toml_addresses_are_converted_to_wire_addresses(
    given: Any, counts_from: int | None, table: str | None, sent: tuple[int, str]
) -> None:
    assert Counting(counts_from).address(given, table, "holding") == sent


@table(
    ("cell", "counts_from", "sent"),
    [
        ("8192", 0, (8192, "holding")),
        ("0x2000", 0, (0x2000, "holding")),
        ("1E10H", 0, (0x1E10, "holding")),
        ("40001", None, (0, "holding")),
        ("30001", None, (0, "input")),
        ("16130", 1, (16129, "holding")),
        ("50200", 1, (50199, "holding")),
        ("0016", 0, (16, "holding")),
    ],
)
def test_csv_addresses_are_converted_to_wire_addresses(
    cell: str, counts_from: int | None, sent: tuple[int, str]
) -> None:
    assert Counting(counts_from).address_in_cell(cell, None, "holding") == sent


@table(
    ("given", "sentence"),
    [
        (True, "True is not an address; write 0x2000"),
        (1.5, "1.5 is not an address; write 0x2000"),
        ("", '"" is not an address; write 0x2000'),
        ("8192", '"8192" may be decimal or hex; write 8192, or "8192H"'),
        (-1, "-1 is outside 0 to FFFFH"),
        (65536, "65536 is outside 0 to FFFFH"),
        ("FFFFFH", "FFFFFH is outside 0 to FFFFH"),
        ("40000", '"40000" is outside "40001" to "465536"'),
        ("465537", '"465537" is outside "400001" to "465536"'),
        (
            40017,
            '40017 may be the number 40017, or register 17 of table holding; write "9C51H" for that number',
        ),
        (400017, "400017 may be the number 400017, or register 17 of table holding; write a smaller number"),
    ],
)
def test_invalid_addresses_in_a_family_file_are_refused(given: Any, sentence: str) -> None:
    with pytest.raises(ValueError) as refused:  # noqa: PT011 (the sentence is compared below)
        Counting(0).address(given, None, "holding")
    assert sentence in str(refused.value)


@table("table", ["holding", "input", "coil", "discrete"])
def test_an_address_as_toml_text_is_read_back_unchanged(table: str) -> None:
    for address in (0, 9, 10_000, 10_001, 19_999, 30_001, 39_999, 40_000, 40_017, 49_999, 0xFFFF):
        written = tomllib.loads(f"at = {sent_as(address, table)}")["at"]
        assert Counting(0).address(written, table, "holding") == (address, table)


def test_an_address_is_refused_if_the_first_digit_contradicts_the_table() -> None:
    with pytest.raises(
        ValueError, match='"30001" begins with 3, which stands for table input, but table = "holding"; '
    ):
        Counting(0).address("30001", "holding", "holding")


@table(
    ("cell", "sentence"),
    [
        ("1E10", "1E10 is a power of ten, into which a spreadsheet has converted a hex number; write 1E10H"),
        ("1.00E+10", "is a power of ten"),
        ("40001", "40001 may be the number 40001, or register 1 of table holding"),
        ("4x0001", '"4x0001" is not an address'),
        ("\uff19", "is not an address"),
        ("1" * 400, "is outside 0 to FFFFH"),
    ],
)
def test_invalid_csv_cell_is_refused_with_a_valid_example(cell: str, sentence: str) -> None:
    with pytest.raises(ValueError) as refused:  # noqa: PT011
        Counting(0).address_in_cell(cell, None, "holding")
    assert sentence in str(refused.value)


def test_the_addresses_of_a_family_file_count_from_0_by_default() -> None:
    counting = Counting(None)
    assert counting.address(16, None, "holding") == (16, "holding")
    assert counting.address("40001", None, "holding") == (0, "holding")
    assert counting.assumed == [16]
