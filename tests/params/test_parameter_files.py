"""Parameter files: saved values load again, and an invalid file raises a one-sentence error."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from multidrop import YD1000, params
from multidrop.params import files

GD20 = "GRUPO_PARAMETRO;CODIGO_FUNCAO;VALOR_PARAMETRO"
FOUND = params.ParameterSet(
    "yd1000", {"0009": 100, "F240": 7}, source="pump-1", title="YD1000", firmware="104", saved="2026-11-29"
)


@pytest.mark.parametrize("name", ["pump.toml", "pump.csv"])
def test_saved_files_load_with_the_same_values(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    params.save(FOUND, path, YD1000)
    found = params.load(path)
    assert found.values == FOUND.values
    assert (found.model, found.firmware, found.saved) == ("yd1000", "104", "2026-11-29")
    assert found.source == str(path)
    assert "acceleration_time" in path.read_text()
    assert "10.0 s" in path.read_text()
    assert params.is_parameter_file(path)


def test_saving_to_an_existing_file_raises(tmp_path: Path) -> None:
    (tmp_path / "pump.toml").write_text("")
    with pytest.raises(ValueError, match="exists already, and is not replaced"):
        params.save(FOUND, tmp_path / "pump.toml")
    with pytest.raises(ValueError, match=r"name ends in \.toml or \.csv"):
        params.save(FOUND, tmp_path / "pump.txt")


def test_a_set_without_parameters_is_not_saved(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"pump-1 answers for none of its parameters, so .* is not written"):
        params.save(params.ParameterSet("yd1000", {}, source="pump-1"), tmp_path / "pump.toml")
    assert not (tmp_path / "pump.toml").exists()


def test_file_that_is_too_long_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"#" * (files.MOST_BYTES + 1))
    with pytest.raises(ValueError, match="the parameter file has more than 1000000 bytes"):
        params.load(tmp_path / "a.csv")


@pytest.mark.parametrize("quote", ["", '"'])
def test_backup_files_of_the_gd20_tool_are_loaded(tmp_path: Path, quote: str) -> None:
    rows = [("CODIGO_FUNCAO", "GRUPO_PARAMETRO", "VALOR_PARAMETRO"), (3, 0, 5000), (12, 14, 3)]
    text = "\r\n".join(";".join(f"{quote}{cell}{quote}" for cell in row) for row in rows)
    (tmp_path / "bkp_result.csv").write_text(text)
    found = params.load(tmp_path / "bkp_result.csv")
    assert found.values == {"P00.03": 5000, "P14.12": 3}
    assert found.model == "invt-goodrive"


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("a.toml", "", r"is not a parameter file: it has no \[parameters\]"),
        ("a.toml", '[[line]]\nname = "a"', "is a plant file, not a parameter file"),
        ("a.toml", "format = 2\n[parameters]\nA = 1", "has format 2, and this version of multidrop reads"),
        ("a.toml", 'format = "x"\n[parameters]\nA = 1', "format = 'x' is not 1"),
        ("a.toml", "[parameters]\nA = 1.5", "A = 1.5 is not a raw count"),
        ("a.toml", "[parameters]", "has no parameters"),
        ("a.toml", "[parameters", "is not TOML"),
        ("a.csv", "x;y\n1;2", "its first row has no code and raw"),
        ("a.csv", "code;raw\nA;1\nA;2", "A is there twice"),
        ("a.csv", "code;raw\nA;one", "'one' is no whole number"),
        ("a.csv", "# format: 7\ncode;raw\nA;1", "has format 7"),
        ("a.csv", "code;raw\nA;" + 5000 * "9", "has 100 digits at most, and this one has 5000"),
        ("a.csv", "# format: " + 5000 * "9" + "\ncode;raw\nA;1", "has 100 digits at most"),
        ("a.csv", 'code;raw\n"' + 200_000 * "A" + '";1', "is not CSV: field larger than field limit"),
        ("a.csv", f"{GD20}\n0;3;6000\n00;03;1", r"P00\.03 is there twice"),
        ("a.csv", f"{GD20}\n0;3;99999999999", r"P00\.03 = 99999999999 is not a raw count"),
        ("a.csv", "GRUPO_PARAMETRO;CODIGO_FUNCAO\n0;1", "lists parameters without values"),
        ("a.csv", "", "is not a parameter file"),
    ],
)
def test_invalid_file_raises_a_one_sentence_error(
    tmp_path: Path, name: str, text: str, sentence: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=sentence) as raised:
        params.load(tmp_path / name)
    assert str(raised.value).startswith(str(tmp_path / name))
    assert "\n" not in str(raised.value)


def test_a_device_or_directory_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "port.csv")
    for path in (tmp_path / "port.csv", tmp_path):
        with pytest.raises(ValueError, match="is no file, but a directory or a device"):
            params.load(path)


def test_missing_file_raises_a_one_sentence_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be read: No such file"):
        params.load(tmp_path / "a.toml")
    assert not params.is_parameter_file(tmp_path / "a.toml")
