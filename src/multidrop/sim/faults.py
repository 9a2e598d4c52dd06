"""Faults of a line and their rates, read from a TOML file."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

from multidrop.toml_check import Key, TomlPlace, duration_of, read_document


def _rate(means: str) -> Any:
    """A field from 0, never, to 1, always."""
    return field(default=0.0, metadata={"means": means, "example": "0.01"})


def _most(default: float, example: str, means: str) -> Any:
    return field(default=default, metadata={"means": means, "example": f'"{example}"'})


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Rates of faults; of `drop`, `flip` and `repeat` at most one happens to a frame.

    So any of the three checksums shows the damage. A reply later than its family's response time-out
    cannot be told from the next one of the same kind.
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
    """Read the faults of a file. Raises ValueError with all that is wrong in it."""
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
