"""Faults of simulated lines and drives, and the TOML file that sets their rates."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

from multidrop.toml_check import Key, TomlPlace, duration_of
from multidrop.toml_document import read_document

MOST_BURST = 4096
RATE, DURATION, WHOLE = (int, float), str, int  # types of the values in a fault file


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
    """The faults of one simulated drive. A damaged reply has one wrong bit, which every checksum detects."""

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
    """Rates of a simulated line's faults, and the faults of its drives by name.

    At most one of `drop`, `flip` and `repeat` happens to a frame. So the checksum of every framing detects
    the fault. A reply that comes after its family's response timeout looks like the reply to the next
    identical request.
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
            raise ValueError(f"burst = {self.burst!r} is not from 1 to {MOST_BURST} characters")


def rates_of(kind: type) -> list[str]:
    """Return the names of the fields that are rates."""
    return [one.name for one in fields(kind) if one.metadata.get("kind") is RATE]


def _keys(kind: type) -> dict[str, Key]:
    found = [one for one in fields(kind) if one.metadata]
    return {one.name: Key(one.metadata["kind"], f"{one.name} = {one.metadata['example']}") for one in found}


def _help(kind: type) -> str:
    # zip ends before the field `drives`, which has no key
    lines = zip(_keys(kind).values(), fields(kind), strict=False)
    return "".join(f"  {key.example:<20}{one.metadata['means']}\n" for key, one in lines)


HELP = (
    "The faults' file has these lines, all of which may be left out: then a share\n"
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
    """Return the valid entries of a table; add an error to `place` for every other entry."""
    keys = _keys(kind)
    given = place.check(table, keys)
    for name in given:
        if keys[name].kind is DURATION:
            given[name] = duration_of(given, name, place)
    made = {name: place.attempt(partial(kind, **{name: value})) for name, value in given.items()}
    return {name: getattr(one, name) for name, one in made.items() if one is not None}
