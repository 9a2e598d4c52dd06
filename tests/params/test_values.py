"""Read parameters in blocks, and compare parameter sets."""

from __future__ import annotations

import os
from pathlib import Path
from typing import ClassVar

import pytest
from simulated_bus import SimulatedBus, one
from tables import table

from multidrop import YD1000, DelixiModbus, DelixiNative, Drive, InvtCHE, NoReply, Unsupported, params
from multidrop.core import Message
from multidrop.drive.parameters import ParameterGroup, ParameterSpace, parameters_of
from multidrop.drive.register import HOLDING
from multidrop.families.registry import find_model
from multidrop.params import files
from multidrop.sim import SimulatedDrive


class Blocky(Drive):
    """A drive with two groups of parameters that can be read in blocks."""

    model = "blocky"
    parameter_space = ParameterSpace(
        groups=(ParameterGroup("P00.", 0x0000, range(16)), ParameterGroup("P01.", 0x0100, range(16)))
    )


CODES = [*parameters_of(Blocky)]


class Limited(SimulatedDrive):
    """A simulated drive that refuses reads of more than `longest` registers."""

    longest = 16

    def read(self, function: int, start: int, count: int) -> list[int]:
        self.most = {3: self.longest}
        return super().read(function, start, count)


def blocky(missing: set[str], longest: int = 16) -> tuple[SimulatedBus, Drive]:
    sim = Limited(Blocky(1))
    sim.longest = longest
    for number, (code, parameter) in enumerate(parameters_of(Blocky).items()):
        if code not in missing:
            sim.memory.declare(parameter)
            sim.memory.set_raw(parameter, number)
    line = SimulatedBus(sim)
    return line, line.attach(sim.drive)


def counts(line: SimulatedBus) -> list[int]:
    return [request.count for request, _ in line.frames]


def test_parameters_are_read_in_few_blocks() -> None:
    line, drive = blocky(set())
    assert dict(params.read(drive).values) == {code: number for number, code in enumerate(CODES)}
    assert counts(line) == [16, 16]


def test_a_refused_block_does_not_prevent_reading_the_other_blocks() -> None:
    line, drive = blocky({"P00.05"})
    assert set(params.read(drive).values) == {*CODES} - {"P00.05"}
    assert counts(line) == [16, 8, 4, 4, 2, 1, 1, 2, 8, 16]


def test_params_read_remembers_the_longest_accepted_block() -> None:
    line, drive = blocky(set(), longest=8)
    assert len(params.read(drive).values) == 32
    assert counts(line) == [16, 8, 8, 8, 8]


def test_params_read_with_codes_reads_only_those_parameters() -> None:
    line, drive = blocky(set())
    assert dict(params.read(drive, ["P01.02"]).values) == {"P01.02": 18}
    assert counts(line) == [1]
    with pytest.raises(ValueError, match=r"has no parameter P09\.00"):
        params.read(drive, ["P09.00"])


def test_reading_skips_the_rest_of_a_parameter_group_without_replies() -> None:
    line, drive, _ = one(DelixiModbus(1))
    found = params.read(drive).values
    assert [*found] == ["P00.00", "P00.01", "P00.02", "P04.28", "P04.29", "P04.30"]
    assert len(line.frames) < 5 * 10 * 8


def test_a_silent_drive_raises_the_error_no_reply() -> None:
    line, drive, _ = one(DelixiNative(1))
    asked: list[Message] = []
    line.deafens = lambda request: bool(asked.append(request)) or len(asked) > 20
    with pytest.raises(NoReply):
        params.read(drive)


# Model, parameter code and register address, copied from the sources beside them.
ADDRESSES = [
    ("delta-cp2000", "04-10", 0x040A),  # CP2000 manual p. 12.1-09-8
    ("powtran-pi130", "F0.01", 0xF001),  # PI130 manual p. 112
    ("powtran-pi130", "F3.12", 0xF30C),  # PI500 manual p. 88, also for the next two
    ("powtran-pi130", "E3.21", 0xA315),
    ("powtran-pi130", "y1.30", 0xC11E),
    ("invt-goodrive", "P14.02", 0x0E02),  # Goodrive200A manual p. 138
    ("delixi-e", "P4.1.02", 0x4102),  # DelixiProtocol.h
    ("erman-er-g-220-05", "P136", 1136),  # erman.py
]


@table("model, code, address", ADDRESSES)
def test_parameter_addresses_equal_the_cited_sources(model: str, code: str, address: int) -> None:
    assert parameters_of(find_model(model))[code].address == address


# Codes of parameters that may let the motor start, and of parameters whose function is unknown.
NEVER_WRITTEN = {
    "invt-goodrive": "P00.01 P00.02 P00.15 P00.18 P01.18 P01.21 P02.01 P05.00 P05.01 P05.09 P05.10 P05.12 "
    "P05.13 P07.00 P07.01 P07.02 P07.03 P07.04 P08.28",
    "delixi-e": "P0.0.03 P0.0.04 P0.0.24 P0.0.00 P0.0.19 P0.1.00 P1.0.01 P1.1.00 P2.0.00 P3.0.00 P4.0.00 "
    "P4.1.07 P8.3.49",
    "delta-cp2000": "00-02 00-07 00-21 02-01 05-00 09-00",
    "powtran-pi130": "F0.11 F1.00 b0.27 y0.00 F9.02",
}


@table("model, codes", NEVER_WRITTEN.items())
def test_hazardous_and_unexplained_parameters_are_not_written(model: str, codes: str) -> None:
    known = parameters_of(find_model(model))
    assert [code for code in codes.split() if not known[code].never] == []


def test_only_explained_delixi_e_parameters_are_writable() -> None:
    """The file DelixiCDIE100.cpp explains these codes.

    The other codes in it are for commands, motor identification and communication.
    """
    named = [f"P0.0.{index:02}" for index in (7, 8, *range(11, 19))] + [
        "P0.0.02",
        "P1.0.00",
        "P4.1.03",
        "P4.1.04",
    ]
    known = parameters_of(find_model("delixi-e"))
    assert {code for code, one in known.items() if not one.never} == {*named}


def test_a_family_without_parameter_addresses_raises_unsupported() -> None:
    _, drive, _ = one(InvtCHE(1))
    with pytest.raises(
        Unsupported,
        match=r"are not known for invt-che: read and write its declared registers instead",
    ):
        params.read(drive)


def test_differing_parameters_have_names_and_units() -> None:
    first = params.ParameterSet("yd1000", {"0009": 100, "F240": 5}, source="a")
    second = params.ParameterSet("yd1000", {"0009": 150, "F240": 5, "F241": 1}, source="b")
    assert params.compare(first, second, YD1000) == [
        params.Difference("0009", "acceleration_time", 100, 150, "10.0 s", "15.0 s"),
        params.Difference("F241", "", None, 1, "-", "1"),
    ]
    assert params.compare(first, first, YD1000) == []


def test_factory_values_are_those_of_the_manual() -> None:
    assert params.defaults(YD1000).values["0011"] == 8000
    with pytest.raises(Unsupported, match="prints no factory values"):
        params.defaults(DelixiModbus)


def test_the_monitor_values_are_not_listed_as_parameters() -> None:
    assert not any(code.startswith("P05.") for code in parameters_of(DelixiModbus))


def test_parameters_use_the_eeprom_address_of_a_register() -> None:
    from multidrop.drive.register import Kept, setting

    class WithAlias(Drive):
        parameter_space: ClassVar[ParameterSpace] = ParameterSpace(groups=(ParameterGroup("P", 0, range(2)),))
        ramp = setting(0x0001, "s", step=0.1, ram_address=0x8001)

    ramp = parameters_of(WithAlias)["P01"]
    assert (ramp.name, ramp.ram_address, ramp.kept, ramp.table) == ("ramp", None, Kept.EEPROM, HOLDING)


GD20 = "GRUPO_PARAMETRO;CODIGO_FUNCAO;VALOR_PARAMETRO"
FOUND = params.ParameterSet(
    "yd1000", {"0009": 100, "F240": 7}, source="pump-1", title="YD1000", firmware="104", saved="2026-11-29"
)


@pytest.mark.parametrize("name", ["pump.toml", "pump.csv"])
def test_a_saved_parameter_file_loads_with_the_same_values(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    params.save(FOUND, path, YD1000)
    found = params.load(path)
    assert found.values == FOUND.values
    assert (found.model, found.firmware, found.saved) == ("yd1000", "104", "2026-11-29")
    assert found.source == str(path)
    assert "acceleration_time" in path.read_text()
    assert "10.0 s" in path.read_text()
    assert params.is_parameter_file(path)


def test_saving_parameters_to_an_existing_file_raises(tmp_path: Path) -> None:
    (tmp_path / "pump.toml").write_text("")
    with pytest.raises(ValueError, match="exists already, and is not replaced"):
        params.save(FOUND, tmp_path / "pump.toml")
    with pytest.raises(ValueError, match=r"name ends in \.toml or \.csv"):
        params.save(FOUND, tmp_path / "pump.txt")


def test_an_empty_parameter_set_is_not_saved(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"pump-1 returned no value of its parameters, so .* is not written"):
        params.save(params.ParameterSet("yd1000", {}, source="pump-1"), tmp_path / "pump.toml")
    assert not (tmp_path / "pump.toml").exists()


def test_an_oversized_parameter_file_is_refused(tmp_path: Path) -> None:
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


@table(
    ("name", "text", "sentence"),
    [
        ("a.toml", "", r"is not a parameter file: it has no \[parameters\]"),
        ("a.toml", '[[line]]\nname = "a"', "is a plant file, not a parameter file"),
        ("a.toml", "format = 2\n[parameters]\nA = 1", "has format 2, but this version of multidrop reads"),
        ("a.toml", 'format = "x"\n[parameters]\nA = 1', "format = 'x' is not supported; write format = 1"),
        ("a.toml", "[parameters]\nA = 1.5", "A = 1.5 is not a raw count"),
        ("a.toml", "[parameters]", "has no parameters"),
        ("a.toml", "[parameters", r"a\.toml:1: the file is not TOML"),
        ("a.csv", "x;y\n1;2", "its first row does not name the columns code and raw"),
        ("a.csv", "code;raw\nA;1\nA;2", "A is given twice"),
        ("a.csv", "code;raw\nA;one", "'one' is not a whole number"),
        ("a.csv", "# format: 7\ncode;raw\nA;1", "has format 7"),
        ("a.csv", "code;raw\nA;" + 5000 * "9", "has 100 digits at most, and this one has 5000"),
        ("a.csv", "# format: " + 5000 * "9" + "\ncode;raw\nA;1", "has 100 digits at most"),
        ("a.csv", 'code;raw\n"' + 200_000 * "A" + '";1', "is not CSV: field larger than field limit"),
        ("a.csv", f"{GD20}\n0;3;6000\n00;03;1", r"P00\.03 is given twice"),
        ("a.csv", f"{GD20}\n0;3;99999999999", r"P00\.03 = 99999999999 is not a raw count"),
        ("a.csv", "GRUPO_PARAMETRO;CODIGO_FUNCAO\n0;1", "lists parameters without values"),
        ("a.csv", "", "is not a parameter file"),
    ],
)
def test_invalid_parameter_files_are_refused(tmp_path: Path, name: str, text: str, sentence: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=sentence) as raised:
        params.load(tmp_path / name)
    assert str(raised.value).startswith(str(tmp_path / name))
    assert "\n" not in str(raised.value)


def test_a_device_or_directory_is_not_opened_as_a_parameter_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "port.csv")
    for path in (tmp_path / "port.csv", tmp_path):
        with pytest.raises(ValueError, match="is not a file, but a directory or a device"):
            params.load(path)


def test_a_missing_parameter_file_raises_a_one_sentence_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be read: No such file"):
        params.load(tmp_path / "a.toml")
    assert not params.is_parameter_file(tmp_path / "a.toml")
