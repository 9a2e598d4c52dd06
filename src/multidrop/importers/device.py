"""Collect an imported device's registers, and write them as a family file and a plant file."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from multidrop.drive.declaration_check import UNIT_IDS, DeclarationError, declaration_errors
from multidrop.drive.family import TAKEN_NAMES, Drive
from multidrop.drive.line_settings import SERIAL_ADDRESSES
from multidrop.drive.register import HOLDING, Access, Register
from multidrop.drive.text import Text
from multidrop.families.files.notation import Counting, sent_as
from multidrop.families.files.registers import MOST_BYTES, MOST_REGISTERS, OF_ENUMERATIONS, Declared, unusable
from multidrop.families.files.sections import MOST_TEXTS, texts_of
from multidrop.printable import is_whole, printable
from multidrop.toml_check import TomlPlace
from multidrop.toml_document import parse_document

UNKNOWN_HOST = "HOST"
_HOST = re.compile(r"[A-Za-z0-9_.:-]{1,200}|\[[0-9A-Fa-f:.]{1,100}\]")
_PORT = re.compile(r"[^!${}\s][^${}]*")  # a port name that is neither a YAML tag nor a variable
_PARITIES = {"n": "N", "none": "N", "e": "E", "even": "E", "o": "O", "odd": "O"}
# Serial formats that are possible if the source states none, by framing. ASCII frames may have 7 data bits.
_FORMATS = {"rtu": ("8N1", "8E1", "8O1", "8N2"), "ascii": ("7E1", "7O1", "7N2", "8N1", "8E1", "8O1", "8N2")}


@dataclass(frozen=True)
class LineSettings:
    """The settings of a line. "" means an unknown port or format, 0 an unknown baud rate."""

    port: str = ""
    baudrate: int = 0
    format: str = ""
    framing: str = "rtu"

    def drive_keys(self) -> dict[str, Any]:
        """Return the line settings as keys of a drive in a plant file.

        On a network line, this is only the framing.
        """
        found: dict[str, Any] = {"framing": self.framing} if self.framing != "rtu" else {}
        if self.is_network:
            return found
        if self.baudrate in Drive.baudrates:
            found["baudrate"] = self.baudrate
        if self.format in _FORMATS[self.framing]:
            found["format"] = self.format
        return found

    def __str__(self) -> str:
        stated = [str(self.baudrate)] * bool(self.baudrate) + [self.format] * bool(self.format)
        return "" if self.is_network else ", ".join(stated)

    @property
    def is_network(self) -> bool:
        return "://" in self.port


UNKNOWN_LINE = LineSettings()


def serial_settings(
    given: Mapping[str, Any],
    *,
    port: Any = "",
    framing: Any = "rtu",
    keys: Sequence[str] = ("baud_rate", "data_bits", "parity", "stop_bits"),
) -> LineSettings:
    """Return the settings of a serial line.

    `keys` are the names of four entries in `given`: baud rate, data bits, parity, stop bits.
    """
    baudrate, bits, parity, stop = (given.get(key, "") for key in keys)
    parity = _PARITIES.get(str(parity).lower(), "")
    bits, stop = _whole(bits) or 8, _whole(stop) or 1
    return LineSettings(
        port[:200] if isinstance(port, str) and _PORT.fullmatch(port) else "",
        _whole(baudrate),
        f"{bits}{parity}{stop}" if parity else "",
        "ascii" if str(framing).lower() == "ascii" else "rtu",
    )


def network_settings(
    host: Any, port: Any, *, is_serial_frames: bool = False, framing: str = "rtu"
) -> LineSettings:
    """Return the settings of a network line: Modbus TCP, or serial frames over a socket.

    An unknown host becomes the placeholder HOST, and an invalid port number becomes 502.
    """
    number = _whole(port)
    known = host if isinstance(host, str) and _HOST.fullmatch(host) else UNKNOWN_HOST
    known = f"[{known}]" if ":" in known and not known.startswith("[") else known
    place = f"{known}:{number if 0 < number < 1 << 16 else 502}"
    return LineSettings(f"{'socket' if is_serial_frames else 'tcp'}://{place}", framing=framing)


def _whole(given: Any) -> int:
    """Return a whole number, which may be given as text. Return 0 for other values."""
    if isinstance(given, str) and re.fullmatch(r"[0-9]{1,9}", given.strip()):
        given = int(given)
    return given if is_whole(given) and 0 < given < 10**9 else 0


WRITTEN = "it is written there; what a write does is not known here"
ONLY_WRITTEN = "is only written: a command is never imported"
MOST_ENTRIES = 20_000  # limit of entries in one file
_LONGEST_NAME = 50
_DECIMAL = re.compile(r"-?[0-9]{1,19}")
_ANY_BASE = re.compile(r"0[xX][0-9a-fA-F]{1,8}|0|[1-9][0-9]{0,5}")


# for each key of the source's schema: True if it may change a register's value, but is not imported
KeyTable = Mapping[str, bool]


def key_table(*, imported: str = "", irrelevant: str = "", gap: str = "") -> KeyTable:
    """Return the table of these keys, which are separated by spaces.

    An `irrelevant` key changes no value. For a `gap`, the family file has a comment.
    """
    return {**dict.fromkeys(f"{imported} {irrelevant}".split(), False), **dict.fromkeys(gap.split(), True)}


def unimported_keys(entry: Mapping[Any, Any], table: KeyTable) -> list[str]:
    """Return a sentence for each key of an entry that is not imported and may affect the register's value.

    Keys that the table lacks are included. Keys with empty or false values are ignored.
    """
    sentences = {True: "{} was not carried over", None: "{} is not known here, and was not carried over"}
    found = ((str(key)[:40], table.get(key)) for key, value in entry.items() if not is_empty(value))
    return [sentences[is_gap].format(key) for key, is_gap in found if is_gap in sentences]


def is_empty(value: Any) -> bool:
    """Return True if the value means that the key is not set; 0 counts as set."""
    return value is None or value is False or value in ("", [], {})


@dataclass
class ImportedRegister:
    """An imported register, with its address as in requests.

    `gaps` are sentences about its unknown properties; the family file lists them. `lacks` is a property that
    affects the value, but that a family file cannot declare: only the raw count of such a register is
    imported. A family file declares every register as read-only; `is_written` and `of_writes` are only for
    reports.
    """

    name: str
    address: int
    table: str = "holding"
    # the register's keys and values in the family file
    details: dict[str, Any] = field(default_factory=dict)
    gaps: list[str] = field(default_factory=list)
    lacks: str = ""
    is_read: bool = True
    is_written: bool = False
    of_writes: dict[str, Any] = field(default_factory=dict)  # more keys for a writable register

    def note_write(self, *, is_written: bool = True) -> None:
        """Record whether the program that made the file writes the register; if it does, add a gap."""
        self.is_written = is_written
        if is_written:
            self.gaps.append(WRITTEN)

    def put_names(self, key: str, pairs: Mapping[Any, Any]) -> None:
        """Add names of the register's values or bits. If names are invalid, add their number to `gaps`.

        If a value or bit has several names, the first is used.
        """
        names, found = UniqueNames(OF_ENUMERATIONS), dict[str, int]()
        for spelt, given in pairs.items():
            number = int(given) if isinstance(given, str) and _DECIMAL.fullmatch(given) else given
            if not is_whole(number) or number in found.values():
                continue
            found[names.free(str(spelt))] = number
        if len(found) < len(pairs):
            self.gaps.append(f"{len(pairs) - len(found)} of the names of its {key} were not carried over")
        if found:
            self.details[key] = found
            self.details.pop("unit", None)


@dataclass(frozen=True)
class Lost:
    """An entry that was not imported, with the reason. `is_entry` is False if only a key was not imported."""

    name: str
    reason: str
    is_entry: bool = True

    def __str__(self) -> str:
        return f"{self.name}: {self.reason}" if self.name else self.reason


@dataclass
class ImportedDevice:
    """A device: its readable registers, its commands, and the entries that could not be imported."""

    title: str = ""
    address: int | None = None
    registers: list[ImportedRegister] = field(default_factory=list)
    texts: list[ImportedRegister] = field(default_factory=list)
    commands: list[ImportedRegister] = field(default_factory=list)
    lost: list[Lost] = field(default_factory=list)
    readable: range = range(0)  # addresses of holding registers that one read may include, declared or not
    together: int = 0  # limit of registers in one read; 0: not stated
    line: LineSettings = UNKNOWN_LINE
    names: UniqueNames = field(default_factory=lambda: UniqueNames())

    def add(self, found: ImportedRegister, *, is_text: bool = False) -> None:
        """Add a register under a unique name. An invalid register is recorded as not imported."""
        if not is_whole(found.address):
            self.lose(found.name, f"its address {str(found.address)[:40]!r} is not a whole number")
            return
        if not 0 <= found.address <= 0xFFFF:
            self.lose(found.name, "its address is not from 0 to 65535")
            return
        spelt, found.name = found.name, self.names.free(found.name)
        if not found.is_read:
            self.lose(spelt, ONLY_WRITTEN)
            self.commands.append(found)
            return
        if spelt != found.name and "note" not in found.details and not is_text:
            found.details["note"] = spelt
        (self.texts if is_text else self.registers).append(found)

    def lose(self, name: str, reason: str, *, is_entry: bool = True) -> None:
        """Record an entry or a key as not imported, with the reason."""
        self.lost.append(Lost(name, reason, is_entry))

    @contextmanager
    def entry(self, name: str) -> Iterator[None]:
        """Record the entry as not imported if the block raises an error.

        Raises ValueError if there are too many entries.
        """
        if len(self.registers) + len(self.texts) + len(self.lost) >= MOST_ENTRIES:
            raise ValueError(f"the file has more than {MOST_ENTRIES} entries; no device has so many")
        try:
            yield
        except KeyError as failure:
            self.lose(name, f"it has no {str(failure.args[0])[:40]}")
        except (ValueError, OverflowError) as failure:
            self.lose(name, f"it cannot be read: {str(failure)[:200]}")
        except (AttributeError, TypeError, IndexError) as failure:
            self.lose(name, f"it is not laid out as an entry: {type(failure).__name__} {str(failure)[:100]}")

    def lose_keys(self, place: str, given: Mapping[Any, Any], table: KeyTable) -> None:
        """Record which keys of a device or a line are not imported."""
        for sentence in unimported_keys(given, table):
            self.lose(place, sentence, is_entry=False)


class UniqueNames:
    """Makes unique Python names that are close to the given spelling."""

    def __init__(self, taken: Collection[str] = TAKEN_NAMES) -> None:
        self._taken = taken
        self._given = Counter[str]()

    def free(self, spelt: str) -> str:
        name = re.sub(r"[^A-Za-z0-9]+", "_", spelt[:200]).strip("_").lower()[:_LONGEST_NAME] or "register"
        if unusable(name) or name in self._taken:
            name = f"r_{name}"
        free = name
        while free in self._given:
            self._given[name] += 1
            free = f"{name}_{self._given[name]}"
        self._given[free] = 1
        return free


def unit_address(given: Any, key: str) -> int | None:
    """Return a device's unit id, 0 to 255; None if it is not stated. Raises ValueError for other values."""
    if given is None:
        return None
    number = int(given.strip(), 0) if isinstance(given, str) and _ANY_BASE.fullmatch(given.strip()) else given
    if not is_whole(number) or number not in UNIT_IDS:
        raise ValueError(f"{key} = {str(given)[:40]!r} is not a unit id from {UNIT_IDS[0]} to {UNIT_IDS[-1]}")
    return number


# ---- the family file and the plant file ----


MOST_LOST = 500  # limit of entries listed in the family file as not imported
UNKNOWN_PORT = f"the port, which the file does not state; tcp://{UNKNOWN_HOST}:502 if it is Modbus TCP"
_LONGEST = 200  # limit of characters in a text
_MOST_POINTS = 20  # limit of dots in a text, because the TOML parser is slow on lines with many dots

_ORDER = (
    *("unit", "values", "bits", "step", "offset", "number_format", "order", "part", "invalid"),
    *("scale_register", "length", "place", "note", "title"),
)


def family_text(device: ImportedDevice, source: str) -> str:
    """Return the text of a family file, which declares only readings and texts.

    Raises ValueError if the text would exceed the size limit of family files.
    """
    lines = [
        f"# Imported from {_comment(source)}: compare each line with the manual, and mend each `gap:`.",
        "# What could be written there is a reading here: make it a [setting] or a [command] once the manual",
        "# says what a write does, whether it is kept in EEPROM, and what is harmless.",
        "[family]",
        f"title = {_value(device.title or source)}  # gap: maker and type",
        f"manual = {_value(f'not stated: imported from {source}')}  # gap: the document and its version",
        "counts_from = 0  # the addresses below are those that are sent",
        _line_gap(device),
    ]
    if device.address is not None and device.address not in SERIAL_ADDRESSES:
        lines.append("addresses = [0, 255]  # unit ids of Modbus TCP")
    if device.together:
        lines.append(f"together = {{ holding = {device.together}, input = {device.together} }}")
    if device.readable:
        first, last = (sent_as(at, "holding") for at in (device.readable[0], device.readable[-1]))
        lines.append(f"gaps = {{ holding = [{first}, {last}] }}")
    for section, registers in (("reading", device.registers), ("text", device.texts)):
        if registers:
            lines += ["", f"[{section}]"]
        for register in registers:
            gaps = [
                *register.gaps,
                *([f"only its count is read: {register.lacks}"] if register.lacks else ()),
            ]
            lines += [*(f"# gap: {register.name}: {_comment(gap)}" for gap in gaps), entry_line(register)]
    if device.lost:
        left = len(device.lost) - MOST_LOST
        lines += ["", "# Not carried over:"]
        lines += [f"# - {_comment(str(lost))}" for lost in device.lost[:MOST_LOST]]
        lines += [f"# - and {left} more"] if left > 0 else []
    text = "\n".join([*lines, ""])
    if len(text.encode()) > MOST_BYTES:
        raise ValueError(
            f"the family file of {_comment(device.title)!r} would have more than {MOST_BYTES} bytes"
        )
    return text


def plant_text(device: ImportedDevice, family_file: str) -> str:
    """Return the text of a plant file with this device.

    Raises ValueError if the device's address is unknown, or if it has no register to poll.
    """
    if not device.registers:
        raise ValueError(
            "no plant file can be made of this device: it has only text registers, which are never polled"
        )
    if device.address is None:
        raise ValueError(
            "no plant file can be made of this device, because the file does not state its address"
        )
    is_serial = device.address in SERIAL_ADDRESSES
    if not is_serial and device.line.port and not device.line.is_network:
        raise ValueError(
            f"no plant file can be made of this device: its address {device.address} is valid only on Modbus "
            f"TCP, and its port {device.line.port} is serial"
        )
    port = device.line.port or ("/dev/ttyUSB0" if is_serial else f"tcp://{UNKNOWN_HOST}:502")
    return "\n".join(
        [
            "[[line]]",
            'name = "line-1"',
            f"port = {_value(port)}  # gap: {'the port' if device.line.port else UNKNOWN_PORT}",
            "",
            "[[line.drive]]",
            f"name = {_value(f'device-{device.address}')}",
            f"model = {_value(family_file)}",
            f"address = {device.address}",
            *(f"{key} = {_value(value)}" for key, value in device.line.drive_keys().items()),
            "",
        ]
    )


def _line_gap(device: ImportedDevice) -> str:
    wanted = "baudrates, formats" if device.together else "baudrates, formats, together"
    there = f"; there it is {_comment(str(device.line))}" if str(device.line) else ""
    return f"# gap: {wanted}: what the manual says of the line{there}"


def entry_line(register: ImportedRegister) -> str:
    """Return the TOML line that declares the register in its section of the family file."""
    parts = [f"at = {sent_as(register.address, register.table)}"]
    if register.table != "holding":
        parts.append(f"table = {_value(register.table)}")
    parts += [f"{key} = {_value(register.details[key])}" for key in _ORDER if key in register.details]
    return f"{register.name} = {{ {', '.join(parts)} }}"


def _value(value: Any) -> str:
    """Return a value in TOML notation, on one line."""
    if isinstance(value, dict):
        pairs = (f"{name} = {_value(given)}" for name, given in value.items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, str):
        text = "".join(character if character.isprintable() else " " for character in _short(value))
        return json.dumps(text, ensure_ascii=False)
    return repr(value)


def _comment(text: str) -> str:
    return printable(_short(text).replace("\n", " "))


def _short(text: str) -> str:
    return text[:_LONGEST].replace(".", " ") if text[:_LONGEST].count(".") > _MOST_POINTS else text[:_LONGEST]


_PLACE = Path("entry")


def drop_undeclarable(device: ImportedDevice) -> None:
    """Move registers and texts that no family can declare to the device's `lost`, with the error."""
    held = _keep(device, device.registers, declare, MOST_REGISTERS, "registers")
    _keep(device, device.texts, declare_text, MOST_TEXTS, "texts")
    _drop_conflicts(device, held)


def _keep(
    device: ImportedDevice,
    listed: list[ImportedRegister],
    declare: Callable[[ImportedRegister], Any],
    most: int,
    kind: str,
) -> dict[str, Any]:
    """Remove the entries from `listed` that no family can declare. Return the declarations by name."""
    held: dict[str, Any] = {}
    kept: list[ImportedRegister] = []
    for found in listed:
        if len(kept) == most:
            device.lose(found.name, f"a family has at most {most} {kind}")
            continue
        try:
            held[found.name] = declare(found)
        except ValueError as refusal:
            device.lose(found.name, str(refusal))
        else:
            kept.append(found)
    listed[:] = kept
    return held


def declare(found: ImportedRegister, access: Access = Access.READING) -> Register[Any]:
    """Return the register that the family file declares. Raises ValueError with all errors."""
    place = TomlPlace(_PLACE)
    declared = Declared(Counting(0), {}, "single")
    ((name, given),) = parse_document(entry_line(found).encode()).items()
    if access is not Access.READING:
        given |= found.of_writes
    declared.add(name, access, given, place, declared.counting.address)
    mistakes = [mistake.removeprefix(f"{_PLACE}: ") for mistake in place.config_errors]
    if not mistakes:
        wrong = declaration_errors(declared.registers, TAKEN_NAMES, ())
        mistakes = [mistake.removeprefix(f"{name}: ") for mistake in wrong]
    if mistakes:
        raise ValueError("; ".join(mistakes))
    return declared.registers[name]


def declare_text(found: ImportedRegister) -> Text:
    """Return the text register that the family file declares. Raises ValueError with all errors."""
    place = TomlPlace(_PLACE)
    texts = texts_of(parse_document(entry_line(found).encode()), Counting(0), {}, place)
    if place.config_errors:
        label = f"{_PLACE}: [text] {found.name}: "
        raise ValueError("; ".join(mistake.removeprefix(label) for mistake in place.config_errors))
    return texts[found.name]


def _drop_conflicts(device: ImportedDevice, held: dict[str, Register[Any]]) -> None:
    """Remove references to scale registers, and then registers, until they form a valid drive class."""
    by_name = {found.name: found for found in device.registers}
    gaps = {HOLDING: device.readable} if device.readable else {}
    while wrong := _conflicts({**held, "readable_gaps": gaps}):
        named = {name: sentence for name, sentence in wrong.items() if name in by_name}
        if not named:
            raise ValueError(f"the file's registers cannot form one family: {'; '.join(wrong.values())}")
        for name, sentence in named.items():
            found = by_name[name]
            if found.details.pop("scale_register", None):
                found.lacks = sentence
                held[name] = declare(found)
            else:
                device.registers.remove(found)
                del held[name], by_name[name]
                device.lose(name, sentence)


def _conflicts(members: dict[str, Any]) -> dict[str, str]:
    """Return the errors of a class with these members, by register name; {} if the class is valid."""
    try:
        type("Imported", (Drive,), {"__doc__": "Of an importer.", **members})
    except DeclarationError as refusal:
        split = [mistake.partition(": ") for mistake in refusal.mistakes]
        return {name: sentence for name, _, sentence in split}
    return {}
