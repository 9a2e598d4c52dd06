"""Reads and writes of a drive, and Link: how a drive reaches its bus."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, NoReturn, Protocol, TypeVar, cast, overload

from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.errors import NotAttached

T = TypeVar("T", bound=float)


class TextWanted(Exception):
    """A text is among the registers to read: it needs requests of its own."""


class Link(Protocol):
    """The reads and writes of one bus; see the methods of Drive."""

    @property
    def values(self) -> Any:
        """Return registers' values by name, of a drive and a sequence of registers or their names.

        Raises TextWanted if one of them is a text.
        """

    def text(self, drive: Any, text: Text) -> str: ...
    def write(self, drive: Any, register: Register[Any], value: Any) -> Any: ...
    def read_raw(
        self, drive: Any, function: int, start: int, count: int, expiry: float = ..., attempts: int = ...
    ) -> bytes: ...
    def send_raw(self, drive: Any, function: int, start: int, data: bytes, count: int) -> bytes: ...


class NoLink:
    """The link of a drive that was never attached: every call raises NotAttached."""

    def values(self, drive: Any, registers: Sequence[Any]) -> NoReturn:
        raise not_attached(drive)

    def text(self, drive: Any, text: Text) -> NoReturn:
        raise not_attached(drive)

    def write(self, drive: Any, register: Register[Any], value: Any) -> NoReturn:
        raise not_attached(drive)

    def read_raw(
        self, drive: Any, function: int, start: int, count: int, expiry: float = 0.0, attempts: int = 1
    ) -> NoReturn:
        raise not_attached(drive)

    def send_raw(self, drive: Any, function: int, start: int, data: bytes, count: int) -> NoReturn:
        raise not_attached(drive)


def not_attached(drive: Any) -> NotAttached:
    """Return the error of a call that needs a bus."""
    return NotAttached(f"{drive.name} is not attached to a bus: use bus.attach(...)")


NO_LINK = NoLink()


class RegisterAccess:
    """The reads and writes of a drive's registers, by themselves or by their names."""

    name: str
    link: Link
    texts: ClassVar[Mapping[str, Text]]
    register: Callable[[str], Register[Any]]
    readings: Callable[[], tuple[Register[Any], ...]]

    @overload
    def read(self, register: Register[T], /) -> T: ...
    @overload
    def read(self, text: Text, /) -> str: ...
    @overload
    def read(self, name: str, /) -> Any: ...
    @overload
    def read(
        self,
        first: Register[Any] | Text | str,
        second: Register[Any] | Text | str,
        /,
        *more: Register[Any] | Text | str,
    ) -> dict[str, Any]: ...
    def read(self, *wanted: Register[Any] | Text | str) -> Any:
        """Return the value of a register or text in engineering units; of several, a dict by name.

        Registers may be given by their names. Several are read in as few requests as the family allows.
        Raises NoReply, BadReply, NoValue, DriveException or LineError if the read fails; ValueError for a
        name that the family does not have, and NotAttached.
        """
        if not wanted:
            raise TypeError(f"read of {self.name} takes registers or their names; read_all() reads all")
        found = self.read_many(wanted)
        return found if len(wanted) > 1 else next(iter(found.values()))

    def read_many(self, wanted: Iterable[Register[Any] | Text | str]) -> dict[str, Any]:
        """Return the values of any number of registers and texts by name, as `read` does of several."""
        asked = tuple(wanted)
        try:
            return cast(dict[str, Any], self.link.values(self, asked))
        except TextWanted:
            return self._read_texts_too(asked)

    def read_all(self) -> dict[str, Any]:
        """Return the values of all readings by name: the registers that a plant polls by default."""
        return self.read_many(self.readings())

    def _read_texts_too(self, wanted: Sequence[Register[Any] | Text | str]) -> dict[str, Any]:
        link = self.link
        known = [self.texts.get(one, one) if isinstance(one, str) else one for one in wanted]
        registers = tuple(one for one in known if not isinstance(one, Text))
        found = link.values(self, registers) if registers else {}
        found |= {text.name: link.text(self, text) for text in known if isinstance(text, Text)}
        return {one if isinstance(one, str) else one.name: found[str(one)] for one in wanted}

    @overload
    def write(self, register: Register[T], value: T) -> T: ...
    @overload
    def write(self, register: str, value: Any) -> Any: ...
    def write(self, register: Register[Any] | str, value: Any) -> Any:
        """Write a value and return the value that the drive then holds; `value` if that cannot be read.

        The write is sent once. It is skipped if the register may be in EEPROM and already holds the value.
        The identity of the drive is checked before the first write to it. Raises WriteForbidden (also a
        ValueError) for a write that the library does not send, TypeError for an invalid value, Expired if it
        cannot be sent within the bus's `expiry`, DriveException if the drive refuses, and Unconfirmed if no
        answer comes and the write may have happened.
        """
        return self.try_write(register, value).value

    def try_write(self, register: Register[Any] | str, value: Any) -> Any:
        """Write like `write`, and return the Outcome of a write that was sent, also if it failed."""
        known = self.register(register) if isinstance(register, str) else register
        return self.link.write(self, known, value)

    def read_raw(self, function: int, start: int, count: int, *, expiry: float = 1.0) -> bytes:
        """Return the data of any read request: addresses that need not be declared as registers.

        `function` is 1 (coils), 2 (discrete inputs), 3 (holding registers) or 4 (input registers). `start` is
        the address on the wire, from 0. `count` is the number of words or bits: at most 125 words or 2000
        bits, or the family's limit for one request. Words come as two bytes, the more significant first;
        bits fill whole bytes from the least significant bit of the first byte.

        The request is sent once, ahead of polling. A late reply to another request is never returned. A
        silent drive costs its timeout, and counts as a failure of the drive. Raises Expired if the request
        cannot be sent within `expiry` seconds, NoReply, BadReply, DriveException or LineError; ValueError or
        TypeError for an invalid request.
        """
        return self.link.read_raw(self, function, start, count, expiry)

    def send_raw(self, function: int, start: int, data: bytes = b"", *, count: int = 0) -> bytes:
        """Send any request but a Modbus read once, past all checks, and return the data of the reply.

        This is the one deliberate way around the rules: no identity check, no limits, no EEPROM budget. It
        may start a motor. Raises Unconfirmed if no answer comes, DriveException, CancelledByStop or Expired;
        ValueError for functions 1 to 4, which `read_raw` sends.
        """
        return self.link.send_raw(self, function, start, data, count)
