"""Invalid TOML files give one sentence with the mistake, its line and a correction.

TOML keys in any layout have the right line numbers.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from tables import table

from multidrop.toml_check import Key, TomlPlace
from multidrop.toml_document import DocumentError, line_numbers, parse_document


def mistake(data: str | bytes) -> tuple[int, str]:
    with pytest.raises(DocumentError) as wrong:
        parse_document(data.encode() if isinstance(data, str) else data)
    return wrong.value.line, str(wrong.value).removeprefix("the file is not TOML: ")


@table(
    ("text", "line", "sentence"),
    [
        # quotes
        ("\nname = pump-1\n", 2, 'pump-1 has no quotes; write name = "pump-1"'),
        ("port = /dev/ttyUSB0 # left\n", 1, '/dev/ttyUSB0 has no quotes; write port = "/dev/ttyUSB0"'),
        ("every = 50 ms", 1, '50 ms has no quotes; write every = "50 ms"'),
        ("poll = [output_current]", 1, 'output_current has no quotes; write "output_current"'),
        ("poll = [{ register = x }]", 1, 'x has no quotes; write "x"'),
        ('a = 1\nname = "hall\nb = 2', 2, "a text is not closed; add a quote"),
        ("name = 'hall", 1, "a text is not closed; add a quote"),
        ("name = “hall”", 1, 'the line has typographic quotes; write them as in "text"'),
        ('port = "C:\\dev"', 1, "a backslash in a text starts a code; write / or two of them"),
        ("name = 'it's'", 1, "s' does not belong here; write each key in its own line"),
        # values
        ("name =\nport = 1", 1, "name has no value; write one after the ="),
        ("address = 5h", 1, '5h has no quotes; write address = "5h"'),
        (
            "baudrate = 9600 bps",
            1,
            '9600 bps is neither a number nor a text in quotes; write a number, or baudrate = "9600 bps"',
        ),
        ("address = 01", 1, "the number starts with 0; write address = 1"),
        ("above = 1,5", 1, "1,5 has a decimal comma; write above = 1.5"),
        (
            "above = .5",
            1,
            "the number has no digit on one side of its point; write above = 0.5 or above = 5.0",
        ),
        ("realtime = True", 1, "True is not a value; write realtime = true or realtime = false"),
        (
            "realtime = yes",
            1,
            'yes is not a value; write realtime = true, realtime = false or realtime = "yes"',
        ),
        ("address = 1 name = 2", 1, "name = 2 does not belong here; write each key in its own line"),
        # lists and tables in one line
        ('poll = ["a" "b"]', 1, 'a comma or a bracket is missing before "b"]'),
        ('poll = ["a", "b"\n\n[serve]', 3, "a comma or a bracket is missing before [serve]"),
        ("a = [1, 2", 1, "a comma or a bracket is missing before the end of the file"),
        ("a = [1,, 2]", 1, "a comma is there twice; keep one"),
        ('poll = "a", "b"', 1, 'a list has no brackets; write poll = ["a", "b"]'),
        ("a = { b = 1 c = 2 }", 1, "a comma or a brace is missing before c = 2 }"),
        (
            "units = { a = 1,\n b = 2 }",
            1,
            "a table in braces is not closed; write the whole table in one line",
        ),
        # keys
        ("name: hall", 1, "name has a colon; write name = hall"),
        ("name", 1, "the line is neither KEY = VALUE nor a [header]"),
        ("= 1", 1, "the line is neither KEY = VALUE nor a [header]"),
        ("Lüfter = 1", 1, 'the key Lüfter has a letter other than a to z; write it in quotes: "Lüfter"'),
        (
            "a = 1\nb = 2\na = 3\n",
            3,
            "a is there twice, first in line 1; keep one, or start a new table with its header",
        ),
        ("a\u00a0= 1", 1, "the line has an invisible character; write the line again"),
        ('a = "\x01"', 1, "a text has an invisible character; remove it"),
        # tomllib's own error is shown for other mistakes
        ("a = 1\nb = 2026-02-30", 2, "Invalid date or datetime"),
        # headers
        ("[[line]\na = 1", 1, "a header lacks a bracket; write [line] or [[line]]"),
        ("[[phase.step # cool\na = 1", 1, "a header lacks a bracket; write [phase.step] or [[phase.step]]"),
        ("[serve\na = 1", 1, "a header lacks a bracket; write [serve] or [[serve]]"),
        ("[serve]]\na = 1", 1, "a header has too many brackets; write [serve] or [[serve]]"),
        ("[[\na = 1", 1, "a header has no name; write one in its brackets"),
        (
            "[serve]\na = 1\n[serve]\nb = 1",
            3,
            "[serve] is there twice, first in line 1; write its keys below one header, or write each header "
            "as [[serve]]",
        ),
        (
            '["x (at 5"]\na = 1\n["x (at 5"]',
            3,
            '["x (at 5"] is there twice, first in line 1; write its keys below one header, or write each '
            'header as [["x (at 5"]]',
        ),
        (
            "[line]\na = 1\n[[line]]\n",
            3,
            "[[line]] is also a single table, first in line 1; write each of its headers in two brackets",
        ),
        # the file
        ("a = 1\rb = 2\r", 1, "a line ends with CR alone; save the file with the line ends LF or CRLF"),
        ("a = 1\r\nb = x\r\n", 2, 'x has no quotes; write b = "x"'),
        ("\ufeffa = x\n", 1, 'x has no quotes; write a = "x"'),
        ("a = 1".encode("utf-16"), 0, "the file is not text in UTF-8, but in UTF-16; save it as UTF-8"),
        ("a = 1".encode("utf-16-be"), 0, "the file is not text in UTF-8, but in UTF-16; save it as UTF-8"),
        (b"a = 1\nb = '\xe4'", 2, "the file is not text in UTF-8, from byte 11 on (0xE4); save it as UTF-8"),
    ],
)
def test_invalid_toml_is_reported_with_advice(text: str | bytes, line: int, sentence: str) -> None:
    assert mistake(text) == (line, sentence)


def test_a_long_line_with_a_toml_mistake_is_reported_quickly_and_shortened() -> None:
    line, sentence = mistake("name = " + "x" * 500_000 + "é" * 500_000)
    assert (line, len(sentence) < 200) == (1, True)


LAYOUT = '''\
top = 1

[[line]]
"name" = "a"
[[line.drive]]
poll = [
    "x",
    # a comment with [brackets] and = signs
    { register = "y", every = "1 s" },
    ["deep", { z = 1 }],
]
note = """
[not.a.header]
address = 9
"""
address = 1
[[line]]
name = "b"
[[line.drive]]
address = 2
[[line.drive]]
address = 3
[serve.may]
look = "anyone"
family.toy = { write = ["a"] }
[[serve.limit]]
above = 1
["quoted.key"]
b = 1
'''


@table(
    ("steps", "key", "line"),
    [
        ([], "top", 1),
        (["line"], "", 3),
        (["line"], "name", 4),
        (["line", "drive"], "poll", 6),
        (["line", "drive", ("poll", 1)], "", 7),
        (["line", "drive", ("poll", 2)], "", 9),
        (["line", "drive", ("poll", 2)], "every", 9),
        (["line", "drive", ("poll", 3)], "", 10),
        # `poll` has no fourth table, so the line number of the key `poll` is used
        (["line", "drive", ("poll", 4)], "", 6),
        (["line", "drive"], "address", 16),
        ([("line", 2)], "name", 18),
        ([("line", 2), "drive"], "address", 20),
        ([("line", 2), ("drive", 2)], "address", 22),
        ([("line", 2), ("drive", 2)], "absent", 21),
        (["serve"], "may", 23),
        (["serve", "may"], "look", 24),
        (["serve", "may", "family"], "toy", 25),
        (["serve", "may", "family", "toy"], "write", 25),
        (["serve", "limit"], "above", 27),
        (["quoted.key"], "b", 29),
        (["absent"], "absent", 0),
    ],
)
def test_an_error_names_the_line_number_of_its_toml_key_in_any_layout(
    tmp_path: Path, steps: list[str | tuple[str, int]], key: str, line: int
) -> None:
    (tmp_path / "a.toml").write_text(LAYOUT)
    place = TomlPlace.in_file(tmp_path / "a.toml")
    for step in steps:
        name, number = step if isinstance(step, tuple) else (step, 1)
        (*_, (_, place)) = place.inside(name, [{}] * number)
    place.wrong("wrong", key)
    (error,) = place.config_errors
    assert error.startswith(f"{tmp_path}/a.toml:{line}: " if line else f"{tmp_path}/a.toml: ")


def test_a_missing_toml_file_has_no_line_numbers(tmp_path: Path) -> None:
    assert line_numbers(tmp_path / "none.toml") == {}
    assert line_numbers(tmp_path) == {}


def test_an_error_that_starts_with_a_key_names_the_line_of_the_key(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("[a]\nb = 1\nc = 2\n")
    place = TomlPlace.in_file(tmp_path / "a.toml").within("[a]", "a")
    place.wrong("c = 2 is too much")
    place.wrong("d is missing")
    assert [error.split(": ")[0].rpartition(":")[2] for error in place.config_errors] == ["3", "1"]


def test_a_long_toml_table_in_an_error_is_shortened(tmp_path: Path) -> None:
    place = TomlPlace(tmp_path / "a.toml")
    place.check({"line": {"name": "x" * 100}}, {"line": Key(list, "[[line]], in two brackets")})
    (error,) = place.config_errors
    assert error.endswith("xxx... is not right; write [[line]], in two brackets")
    assert len(error) < len(str(tmp_path)) + 150


def test_a_toml_table_in_the_wrong_place_is_reported_with_the_right_header(tmp_path: Path) -> None:
    from multidrop.plant.loader import PlantError, load_plant

    path = tmp_path / "plant.toml"
    path.write_text('[[line]]\nname = "L"\nport = "/dev/a"\n[[drive]]\nname = "D"\n')
    with pytest.raises(PlantError) as wrong:
        load_plant(path)
    assert wrong.value.mistakes[0] == (
        f"{path}:4: [[drive]] is not inside a line; write [[line.drive]], in two brackets"
    )
