"""Parameter files: TOML and CSV, and the CSV of a public backup tool for INVT's GD20."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from multidrop.drive.parameters import Parameter, parameters_of
from multidrop.errors import Unsupported
from multidrop.params.values import ParameterSet
from multidrop.printable import is_whole, plain_whole, printable
from multidrop.toml_document import DocumentError, parse_document, read_bounded

FORMAT = 1  # version of the file format; files with a higher number are refused
MOST_BYTES = 1_000_000
FACTS = ("model", "title", "firmware", "saved")
COLUMNS = ("code", "raw", "name", "value", "factory")
GD20_COLUMNS = {"grupo_parametro", "codigo_funcao", "valor_parametro"}
GD20_MODEL = "invt-goodrive"
_FACT = re.compile(r"#\s*(\w+):\s*(.*?)\s*$")


def is_parameter_file(path: Path | str) -> bool:
    """Return True if the path ends in .csv, or is a TOML file with parameters."""
    path = Path(path)
    if path.suffix.lower() == ".csv":
        return True
    if path.suffix.lower() != ".toml" or not path.is_file():
        return False
    try:
        return "parameters" in parse_document(read_bounded(path, MOST_BYTES, "parameter file"))
    except ValueError:
        return False


def load(path: Path | str) -> ParameterSet:
    """Return the parameters in a TOML or CSV file. Raises ValueError if the file is invalid."""
    path = Path(path)
    # a serial port is not opened, because reading it would take bytes from its drives
    if path.exists() and not path.is_file():
        raise ValueError(f"{path}: this is not a file, but a directory or a device; name a parameter file")
    try:
        data = read_bounded(path, MOST_BYTES, "parameter file")
        facts, values = _from_csv(data) if path.suffix.lower() == ".csv" else _from_toml(data)
    except DocumentError as mistake:
        raise ValueError(mistake.in_file(path)) from mistake
    except ValueError as mistake:
        raise ValueError(f"{path}: {mistake}") from mistake
    if not values:
        raise ValueError(f"{path}: the file has no parameters")
    return ParameterSet(values=values, source=str(path), **{"model": "", **facts})


def save(found: ParameterSet, path: Path | str, family: Any = None) -> None:
    """Write the parameters to a new TOML or CSV file; the path's suffix selects the format.

    Raises ValueError for another suffix, if the file exists, or if the set is empty. With `family`, a drive
    class, the file also shows names, units and factory values.
    """
    path = Path(path)
    check_name(path)
    if not found.values:
        raise ValueError(f"{found.source} returned no value of its parameters, so {path} is not written")
    text = to_csv(found, family) if path.suffix.lower() == ".csv" else to_toml(found, family)
    try:
        with path.open("x", encoding="utf-8", newline="\n") as file:
            file.write(text)
    except FileExistsError:
        raise ValueError(f"{path} exists already, and is not replaced: name another file") from None


def check_name(path: Path) -> None:
    """Raise ValueError if the suffix is not that of a parameter file, or the file exists."""
    if path.suffix.lower() not in (".toml", ".csv"):
        raise ValueError(f"{path}: a parameter file's name ends in .toml or .csv")
    if path.exists():
        raise ValueError(f"{path} exists already, and is not replaced: name another file")


# ---- TOML ----


def to_toml(found: ParameterSet, family: Any = None) -> str:
    """Return a parameter set as TOML: each code's raw count, with a comment if the parameter is declared."""
    facts = {name: getattr(found, name) for name in FACTS}
    lines = [f"format = {FORMAT}"]
    lines += [f'{name} = "{_plain(value)}"' for name, value in facts.items() if value]
    lines += ["", "[parameters]  # raw counts; the comments are not read back"]
    known = _known(family)
    for code, raw in found.values.items():
        name, value, factory = _words(known.get(code), raw)
        comment = f"  # {name} = {value}" if name else ""
        comment += f" (factory {factory})" if factory else ""
        lines.append(f'"{_plain(code)}" = {raw}{comment}')
    return "\n".join(lines) + "\n"


def _from_toml(data: bytes) -> tuple[dict[str, str], dict[str, int]]:
    document = parse_document(data)
    if "line" in document:
        raise ValueError(
            "this is a plant file, not a parameter file; to name one of its drives, write PLANT.toml DRIVE"
        )
    values = document.get("parameters")
    if not isinstance(values, dict):
        raise ValueError("this is not a parameter file: it has no [parameters]")
    _check_format(document.get("format"))
    facts = {name: str(document[name]) for name in FACTS if name in document}
    return facts, {code: _raw(code, raw) for code, raw in values.items()}


def _check_format(given: object) -> None:
    if isinstance(given, int) and given > FORMAT:
        raise ValueError(
            f"the file has format {given}, but this version of multidrop reads format {FORMAT}: "
            "use a newer version"
        )
    if given not in (None, FORMAT):
        raise ValueError(f"format = {given!r} is not supported; write format = {FORMAT}")


def _raw(code: str, raw: object) -> int:
    if is_whole(raw) and -(2**31) <= raw < 2**32:
        return raw
    raise ValueError(f"{code} = {raw!r} is not a raw count, such as 100")


# ---- CSV ----


def to_csv(found: ParameterSet, family: Any = None) -> str:
    """Return a parameter set as CSV with semicolons; `load` uses only the code and raw count columns."""
    out = io.StringIO()
    out.write(f"# format: {FORMAT}\n")
    for name in FACTS:
        if value := getattr(found, name):
            out.write(f"# {name}: {_plain(value)}\n")
    rows = csv.writer(out, delimiter=";", lineterminator="\n")
    rows.writerow(COLUMNS)
    known = _known(family)
    rows.writerows((code, raw, *_words(known.get(code), raw)) for code, raw in found.values.items())
    return out.getvalue()


def _from_csv(data: bytes) -> tuple[dict[str, str], dict[str, int]]:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        raise ValueError(f"the file is not text in UTF-8, from byte {failure.start} on") from failure
    lines = text.splitlines()
    facts = {match[1]: match[2] for line in lines if (match := _FACT.match(line))}
    if "format" in facts:
        number = facts.pop("format")
        _check_format(plain_whole(number) if number.isascii() and number.isdecimal() else number)
    table = [line for line in lines if line.strip() and not line.startswith("#")]
    delimiter = ";" if table and ";" in table[0] else ","
    rows = csv.DictReader(table, delimiter=delimiter)
    names = {(name or "").strip().lower(): name for name in rows.fieldnames or ()}
    facts = {name: value for name, value in facts.items() if name in FACTS}
    if is_gd20 := {*names} >= GD20_COLUMNS:
        facts = {"model": GD20_MODEL, **facts}
    elif not {"code", "raw"} <= {*names}:
        if GD20_COLUMNS - {"valor_parametro"} <= {*names}:
            raise ValueError("the file lists parameters without values; give a backup file of the PC tool")
        raise ValueError("this is not a parameter file: its first row does not name the columns code and raw")
    found: dict[str, int] = {}
    try:
        for row in rows:
            code = _gd20_code(row, names) if is_gd20 else (row[names["code"]] or "").strip()
            if code in found:
                raise ValueError(f"the parameter {code} is given twice")
            found[code] = _raw(code, _whole(row[names["valor_parametro" if is_gd20 else "raw"]]))
    except csv.Error as failure:
        raise ValueError(f"the file is not CSV: {failure}") from failure
    return facts, found


def _gd20_code(row: Mapping[str, str | None], names: Mapping[str, str]) -> str:
    return f"P{_whole(row[names['grupo_parametro']]):02}.{_whole(row[names['codigo_funcao']]):02}"


def _whole(text: str | None) -> int:
    return plain_whole((text or "").strip())


# ---- texts ----


def _known(family: Any) -> Mapping[str, Parameter]:
    try:
        return {} if family is None else parameters_of(family)
    except Unsupported:
        return {}


def _words(parameter: Parameter | None, raw: int) -> tuple[str, str, str]:
    """Return the name, value and factory value of a parameter as texts, empty if it is not declared."""
    if parameter is None or not parameter.is_declared:
        return "", "", ""
    default = parameter.default_raw
    return parameter.name, parameter.text(raw), "" if default is None else parameter.text(default)


def _plain(text: str) -> str:
    """Return the text without characters that need an escape in a TOML string, a comment or a CSV line."""
    return printable(text).replace("\\", "/").replace('"', "'")
