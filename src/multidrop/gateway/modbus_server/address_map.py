"""The address map: a table of all values of the Modbus server, for import into SCADA systems."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from multidrop import Register
from multidrop.core import NumberFormat
from multidrop.drive import Carrier, Text
from multidrop.gateway.http.rights import May, Right
from multidrop.gateway.modbus_server.settings import ModbusSettings, Unit, Units
from multidrop.gateway.modbus_server.words import NUMBERS, STATE, STOP, reading_function
from multidrop.printable import spreadsheet_text

# the exception code that a read gets if neither the gateway nor the drive has a current value
NO_ANSWER = "exception 0BH"
_WRITE_FUNCTIONS = {Carrier.BIT: 5, Carrier.WORD: 6}


class AddressRow(NamedTuple):
    """A value that Modbus clients can read or write.

    The value in the unit `unit` is number * step + offset. If `scale_address` is given, first multiply the
    number by ten to the power of the number at that address. None means that a column does not apply to this
    value.
    """

    line: str
    drive: str
    tcp_port: int
    unit_id: int
    status_address: int  # address of the drive's state in the common block, which is the same for all drives
    name: str
    title: str
    access: str  # "read", "write" or "read and write"
    function: int | None  # for reading
    write_function: int | None
    address: int  # address of the value in a request, counted from 0
    words: int  # number of 16-bit words; for coils and discrete inputs, number of bits
    format: str
    order: str = ""  # order of the bytes, such as "AB"; A is the most significant byte
    bits: str = ""  # which bits of the words the number has; "": all
    step: float | None = 1
    offset: float = 0
    scale_address: int | None = None
    unit: str = ""
    unknown: str = NO_ANSWER  # answer to a read while the value is unknown
    # origin of the value: "gateway": computed; "polled": polled from the drive; "drive": read on request
    source: str = "gateway"
    note: str = ""


# A function that makes an AddressRow of one drive. Its first argument is the name of the value in this row;
# the others are the row's remaining fields, `access` first.
MakeRow = Callable[..., AddressRow]


def address_map(
    units: Units, settings: ModbusSettings, ports: Mapping[str, int], may: May
) -> list[AddressRow]:
    """Return a row for each value of the units. A unit is a drive that clients can address.

    `ports` has the TCP ports by line.
    """
    rows: list[AddressRow] = []
    for port, number, unit in units:
        first = (unit.line, unit.drive.name, ports[port], number, settings.common + STATE)
        rows += _rows_of(unit, partial(_row, first), settings, may)
    return rows


def to_csv(rows: Sequence[AddressRow]) -> str:
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(AddressRow._fields)
    table.writerows([spreadsheet_text(one) if isinstance(one, str) else one for one in row] for row in rows)
    return out.getvalue()


def to_json(rows: Sequence[AddressRow]) -> str:
    """Return the table as JSON, with one row on each line."""
    # row by row, because all threads, including those of stops, wait until a call of json.dumps ends
    return "[\n" + ",\n".join(json.dumps(row._asdict(), allow_nan=False) for row in rows) + "\n]"


def _row(first: tuple[str, str, int, int, int], name: str, *others: Any, **more: Any) -> AddressRow:
    return AddressRow(*first, name, name.replace("_", " "), *others, **more)


def _rows_of(unit: Unit, make: MakeRow, settings: ModbusSettings, may: May) -> Iterator[AddressRow]:
    role = Right[settings.may.upper()]
    yield from _common_rows(unit, make, settings.common)
    if role >= Right.STOP:
        at, note = settings.common + STOP, "any number except 0 stops the drive"
        yield make("common_stop", "write", None, 6, at, 1, "u16", "AB", unknown="", note=note)
    for number, channel in enumerate(unit.channels.channels):
        at, name = settings.channels + 2 * number, channel.name
        note = f"computed: {channel.value}"
        yield make(name, "read", 3, None, at, 2, "f32", "ABCD", unit=channel.unit, unknown="NaN", note=note)
    may_write = may.write if role >= Right.WRITE else ()
    for register in unit.drive.registers.values():
        yield from _register_row(unit, make, register, settings.passing, may_write)
    if settings.passing != "off":
        yield from (_text_row(make, text) for text in unit.drive.texts.values())


def _common_rows(unit: Unit, make: MakeRow, common: int) -> Iterator[AddressRow]:
    setpoint = unit.drive.registers.get(unit.drive.setpoint_name)
    for one in NUMBERS:
        yield make(
            *(f"common_{one.name}", "read", 3, None),
            *(common + one.at, one.words, one.format, "ABCD"[: 2 * one.words]),
            step=one.step,
            unit=one.unit if one.unit is not None else setpoint.unit if setpoint else "",
            unknown=f"{one.unknown % (1 << 16 * one.words):0{4 * one.words}X}H",
            note=one.note,
        )


def _register_row(
    unit: Unit, make: MakeRow, register: Register[Any], passing: str, may_write: Container[str]
) -> Iterator[AddressRow]:
    """Yield the row of a register, if clients can read or write it."""
    carrier, name = register.table.carrier, register.name
    is_polled = name in unit.words.registers
    function = reading_function(register.table) if register.readable else 0
    is_read = bool(function) and (is_polled or passing != "off")
    is_written = f"{unit.drive.name}.{name}" in may_write and not register.commands
    is_written = is_written and unit.writable(carrier, register.address) is register
    if not is_read and not is_written:
        return
    write_function = _WRITE_FUNCTIONS[carrier] if register.words == 1 else 16
    part = (0, 7) if register.number_format is NumberFormat.I8 else register.part
    invalid = [str(count).removesuffix(".0") for count in register.invalid]
    yield make(
        *(name, " and ".join(["read"] * is_read + ["write"] * is_written)),
        *(function if is_read else None, write_function if is_written else None),
        *(register.address, register.words, register.number_format.name.lower()),
        order="" if carrier is Carrier.BIT else register.coding.wire_order,
        bits="{} to {}".format(*part) if part else "",
        step=register.step if register.step is not None else 1,
        offset=register.offset,
        scale_address=register.scaled_by.address if register.scaled_by else None,
        unit=register.value_unit,
        unknown=" or ".join([NO_ANSWER, *invalid]) if is_read else "",
        source="polled" if is_polled else "drive",
        note=register.note,
    )


def _text_row(make: MakeRow, text: Text) -> AddressRow:
    columns = ("read", reading_function(text.table), None, text.address, text.length, "text", text.order)
    return make(text.name, *columns, step=None, source="drive")
