"""ManualFacts: what a family's manual says of its registers, its exceptions and its commands."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

from multidrop.drive.line_facts import LineFacts
from multidrop.drive.options import Option
from multidrop.drive.register import Access, Register
from multidrop.drive.table import Kept, Table
from multidrop.drive.text import Text

A = TypeVar("A")


class ManualFacts(LineFacts):
    """The tables of a family's manual, and what they say of a register by its name."""

    model: ClassVar[str] = ""
    declared_in: ClassVar[str] = ""  # name of the file that declares it; nobody tested such a family
    manual: ClassVar[str] = ""

    most_registers: ClassVar[Mapping[Table, int]] = {}  # in one read; the standard's where none is stated
    readable_gaps: ClassVar[Mapping[Table, range]] = {}  # reserved addresses that may be read across
    read_together: ClassVar[tuple[tuple[str, ...], ...]] = ()  # registers that share a request, in this order
    exceptions: ClassVar[Mapping[int, str]] = {
        1: "illegal function",
        2: "illegal address",
        3: "illegal value",
        4: "device failure",
        5: "acknowledged, still working",
        6: "busy",
    }
    damaged: ClassVar[frozenset[int]] = frozenset()  # those of a request that came damaged
    later: ClassVar[frozenset[int]] = frozenset({5, 6})  # those of a drive that will answer later
    broadcasts: ClassVar[bool] = False  # the document has broadcasts, which nobody answers
    identify_recognises: ClassVar[bool] = False  # a drive of another make does not pass `identify` by chance
    identity_proofs: ClassVar[tuple[Any, ...]] = ()  # of a family's file: registers with their values
    options: ClassVar[Mapping[str, Option]] = {}
    setpoint_name: ClassVar[str] = "frequency"  # the register that set_frequency writes
    remote: ClassVar[str] = "the drive must take its commands from the line"  # to be set on its keypad
    line_parameters: ClassVar[str] = ""  # those for its address, baud rate and format
    no_broadcasts: ClassVar[str] = "none documented"  # in words, where there are none
    watchdog: ClassVar[str] = "The document names no watchdog: the motor runs on when the client dies."

    registers: ClassVar[Mapping[str, Register[Any]]] = {}
    texts: ClassVar[Mapping[str, Text]] = {}

    @classmethod
    def _declared(cls, kind: type[A]) -> dict[str, A]:
        """Return the class's attributes of a kind by name, without those that a subclass has replaced."""
        found: dict[str, A] = {}
        for owner in reversed(cls.__mro__):
            for name, attribute in vars(owner).items():
                if isinstance(attribute, kind):
                    found[name] = attribute
                else:
                    found.pop(name, None)
        return found

    @classmethod
    def _in_ram(cls, name: str) -> str:
        if not isinstance(name, str):
            raise TypeError(f"ram takes names of registers, not {name!r}")
        register = cls.register(name)
        if register.kept is Kept.EEPROM:
            raise ValueError(f"{name} of {cls.title or cls.__name__} is in EEPROM, as its document says")
        return register.name

    @classmethod
    def register(cls, name: str) -> Register[Any]:
        """Return the register of this name; ValueError with the nearest names when there is none."""
        if not isinstance(name, str):
            first = next(iter(cls.registers), "speed")
            raise TypeError(f"a register has a name, such as {first!r}, and {name!r} is none")
        try:
            return cls.registers[name]
        except KeyError:
            near = difflib.get_close_matches(name, cls.registers, n=3)
            hint = f"did you mean {' or '.join(near)}?" if near else f"see `multidrop models {cls.model}`"
            raise ValueError(f"{cls.title or cls.__name__} has no register {name!r}; {hint}") from None

    @classmethod
    def readings(cls) -> tuple[Register[Any], ...]:
        """Return the registers that are polled by default."""
        return tuple(
            register
            for register in cls.registers.values()
            if register.access is Access.READING and register.readable
        )

    @property
    def ledger_name(self) -> str:
        """Name under which writes to its EEPROM are counted; two files of one name differ by their titles."""
        if self.declared_in:
            return f"{self.model}: {self.title}"
        return self.model or type(self).__name__

    @property
    def echo_probe(self) -> Register[Any] | None:
        """Register whose reply is never a copy of its request; None where no reply of the family is one.

        It is read first while it is unknown whether the adapter echoes.
        """
        return None

    def known_counts(self) -> Mapping[Register[Any], tuple[int, int]]:
        """Return registers that hold raw counts in a known range, from the least to the most.

        Where a family reads one register at a time, its replies differ in nothing else: only its value tells
        a late reply from another register's, so no two of the ranges may overlap.
        """
        return {}

    def __setattr__(self, name: str, value: object) -> None:
        if name in self.registers:
            raise AttributeError(f"{name} is a register, which bus.write(drive, drive.{name}, VALUE) writes")
        if name in self.texts:
            raise AttributeError(f"{name} is a text, which bus.read_text(drive, drive.{name}) reads")
        super().__setattr__(name, value)

    def exception(self, code: int) -> str:
        """Return the meaning of an exception code in this family."""
        return self.exceptions.get(code, "a code that the document does not explain")

    def is_passing(self, code: int) -> bool:
        """Return True where the request may be right, but came damaged or at a bad time."""
        return code in self.exceptions and code in self.damaged | self.later
