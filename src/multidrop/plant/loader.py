"""Load a plant file and find all mistakes in it. Opens no port."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from multidrop.channels import MOST_CHARACTERS, MOST_NAME, Channel, ChannelSet
from multidrop.channels.functions import NAMES as FUNCTION_NAMES
from multidrop.core import RS485, Echo, TransactionIds
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import BAUDRATES, FORMAT, Settings, check_port, check_settle, speaks_tcp
from multidrop.families import MODELS
from multidrop.families.files import FamilyError
from multidrop.families.registry import find_model
from multidrop.plant.model import (
    FLEET_KEYS,
    RESERVED_NAMES,
    Plant,
    PlantLine,
    Polled,
    PolledDrive,
    check_drive_name,
    series_of,
)
from multidrop.toml_check import (
    DURATION,
    PORT_NUMBER,
    Key,
    TomlPlace,
    duration_of,
    duration_up_to,
    grouped,
    json_schema,
)
from multidrop.toml_document import read_document


class PlantError(ValueError):
    """Raised for a plant file with mistakes; `mistakes` has a sentence for each, with place and correction.

    `right` is a plant with the drives that can still be stopped. Mistakes in `every`, `poll` and channels do
    not prevent a stop; drives with other mistakes are left out. If the file is not valid TOML, `right` is
    None.
    """

    def __init__(self, mistakes: tuple[str, ...], right: Plant | None = None) -> None:
        super().__init__("\n".join(mistakes))
        self.mistakes = mistakes
        self.right = right


def load_plant(path: Path | str) -> Plant:
    """Return the plant that a file describes. Raises PlantError with all mistakes in the file."""
    return _load(path, lambda document: PLANT_KEYS)


def load_served_plant(path: Path | str) -> Plant:
    """Return the plant that a file describes; with [serve.fleet] it may have no lines.

    Raises PlantError with all mistakes in the file.
    """
    return _load(path, _served_keys)


def _served_keys(document: Mapping[str, Any]) -> Mapping[str, Key]:
    serve = document.get("serve")
    return _FOLLOWING_KEYS if isinstance(serve, dict) and "fleet" in serve else PLANT_KEYS


def _load(path: Path | str, keys_of: Callable[[Mapping[str, Any]], Mapping[str, Key]]) -> Plant:
    if why := port_or_address(path):
        raise PlantError((why,))
    path = Path(path)
    place = TomlPlace.in_file(path)
    document = place.attempt(read_document, path, "plant file")
    if document and "family" in document and "line" not in document:
        raise PlantError((f"{path}: {_FAMILY_FILE}",))
    given = {} if document is None else _tables(document, keys_of(document), place)
    lines = [_line(table, at) for table, at in place.inside("line", given.get("line", []))]
    right = tuple(line for line in lines if line is not None)
    totals = path.parent / given["totals"] if "totals" in given else None
    plant = Plant(right, path, given.get("serve", {}), given.get("realtime", False), totals)
    if not place.config_errors:
        _check_channels(plant, given, place)
    if place.config_errors:
        raise PlantError(grouped(place.config_errors), None if document is None else plant)
    return plant


def _tables(document: dict[str, Any], keys: Mapping[str, Key], place: TomlPlace) -> dict[str, Any]:
    """Return the valid tables of a document. Each other table adds an error to `place`."""
    for name, inside in _INNER.items():
        if name in document:
            place.wrong(f"[[{name}]] is not inside a line; write {inside}, in two brackets", name)
    return place.check({name: one for name, one in document.items() if name not in _INNER}, keys)


_FAMILY_FILE = "this is a family file, not a plant file; name it in a plant file, as the model of a drive"
_INNER = {"drive": "[[line.drive]]", "channel": "[[line.drive.channel]]"}


def check_channels(plant: Plant) -> None:
    """Raise PlantError with all mistakes in the channels of a plant."""
    if mistakes := ChannelSet(series_of(plant)).mistakes:
        raise PlantError(tuple(map(str, mistakes)))


def port_or_address(name: Path | str) -> str:
    """Return an error sentence if `name` is a URL or a device instead of a plant file, else ""."""
    url = _URL.match(str(name))
    if url is None and not str(name).startswith("/dev/tty"):
        return ""
    shown = f"{url[1]}://{url[2]}" if url else str(name)
    if url and url[1].lower() in ("http", "https"):
        return f"{shown} is a web address, not a plant file; open a gateway's page in a browser"
    if url and url[1].lower() not in _PORTS:
        return f"{shown} is an address, not a plant file; name a file such as plant.toml"
    return f"{shown} is a port, not a plant file; `multidrop scan {shown} --out plant.toml` writes one"


# one or two slashes, because a Path turns two slashes into one
_URL = re.compile(r"([a-z][a-z0-9+.-]+):/{1,2}(.*)", re.IGNORECASE)
_PORTS = ("tcp", "socket", "rfc2217")

# JSON Schemas of the names of lines and drives, and of ports
NAME = {"not": {"enum": [*RESERVED_NAMES]}, "pattern": r"^[^-\x00-\x1f\x7f][^\x00-\x1f\x7f]*$"}
_HOST = r"(\[[0-9A-Fa-f:.%]+\]|[^@:/?#\[\]]+)"
_NUMBER = rf":(?!0+([/?#]|$)){PORT_NUMBER}"
_BY_TCP = rf"[Tt][Cc][Pp]://{_HOST}({_NUMBER})?"
_BY_SOCKET = rf"([Ss][Oo][Cc][Kk][Ee][Tt]|[Rr][Ff][Cc]2217)://{_HOST}{_NUMBER}"
PORT = {"pattern": rf"^((?!.*://).*|({_BY_TCP}|{_BY_SOCKET})([/?#].*)?)$"}
FORMATS = {"pattern": f"^{FORMAT}$"}
BAUDRATE = {"minimum": BAUDRATES[0], "maximum": BAUDRATES[1]}
TEXTS = {"items": {"type": "string", "minLength": 1}}
_KNOWN = "|".join((*FUNCTION_NAMES, "and", "or", "not"))  # words that may stand before a parenthesis
_UNKNOWN_FUNCTION = rf"^[^\"']*(?<![\w.-])(?!({_KNOWN})\s*\()[^\W\d]\w*\s*\("

PLANT_KEYS = {
    "realtime": Key(bool, "realtime = true"),
    "totals": Key(str, 'totals = "totals.json"'),
    "line": Key(list, "[[line]], in two brackets, with its name, port and drives", needed=True),
    "serve": Key(dict, "[serve], a table that `multidrop serve` reads"),
    "fleet": Key(
        dict, "[fleet], a table that `multidrop fleet init` reads", keywords=json_schema(FLEET_KEYS)
    ),
}

_FOLLOWING_KEYS = {**PLANT_KEYS, "line": replace(PLANT_KEYS["line"], needed=False)}

LINE_KEYS = {
    "name": Key(str, 'name = "hall-1"', needed=True, keywords=NAME),
    "port": Key(str, 'port = "/dev/ttyUSB0"', needed=True, keywords=PORT),
    "baudrate": Key(int, "baudrate = 9600", keywords=BAUDRATE),
    "format": Key(str, 'format = "8N1"', keywords=FORMATS),
    "silence": Key(str, 'silence = "500 us"', keywords=duration_up_to(0)),
    "switching": Key(str, 'switching = "2 ms"', keywords=DURATION),
    "echo": Key(str, 'echo = "auto"', keywords={"enum": [one.value for one in Echo]}),
    "rs485": Key(str, 'rs485 = "kernel"', keywords={"enum": [one.value for one in RS485]}),
    "settle": Key(str, 'settle = "1.5 s"', keywords=duration_up_to(1)),
    "transaction": Key(
        str, 'transaction = "match"', keywords={"enum": [one.value for one in TransactionIds]}
    ),
    "drive": Key(list, "[[line.drive]], in two brackets, with its name, model and address", needed=True),
}

DRIVE_KEYS = {
    "name": Key(str, 'name = "pump-1"', needed=True, keywords=NAME),
    "model": Key(str, 'model = "innovert-ibd"', needed=True),
    "address": Key(int, "address = 1", needed=True, keywords={"minimum": 0, "maximum": 255}),
    "framing": Key(str, 'framing = "rtu"'),
    "baudrate": Key(int, "baudrate = 9600", keywords=BAUDRATE),
    "format": Key(str, 'format = "8N1"', keywords=FORMATS),
    "ram": Key(
        list, 'ram = ["frequency"], registers that this drive is known not to store in EEPROM', keywords=TEXTS
    ),
    "every": Key(str, 'every = "50 ms"', keywords=DURATION),
    "poll": Key(list, 'poll = ["output_current"], or leave it out to poll all readings'),
    "channel": Key(list, "[[line.drive.channel]], in two brackets, with its name and value"),
}

POLL_KEYS = {
    "register": Key(str, 'register = "output_current"', needed=True),
    "every": Key(str, 'every = "50 ms"', keywords=DURATION),
}

CHANNEL_KEYS = {
    "name": Key(
        str,
        'name = "energy"',
        needed=True,
        keywords={"pattern": r"^[^\W\d]\w*$", "maxLength": MOST_NAME},
    ),
    "value": Key(
        str,
        'value = "integral(output_power)"',
        needed=True,
        keywords={"maxLength": MOST_CHARACTERS, "not": {"pattern": _UNKNOWN_FUNCTION}},
    ),
    "unit": Key(str, 'unit = "kWh"', keywords={"maxLength": MOST_NAME}),
}

# keys that are not arguments of a drive's class
_NOT_ARGUMENTS = ("name", "model", "every", "poll", "channel")


def _line(table: Any, place: TomlPlace) -> PlantLine | None:
    """Return the line with the drives that can still be stopped; None if the line itself has a mistake."""
    before = len(place.config_errors)
    given = place.check(table, LINE_KEYS)
    name, port = given.get("name", ""), given.get("port", "")
    if name:
        place.attempt(check_drive_name, name, key="name")
        sentence = "another line already has this name; each line needs its own"
        place.once("line", name, sentence=sentence, key="name")
    # several lines may have the same tcp:// port, because each has its own connection
    if port and not speaks_tcp(port):
        sentence = f"port {port} is already used by {{first}}; make them one line"
        place.once("port", port, sentence=sentence, key="port")
    if port:
        place.attempt(check_port, port, key="port")
    settings: dict[str, Any] = {
        "baudrate": place.attempt(Settings, given.get("baudrate", 9600), "8N1", key="baudrate")
        and given.get("baudrate"),
        "format": place.attempt(Settings, 9600, given.get("format", "8N1"), key="format")
        and given.get("format"),
    }
    silence, switching, settle = (
        duration_of(given, key, place) for key in ("silence", "switching", "settle")
    )
    place.attempt(check_settle, settle or 0.0, key="settle")
    echo = place.attempt(Echo, given.get("echo", "auto"), key="echo")
    rs485 = place.attempt(RS485, given.get("rs485", "off"), key="rs485") or RS485.OFF
    place.attempt(rs485.check_port, port, key="rs485")
    transaction = place.attempt(TransactionIds, given.get("transaction", "match"), key="transaction")
    if "transaction" in given and not speaks_tcp(port):
        place.wrong(f"transaction is only for tcp:// ports, and {port} is not one; remove it", "transaction")
    is_right = len(place.config_errors) == before
    inherited = {**settings, "silence": silence, "port": port}
    drives = [_drive(drive, inherited, at) for drive, at in place.inside("drive", given.get("drive", []))]
    if not is_right:
        return None
    polled = tuple(filter(None, drives))
    return PlantLine(
        name,
        port,
        **settings,
        drives=polled,
        switching=switching or 0.0,
        echo=echo or Echo.AUTO,
        transaction=transaction or TransactionIds.MATCH,
        rs485=rs485,
        settle=settle or 0.0,
    )


def _drive(table: Any, line: Mapping[str, Any], place: TomlPlace) -> PolledDrive | None:
    """Return the drive; None if its entry has a mistake other than in `every`, `poll` and channels."""
    before = len(place.config_errors)
    model = _model(table, place)
    given = place.check(table, DRIVE_KEYS | _option_keys(model))
    if "name" in given:
        place.attempt(check_drive_name, given["name"], key="name")
        sentence = "another drive already has this name; each drive needs its own"
        place.once("drive", given["name"], sentence=sentence, key="name")
    if "address" in given:
        sentence = f"address {given['address']} is already used by {{first}}; give each drive its own"
        wire = line["port"] if speaks_tcp(line["port"]) else place.steps[0]
        place.once("address", wire, given["address"], sentence=sentence, key="address")
    is_right = len(place.config_errors) == before
    every = duration_of(given, "every", place)
    if model is None:
        return None
    arguments = {key: value for key, value in given.items() if key not in _NOT_ARGUMENTS}
    inherited = {
        key: value for key, value in line.items() if value is not None and key not in given and key != "port"
    }
    before = len(place.config_errors)
    _try_each(model, arguments, inherited, place)
    is_right &= len(place.config_errors) == before
    polls = _polls(given.get("poll"), model, every, place)
    channels = [_channel(table, at) for table, at in place.inside("channel", given.get("channel", []))]
    if not is_right:  # a drive with mistakes only in `every`, `poll` and channels can still be stopped
        return None
    drive = place.attempt(partial(model, name=given["name"], **inherited, **arguments))
    if drive is None or place.attempt(partial(_on_port, drive, line["port"])) is None:
        return None
    polled = partial(PolledDrive, drive, channels=tuple(filter(None, channels)))
    return place.attempt(polled, polls, key="poll") or polled([])


def _channel(table: Any, place: TomlPlace) -> Channel | None:
    given = place.check(table, CHANNEL_KEYS)
    return (
        Channel(given["name"], given["value"], given.get("unit", ""))
        if {"name", "value"} <= given.keys()
        else None
    )


def _check_channels(plant: Plant, given: Mapping[str, Any], place: TomlPlace) -> None:
    """Add an error to `place` for each mistake in a channel."""
    places = {
        (drive["name"], channel["name"]): at
        for line, at_line in place.inside("line", given.get("line", []))
        for drive, at_drive in at_line.inside("drive", line["drive"])
        for channel, at in at_drive.inside("channel", drive.get("channel", []))
    }
    for mistake in ChannelSet(series_of(plant)).mistakes:
        places[mistake.drive, mistake.channel].wrong(mistake.sentence, "value")


def _on_port(drive: Drive, port: str) -> Drive:
    drive.take_framing_of(port)
    return drive


def _model(table: Any, place: TomlPlace) -> type[Drive] | None:
    text = table.get("model") if isinstance(table, dict) else None
    if not text or not isinstance(text, str):
        return None
    try:
        return find_model(text, place.path.parent)
    except FamilyError as wrong:
        once = ("family", text)
        if once not in place.seen:  # report the family file's mistakes only once
            for mistake in wrong.mistakes:
                place.wrong(mistake, "model")
        place.seen.setdefault(once, "")
    except ValueError as mistake:
        place.wrong(mistake, "model")
    return None


def _option_keys(model: type[Drive] | None) -> dict[str, Key]:
    """Return the keys for the options of a family; if it is unknown, for those of all families."""
    families = [model] if model else list(MODELS.values())
    return {
        name: Key((int, float), f"{name} = {option.span[1]:g}")
        for family in families
        for name, option in family.options.items()
    }


def _try_each(
    model: type[Drive], arguments: Mapping[str, Any], inherited: Mapping[str, Any], place: TomlPlace
) -> None:
    """Pass each argument to the drive's class separately: each refused argument gets its own error."""
    least: dict[str, Any] = {"address": model.addresses[0]}
    if "framing" in arguments:
        framing = {"framing": arguments["framing"]}
        if place.attempt(partial(model, **least, **framing), key="framing"):
            least |= framing  # the allowed formats depend on the framing
    for key, value in arguments.items():
        if key != "framing":
            place.attempt(partial(model, **(least | {key: value})), key=key)
    settings = model(**least).settings
    right = {"baudrate": str(settings.baudrate), "format": f'"{settings.format}"'}
    for key, value in inherited.items():
        if key not in right:  # other keys, such as `silence`, are checked when the drive is created
            continue
        hint = f"; {value} is the value of the line, so add {key} = {right[key]} to this drive"
        place.attempt(partial(model, **(least | {key: value})), hint=hint)


def _polls(
    entries: list[Any] | None, model: type[Drive], every: float | None, place: TomlPlace
) -> list[Polled]:
    if entries is None:
        if not model.readings():
            place.wrong(f"{model.title or model.__name__} has no readings; add poll = [...] with registers")
        return [Polled("*", every)]
    found = (_polled(entry, model, every, at) for entry, at in place.inside("poll", entries))
    return list(filter(None, found))


def _polled(entry: Any, model: type[Drive], every: float | None, place: TomlPlace) -> Polled | None:
    """Return an entry of the list `poll`, which is a register or "*"; None if the entry is invalid."""
    if not isinstance(entry, (str, dict)):
        place.wrong(f'{entry!r} is not right; write "output_current" or {{ register = "output_current" }}')
        return None
    given = place.check({"register": entry} if isinstance(entry, str) else entry, POLL_KEYS)
    own = duration_of(given, "every", place) if "every" in given else every
    if given.get("register") == "*":
        return Polled("*", own)
    register = (
        place.attempt(model.register, given["register"], key="register") if "register" in given else None
    )
    if register is None:
        return None
    if not register.readable:
        place.wrong(f"{register} can only be written, not polled; see `multidrop models {model.model}`")
        return None
    return Polled(register, own)
