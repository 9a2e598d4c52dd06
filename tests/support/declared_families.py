"""Classes made of documents with verbs, for tests that change these documents."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import Any

from multidrop.core import NumberFormat
from multidrop.drive import Drive
from multidrop.drive.declare import command, reading, setting
from multidrop.drive.options import Option
from multidrop.drive.register import Register
from multidrop.drive.table import COIL, HOLDING, Kept, Table
from multidrop.family_file.verbs import add_verbs
from multidrop.toml_check import TomlPlace

FAMILIES = Path(__file__).parents[1] / "data" / "families"
NAMES = ("abb", "fc", "enum", "coil")
_TABLES: Mapping[str, Table] = {"holding": HOLDING, "coil": COIL}


def document_of(name: str) -> dict[str, Any]:
    return tomllib.loads((FAMILIES / f"{name}.toml").read_text("utf-8"))


def registers_of(document: Mapping[str, Any]) -> dict[str, Register[Any]]:
    """Return the registers of a document as far as these tests need them."""
    found: dict[str, Register[Any]] = {}
    counts_from = document["family"]["counts_from"]
    for declare in (reading, setting, command):
        for name, table in document.get(declare.__name__, {}).items():
            found[name] = _register(declare, name, dict(table), counts_from)
    return found


def _register(declare: Any, name: str, given: dict[str, Any], counts_from: int) -> Register[Any]:
    at = given.pop("at")
    address = int(at) - 40001 if isinstance(at, str) else at - counts_from
    what: Any = given.pop("unit", "")
    if "bits" in given:
        what = IntFlag(name, {bit: 1 << at for bit, at in given.pop("bits").items()})
    elif "values" in given:
        what = IntEnum(name, given.pop("values"))
    details = {key: tuple(value) if isinstance(value, list) else value for key, value in given.items()}
    if "kept" in details:
        details["kept"] = Kept[details["kept"].upper()]
    if "number_format" in details:
        details["number_format"] = NumberFormat[details["number_format"]]
    if "table" in details:
        details["table"] = _TABLES[details["table"]]
    return declare(address, what, **details)


def mistakes_of(document: Mapping[str, Any]) -> list[str]:
    """Return what is told about the verbs of a document."""
    place = TomlPlace(Path("file.toml"))
    add_verbs(_namespace(document), document, registers_of(document), place)
    return place.config_errors


def class_of(document: Mapping[str, Any]) -> type[Drive]:
    """Return the class of a document without mistakes."""
    place, registers = TomlPlace(Path("file.toml")), registers_of(document)
    namespace = _namespace(document) | registers
    add_verbs(namespace, document, registers, place)
    assert place.config_errors == []
    return type("FromFile", (Drive,), namespace)


def _namespace(document: Mapping[str, Any]) -> dict[str, Any]:
    family = document["family"]
    options = {
        name: Option(option["unit"], tuple(option["span"]), option["meaning"])
        for name, option in document.get("option", {}).items()
    }
    return {
        "title": family["title"],
        "declared_in": "file.toml",
        "options": options,
        "most_registers": {HOLDING: family["together"]["holding"]} if "together" in family else {},
        "remote": family.get("remote", ""),
        "broadcasts": True,
    }
