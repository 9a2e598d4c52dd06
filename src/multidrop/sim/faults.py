"""Faults of simulated lines and drives: their rates in a TOML file, and a simulated wire that has them.

All random decisions derive from one seed.
"""

from __future__ import annotations

import math
import os
import random
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

from multidrop.drive.family import Drive
from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.motor import MotorDrive
from multidrop.sim.receiver import Frame
from multidrop.sim.wire import ReceiverGroup, Transmission, Wire
from multidrop.toml_check import Key, TomlPlace, duration_of
from multidrop.toml_document import read_document

MOST_BURST = 4096
RATE, DURATION, WHOLE = (int, float), str, int  # types of rates, durations and whole numbers in a faults file


def _rate(means: str, example: str = "0.01") -> Any:
    """Return a dataclass field for a fault's rate from 0 (never) to 1 (always)."""
    return field(default=0.0, metadata={"means": means, "example": example, "kind": RATE})


def _duration(default: float | None, example: str, means: str) -> Any:
    return field(default=default, metadata={"means": means, "example": f'"{example}"', "kind": DURATION})


def _whole(default: int, means: str, example: str) -> Any:
    return field(default=default, metadata={"means": means, "example": example, "kind": WHOLE})


def _check_rates(faults: Any) -> None:
    for name in rates_of(type(faults)):
        value = getattr(faults, name)
        if not 0 <= value <= 1:
            raise ValueError(f"{name} = {value!r} is not a rate; write one from 0 to 1, such as 0.01")


@dataclass(frozen=True, kw_only=True)
class DriveFaults:
    """The faults of one simulated drive. A damaged reply has one wrong bit, so every checksum detects it."""

    loss: float = _rate("of its replies are lost")
    damage: float = _rate("of its replies have one bit turned")
    delay: float = _rate("of its replies come late")
    late: float = _duration(0.1, "100 ms", "the longest delay")
    silence: float | None = _duration(None, "1 min", "it falls silent this often")
    silent_for: float = _duration(5.0, "5 s", "how long it is silent")
    trip: float | None = _duration(None, "1 min", "its running motor trips this often")
    first: float | None = _duration(None, "10 s", "until the first silence or trip; else random")
    drift: float = _rate("of the rated torque: its load moves by so much", "0.3")

    def __post_init__(self) -> None:
        _check_rates(self)


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Rates of a simulated line's faults, and the faults of its drives, by drive name.

    A frame has at most one of the faults `drop`, `flip` and `repeat`, so that every checksum detects it. A
    reply that comes after the response timeout looks like the reply to the next identical request.
    """

    seed: int = _whole(0, "the same one brings the same faults", "7")
    drop: float = _rate("of the frames lose a character")
    flip: float = _rate("of the frames have one bit turned")
    repeat: float = _rate("of the frames have one character twice")
    twice: float = _rate("of the replies come twice")
    delay: float = _rate("of the replies come late")
    late: float = _duration(0.1, "100 ms", "the longest delay")
    merge: float = _rate("of the replies wait, up to `late`, and come with the next")
    split: float = _rate("of the replies have a pause inside")
    pause: float = _duration(0.02, "20 ms", "the longest pause")
    echo: float = _rate("of the requests come back to the client")
    noise: float = _rate("of the requests have noise before them")
    start_noise: float = _rate("of the motors' starts bring noise")
    burst: int = _whole(32, "characters of noise at most", "32")
    hang_up: float = _rate("of the requests find the port gone")
    away: float = _duration(1.0, "1 s", "the longest time until it is back")
    rename: float = _rate("of the returns are under another name; the link follows")
    drives: Mapping[str, DriveFaults] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_rates(self)
        if not 1 <= self.burst <= MOST_BURST:
            raise ValueError(f"burst = {self.burst!r} is not a number of characters from 1 to {MOST_BURST}")


def rates_of(kind: type) -> list[str]:
    """Return the names of the fields whose value is a rate."""
    return [one.name for one in fields(kind) if one.metadata.get("kind") is RATE]


def _keys(kind: type) -> dict[str, Key]:
    found = [one for one in fields(kind) if one.metadata]
    return {one.name: Key(one.metadata["kind"], f"{one.name} = {one.metadata['example']}") for one in found}


def _help(kind: type) -> str:
    # zip stops before the last field, `drives`, which has no key of its own
    lines = zip(_keys(kind).values(), fields(kind), strict=False)
    return "".join(f"  {key.example:<20}{one.metadata['means']}\n" for key, one in lines)


HELP = (
    "The faults' file has these lines, all of which may be left out: then a rate\n"
    "and the seed are 0, and the longest times and bursts are as here.\n"
    f"{_help(Faults)}\nA table [drive.NAME] has the faults of one drive:\n{_help(DriveFaults)}"
)


def load_faults(path: Path | str, drives: Collection[str] | None = None) -> Faults:
    """Read faults from a TOML file.

    The file's tables may name only these `drives`; None allows any name. Raises ValueError with all mistakes
    in the file.
    """
    path = Path(path)
    place = TomlPlace.in_file(path)
    document = place.attempt(read_document, path, "faults' file") or {}
    tables = document.pop("drive", {})
    if not isinstance(tables, dict):
        place.wrong("drive is not a table; write [drive.NAME] before a drive's faults")
        tables = {}
    if drives is not None:
        place.within("[drive]", "drive").unknown(tables, dict.fromkeys(drives))
    line = _given(Faults, document, place)
    by_drive = {
        name: _given(DriveFaults, one, place.within(f'drive "{name}"', "drive", name))
        for name, one in tables.items()
    }
    if place.config_errors:
        raise ValueError("\n".join(place.config_errors))
    return Faults(**line, drives={name: DriveFaults(**one) for name, one in by_drive.items()})


def _given(kind: type, table: Any, place: TomlPlace) -> dict[str, Any]:
    """Return the valid entries of a table. Each other entry adds an error to `place`."""
    keys = _keys(kind)
    given = place.check(table, keys)
    for name in given:
        if keys[name].kind is DURATION:
            given[name] = duration_of(given, name, place)
    made = {name: place.attempt(partial(kind, **{name: value})) for name, value in given.items()}
    return {name: getattr(one, name) for name, one in made.items() if one is not None}


DAMAGES: Mapping[str, Callable[[bytes, int, int], bytes]] = {
    "drop": lambda frame, at, bit: frame[:at] + frame[at + 1 :],
    "flip": lambda frame, at, bit: frame[:at] + bytes([frame[at] ^ 1 << bit]) + frame[at + 1 :],
    "repeat": lambda frame, at, bit: frame[: at + 1] + frame[at:],
}
DRIFT_S = 20.0  # period in s of a load that changes slowly


class FaultyWire(Wire):
    """A wire with `faults`, which may change at any time. `struck` counts the faults that have occurred.

    The fault `hang_up` removes the port. It needs a TCP port, or a link to a pty, because a pty alone cannot
    be opened again under its name.
    """

    def __init__(
        self,
        drives: Sequence[SimulatedDrive],
        faults: Faults,
        *,
        name: str = "line",
        port: str = "pty",
        unpaced: bool = False,
    ) -> None:
        super().__init__(drives, name=name, port=port, unpaced=unpaced)
        if faults.hang_up and port == "pty":
            raise ValueError(
                f"{name}: with `hang_up`, the port must be a link or a TCP port. "
                "A new pseudo-terminal would have another name"
            )
        self._by_name = {sim.drive.name: sim for sim in drives}
        for drive, own in faults.drives.items():
            sim = self._by_name.get(drive)
            if sim and (own.trip or own.drift) and not isinstance(sim, MotorDrive):
                raise ValueError(
                    f"{name}: {drive} has no simulated motor: remove its keys `trip` and `drift`"
                )
        self.faults = faults
        self.struck: Counter[str] = Counter()
        self._random = random.Random(f"{faults.seed} {name}")
        self._stray: list[Transmission] = []  # noise and echoes that are being sent to the client
        self._held: Transmission | None = None  # a reply that is delayed until the next reply is sent
        # time in s at which the removed port returns; None while the port exists
        self._back_at: float | None = None
        # time in s of a drive's next silence or trip, by drive and event
        self._due: dict[tuple[str, str], float] = {}
        self._loads: dict[str, float] = {}  # average load of each drive whose load changes slowly

    def _strikes(self, fault: str, of: Faults | DriveFaults | None = None) -> bool:
        rate: float = getattr(of or self.faults, fault)
        if rate <= 0 or self._random.random() >= rate:
            return False
        self.struck[fault] += 1
        return True

    def _damaged(self, frame: bytes) -> bytes:
        """Return the frame with at most one fault, because a checksum might not detect several faults."""
        for fault, damage in DAMAGES.items():
            if self._strikes(fault):
                return damage(frame, self._random.randrange(len(frame)), self._random.randrange(8))
        return frame

    def receive(self, chunk: bytes, now: float, baudrate: int | None = None) -> None:
        if self._strikes("hang_up"):
            self._hang_up(now)
            return
        for name, faults in self.faults.drives.items():
            if name in self._by_name:
                self._pass_time(self._by_name[name], faults, now)
        character = next(
            (group.receiver.character for group in self._groups if group.settings.baudrate == baudrate),
            self._groups[0].receiver.character,
        )
        if self._strikes("noise"):
            self._make_noise(now, character)
        if self._strikes("echo"):
            self._stray.append(Transmission(chunk, now, character))
        super().receive(self._damaged(chunk), now, baudrate)

    def _pass_time(self, sim: SimulatedDrive, faults: DriveFaults, now: float) -> None:
        """Make the drive silent, trip its motor or change its load if one of its `faults` is due."""
        name = sim.drive.name
        if self._is_due(name, "silence", faults, now):
            sim.deaf_until = max(sim.deaf_until, now + faults.silent_for)
        if not isinstance(sim, MotorDrive):
            return
        if self._is_due(name, "trip", faults, now) and sim.motor.energised:
            sim.trip(overload_code(sim.drive))
        if faults.drift:
            mean = self._loads.setdefault(name, sim.motor.load)
            sim.motor.load = mean + faults.drift * math.sin(now * math.tau / DRIFT_S + sim.drive.address)

    def _is_due(self, drive: str, event: str, faults: DriveFaults, now: float) -> bool:
        """Return True once in each period of this event."""
        period: float | None = getattr(faults, event)
        if not period:
            return False
        key = drive, event
        if key not in self._due:
            self._due[key] = now + (self._up_to(period) if faults.first is None else faults.first)
        if now < self._due[key]:
            return False
        self._due[key] = now + period
        self.struck[event] += 1
        return True

    def _reply(self, sim: SimulatedDrive, data: bytes, begin: float, character: float) -> None:
        faults = self.faults.drives.get(sim.drive.name)
        if faults:
            if self._strikes("loss", faults):
                return
            if self._strikes("damage", faults):
                data = DAMAGES["flip"](data, self._random.randrange(len(data)), self._random.randrange(8))
            if self._strikes("delay", faults):
                begin += self._up_to(faults.late)
        super()._reply(sim, data, begin, character)

    def _deliver(self, group: ReceiverGroup, frames: Sequence[Frame]) -> None:
        if not frames:
            return
        if not self.faults.start_noise:
            super()._deliver(group, frames)
            return
        before = self._running()
        super()._deliver(group, frames)
        if self._running() - before and self._strikes("start_noise"):
            self._make_noise(frames[-1].end, group.receiver.character)

    def _running(self) -> set[SimulatedDrive]:
        return {sim for sim in self.drives if isinstance(sim, MotorDrive) and sim.motor.energised}

    def _make_noise(self, begin: float, character: float) -> None:
        noise = self._random.randbytes(self._random.randint(1, self.faults.burst))
        self._stray.append(Transmission(noise, begin, character))
        for group in self._groups:
            super()._deliver(group, group.receiver.feed(noise, begin))

    def _send(self, data: bytes, begin: float, character: float) -> None:
        data = self._damaged(data)
        if self._held:
            data = self._held.data + data
            self._held = None
        elif self._strikes("merge"):
            self._held = Transmission(data, begin + self._up_to(self.faults.late), character)
            return
        elif self._strikes("delay"):
            begin += self._up_to(self.faults.late)
        if self._strikes("twice"):
            data += data
        if len(data) > 1 and self._strikes("split"):
            at = self._random.randrange(1, len(data))
            super()._send(data[:at], begin, character)
            begin += at * character + self._up_to(self.faults.pause)
            data = data[at:]
        super()._send(data, begin, character)

    def _up_to(self, most: float) -> float:
        return self._random.uniform(0.0, most)

    def advance(self, now: float) -> bytes:
        if self._held and now >= self._held.begin:
            held, self._held = self._held, None
            super()._send(held.data, held.begin, held.character)
        data = super().advance(now)
        if self._stray:
            data += b"".join([stray.take(now) for stray in self._stray])
            self._stray = [stray for stray in self._stray if stray.end > now]
        if self._back_at is None:
            return data
        if now >= self._back_at:
            self._come_back()
        return b""  # the client is disconnected

    @property
    def wake(self) -> float | None:
        times = [stray.next_at for stray in self._stray]
        if self._held:
            times.append(self._held.begin)
        if self._back_at is not None:
            times.append(self._back_at)
        if (first := super().wake) is not None:
            times.append(first)
        return min(times, default=None)

    def _hang_up(self, now: float) -> None:
        # the path includes the port number, so that a TCP port is reopened under the same number
        self.where = self.path
        self._name = os.path.realpath(self.path)  # name of the pty to which the link points
        self.close()
        self._back_at = now + self._up_to(self.faults.away)

    def _come_back(self) -> None:
        self._back_at = None
        # ptys that use up the former name, so that the new pty gets another name
        taken = _ptys_up_to(self._name) if self._strikes("rename") else []
        try:
            self.open()
        finally:
            for fd in taken:
                os.close(fd)


def _ptys_up_to(name: str) -> list[int]:
    """Open ptys until one pty has this name; return their descriptors.

    A new pty gets the lowest free number.
    """
    taken: list[int] = []
    while name.startswith("/dev/pts/"):
        taken += os.openpty()
        if int(Path(os.ttyname(taken[-1])).name) >= int(Path(name).name):
            break
    return taken


def overload_code(drive: Drive) -> int:
    """Return the family's fault code for an overload, else the code of its first named fault, else 1."""
    for name in ("fault", "last_fault", "fault_record_1"):
        register = drive.registers.get(name)
        if register is not None and register.values is not None:
            faults = [one for one in register.values if one]
            return int(next((one for one in faults if "OVERLOAD" in one.name), faults[0]))
    return 1
