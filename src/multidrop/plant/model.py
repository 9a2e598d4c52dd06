"""Plant: its lines, their drives and the polled registers, as plain data."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from enum import Flag
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any, Final, NoReturn, TypeVar
from unicodedata import normalize

import multidrop
from multidrop.channels import Channel, DriveSeries
from multidrop.core import RS485, Echo, EchoMode, RS485Mode, TransactionIds, TransactionMode
from multidrop.drive.family import Drive, verbs_of
from multidrop.drive.line_settings import check_port
from multidrop.drive.register import Register
from multidrop.drive.verbs import LISTED_VERBS
from multidrop.planning.blocks import Planned, planned
from multidrop.planning.prediction import predict, prediction_metadata
from multidrop.printable import did_you_mean, is_whole
from multidrop.toml_check import Key, TomlPlace, check_period, json_schema

_VERB = f"({'|'.join(LISTED_VERBS)})"


def _entries(pattern: str) -> dict[str, Any]:
    return {"items": {"type": "string", "pattern": f"^{pattern}$"}}


MAY_LISTS: Final = {
    "write": Key(list, 'write = ["pump-1.frequency_setpoint"]', keywords=_entries(r".+\.[A-Za-z]\w*")),
    "verbs": Key(list, 'verbs = ["pump-1.start"]', keywords=_entries(rf".+\.{_VERB}")),
}
_OF_A_FAMILY = {
    "write": Key(list, 'write = ["setpoint"]', keywords=_entries(r"[A-Za-z]\w*")),
    "verbs": Key(list, 'verbs = ["start"]', keywords=_entries(_VERB)),
}
MAY_KEYS: Final = {
    **MAY_LISTS,
    "family": Key(
        dict,
        'family.invt-che = { write = ["setpoint"] }',
        keywords={"additionalProperties": json_schema(_OF_A_FAMILY)},
    ),
}
FLEET_KEYS: Final = {"may": Key(dict, "[fleet.may], a table", keywords=json_schema(MAY_KEYS))}


T = TypeVar("T")


@dataclass(frozen=True, init=False)
class Polled:
    """A register that is read every `every` seconds; None means as fast as the line allows.

    A PolledDrive replaces a name by the drive's register, and "*" by all readings that have no other entry.
    Raises ValueError unless `every` is None or from 0.0001 to 86400 s.
    """

    register: Register[Any]
    every: float | None

    def __init__(self, register: Register[Any] | str, every: float | None = None) -> None:
        if every is not None:
            check_period(every)
        object.__setattr__(self, "register", register)
        object.__setattr__(self, "every", every)


@dataclass(frozen=True, init=False)
class PolledDrive:
    """A drive and its polled registers, each with its period.

    `poll` lists registers of the drive, their names, or Polled objects for registers with their own period.
    "*" stands for all readings that have no other entry. Without `poll`, all readings are polled. `every` is
    the period in s of registers without their own; None means as fast as the line allows. `channels` are
    computed from registers of this drive and of others.
    """

    drive: Drive
    polls: tuple[Polled, ...]
    channels: tuple[Channel, ...]

    def __init__(
        self,
        drive: Drive,
        poll: Iterable[Polled | Register[Any] | str] | None = None,
        *,
        every: float | None = None,
        channels: Iterable[Channel] = (),
    ) -> None:
        if not isinstance(drive, Drive):
            raise TypeError(f"PolledDrive takes a drive such as YD1000(1), not {drive!r}")
        if isinstance(poll, (str, Register, Polled)):
            raise TypeError(
                "PolledDrive takes a list of registers, such as ['output_current'], not a single register"
            )
        wanted = ["*"] if poll is None else poll
        entries = [one if isinstance(one, Polled) else Polled(one, every) for one in wanted]
        object.__setattr__(self, "drive", drive)
        object.__setattr__(self, "polls", tuple(_polls(drive, entries)))
        object.__setattr__(self, "channels", tuple(channels))

    def __hash__(self) -> int:  # the polls are not hashed, because the hash is computed often
        return hash(self.drive)

    @property
    def wanted(self) -> list[tuple[Register[Any], float | None]]:
        """The polled registers with their periods in s, in the form that `plan` needs."""
        return [(poll.register, poll.every) for poll in self.polls]

    def at_rate(self, register: Register[Any] | None, every: float | None) -> PolledDrive:
        """Return a copy that polls `register` (None: every register) with another period in s.

        Raises ValueError for a register that is not polled.
        """
        if register is not None and register not in [poll.register for poll in self.polls]:
            names = ", ".join(poll.register.name for poll in self.polls) or "nothing"
            raise ValueError(
                f"{register.name} of {self.drive.name} is not polled; its polled registers are: {names}"
            )
        polls = [
            Polled(poll.register, every) if register in (None, poll.register) else poll for poll in self.polls
        ]
        return PolledDrive(self.drive, tuple(polls), channels=self.channels)

    @property
    def series(self) -> tuple[Polled, ...]:
        """The polled registers, and for each channel a placeholder register that is never read."""
        slowest = max((poll.every or 0.0 for poll in self.polls), default=0.0) or None
        return (*self.polls, *(Polled(channel.register, slowest) for channel in self.channels))

    def find_register(self, name: str) -> Register[Any]:
        """Return the register or the channel of this name. Raises ValueError if there is none."""
        found = (channel.register for channel in self.channels if channel.name == name)
        return next(found, None) or self.drive.register(name)


def _polls(drive: Drive, given: Iterable[Polled]) -> Iterator[Polled]:
    """Yield the polled registers of the entries `given`: see PolledDrive. Raises ValueError for repeats."""

    def known(name: Register[Any] | str) -> Register[Any] | str:
        return drive.register(name) if isinstance(name, str) and name != "*" else name

    entries = [(known(poll.register), poll.every) for poll in given]
    named = Counter(register for register, _ in entries)
    for register, count in named.items():
        if count > 1:
            raise ValueError(f"{register} of {drive.name} is in poll twice; remove one")
    for register, every in entries:
        if isinstance(register, str):  # "*"
            yield from (Polled(one, every) for one in drive.readings() if one not in named)
        else:
            yield Polled(register, every)


def _all_of(kind: type[T], given: Iterable[T], owner: str, name: str) -> tuple[T, ...]:
    """Return the given objects as a tuple. Raises TypeError unless they are a list of this class."""
    found = tuple(given) if isinstance(given, Iterable) else ()
    if isinstance(given, Iterable) and all(isinstance(one, kind) for one in found):
        return found
    raise TypeError(f"{owner} takes {name} as a list of {kind.__name__} objects, not {given!r}")


@dataclass(frozen=True)
class PlantLine:
    """A port with its drives; the baud rate and format apply to drives that are created without their own."""

    name: str
    port: str
    _: KW_ONLY
    baudrate: int | None = None
    format: str | None = None
    drives: Sequence[PolledDrive] = ()  # converted to a tuple
    switching: float = 0.0  # seconds that the port takes to change baud rate or format
    echo: EchoMode = Echo.AUTO
    transaction: TransactionMode = TransactionIds.MATCH
    rs485: RS485Mode = RS485.OFF
    settle: float = 0.0  # seconds of silence after the port is opened

    def __post_init__(self) -> None:
        if self.baudrate is not None and not is_whole(self.baudrate):
            raise TypeError(f"a line's baud rate is a whole number, not {self.baudrate!r}")
        object.__setattr__(self, "echo", Echo(self.echo))
        object.__setattr__(self, "transaction", TransactionIds(self.transaction))
        object.__setattr__(self, "rs485", RS485(self.rs485))
        object.__setattr__(self, "drives", _all_of(PolledDrive, self.drives, "PlantLine", "drives"))
        for polled in self.drives:
            polled.drive.take_settings(self.baudrate, self.format, None)

    def at(self, port: str) -> PlantLine:
        """Return a copy of the line at another port, without `rs485` if the new port is a network port."""
        return replace(self, port=port, rs485=RS485.OFF if "://" in port else self.rs485)


@dataclass(frozen=True, repr=False)
class Plant:
    """All lines of a plant file, and its table `serve`, which only the gateway uses and checks.

    If `realtime` is True, the thread of the C core gets a realtime priority; see Poller.
    """

    lines: Sequence[PlantLine]  # converted to a tuple
    path: Path = Path("plant")  # path of the plant file
    serve: Mapping[str, Any] = field(default_factory=dict, hash=False)
    realtime: bool = False
    totals: Path | None = None  # file with the totals of channels; None: the default file, see `totals_path`

    def __post_init__(self) -> None:
        if isinstance(self.lines, (str, Path)):
            raise TypeError(f"Plant takes lines; to load a plant file, write Plant.load({str(self.lines)!r})")
        object.__setattr__(self, "lines", _all_of(PlantLine, self.lines, "Plant", "lines"))

    def __repr__(self) -> str:
        lines = ", ".join(f"{line.name}: {len(line.drives)} drives" for line in self.lines)
        return f"<Plant {self.path}; {lines or 'no lines'}>"

    @classmethod
    def load(cls, path: Path | str) -> Plant:
        """Return the plant that a file describes; no port is opened. Raises PlantError with all mistakes."""
        # imported here to avoid an import cycle
        plant: Plant = import_module("multidrop.plant.loader").load_plant(path)
        return plant

    @property
    def drives(self) -> tuple[PolledDrive, ...]:
        """The drives of all lines, with their polled registers."""
        return tuple(polled for line in self.lines for polled in line.drives)

    def find_line(self, name: str) -> PlantLine:
        """Return the line of this name. Raises ValueError with the nearest names if there is none."""
        found = next((line for line in self.lines if line.name == name), None)
        return found or self._unknown("line", name, (line.name for line in self.lines))

    def find_drive(self, name: str) -> tuple[PlantLine, Drive]:
        """Return the line and the drive of this name.

        Raises ValueError with the nearest names if there is none.
        """
        drives = {polled.drive.name: (line, polled.drive) for line in self.lines for polled in line.drives}
        return drives.get(name) or self._unknown("drive", name, drives)

    def _unknown(self, kind: str, name: str, names: Iterable[str]) -> NoReturn:
        raise ValueError(f"{self.path} has no {kind} {name!r}; {did_you_mean(name, names)}")

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
                raise ValueError(
                    f"lines {owners[line.port]} and {line.name} would both use {line.port}; give each its own"
                )
            owners[line.port] = line.name
        return replace(self, lines=lines)

    def metadata(self) -> dict[str, Any]:
        """Return the metadata of a recording: versions, drives, registers and predictions."""
        return {
            "multidrop": multidrop.__version__,
            "plant": str(self.path),
            "planned": {
                line.name: prediction_metadata(planned_on(line), line.switching) for line in self.lines
            },
            "drives": {
                polled.drive.name: _of_drive(line, polled) for line in self.lines for polled in line.drives
            },
        }


def current_for(period: float) -> float:
    """Return for how many seconds a polled value is valid, if it is read every `period` seconds."""
    return max(1.0, 3 * period)


def planned_on(line: PlantLine, delays: Mapping[Drive, float] | None = None) -> list[Planned]:
    """Return the requests that poll a line; `delays` are measured response delays in s, by drive."""
    known = delays or {}
    return [
        each
        for polled in line.drives
        for each in planned(polled.drive, polled.wanted, known.get(polled.drive))
    ]


def series_of(plant: Plant, planned: Mapping[str, Any] | None = None) -> list[DriveSeries]:
    """Return the registers and channels from which channels are computed; [] if the plant has no channels.

    `planned` is `plant.metadata()["planned"]`; without it, the bus cycles are predicted here.
    """
    if not any(polled.channels for polled in plant.drives):
        return []
    found = []
    for line in plant.lines:
        if planned is None:
            cycle = predict(planned_on(line), switching=line.switching).cycle
        else:
            cycle = planned[line.name]["cycle_ms"] / 1e3
        for polled in line.drives:
            units = {
                poll.register.name: (
                    "" if poll.register.values else poll.register.value_unit,
                    current_for(max(cycle, poll.every or 0.0)),
                )
                for poll in polled.polls
            }
            drive = polled.drive
            found.append(DriveSeries(drive.name, units, drive.registers.keys(), polled.channels))
    return found


def _of_drive(line: PlantLine, polled: PolledDrive) -> dict[str, Any]:
    drive = polled.drive
    return {
        "line": line.name,
        "model": drive.model,
        "address": drive.address,
        "settings": str(drive.settings),
        "framing": str(drive.framing),
        "registers": {
            **{poll.register.name: _of_register(poll.register) for poll in polled.polls},
            **{one.name: {"unit": one.unit, "computed": one.value} for one in polled.channels},
        },
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
    """Return the registers ("write") and verbs ("verbs") that [serve.may] or [fleet.may] allows.

    Each has the form "drive.name". The keys and types in `table` are already checked. Errors are added to
    `place`. `stop` is never listed, because it is always allowed.
    """
    found: dict[str, set[str]] = {key: set() for key in MAY_LISTS}
    for key, names in found.items():
        for entry in table.get(key, ()):
            names.update(place.attempt(_listed, plant, key, entry) or ())
    for model, lists in table.get("family", {}).items():
        inside = place.within(f"family {model}", "family", model)
        drives = [polled.drive for polled in plant.drives if polled.drive.model == model]
        if not drives:
            models = {polled.drive.model for polled in plant.drives}
            inside.wrong(f"no drive has this model; the plant has {', '.join(sorted(models))}")
        for key, entries in inside.check(lists, _OF_A_FAMILY).items():
            for drive, entry in product(drives, entries):
                found[key].update(filter(None, [inside.attempt(_entry, key, drive, entry)]))
    return {key: frozenset(names) for key, names in found.items()}


def _listed(plant: Plant, key: str, entry: object) -> list[str]:
    """Return the registers or verbs, as "drive.name", that an entry such as "pump-*.start" allows.

    Matching drives without the register or verb are skipped. Raises ValueError if no drive has it.
    """
    name, dot, rest = entry.rpartition(".") if isinstance(entry, str) else ("", "", "")
    if not dot:
        raise ValueError(f"{key}: {entry!r} is not right; write {MAY_LISTS[key].example}")
    drives = {polled.drive.name: polled.drive for polled in plant.drives}
    if name in drives:
        return [_entry(key, drives[name], rest)]
    if "*" not in name:
        raise ValueError(f"{key}: there is no drive {name!r}; {did_you_mean(name, drives)}")
    pattern = re.compile(".*".join(map(re.escape, name.split("*"))))
    found, refusals = [], [f"there is no drive {name!r}"]
    for drive in drives.values():
        if pattern.fullmatch(drive.name):
            try:
                found.append(_entry(key, drive, rest))
            except ValueError as refusal:
                refusals.append(str(refusal).removeprefix(f"{key}: "))
    if not found:
        raise ValueError(f"{key}: {entry} matches no register or verb: {refusals[-1]}")
    return found


def _entry(key: str, drive: Drive, name: object) -> str:
    """Return "DRIVE.NAME" of a register or verb. Raises ValueError if it cannot be allowed."""
    entry = f"{drive.name}.{name}"
    if key == "write":
        try:
            register = drive.register(str(name))
        except ValueError as unknown:
            raise ValueError(f"{key}: {entry}: {unknown}") from None
        if not register.writable:
            raise ValueError(
                f"{key}: {entry} is never written: {register.never or 'the register can only be read'}"
            )
        return entry
    verbs = [verb for verb in verbs_of(drive) if verb in LISTED_VERBS]
    if name not in verbs:
        known = ", ".join(verbs) or "none"
        raise ValueError(f"{key}: {name!r} of {drive.name} cannot be allowed; choose from {known}")
    return entry


# ---- names of drives and lines ----


# Reserved names, each with the topic, path or key that already has the name.
RESERVED_NAMES: Final[Mapping[str, str]] = {
    "gateway": "the MQTT topic PREFIX/gateway",
    "stop": "the MQTT topic PREFIX/stop, which stops all drives",
    "alarms": "the MQTT topic PREFIX/alarms",
    "act": "the MQTT topic PREFIX/DRIVE/act, which takes verbs",
    "set": "the MQTT topics PREFIX/DRIVE/set/REGISTER, which take writes",
    "available": "the MQTT topic PREFIX/DRIVE/available",
    "told": "the MQTT topic PREFIX/DRIVE/told",
    "event": "rows of events, such as comments",
    ".": "this folder, in paths of files and URLs",
    "..": "the folder above, in paths of files and URLs",
    "__proto__": "a key of JavaScript's own, on the gateway's page",
}


def check_drive_name(name: str) -> bool:
    """Return True if a drive or a line may have this name. Raises ValueError if not."""
    if name in RESERVED_NAMES:
        raise ValueError(f'name "{name}" is reserved for {RESERVED_NAMES[name]}; give it another name')
    if name.startswith("-"):
        raise ValueError(f'name "{name}" begins with -, like the options of commands; give it another name')
    return True


def drive_meant(name: str, names: Iterable[str]) -> str:
    """Return the name in `names` that equals `name`, or that has the same Unicode normal form.

    If there is none, or more than one, return `name`. Use this only for stops and reads: a command that moves
    a motor must name it exactly.
    """
    names = [*names]
    if name in names:
        return name
    alike = [one for one in names if normalize("NFC", one) == normalize("NFC", name)]
    return alike[0] if len(alike) == 1 else name
