"""Text: a text in neighbouring registers of a drive. It is read on demand, and never polled."""

from __future__ import annotations

from dataclasses import dataclass, field

from multidrop.drive.number_format import arranged
from multidrop.drive.register import HOLDING, Table
from multidrop.printable import is_whole

_LAST_ADDRESS = 0xFFFF
MOST_WORDS = 125  # limit of one request, in registers
_ORDERS = ("AB", "BA", "B")  # order of a register's two characters; B: only one character, in the low byte


@dataclass(frozen=True, eq=False)
class Text:
    """A text of a drive: its address, its length in registers, and the order of characters in them.

    Raises ValueError if no request could read it.
    """

    address: int
    length: int
    table: Table = HOLDING
    order: str = "AB"
    place: str = ""
    name: str = field(default="", init=False)

    def __post_init__(self) -> None:
        if not is_whole(self.length) or not 1 <= self.length <= MOST_WORDS:
            raise ValueError(f"length = {self.length!r} of a text is not 1 to {MOST_WORDS} registers")
        if not is_whole(self.address) or not 0 <= self.address <= _LAST_ADDRESS + 1 - self.length:
            raise ValueError(f"a text starts at {self.address!r}; its registers must be within 0 to FFFFH")
        if self.order not in _ORDERS:
            raise ValueError(f"a text has order = {self.order!r}; it must be 'AB', 'BA' or 'B'")
        if not isinstance(self.table, Table) or self.table.read not in (0x03, 0x04):
            other = self.table.name if isinstance(self.table, Table) else self.table
            raise ValueError(f"a text has the table {other!r}; a text must be in holding or input registers")

    def __set_name__(self, owner: type, name: str) -> None:
        if not self.name:
            object.__setattr__(self, "name", name)

    def __str__(self) -> str:
        return self.name

    def decode(self, data: bytes) -> str:
        """Return the text in a reply's data, up to the first NUL and without trailing spaces.

        Bytes above 7FH are Latin-1. An unprintable character becomes a question mark.
        """
        if self.order == "BA":
            data = arranged(data, "BA")
        elif self.order == "B":
            data = data[1::2]
        found = data.partition(b"\0")[0].decode("latin-1").rstrip()
        return "".join(character if character.isprintable() else "?" for character in found)

    def encode(self, value: str) -> bytes:
        """Return a text as the bytes of its registers. Raises ValueError if the text is too long."""
        data = value.encode("latin-1")
        most = self.length * (1 if self.order == "B" else 2)
        if len(data) > most:
            raise ValueError(f"{self.name} can hold {most} characters, not {len(data)}")
        if self.order == "B":
            return b"".join(bytes((0, character)) for character in data.ljust(most, b"\0"))
        data = data.ljust(2 * self.length, b"\0")
        return arranged(data, "BA") if self.order == "BA" else data


def text(address: int, length: int, *, table: Table = HOLDING, order: str = "AB", place: str = "") -> Text:
    """Declare a text of `length` registers with two characters in each.

    With order "BA" the second character is in the high byte. With order "B" each register has only one
    character, in its low byte.
    """
    return Text(address, length, table, order, place)
