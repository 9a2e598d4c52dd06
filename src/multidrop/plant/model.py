"""Plant: lines, their drives and the polled registers, as plain data."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Flag
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any, Final, NoReturn

from multidrop.core import RS485, Echo, TransactionIds
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import check_port
from multidrop.drive.named_verbs import verbs_of
from multidrop.drive.register import Register
from multidrop.planning.blocks import Planned, planned
from multidrop.planning.prediction import prediction_metadata
from multidrop.toml_check import Key, TomlPlace, check_period

MAY_LISTS: Final = {
    "write": Key(list, 'write = ["pump-1.frequency_setpoint"]'),
    "verbs": Key(list, 'verbs = ["pump-1.start"]'),
}
MAY_KEYS: Final = {**MAY_LISTS, "family": Key(dict, 'family.invt-che = { write = ["setpoint"] }')}


@dataclass(frozen=True)
class Polled:
    """A register that is read every `every` seconds; None means as fast as the line allows.

    Raises ValueError unless `every` is from 0.0001 to 86400 s, or None.
    """

    register: Register[Any]
    every: float | None = None

    def __post_init__(self) -> None:
        if self.every is not None:
            check_period(self.every)


@dataclass(frozen=True, init=False)
class PolledDrive:
    """A drive and its polled registers, each with its rate.

    `polls` lists registers of the drive or their names, or Polled for a register with a period of its own.
    Without `polls`, all readings of the drive are polled. `every` is the period of the others in s; None
    means as fast as the line allows.
    """

    drive: Drive
    polls: tuple[Polled, ...]

    def __init__(
        self,
        drive: Drive,
        polls: Iterable[Polled | Register[Any] | str] | None = None,
        *,
        every: float | None = None,
    ) -> None:
        wanted = drive.readings() if polls is None else polls
        object.__setattr__(self, "drive", drive)
        object.__setattr__(self, "polls", tuple(_polled(drive, one, every) for one in wanted))

    def __hash__(self) -> int:  # without the polls, because it is computed often
        return hash(self.drive)

    @property
    def wanted(self) -> list[tuple[Register[Any], float | None]]:
        """The polled registers with their periods in s, as `plan` takes them."""
        return [(poll.register, poll.every) for poll in self.polls]

    def at_rate(self, register: Register[Any] | None, every: float | None) -> PolledDrive:
        """Return a copy with another period in s for one register, or for all if `register` is None.

        Raises ValueError for a register that is not polled.
        """
        if register is not None and register not in [poll.register for poll in self.polls]:
            names = ", ".join(poll.register.name for poll in self.polls) or "nothing"
            raise ValueError(f"{register.name} of {self.drive.name} is not polled: that is {names}")
        polls = [
            Polled(poll.register, every) if register in (None, poll.register) else poll for poll in self.polls
        ]
        return PolledDrive(self.drive, tuple(polls))


def _polled(drive: Drive, wanted: Polled | Register[Any] | str, every: float | None) -> Polled:
    if isinstance(wanted, Polled):
        return wanted
    return Polled(drive.register(wanted) if isinstance(wanted, str) else wanted, every)


@dataclass(frozen=True)
class PlantLine:
    """A port with its drives; its baud rate and format are already in the drives' settings."""

    name: str
    port: str
    baudrate: int | None = None
    format: str | None = None
    drives: Sequence[PolledDrive] = ()  # kept as a tuple
    switching: float = 0.0  # s that the port takes to change baud rate or format
    echo: Echo = Echo.AUTO
    ids: TransactionIds = TransactionIds.MATCH
    rs485: RS485 = RS485.OFF
    settle: float = 0.0  # s of silence after the port is opened

    def __post_init__(self) -> None:
        object.__setattr__(self, "drives", tuple(self.drives))

    def at(self, port: str) -> PlantLine:
        """Return the same line at another port; without `rs485` if that is a network port."""
        return replace(self, port=port, rs485=RS485.OFF if "://" in port else self.rs485)


@dataclass(frozen=True)
class Plant:
    """All lines of a plant file, and its table `serve`, unchecked, which only the gateway reads.

    With `realtime`, the core's thread is scheduled before all normal threads; see Poller.
    """

    lines: Sequence[PlantLine]  # kept as a tuple
    path: Path = Path("plant")  # the plant file
    serve: Mapping[str, Any] = field(default_factory=dict, hash=False)
    realtime: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "lines", tuple(self.lines))

    @classmethod
    def load(cls, path: Path | str) -> Plant:
        """Return the plant that a file describes; no port is opened. Raises PlantError with all mistakes."""
        plant: Plant = import_module("multidrop.plant.loader").load_plant(path)  # avoids an import cycle
        return plant

    def find_line(self, name: str) -> PlantLine:
        """Return the line of this name. Raises ValueError with the nearest names if there is none."""
        found = next((line for line in self.lines if line.name == name), None)
        return found or self._unknown("line", name, (line.name for line in self.lines))

    def find_drive(self, name: str) -> tuple[PlantLine, Drive]:
        """Return the line and the drive of this name. Raises ValueError with the nearest names otherwise."""
        drives = {polled.drive.name: (line, polled.drive) for line in self.lines for polled in line.drives}
        return drives.get(name) or self._unknown("drive", name, drives)

    def _unknown(self, kind: str, name: str, names: Iterable[str]) -> NoReturn:
        names = list(names)
        near = difflib.get_close_matches(name, names, n=2)
        hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(names) or 'none'}"
        raise ValueError(f"{self.path} has no {kind} {name!r}; {hint}")

    def with_ports(self, ports: Mapping[str, str]) -> Plant:
        """Return the same plant with other ports, given by line name, such as those of a simulator.

        Raises ValueError for an unknown line, and if two lines would have the same port.
        """
        for name, port in ports.items():
            self.find_line(name)
            check_port(port)
        lines = tuple(line.at(ports.get(line.name, line.port)) for line in self.lines)
        owners: dict[str, str] = {}
        for line in lines:
            if line.port in owners:
                raise ValueError(f"lines {owners[line.port]} and {line.name} would both be at {line.port}")
            owners[line.port] = line.name
        return replace(self, lines=lines)

    def metadata(self) -> dict[str, Any]:
        """Return the metadata of a recording: versions, drives, registers, predictions."""
        return _metadata(self)


def current_for(period: float) -> float:
    """Return for how many seconds a polled value counts as current.

    `period` in s is the register's own period or the line's bus cycle, whichever is longer.
    """
    return max(1.0, 3 * period)


def planned_on(line: PlantLine, delays: Mapping[Drive, float] | None = None) -> list[Planned]:
    """Return the planned blocks of a line; `delays` are measured response delays in s."""
    known = delays or {}
    return [
        each
        for polled in line.drives
        for each in planned(polled.drive, polled.wanted, known.get(polled.drive))
    ]


def _metadata(plant: Plant) -> dict[str, Any]:
    from importlib.metadata import version  # imported here: a fifth of the import time of a poller

    return {
        "multidrop": version("multidrop"),
        "plant": str(plant.path),
        "planned": {line.name: prediction_metadata(planned_on(line), line.switching) for line in plant.lines},
        "drives": {
            polled.drive.name: _of_drive(line, polled) for line in plant.lines for polled in line.drives
        },
    }


def _of_drive(line: PlantLine, polled: PolledDrive) -> dict[str, Any]:
    drive = polled.drive
    return {
        "line": line.name,
        "model": drive.model,
        "address": drive.address,
        "settings": str(drive.settings),
        "framing": str(drive.framing),
        "registers": {poll.register.name: _of_register(poll.register) for poll in polled.polls},
    }


def _of_register(register: Register[Any]) -> dict[str, Any]:
    values = register.values
    return {
        "unit": register.unit,
        "step": register.step,
        "values": {member.name: member.value for member in values} if values else None,
        "bits": values is not None and issubclass(values, Flag),
        "function": register.table.read,
        "address": register.reach.start,
        "words": len(register.reach),
    }


def allowed(plant: Plant, table: Mapping[str, Any], place: TomlPlace) -> dict[str, frozenset[str]]:
    """Return the registers ("write") and verbs ("verbs"), as "drive.name", that a table `may` allows.

    `table` has checked values of MAY_KEYS. Errors are added to `place`. `stop` is never listed: it is always
    allowed.
    """
    found: dict[str, set[str]] = {key: set() for key in MAY_LISTS}
    for key, names in found.items():
        for entry in table.get(key, ()):
            names.update(place.attempt(_listed, plant, key, entry) or ())
    for model, lists in table.get("family", {}).items():
        inside = place.within(f"family {model}")
        drives = [drive for drive in _drives(plant) if drive.model == model]
        if not drives:
            inside.wrong(f"no drive has this model; the plant has {', '.join(sorted(_models(plant)))}")
        for key, entries in inside.check(lists, MAY_LISTS).items():
            for drive, entry in product(drives, entries):
                found[key].update(filter(None, [inside.attempt(_entry, key, drive, entry)]))
    return {key: frozenset(names) for key, names in found.items()}


def _drives(plant: Plant) -> list[Drive]:
    return [polled.drive for line in plant.lines for polled in line.drives]


def _models(plant: Plant) -> set[str]:
    return {drive.model for drive in _drives(plant)}


def _listed(plant: Plant, key: str, entry: object) -> list[str]:
    """Return what an entry such as "pump-1.start" or "pump-*.start" allows. Raises ValueError if it is wrong.

    `*` stands for any characters of a drive's name. Drives without the register or verb are left out, unless
    no drive has it.
    """
    name, dot, rest = entry.rpartition(".") if isinstance(entry, str) else ("", "", "")
    if not dot:
        raise ValueError(f"{key}: {entry!r} is not right; write {MAY_LISTS[key].example}")
    if "*" not in name or any(drive.name == name for drive in _drives(plant)):
        try:
            _, drive = plant.find_drive(name)
        except ValueError as unknown:
            raise ValueError(f"{key}: {str(unknown).replace(f'{plant.path} has', 'there is')}") from None
        return [_entry(key, drive, rest)]
    pattern = re.compile(".*".join(map(re.escape, name.split("*"))))
    found, refusals = [], [f"there is no drive {name!r}"]
    for drive in _drives(plant):
        if pattern.fullmatch(drive.name):
            try:
                found.append(_entry(key, drive, rest))
            except ValueError as refusal:
                refusals.append(str(refusal).removeprefix(f"{key}: "))
    if not found:
        raise ValueError(f"{key}: {entry} allows nothing: {refusals[-1]}")
    return found


def _entry(key: str, drive: Drive, name: object) -> str:
    """Return "drive.name" if a list may allow this register or verb. Raises ValueError if not."""
    entry = f"{drive.name}.{name}"
    if key == "write":
        try:
            register = drive.register(str(name))
        except ValueError as unknown:
            raise ValueError(f"{key}: {entry}: {unknown}") from None
        if not register.writable:
            raise ValueError(f"{key}: {entry} is never written: {register.never or 'it can only be read'}")
        return entry
    verbs = [verb for verb in verbs_of(drive) if verb != "stop"]
    if name not in verbs:
        known = ", ".join(verbs) or "none"
        raise ValueError(f"{key}: {drive.name} has no verb {name!r} that a list allows; it has {known}")
    return entry
