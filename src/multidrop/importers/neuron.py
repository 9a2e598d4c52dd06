"""Tags of EMQX Neuron's Modbus plugins: SLAVE!ADDRESS[.BIT][#ENDIAN][.LEN[H][L][D][E]] in one cell."""

from __future__ import annotations

import re
from dataclasses import dataclass

from multidrop.importers.device import ImportedDevice, ImportedRegister
from multidrop.importers.numbers import words_of

_TAG = re.compile(r"([0-9]{1,6})!([0-9]{1,9})(?:[.](\d{1,6})([HLDE]?))?(?:#([A-Z]{1,2}))?")
_ORDERS = {  # Neuron's Modbus TCP page, #ENDIAN: LL is 1,2,3,4
    **{"L": "", "LL": "", "LB": "BADC", "BL": "CDAB", "BB": "DCBA", "B": "DCBA"},
}
_OF_TEXTS = {"": "", "H": "", "L": "BA", "D": "B"}  # E is one character a register, in its high byte


@dataclass(frozen=True)
class Tag:
    """The parts of a tag's address; `part` is a bit, or a text's bytes."""

    slave: int
    address: str
    part: str
    of_text: str
    order: str


def parse_tag(cell: str) -> Tag | None:
    """Return the parts of such an address; None for a cell that is none."""
    match = _TAG.fullmatch(cell)
    if match is None:
        return None
    return Tag(int(match[1]), match[2], match[3] or "", match[4] or "", match[5] or "")


def order_of(register: ImportedRegister, tag: Tag, number: str) -> str:
    """Return the order of a number's bytes; notes a gap where the tag leaves it to its node."""
    if tag.order in _ORDERS:
        return _ORDERS[tag.order]
    if tag.order:
        register.lacks = f"its order of bytes #{tag.order}"
    elif words_of(number) > 1:
        register.gaps.append("its order of bytes is its node's; ABCD was assumed, as Neuron does")
    return ""


def add_text(device: ImportedDevice, register: ImportedRegister, tag: Tag) -> None:
    if not tag.part:
        device.lose(register.name, "a text of unknown length")
        return
    if tag.of_text not in _OF_TEXTS:
        device.lose(register.name, "a text of one character a register, in its high byte")
        return
    register.details.pop("note", None)
    length = int(tag.part)
    register.details["length"] = length if tag.of_text == "D" else (length + 1) // 2
    if order := _OF_TEXTS[tag.of_text]:
        register.details["order"] = order
    device.add(register, is_text=True)
