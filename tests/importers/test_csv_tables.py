"""Import of CSV tables: ambiguous cells, and properties that the table does not state, are marked as gaps."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from imported import entries, gaps, omissions, only
from tables import table

from multidrop.importers import ImportedDevice

UNPLACED = ["whether its address counts from 0 or 1; 0 was assumed", "its table; holding was assumed"]


def row(folder: Path, header: str, cells: str) -> ImportedDevice:
    """Return the device imported from a table with one row, which declares the register `a`."""
    return only(folder, "t.csv", f"name,{header}\na,{cells}\n")


def found(device: ImportedDevice) -> list[str]:
    """Return the device's gaps (unknown properties), except those about numbering and a missing table."""
    return [gap for gap in gaps(device, "a") if gap not in UNPLACED]


@table(
    ("header", "cells", "at", "table", "gap"),
    [
        ("address,type", "400001,uint16", 0, None, ""),
        (
            "address,type",
            "40001,uint16",
            0,
            None,
            "40001 may be the number that is sent, or register 1 of table 4",
        ),
        ("address,type", "32080,uint16", 2079, "input", "32080 may be the number"),
        (
            "address,type,table",
            "30775,uint16,holding",
            30775,
            None,
            "",
        ),  # the first digit 3 contradicts the table that the row states
        ("address,type", "13001,uint16", 13001, None, "13001 names a discrete, and its row a number"),
        ("address,unit", "13001,kWh", 13001, None, "13001 names a discrete, and its row a number"),
        ("address,type", "00010,int16", 10, None, "00010 names a coil, and its row a number"),
        ("address,type", "10001,bool", 0, "discrete", "10001 may be the number"),
        ("address,type,fc", "5,uint16,3", 5, None, ""),
        ("address,type,fc", "5,uint16,0x04", 5, "input", ""),
        ("address,type,function code", "5,uint16,FC 03", 5, None, ""),
        ("address,type,table", "5,uint16,4", 5, "input", "its table: 4 was taken for function 04, input"),
        ("address,type,table", "5,uint16,4x", 5, None, ""),
        ("address,table", "5,Input Status", 5, "discrete", ""),
        ("address,type,table", "5,uint16,Input Registers", 5, "input", ""),
        ("address,table", "5,Coils", 5, "coil", ""),
        ("address,type,table", "5,uint16,file", 5, None, "its table 'file' is not known"),
        ("Address (hex),type", "1F,uint16", 0x1F, None, ""),
        ("Address [HEX],type", "10,uint16", 0x10, None, ""),
    ],
)
def test_address_and_table_in_a_csv_cell_are_read_from_every_notation(
    tmp_path: Path, header: str, cells: str, at: int, table: str | None, gap: str
) -> None:
    device = row(tmp_path, header, cells)
    (register,) = device.registers
    assert (register.address, register.table) == (at, table or "holding")
    said = [each for each in found(device) if "type" not in each and "bit" not in each]
    assert said == [] if not gap else said[0].startswith(gap)


def test_csv_address_above_65535_is_reported_as_not_imported(tmp_path: Path) -> None:
    device = only(tmp_path, "t.csv", "name,address,type\na,103247,float\nb,5,uint16\n")
    assert list(entries(device)) == ["b"]
    assert omissions(device) == ["a: its address is not from 0 to 65535"]


def test_decimal_address_among_hex_addresses_is_reported_as_ambiguous(tmp_path: Path) -> None:
    device = only(tmp_path, "t.csv", "name,address,type\na,10,uint16\nb,1F,uint16\n")
    assert "its address 10 may be hex, as others of its column are" in gaps(device, "a")
    assert "b: it cannot be read:" in omissions(device)[0]


def test_a_unit_of_a_coil_in_a_csv_table_is_reported(tmp_path: Path) -> None:
    device = row(tmp_path, "address,type,table,unit", "5,uint16,coil,V")
    assert entries(device)["a"] == {"at": 5, "table": "coil"}
    assert found(device) == ["its type, unit and scale were left out: a coil is a bit"]


@table(
    ("header", "cell", "step", "gap"),
    [
        ("factor", "0.1", 0.1, ""),
        ("factor", "10", 10, ""),
        ("scale", "0.1", 0.1, ""),
        ("scale", "10", 10, "its scale 10 was taken as a factor; in some tables it is a divisor"),
        ("divisor", "10", 0.1, ""),
        ("gain", "10", 0.1, "its gain 10 was taken as a divisor: a step of 0.1"),
        ("gain", "0.1", 0.1, "its gain 0.1 was taken as a factor; in some tables it is a divisor"),
        ("gain", "1", None, ""),
        ("decimal", "2", 0.01, "its decimal 2 was taken as digits after the point: a step of 0.01"),
        ("Decimal places", "1", 0.1, "its decimal 1 was taken as digits after the point: a step of 0.1"),
        ("decimal", "0.1", 0.1, "its decimal 0.1 was taken as a factor"),
        ("unit", "0.1V", None, "its unit '0.1V' begins with a number, which may be its step"),
        ("scale", "1_0", None, "only its count is read: its scale '1_0' or offset '' is not a number"),
        ("scale", "\u0661", None, "only its count is read: its scale '\u0661' or offset '' is not a number"),
        ("scale", "x/10", None, "only its count is read: its scale 'x/10' or offset '' is not a number"),
    ],
)
def test_a_scale_column_with_several_meanings_is_reported(
    tmp_path: Path, header: str, cell: str, step: float | None, gap: str
) -> None:
    device = row(tmp_path, f"address,type,{header}", f"0x10,uint16,{cell}")
    assert entries(device)["a"].get("step") == step
    assert found(device) == ([gap] if gap else [])


def test_a_column_named_decimal_in_a_neuron_table_is_a_factor(tmp_path: Path) -> None:
    header = "address,attribute,type,decimal,precision,bias"
    device = row(tmp_path, header, "1!400001,Read Subscribe,UINT16,2,3,-40")
    assert entries(device)["a"] == {"at": 0, "step": 2, "offset": -40}
    assert (gaps(device, "a"), omissions(device)) == ([], [])


@pytest.mark.parametrize("one", ["1", "1.0", "1,0", "1.000"])
def test_csv_divisor_is_used_if_the_scale_is_one(tmp_path: Path, one: str) -> None:
    device = only(tmp_path, "t.csv", f"name;address;type;scale;divisor\na;0x10;uint16;{one};10\n")
    assert (entries(device)["a"], found(device)) == ({"at": 16, "step": 0.1}, [])


def test_a_second_scale_column_of_a_csv_table_is_reported(tmp_path: Path) -> None:
    device = row(tmp_path, "address,type,scale,gain", "0x10,uint16,0.1,10")
    assert found(device) == ["its gain 10 was not carried over beside its scale"]
    device = row(tmp_path, "address,type,data type", "0x10,uint16,int32")
    assert found(device) == ["the column data type was not carried over"]


def test_the_order_of_offset_and_scale_in_a_csv_table_is_reported(tmp_path: Path) -> None:
    device = row(tmp_path, "address,type,scale,offset", "0x10,uint16,0.1,-40")
    assert found(device) == ["its offset -40 was taken as added after the step"]


@table(
    ("header", "cells", "number_format", "gap"),
    [
        ("unit", "C", None, "its type and sign are not stated; uint16 was assumed"),
        ("count", "2", "U32", "its type and sign are not stated; uint32 was assumed"),
        ("signed,count", "yes,2", "I32", "its type is not stated; int32 was assumed"),
        ("signed", "unsigned", None, "its type is not stated; uint16 was assumed"),
        ("type", "int", "I16", "the width of its type int is not stated; 16 bits were assumed"),
        ("type,count", "int,2", "I32", ""),
        ("type,signed", "uint16,signed", "I16", ""),
        ("type,signed", "uint16,maybe", None, "its sign 'maybe' was not carried over"),
        ("type", "uint16_t", None, ""),
        ("type", "16 bit unsigned integer", None, ""),
        ("type", "Signed Int32", "I32", ""),
        ("type", "U32", "U32", ""),
        ("type", "REAL", "F32", ""),
        ("type", "float16", "F16", ""),
        ("type", "DINT", "I32", ""),
        ("type,length", "uint16,2", None, "its length 2 is not that of its type, which takes 1 registers"),
        ("type", "int8", "I8", "which byte of its word it is; the low one was assumed"),
        ("type", "bool", None, "which bit of its word it is; bit 0 was assumed"),
        ("type,bit", "bool,3", None, ""),
    ],
)
def test_missing_number_type_in_a_csv_table_is_reported(
    tmp_path: Path, header: str, cells: str, number_format: str | None, gap: str
) -> None:
    device = row(tmp_path, f"address,{header}", f"0x10,{cells}")
    assert entries(device)["a"].get("number_format") == number_format
    said = [each for each in found(device) if each != "the order of its words is not stated"]
    assert said == ([gap] if gap else [])


def test_ambiguous_length_of_a_text_in_a_csv_table_is_reported(tmp_path: Path) -> None:
    device = row(tmp_path, "address,type,length", "0x10,string,8")
    assert found(device) == ["its length was taken for registers, and may be characters"]
    assert found(row(tmp_path, "address,type,registers", "0x10,string,8")) == []


def test_csv_register_of_three_words_without_a_type_is_not_imported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a: its type of 3 registers has no number format"):
        row(tmp_path, "address,count", "0x10,3")


@table(
    ("cell", "order", "gap"),
    [
        ("CDAB", "CDAB", ""),
        ("Big Endian", None, ""),
        ("little endian", None, "only its count is read: its order of words 'little endian'"),
        ("", None, "the order of its words is not stated"),
    ],
)
def test_ambiguous_byte_order_of_a_csv_table_is_reported(
    tmp_path: Path, cell: str, order: str | None, gap: str
) -> None:
    device = row(tmp_path, "address,type,byte order", f"0x10,uint32,{cell}")
    assert (entries(device)["a"].get("order"), found(device)) == (order, [gap] if gap else [])


WRITTEN = ["it is written there; what a write does is not known here"]


@table(
    ("word", "said"),
    [
        *((word, []) for word in ("", "R", "RO", "Read", "read-only", "Read Only")),
        *((word, WRITTEN) for word in ("RW", "R/W", "r/w", "Read/Write", "Read Write", "rw", "W/R")),
        ("sometimes", ["its access 'sometimes' is not known; it is read here"]),
    ],
)
def test_an_unknown_or_writable_access_in_a_csv_table_is_reported(
    tmp_path: Path, word: str, said: list[str]
) -> None:
    assert found(row(tmp_path, "address,type,access", f"0x10,uint16,{word}")) == said


@table("word", ["W", "WO", "Write", "write only", "Write-only"])
def test_a_write_only_register_of_a_csv_table_is_not_imported(tmp_path: Path, word: str) -> None:
    with pytest.raises(ValueError, match="a: is only written: a command is never imported"):
        row(tmp_path, "address,type,access", f"0x10,uint16,{word}")


def test_csv_row_with_a_writing_function_code_is_marked_as_written(tmp_path: Path) -> None:
    assert found(row(tmp_path, "address,type,fc", '0x10,uint16,"03,06,16"')) == WRITTEN
    with pytest.raises(ValueError, match="a: is only written"):
        row(tmp_path, "address,type,fc", "0x10,uint16,16")


def test_csv_columns_that_are_not_imported_are_reported(tmp_path: Path) -> None:
    device = row(tmp_path, "address,type,enum,room,wobble", "0x10,uint16,0=off,hall,1")
    assert found(device) == ["the column enum was not carried over"]
    assert omissions(device) == ["the column wobble: is not known here, and was not carried over"]


def test_numbers_in_a_csv_column_named_register_are_addresses(tmp_path: Path) -> None:
    device = only(tmp_path, "t.csv", "Register,Name,Type\n16,volts,uint16\n")
    assert entries(device)["volts"]["at"] == 16


def test_lines_above_the_column_names_of_a_csv_table_are_skipped(tmp_path: Path) -> None:
    text = "Meter M-1\nInput registers;;\nName;Address;Type\nvolts;0x10;uint16\n"
    assert entries(only(tmp_path, "t.csv", text))["volts"]["at"] == 16


@pytest.mark.parametrize("comma", [",", ";", "\t"])
def test_the_first_csv_column_may_be_named_with_a_hash_sign(tmp_path: Path, comma: str) -> None:
    lines = ["# a comment", "#,Name,Address,Type", "1,volts,0x10,uint16", "#2,amperes,0x11,uint16"]
    device = only(tmp_path, "t.csv", "\n".join([lines[0], *(one.replace(",", comma) for one in lines[1:])]))
    assert {name: entry["at"] for name, entry in entries(device).items()} == {"volts": 16}


@pytest.mark.parametrize("unit", [0, 255])
def test_unit_ids_0_and_255_in_a_csv_table_are_valid_addresses(tmp_path: Path, unit: int) -> None:
    assert row(tmp_path, "address,type,slave", f"0x10,uint16,{unit}").address == unit


@table(
    ("text", "reason"),
    [
        ("name,x\na,1\n", "no column is called address; the first line names these columns: name, x"),
        ("name,address\n", "has no row with an address"),
        ("name,address\na,\n", "a: its row has no address"),
        ("name,address,slave\na,1,900\n", "a: it cannot be read: slave = '900' is not a unit id"),
        ("name,address\na,1-2\n", 'a: it cannot be read: "1-2" is not an address'),
        ("device,m,900\n", "row 1: device = '900' is not a unit id"),
        ("device,m,1\npoll,file,0,1,BE_BE\nref,a,0,uint16,r\n", "a: its table file is not known"),
    ],
)
def test_invalid_csv_table_raises_value_error_with_the_reason(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=re.escape(reason)):
        only(tmp_path, "t.csv", text)


def test_a_missing_byte_order_of_modpoll_is_assumed_and_reported(tmp_path: Path) -> None:
    text = "device,m,1\npoll,holding_register,0,4,{}\nref,a,0,uint32,{},V,0.1{}\n"
    device = only(tmp_path, "m.csv", text.format("", "r", ""))
    assert entries(device)["a"]["order"] == "CDAB"
    assert gaps(device, "a") == ["the order of its words is not stated; BE_LE was assumed, as modpoll does"]
    assert gaps(only(tmp_path, "m.csv", text.format("BE_BE", "rm", "")), "a") == [
        "its access 'rm' is none of r, w and rw"
    ]
    with pytest.raises(ValueError, match="a: it cannot be read: row 3 has more than 7 cells"):
        only(tmp_path, "m.csv", text.format("BE_BE", "r", ",more"))


def test_a_byte_order_of_modpoll_does_not_apply_to_texts(tmp_path: Path) -> None:
    text = "device,m,1\npoll,holding_register,0,4,LE_LE\nref,a,0,string8,r\nref,b,4,bool8,r\n"
    device = only(tmp_path, "m.csv", text)
    assert entries(device)["a"] == {"at": 0, "length": 4}
    assert gaps(device, "b") == ["its type bool8 is a list of bits there; the whole word is read"]
