"""The frames printed in the documents, decoded manually; tests/data/frames.csv has their bytes.

E1 to E14 are errata of the ERMAN ER-G-220 protocol description v1.4, numbered as in docs and tests.
"""

from __future__ import annotations

import csv
import struct
from dataclasses import dataclass
from pathlib import Path

from multidrop.core import FrameFault, Framing, Message

FRAMINGS = {"rtu": Framing.RTU, "ascii": Framing.ASCII, "delixi": Framing.DELIXI}


def words(*values: int) -> bytes:
    return struct.pack(f">{len(values)}H", *values)


ON = words(0xFF00)


def _line(text: str) -> str:
    return f":{text}\\r\\n"


# The meaning of each printed request and of its printed replies. "same" is a reply that copies its request.
MEANING: dict[str, tuple[Message, dict[str, Message | FrameFault]]] = {
    "01 01 00 00 00 0C 3C 0F": (
        Message(1, 0x01, 0, 12),
        {
            "01 01 02 00 01 78 3C": Message(1, 0x01, 0, 12, bytes([0x00, 0x01])),
            "01 81 03 00 51": Message(1, 0x01, exception=3),
        },
    ),
    "01 03 00 01 00 04 15 C9": (
        Message(1, 0x03, 1, 4),
        {
            "01 03 08 01 00 01 F4 01 F4 00 32 25 C4": Message(1, 0x03, 1, 4, words(1 << 8, 500, 500, 50)),
            "01 83 03 01 31": Message(1, 0x03, exception=3),
        },
    ),
    "01 04 00 01 00 05 61 C9": (  # ERMAN erratum E1: here the checksum is corrected
        Message(1, 0x04, 1, 5),
        {
            # ERMAN erratum E2: wrong byte count
            "01 04 10 01 F4 00 00 00 D6 00 00 02 32 0A 03": FrameFault.BAD_LENGTH,
            "01 04 0A 01 F4 00 00 00 D6 00 00 02 32 7F 1B": Message(
                1, 0x04, 1, 5, words(500, 0, 214, 0, 562)
            ),
            "01 84 03 03 01": Message(1, 0x04, exception=3),
        },
    ),
    "01 05 00 00 FF 00 8C 3A": (
        Message(1, 0x05, 0, data=ON),
        {"same": Message(1, 0x05, 0, data=ON), "01 85 03 02 91": Message(1, 0x05, exception=3)},
    ),
    "01 06 00 01 01 1D 19 93": (  # ERMAN erratum E3: a valid frame, but it must never be sent
        Message(1, 0x06, 1, data=words(285)),
        {},
    ),
    "01 06 00 02 01 1D E9 93": (
        Message(1, 0x06, 2, data=words(285)),
        {"same": Message(1, 0x06, 2, data=words(285)), "01 86 03 02 61": Message(1, 0x06, exception=3)},
    ),
    "01 0F 00 00 00 09 02 01 01 25 2C": (  # ERMAN erratum E4: a valid frame, but it must never be sent
        Message(1, 0x0F, 0, 9, bytes([0x01, 0x01])),
        {"01 0F 00 00 00 09 95 CD": Message(1, 0x0F, 0, 9), "01 8F 03 04 31": Message(1, 0x0F, exception=3)},
    ),
    "01 10 00 0C 00 02 04 00 C8 01 90 73 F8": (
        Message(1, 0x10, 12, 2, words(200, 400)),
        {"01 10 00 0C 00 02 81 CB": Message(1, 0x10, 12, 2), "01 90 03 0C 01": Message(1, 0x10, exception=3)},
    ),
    "01 08 00 00 A5 37 DA 8D": (
        Message(1, 0x08, 0, data=words(0xA537)),
        {
            "same": Message(1, 0x08, 0, data=words(0xA537)),
            "01 89 01 86 50": Message(1, 0x08, exception=1),  # ERMAN erratum E13: 89H is a misprint of 88H
            "01 88 01 87 C0": Message(1, 0x08, exception=1),
        },
    ),
    "01 03 00 16 00 01 65 CE": (
        Message(1, 0x03, 22, 1),
        {"01 03 02 18 00 B2 44": Message(1, 0x03, 22, 1, words(0x1800))},
    ),
    "01 03 01 F4 00 01 C4 04": (
        Message(1, 0x03, 500, 1),
        {"01 03 02 13 88 B5 12": Message(1, 0x03, 500, 1, words(5000))},
    ),
    _line("010301F4000106"): (
        Message(1, 0x03, 500, 1),
        {_line("01030213885F"): Message(1, 0x03, 500, 1, words(5000))},
    ),
    _line("010701F400000000FD"): (
        Message(1, 7, 500, data=words(0, 0)),
        {_line("010701F40000138898"): Message(1, 7, 500, data=words(0, 5000))},
    ),
}

# Writes of one register: function 06, address, value.
for _text, _start, _value in (
    ("01 06 20 01 13 88 DE 9C", 0x2001, 5000),
    ("01 06 20 00 00 02 03 CB", 0x2000, 2),
    ("01 06 20 00 00 01 43 CA", 0x2000, 1),
    ("01 06 00 6B 00 C8 F9 80", 107, 200),
    ("01 06 20 00 00 12 02 07", 0x2000, 0x12),
    ("01 06 00 02 13 88 25 5C", 2, 5000),
    (_line("0106200113883D"), 0x2001, 5000),
    (_line("010620000002D7"), 0x2000, 2),
    (_line("010620000001D8"), 0x2000, 1),
    (_line("01060065000391"), 101, 3),
    (_line("0106006500058F"), 101, 5),
    (_line("010620000012C7"), 0x2000, 0x12),
    (_line("0106000213885C"), 2, 5000),
):
    _write = Message(1, 0x06, _start, data=words(_value))
    MEANING[_text] = _write, {"same": _write}

# Delixi's packets that set a value, with the fields K, P1P0 and D3..D0 of the manual.
for _text, _k, _p, _d in (
    (_line("010200020000000005"), 2, 2, 0),
    (_line("0104000100001388A1"), 4, 1, 5000),
    (_line("0106000200001388A4"), 6, 2, 5000),
):
    _write = Message(1, _k, _p, data=words(0, _d))
    MEANING[_text] = _write, {"same": _write}


@dataclass(frozen=True)
class Printed:
    """A row of frames.csv with its decoded message; a reply also has its request."""

    framing: Framing
    direction: str
    frame: bytes
    text: str
    verdict: str
    source: str
    says: Message | FrameFault
    request: Message | None = None
    request_frame: bytes = b""

    def __str__(self) -> str:
        return f"{self.source}: {self.direction} {self.text}"


def _bytes(text: str) -> bytes:
    if text.startswith(":"):
        return text.replace("\\r\\n", "\r\n").encode()
    return bytes.fromhex(text)


def _printed() -> list[Printed]:
    answers = {
        reply: (says, request, _bytes(text))
        for text, (request, replies) in MEANING.items()
        for reply, says in replies.items()
    }
    found = []
    with (Path(__file__).parents[2] / "data" / "frames.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            text, framing = row["bytes"], FRAMINGS[row["framing"]]
            common = (framing, row["direction"], _bytes(text), text, row["verdict"])
            source = f"{row['model']}, {row['source']}"
            if row["verdict"] == "bad checksum":
                found.append(Printed(*common, source, FrameFault.BAD_CHECKSUM))
            elif row["direction"] == "request":
                request, replies = MEANING[text]
                found.append(Printed(*common, source, request))
                if "same" in replies:
                    copy = (framing, "reply", _bytes(text), text, row["verdict"])
                    found.append(Printed(*copy, source, replies["same"], request, _bytes(text)))
            else:
                found.append(Printed(*common, source, *answers[text]))
    return found


PRINTED = _printed()
