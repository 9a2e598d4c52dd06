"""RegisterAccess: a drive's read and write methods. Link: the methods of a bus that a drive calls.

The functions at the end check that a register belongs to a drive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, NoReturn, Protocol, TypeVar, cast, overload

from multidrop.drive.parameters import Parameter
from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.drive.verbs import CalledStop, Script, UnattachedStop
from multidrop.errors import NotAttached

T = TypeVar("T", bound=float)


class TextWanted(Exception):
    """Raised if a text is among the registers to read, because a text needs a request of its own."""


class Link(Protocol):
    """The methods of a bus that a drive calls; see the methods of the same names in Drive.

    Each method takes the drive as an argument. Bound methods would create a reference cycle, which keeps a
    removed drive in memory until a garbage collection.
    """

    @property
    def values(self) -> Any:
        """A function that takes a drive and registers, or their names, and returns their values by name.

        The function raises TextWanted if one of the registers is a text.
        """

    def text(self, drive: Any, text: Text) -> str: ...
    def write(self, drive: Any, register: Register[Any], value: Any) -> Any: ...
    def read_raw(
        self, drive: Any, function: int, start: int, count: int, expiry: float = ..., attempts: int = ...
    ) -> bytes: ...
    def send_raw(self, drive: Any, function: int, start: int, data: bytes, count: int) -> bytes: ...
    def perform(self, drive: Any, script: Script[Any]) -> Any: ...
    def begin_call(self, drive: Any, verb: str, seen: int) -> Any: ...
    def carry_out_move(self, drive: Any, script: Script[Any], call: Any) -> Any: ...
    def begin_stop(
        self, drive: Any, verb: str, make: Callable[[], Script[Any]], seconds: float | None
    ) -> CalledStop: ...


class NoLink:
    """The link of a drive that is not attached to a bus: each call raises NotAttached."""

    def _refuse(self, drive: Any, *details: Any, **options: Any) -> NoReturn:
        raise NotAttached(f"{drive.name} is not attached to a bus: use bus.attach(...)")

    values = text = write = read_raw = send_raw = perform = _refuse

    def begin_call(self, drive: Any, verb: str, seen: int) -> None:
        return None

    def carry_out_move(self, drive: Any, script: Script[Any], call: Any) -> Any:
        return drive.perform(script)

    def begin_stop(
        self, drive: Any, verb: str, make: Callable[[], Script[Any]], seconds: float | None
    ) -> CalledStop:
        return UnattachedStop(drive, make)


NO_LINK = NoLink()


class RegisterAccess:
    """Methods that read and write a drive's registers, which are given as objects or by name."""

    name: str
    link: Link
    registers: ClassVar[Mapping[str, Register[Any]]]
    texts: ClassVar[Mapping[str, Text]]
    _kind: Callable[[], str]
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
        """Return the value of a register or text in engineering units; for several, a dict by name.

        Registers may be given by name. They are read in as few requests as the family allows. Raises
        NoReply, BadReply, NoValue, DriveException or LineError if the read fails, ValueError for an unknown
        name, and NotAttached if the drive is not attached to a bus.
        """
        if not wanted:
            raise TypeError(f"read() of {self.name} needs registers or their names; read_all() reads all")
        found = self.read_many(wanted)
        return found if len(wanted) > 1 else next(iter(found.values()))

    def read_many(self, wanted: Iterable[Register[Any] | Text | str]) -> dict[str, Any]:
        """Return the values of any number of registers and texts, as a dict by name."""
        asked = tuple(wanted)
        try:
            return cast(dict[str, Any], self.link.values(self, asked))
        except TextWanted:
            return self._read_texts_too(asked)

    def read_all(self) -> dict[str, Any]:
        """Return the values of all readings by name. These are the registers that are polled by default."""
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
        """Write a value; return the value read back, or `value` if the register cannot be read.

        The write is sent once, or skipped if the register may be in EEPROM and already holds the value.
        The identity of the drive is checked before the first write to it.

        Raises WriteForbidden (also a ValueError) for a write that the library does not send, and TypeError
        for an invalid value. Raises Expired if the write cannot be sent within the bus's `expiry`. Raises
        DriveException if the drive refuses the write, and Unconfirmed if there is no reply, so that the write
        may have happened.
        """
        return self.try_write(register, value).value

    def try_write(self, register: Register[Any] | str, value: Any) -> Any:
        """Write like `write`, but if the write was sent, return its Outcome instead of raising an error."""
        known = self.register(register) if isinstance(register, str) else register
        return self.link.write(self, known, value)

    def read_raw(self, function: int, start: int, count: int, *, expiry: float = 1.0) -> bytes:
        """Read any addresses, whether or not they are declared as registers; return the reply's data.

        `function` is 1 (coils), 2 (discrete inputs), 3 (holding registers) or 4 (input registers). `start` is
        the address on the wire, from 0. `count` is the number of words or bits: at most 125 words or 2000
        bits, or the family's limit for one request. Words are returned as two bytes, most significant first;
        bits fill whole bytes from the least significant bit of the first byte. The functions 7 (exception
        status), 17 (server id) and 43 (device identification) read no addresses: `count` is 0, and so is
        `start`, except with 43: there it is the device id code times 256 plus the id of the first object.

        The request is sent once, before queued polling. The late reply to an earlier request is never
        returned. If there is no reply, the call waits for the timeout, and this counts as a failure of the
        drive. Raises Expired if the request cannot be sent within `expiry` seconds. Raises NoReply, BadReply,
        DriveException or LineError if it fails, and ValueError or TypeError if an argument is invalid.
        """
        return self.link.read_raw(self, function, start, count, expiry)

    def send_raw(self, function: int, start: int, data: bytes = b"", *, count: int = 0) -> bytes:
        """Send any request once, without checks, and return the reply's data. Modbus reads are refused.

        This deliberately bypasses the rules: no identity check, no limits, no EEPROM budget. It may start a
        motor. Raises Unconfirmed if there is no reply, DriveException if the drive refuses, and
        CancelledByStop or Expired if the request was not sent. Raises ValueError for functions that
        `read_raw` sends, such as 1 to 4.
        """
        return self.link.send_raw(self, function, start, data, count)


# ---- checks that a register belongs to the drive's family, because families use addresses differently ----


def check_drive(drive: RegisterAccess) -> None:
    """Raise TypeError unless `drive` is a Drive."""
    if not isinstance(drive, RegisterAccess):
        raise TypeError(f"{drive!r} is not a drive: pass the drive that bus.attach() returned")


def check_own(drive: RegisterAccess, register: Register[Any]) -> None:
    """Raise ValueError for a register of another family, TypeError if `register` is not a Register."""
    check_drive(drive)
    if not isinstance(register, Register):
        hint = "pass attributes of the drive, or drive.register(NAME), as separate arguments"
        raise TypeError(f"{register!r} is not a Register of {drive.name}: {hint}")
    is_parameter = isinstance(register, Parameter) and isinstance(drive, register.family)
    if not is_parameter and drive.registers.get(register.name) is not register:
        raise ValueError(
            f"this {register.name} is not a register of {drive.name}, which is a {drive._kind()}"
        )


def check_readable(drive: RegisterAccess, register: Register[Any]) -> None:
    """Raise ValueError if the register cannot be read."""
    if not register.readable:
        kind = register.access.value
        raise ValueError(f"{register.name} of {drive.name} cannot be read: it is declared as a {kind}")


def check_own_text(drive: RegisterAccess, text: Text) -> None:
    """Raise ValueError for a text register of another family, TypeError if `text` is not a Text."""
    check_drive(drive)
    if not isinstance(text, Text):
        raise TypeError(
            f"{text!r} is not a Text: use an attribute of {drive.name}, or {drive.name}.texts[NAME]"
        )
    if drive.texts.get(text.name) is not text:
        raise ValueError(f"this {text.name} is not a text of {drive.name}, which is a {drive._kind()}")
