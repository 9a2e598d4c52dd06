"""Numbers in command arguments, requests and files: only ASCII decimal digits are accepted."""

from __future__ import annotations

import math
from typing import Any

import pytest
from tables import table

from multidrop.cli import main
from multidrop.families import InvtCHE
from multidrop.families.files import notation
from multidrop.gateway.http.messages import Denied, number_in
from multidrop.importers.numbers import count, number
from multidrop.printable import plain_number, plain_whole
from multidrop.recording.csv import _parse

# Fullwidth, Arabic-Indic, Devanagari and mathematical digits, and underscores as in Python.
ODD = ["1_0", "\uff11\uff12", "\u0663", "\u0967\u0968", "\U0001d7cf", "\u00bd", "12\u00a0", "1\u066b5"]


@table("text", [*ODD, "", "-", "0x10", "0b1", "1 2", "1,5"])
def test_texts_with_other_digits_are_not_parsed_as_numbers(text: str) -> None:
    for parse in (plain_number, plain_whole):
        with pytest.raises(ValueError, match="in decimal digits"):
            parse(text)


def test_number_of_thousands_of_digits_is_refused_in_own_words() -> None:
    with pytest.raises(ValueError, match="100 digits at most, and this one has 5000"):
        plain_whole("9" * 5000)


def test_numbers_in_ascii_digits_are_parsed() -> None:
    given = ("12", " 12 ", "+12", "-0", "12.", ".5", "1e1", "0012")
    assert [plain_number(text) for text in given] == [12, 12, 12, 0, 12, 0.5, 10, 12]
    assert [plain_whole(text) for text in ("12", " 12", "+12", "-3", "0012")] == [12, 12, 12, -3, 12]
    assert math.isnan(plain_number("nan"))


@table("text", [text for text in ODD if text.strip() == text])
def test_other_digits_are_refused_in_requests_and_files(text: str) -> None:
    row = ["2026-11-21T09:30:00.000000000Z", "1", "", "pump", "speed", text, "ok"]
    attempts: list[tuple[Any, Any]] = [
        (InvtCHE(1).setpoint.parse, text),
        (notation.number, text),
        (notation.whole, text),
        (count, text),
        (number, (text, 0)),
        (_parse, row),
        (number_in, (text, "count")),
    ]
    for parse, given in attempts:
        with pytest.raises((ValueError, Denied)):
            parse(*given) if isinstance(given, tuple) else parse(given)


@table("text", ODD)
@table(
    "words",
    [
        ["set-frequency", "/dev/none", "invt-che", "3", "--yes", "{}"],
        ["set-frequency", "/dev/none", "invt-che", "{}", "--yes", "21"],
        ["simulate", "none.toml", "--speed", "{}"],
        ["start", "/dev/none", "invt-che", "3", "--yes", "--frequency", "{}"],
        ["write", "/dev/none", "invt-che", "3", "setpoint", "{}", "--yes"],
        ["state", "/dev/none", "invt-che", "3", "--option", "maximum_frequency={}"],
        ["state", "/dev/none", "invt-che", "3", "--baudrate", "{}"],
        ["scan", "/dev/none", "--addresses", "{}"],
        ["scan", "/dev/none", "--baudrates", "{}"],
        ["doctor", "/dev/none", "--address", "{}"],
    ],
)
def test_other_digits_in_arguments_make_a_command_return_2(
    words: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([word.format(text) for word in words]) == 2
    assert "no such" not in capsys.readouterr().err.lower()  # neither port nor file was looked for
