"""FaultyWire: a wire that damages, delays and loses bytes between its client and its drives.

Input and output are bytes with times. All random decisions come from one seed.
"""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.motor_drive import MotorDrive
from multidrop.sim.receiver import Frame
from multidrop.sim.wire import ReceiverGroup, Transmission, Wire
from multidrop.toml_check import Key, TomlPlace, duration_of, read_document

DAMAGES: Mapping[str, Callable[[bytes, int, int], bytes]] = {
    "drop": lambda frame, at, bit: frame[:at] + frame[at + 1 :],
    "flip": lambda frame, at, bit: frame[:at] + bytes([frame[at] ^ 1 << bit]) + frame[at + 1 :],
    "repeat": lambda frame, at, bit: frame[: at + 1] + frame[at:],
}


class FaultyWire(Wire):
    """A wire with `faults`, which may be changed at any time; `struck` counts them.

    To hang up, its port must be a link or a TCP port: a bare pty cannot come back under its name.
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
            raise ValueError(f"{name}: a port that hangs up must be a link or a TCP port, to come back there")
        self.faults = faults
        self.struck: Counter[str] = Counter()
        self._random = random.Random(f"{faults.seed} {name}")
        self._stray: list[Transmission] = []  # noise and echo on their way to the client
        self._held: Transmission | None = None  # a reply that waits for the next one
        self._back_at: float | None = None  # when a removed port comes back

    def _strikes(self, fault: str) -> bool:
        rate: float = getattr(self.faults, fault)
        if rate <= 0 or self._random.random() >= rate:
            return False
        self.struck[fault] += 1
        return True

    def _damaged(self, frame: bytes) -> bytes:
        """Return the frame, damaged at most once, so that every checksum detects it."""
        for fault, damage in DAMAGES.items():
            if self._strikes(fault):
                return damage(frame, self._random.randrange(len(frame)), self._random.randrange(8))
        return frame

    def receive(self, chunk: bytes, now: float, baudrate: int | None = None) -> None:
        if self._strikes("hang_up"):
            self._hang_up(now)
            return
        character = next(
            (group.receiver.character for group in self._groups if group.settings.baudrate == baudrate),
            self._groups[0].receiver.character,
        )
        if self._strikes("noise"):
            self._make_noise(now, character)
        if self._strikes("echo"):
            self._stray.append(Transmission(chunk, now, character))
        super().receive(self._damaged(chunk), now, baudrate)

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
        """Add noise for the client and for the drives."""
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
        self.where = self.path  # a TCP port keeps its number
        self._name = os.path.realpath(self.path)  # name of the pty, not of the link to it
        self.close()
        self._back_at = now + self._up_to(self.faults.away)

    def _come_back(self) -> None:
        self._back_at = None
        taken = _ptys_up_to(self._name) if self._strikes("rename") else []  # else the old name may be free
        try:
            self.open()
        finally:
            for fd in taken:
                os.close(fd)


def _ptys_up_to(name: str) -> list[int]:
    """Open ptys until the next one, which gets the lowest free number, cannot have this name."""
    taken: list[int] = []
    while name.startswith("/dev/pts/"):
        taken += os.openpty()
        if int(Path(os.ttyname(taken[-1])).name) >= int(Path(name).name):
            break
    return taken


def _rate(means: str) -> Any:
    """Return a dataclass field for a rate from 0 (never) to 1 (always)."""
    return field(default=0.0, metadata={"means": means, "example": "0.01"})


def _most(default: float, example: str, means: str) -> Any:
    return field(default=default, metadata={"means": means, "example": f'"{example}"'})


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Rates of faults. At most one of `drop`, `flip` and `repeat` happens to a frame.

    Therefore each of the three checksums detects the damage. If a reply is later than its family's response
    timeout, it cannot be distinguished from the reply to the next equal request.
    """

    seed: int = field(default=0, metadata={"means": "the same one brings the same faults", "example": "7"})
    drop: float = _rate("of the frames lose a character")
    flip: float = _rate("of the frames have one bit turned")
    repeat: float = _rate("of the frames have one character twice")
    twice: float = _rate("of the replies come twice")
    delay: float = _rate("of the replies come late")
    late: float = _most(0.1, "100 ms", "the longest delay")
    merge: float = _rate("of the replies wait, up to `late`, and come with the next")
    split: float = _rate("of the replies have a pause inside")
    pause: float = _most(0.02, "20 ms", "the longest pause")
    echo: float = _rate("of the requests come back to the client")
    noise: float = _rate("of the requests have noise before them")
    start_noise: float = _rate("of the motors' starts bring noise")
    burst: int = field(default=32, metadata={"means": "characters of noise at most", "example": "32"})
    hang_up: float = _rate("of the requests find the port gone")
    away: float = _most(1.0, "1 s", "the longest time until it is back")
    rename: float = _rate("of the returns are under another name; the link follows")

    def __post_init__(self) -> None:
        for name in RATES:
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise ValueError(f"{name} = {value!r} is not a rate; write one from 0 to 1, such as 0.01")
        if not 1 <= self.burst <= MOST_BURST:
            raise ValueError(f"burst = {self.burst!r} is not from 1 to {MOST_BURST} characters")


MOST_BURST = 4096
_DURATIONS = ("late", "pause", "away")
RATES = tuple(one.name for one in fields(Faults) if one.name not in ("seed", "burst", *_DURATIONS))


def _kind(name: str) -> Any:
    return str if name in _DURATIONS else (int, float) if name in RATES else int


_EXAMPLES = {one.name: f"{one.name} = {one.metadata['example']}" for one in fields(Faults)}
_KEYS = {name: Key(_kind(name), example) for name, example in _EXAMPLES.items()}
HELP = (
    "The faults' file has these lines, all of which may be left out: then a share\n"
    "and the seed are 0, and the longest times and bursts are as here.\n"
) + "".join(f"  {_EXAMPLES[one.name]:<20}{one.metadata['means']}\n" for one in fields(Faults))


def load_faults(path: Path | str) -> Faults:
    """Read the rates of faults from a file. Raises ValueError with all mistakes in it."""
    path = Path(path)
    place = TomlPlace(path)
    document = place.attempt(read_document, path, "faults' file")
    given = place.check({} if document is None else document, _KEYS)
    for name in [name for name in given if name in _DURATIONS]:
        given[name] = duration_of(given, name, place)
    faults = {name: place.attempt(partial(Faults, **{name: value})) for name, value in given.items()}
    if place.config_errors:
        raise ValueError("\n".join(place.config_errors))
    return Faults(**{name: getattr(one, name) for name, one in faults.items()})
