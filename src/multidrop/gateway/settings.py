"""The table `[serve]` of a plant file, and the files that the table names.

All mistakes are reported before the gateway starts.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import ssl
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from multidrop import Plant, PlantError
from multidrop.gateway.http.rights import May, Right, Token, is_loopback, read_tokens
from multidrop.gateway.live.alarms import LIMIT_KEYS, Limit, read_limits
from multidrop.gateway.parts import PARTS, missing_library
from multidrop.plant import MAY_KEYS, allowed
from multidrop.supervisor import Hung, in_time
from multidrop.toml_check import ADDRESS, Key, TomlPlace, json_schema, parse_address

LISTEN = "127.0.0.1:8750"
MOST_SECRET = 4096  # limit, in bytes, of a file that contains a secret
AUDIT_S = 2.0  # time limit, in s, for checking the disk of the audit log
HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?")
EXAMPLES = {  # example values for error messages, by type
    bool: "true",
    int: "10",
    float: "1.5",
    str: '"text"',
    dict: "{ name = value }",
    list: '["one", "two"]',
    tuple: '["one", "two"]',
}

_MAY = {
    "look": Key(str, 'look = "anyone"', keywords={"enum": ["anyone", "token"]}),
    "stop": Key(str, 'stop = "token"', keywords={"enum": ["anyone", "token"]}),
    **MAY_KEYS,
}

_SERVE = {
    "listen": Key(str, f'listen = "{LISTEN}"', keywords=ADDRESS),
    "names": Key(
        list,
        'names = ["plant.example"]',
        keywords={"items": {"type": "string", "pattern": f"^{HOST.pattern}$"}},
    ),
    "certificate": Key(str, 'certificate = "cert.pem"'),
    "key": Key(str, 'key = "key.pem"'),
    "behind_proxy": Key(bool, "behind_proxy = true"),
    "tokens": Key(str, 'tokens = "tokens"'),
    "audit": Key(str, 'audit = "audit.jsonl"'),
    "alarms": Key(str, 'alarms = "alarms.jsonl"'),
    "may": Key(dict, "[serve.may], a table", keywords=json_schema(_MAY)),
    "limit": Key(
        list,
        "[[serve.limit]], a table for each limit",
        keywords={"items": json_schema(LIMIT_KEYS, oneOf=[{"required": ["above"]}, {"required": ["below"]}])},
    ),
} | {name: Key(dict, f"[serve.{name}], a table") for name in PARTS}


NOT_FOLLOWED = {  # parts that a gateway without lines of its own cannot have, each with the reason
    **dict.fromkeys(
        ("history", "influx", "postgres", "upload"), "`multidrop hub` stores the samples of a fleet"
    ),
    "modbus": "it serves only values that this gateway polls",
    "tool": "vendors' programs use the lines of this gateway",
    "trigger": "triggers need the rows that this gateway polls",
}


ListenAddress = tuple[str, int]  # host and port


@dataclass(frozen=True)
class ServeSettings:
    """The settings in the table `[serve]`, after all checks."""

    host: str = "127.0.0.1"
    port: int = 8750
    names: tuple[str, ...] = ()
    tls: ssl.SSLContext | None = None
    # digest of the files of certificate and key, because their contents may change under the same names
    certificate: str = ""
    behind_proxy: bool = False
    tokens: tuple[Token, ...] = ()
    may: May = May()  # noqa: RUF009 (it cannot change)
    audit: Path | None = None
    alarms: Path | None = None
    limits: tuple[Limit, ...] = ()
    folder: Path = Path()
    parts: Mapping[str, Any] = field(default_factory=dict)
    is_demo: bool = False

    @property
    def page(self) -> str:
        """The page's address; "" if the gateway listens on all addresses and has no name."""
        if self.behind_proxy:
            return f"https://{self.names[0]}" if self.names else ""
        host = self.names[0] if self.names else f"[{self.host}]" if ":" in self.host else self.host
        is_known = host not in ("0.0.0.0", "[::]")
        return f"{'https' if self.tls else 'http'}://{host}:{self.port}" if is_known else ""


class Folders:
    """Finds the files that `[serve]` names.

    Input files are looked for among the systemd service's credentials first, then beside the plant file.
    Output files are in the service's state folder; without a service, beside the plant file.
    """

    def __init__(self, plant: Path, environment: Mapping[str, str]) -> None:
        self._beside = plant.resolve().parent
        credentials = environment.get("CREDENTIALS_DIRECTORY")
        state = environment.get("STATE_DIRECTORY", "").partition(":")[0]
        self._credentials = Path(credentials) if credentials else None
        self.state = Path(state) if state else self._beside

    def find(self, name: str) -> Path:
        """Return the path of an input file, which may be missing."""
        if self._credentials and not Path(name).is_absolute() and (self._credentials / name).exists():
            return self._credentials / name
        return self._beside / name


def input_file(name: str, plant: Plant) -> Path:
    """Return the path of an input file: in systemd's credentials folder, or beside the plant file."""
    return Folders(plant.path, os.environ).find(name)


def secret_in(name: str, plant: Plant) -> str:
    """Return the secret in a file: one of the systemd service's credentials, or a file beside the plant file.

    Raises OSError. If `name` is "", return "".
    """
    if not name:
        return ""
    with input_file(name, plant).open("rb") as file:
        return file.read(MOST_SECRET).decode("utf-8", "replace").strip()


def secret_mistakes(key: str, name: str, plant: Plant) -> Iterator[str]:
    """Yield an error sentence if a file with a secret cannot be read, or does not have exactly one line."""
    try:
        secret = secret_in(name, plant)
        if name and len(secret.splitlines()) != 1:
            yield f'{key} = "{name}": {input_file(name, plant)} has {len(secret.splitlines())} lines, not one'
    except OSError as failure:
        yield f'{key} = "{name}": {input_file(name, plant)} cannot be read: {failure.strerror}'


def refuse(mistakes: Iterable[str]) -> None:
    """Raise ValueError with a line for each mistake, if there are any."""
    if wrong := "\n".join(mistakes):
        raise ValueError(wrong)


def parsing_mistakes(settings: object, **parsers: Callable[[str], object]) -> Iterator[str]:
    """Parse each setting with its parser, and yield an error sentence for each ValueError."""
    for key, parse in parsers.items():
        try:
            parse(getattr(settings, key))
        except ValueError as mistake:
            yield f"{key} = {mistake}"


def read_plant(load: Callable[[], Plant], environment: Mapping[str, str]) -> tuple[Plant, ServeSettings]:
    """Return a plant and the settings in its table `[serve]`.

    Raises PlantError with all mistakes in the file.
    """
    try:
        plant = load()
    except PlantError as wrong:
        if wrong.right is None:
            raise
        try:
            read_settings(replace(wrong.right, lines=()), environment)
        except PlantError as also:
            raise PlantError((*wrong.mistakes, *also.mistakes)) from None
        raise
    settings = read_settings(plant, environment)
    if not plant.lines:
        _check_followed(plant, settings)
    return plant, settings


def _check_followed(plant: Plant, settings: ServeSettings) -> None:
    """Check the settings of a gateway that shows a fleet's drives. Its plant file has no [[line]] tables.

    Raises PlantError for settings that need such tables.
    """
    place = replace(TomlPlace.in_file(plant.path), steps=(("serve", 1),))
    for name, other in NOT_FOLLOWED.items():
        if name in settings.parts:
            place.wrong(f"[serve.{name}] needs [[line]] tables in this plant file; {other}", name)
    if getattr(settings.parts.get("mqtt"), "rows", False):
        place.wrong("rows = true of [serve.mqtt] needs [[line]] tables in this plant file", "mqtt")
    if MAY_KEYS.keys() & plant.serve.get("may", {}).keys():
        sentence = "[serve.may] lists need [[line]] tables in this file; [fleet.may] is for a fleet's drives"
        place.wrong(sentence, "may")
    if place.config_errors:
        raise PlantError(tuple(place.config_errors))


def read_settings(plant: Plant, environment: Mapping[str, str]) -> ServeSettings:
    """Return the settings in the table `[serve]` of a plant. Raises PlantError with all mistakes.

    If the plant has no lines, names of drives and lines are not checked.
    """
    root = TomlPlace.in_file(plant.path)
    place = root.within("[serve]", "serve")
    folders = Folders(plant.path, environment)
    given = place.check(dict(plant.serve), _SERVE)
    listen = given.get("listen", LISTEN)
    host, port = place.attempt(parse_address, listen, f'listen = "{LISTEN}"', key="listen") or (
        "127.0.0.1",
        0,
    )
    names = tuple(filter(None, (place.attempt(_name, name) for name in given.get("names", ()))))
    tls = _tls(given, folders, place)
    tokens = _tokens(given, folders, place)
    usual = "token" if "tokens" in given else "anyone"
    may = _may(given.get("may", {}), usual, plant, root.within("[serve.may]", "serve", "may"))
    behind_proxy = given.get("behind_proxy", False)
    if may.look == "token" and not tokens and "tokens" not in given:
        place.wrong('look = "token" of [serve.may] needs a file of tokens; add tokens = "tokens"', "may")
    # the files of tokens, certificate and key are checked above
    is_safe = behind_proxy or {"tokens", "certificate", "key"} <= given.keys()
    if not is_loopback(host) and not is_safe and "listen" in given:
        place.wrong(
            f'listen = "{given["listen"]}" is open to other machines. Add tokens, certificate and key, or '
            "behind_proxy = true; or listen on 127.0.0.1",
            "listen",
        )
    audit = folders.state / given.get("audit", "audit.jsonl")
    place.attempt(_check_audit, audit, key="audit")
    limits = read_limits(given.get("limit", ()), plant, place)
    parts = {
        name: _part(name, given[name], plant, root.within(f"[serve.{name}]", "serve", name))
        for name in PARTS
        if name in given
    }
    _check_ports((host, port), parts, root)
    if place.config_errors:
        raise PlantError(tuple(place.config_errors))
    digest = _digest(folders.find(given[key]) for key in ("certificate", "key")) if tls else ""
    alarms = folders.state / given.get("alarms", "alarms.jsonl")
    return ServeSettings(
        host=host,
        port=port,
        names=names,
        tls=tls,
        certificate=digest,
        behind_proxy=behind_proxy,
        tokens=tuple(tokens),
        may=may,
        audit=audit,
        alarms=alarms,
        limits=limits,
        folder=folders.state,
        parts=parts,
    )


def _name(name: object) -> str:
    if not isinstance(name, str) or not HOST.fullmatch(name):
        raise ValueError(
            f'names: {name!r} is not a host name; write names = ["plant.example"], without a port'
        )
    return name


def _tls(given: Mapping[str, Any], folders: Folders, place: TomlPlace) -> ssl.SSLContext | None:
    paths = {key: folders.find(given[key]) for key in ("certificate", "key") if key in given}
    if len(paths) == 1:
        only = next(iter(paths))
        place.wrong(f"{only} alone is not enough: give both keys, certificate and key", only)
    found = [place.attempt(_check_readable, f"{key} {path}", path, key=key) for key, path in paths.items()]
    if found != [True, True]:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(paths["certificate"], paths["key"], password="")
    except (ssl.SSLError, ValueError) as failure:
        is_mismatch = getattr(failure, "reason", "") == "KEY_VALUES_MISMATCH"
        wrong = "must be a certificate and a key in PEM, without password"
        why = "do not belong together" if is_mismatch else wrong
        place.wrong(f"certificate {paths['certificate']} and key {paths['key']} {why}", "certificate")
        return None
    return context


def _tokens(given: Mapping[str, Any], folders: Folders, place: TomlPlace) -> list[Token]:
    if "tokens" not in given:
        return []
    path = folders.find(given["tokens"])
    if place.attempt(_check_readable, f"tokens {path}", path, key="tokens") is None:
        return []
    try:
        found, wrong = read_tokens(path.read_text("utf-8"))
    except UnicodeDecodeError:
        found, wrong = [], ["it is not UTF-8 text"]
    for sentence in wrong:
        place.wrong(f"tokens {path}: {sentence}", "tokens")
    if not found and not wrong:
        place.wrong(
            f"tokens {path} is empty; add the line that `multidrop serve --new-token stop --for anna` prints",
            "tokens",
        )
    return found


def _may(table: Any, look: str, plant: Plant, place: TomlPlace) -> May:
    """Return the rights in the table [serve.may]. `look` is the default of the key `look`."""
    given = place.check(table, _MAY)
    for key in ("look", "stop"):
        if given.get(key, "anyone") not in ("anyone", "token"):
            place.wrong(f'{key} = "{given[key]}" is neither "anyone" nor "token"')
    lists = allowed(plant, given if plant.lines else {}, place)
    on_loopback = Right.STOP if given.get("stop") == "anyone" else Right.LOOK
    return May(given.get("look", look), on_loopback, lists["write"], lists["verbs"])


def _part(name: str, table: Mapping[str, Any], plant: Plant, place: TomlPlace) -> Any:
    """Return the settings of an optional part of the gateway, such as MQTT; None if there are mistakes.

    `table` is the part's table in the plant file. The part's own dataclass checks it.
    """
    try:
        made, keys = _settings_of(name)
    except ImportError as missing:
        place.wrong(missing_library(name, missing))
        return None
    before = len(place.config_errors)
    given = place.check(dict(table), keys)
    # keys with invalid values: they must not be reported as missing too
    refused = tuple(table.keys() - given.keys())
    try:
        found = made(**given)
    except (ValueError, TypeError) as mistakes:
        for sentence in str(mistakes).splitlines():
            if not sentence.startswith(refused):
                place.wrong(sentence)
        return None
    if len(place.config_errors) == before and hasattr(found, "check"):
        for sentence in found.check(plant):
            place.wrong(sentence)
    for library in getattr(found, "libraries", ()):
        if find_spec(library) is None:
            place.wrong(missing_library(name, ImportError(name=library)))
    return found


def _check_ports(page: ListenAddress, parts: Mapping[str, Any], place: TomlPlace) -> None:
    """Add a mistake for each part that listens on the same address as the web server or another part."""
    taken = {"listen of [serve]": page}
    for name, part in parts.items():
        own: Mapping[str, ListenAddress] = getattr(part, "addresses", {})
        for key, address in own.items():
            other = next((other for other, used in taken.items() if _are_one_port(address, used)), None)
            if other:
                there = place.within(f"[serve.{name}]", "serve", name)
                there.wrong(f"{key}: port {address[1]} is in use by {other}; choose another port")
        taken |= {f"{key} of [serve.{name}]": address for key, address in own.items()}


def _are_one_port(one: ListenAddress, other: ListenAddress) -> bool:
    """Return True if these two addresses exclude each other, so that only one socket can listen on them.

    Port 0 means any free port.
    """
    hosts = {"127.0.0.1" if host == "localhost" else host for host, _ in (one, other)}
    is_ipv4 = not any(":" in host for host in hosts)
    overlap = len(hosts) == 1 or "::" in hosts or ("0.0.0.0" in hosts and is_ipv4)
    return one[1] == other[1] != 0 and overlap


def _settings_of(part: str) -> tuple[Any, dict[str, Key]]:
    """Return the settings class of a table such as [serve.mqtt], and the table's keys.

    The class has a field for each key. A field's metadata are the JSON Schema keywords of its key.
    """
    made = resolve_name(PARTS[part])
    return made, {one.name: _key_of(one) for one in fields(made) if one.init}


def _key_of(one: Field[Any]) -> Key:
    default = one.default_factory() if one.default_factory is not MISSING else one.default
    kind = list if isinstance(default, tuple) else type(default)
    example = json.dumps(default) if kind is str and default else EXAMPLES[kind]
    return Key((int, float) if kind is float else kind, f"{one.name} = {example}", keywords=one.metadata)


# ---- JSON Schema ----


def serve_schema() -> dict[str, Any]:
    """Return the JSON Schema of the table `[serve]`: the table's own keys, and the tables of the parts."""
    is_private = {"pattern": r"^(localhost|127\.[0-9.]+|\[?::1\]?):"}
    is_public = {"required": ["listen"], "properties": {"listen": {"not": is_private}}}
    is_protected = [
        {"required": ["behind_proxy"], "properties": {"behind_proxy": {"const": True}}},
        {"required": ["tokens", "certificate", "key"]},
    ]
    looks_by_token = {"required": ["look"], "properties": {"look": {"const": "token"}}}
    needs_tokens = {"required": ["may"], "properties": {"may": looks_by_token}}
    schema = json_schema(
        _SERVE,
        dependencies={"certificate": ["key"], "key": ["certificate"]},
        allOf=[
            {"if": is_public, "then": {"anyOf": is_protected}},
            {"if": needs_tokens, "then": {"required": ["tokens"]}},
        ],
    )
    for name in PARTS:
        with suppress(ImportError):  # if a part's library is missing, the schema lacks the part's keys
            schema["properties"][name] |= json_schema(_settings_of(name)[1])
    return schema


# ---- files ----


def _check_readable(what: str, path: Path) -> bool:
    try:
        with path.open("rb"):
            return True
    except OSError as failure:
        raise ValueError(f"{what} cannot be read: {failure.strerror}") from failure


def _digest(paths: Iterable[Path]) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def _check_audit(path: Path) -> None:
    """Raise ValueError if the audit log cannot be written. A hanging disk is not an error."""
    with suppress(Hung):
        in_time("audit log", AUDIT_S, partial(check_writable, path))


def check_writable(path: Path) -> None:
    """Raise ValueError if this audit log cannot be written."""
    is_new = not path.exists()
    try:
        with path.open("ab"):
            pass
    except OSError as failure:
        raise ValueError(f"audit {path} cannot be written: {failure.strerror}") from failure
    if is_new:
        path.unlink(missing_ok=True)
