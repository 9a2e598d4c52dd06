"""The table `[serve]` of a plant file. All its mistakes are reported before the gateway starts."""

from __future__ import annotations

import hashlib
import json
import re
import ssl
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from multidrop import Plant, PlantError
from multidrop.gateway.http.rights import May, Right, Token, is_loopback, read_tokens
from multidrop.gateway.live.limits import Limit, read_limits
from multidrop.gateway.parts import PARTS
from multidrop.plant import MAY_KEYS, allowed
from multidrop.supervisor import Hung, in_time
from multidrop.toml_check import Key, TomlPlace

LISTEN = "127.0.0.1:8750"
AUDIT_S = 2.0  # time limit for the disk of the audit log
HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?")
EXAMPLES = {  # example values in error messages, by type
    bool: "true",
    int: "10",
    float: "1.5",
    str: '"text"',
    dict: "{ name = value }",
    list: '["one", "two"]',
    tuple: '["one", "two"]',
}

_SERVE = {
    "listen": Key(str, f'listen = "{LISTEN}"'),
    "names": Key(list, 'names = ["plant.example"]'),
    "certificate": Key(str, 'certificate = "cert.pem"'),
    "key": Key(str, 'key = "key.pem"'),
    "behind_proxy": Key(bool, "behind_proxy = true"),
    "tokens": Key(str, 'tokens = "tokens"'),
    "audit": Key(str, 'audit = "audit.jsonl"'),
    "alarms": Key(str, 'alarms = "alarms.jsonl"'),
    "may": Key(dict, "[serve.may], a table"),
    "limit": Key(list, "[[serve.limit]], a table for each limit"),
} | {name: Key(dict, f"[serve.{name}], a table") for name in PARTS}

_MAY = {
    "look": Key(str, 'look = "anyone"'),
    "stop": Key(str, 'stop = "token"'),
    **MAY_KEYS,
}


@dataclass(frozen=True)
class ServeSettings:
    """The checked settings of `[serve]`."""

    host: str = "127.0.0.1"
    port: int = 8750
    names: tuple[str, ...] = ()
    tls: ssl.SSLContext | None = None
    certificate: str = ""  # digest of certificate and key, because these files may be renewed in place
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
    """Finds the files that `[serve]` names: among the service's credentials, else beside the plant file.

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


def read_plant(load: Callable[[], Plant], environment: Mapping[str, str]) -> tuple[Plant, ServeSettings]:
    """Return a plant and its `[serve]` settings. Raises PlantError with all mistakes in the file."""
    try:
        plant = load()
    except PlantError as wrong:
        if wrong.rest is None:
            raise
        try:
            read_settings(wrong.rest, environment)
        except PlantError as also:
            raise PlantError((*wrong.mistakes, *also.mistakes)) from None
        raise
    return plant, read_settings(plant, environment)


def read_settings(plant: Plant, environment: Mapping[str, str]) -> ServeSettings:
    """Return the `[serve]` settings of a plant. Raises PlantError with all mistakes.

    In a plant without lines, names of drives and lines are not checked.
    """
    place = TomlPlace(plant.path, ("[serve]",))
    folders = Folders(plant.path, environment)
    given = place.check(dict(plant.serve), _SERVE)
    host, port = place.attempt(_address, given.get("listen", LISTEN)) or ("127.0.0.1", 0)
    names = tuple(filter(None, (place.attempt(_name, name) for name in given.get("names", ()))))
    tls = _tls(given, folders, place)
    tokens = _tokens(given, folders, place)
    usual = "token" if "tokens" in given else "anyone"
    may = _may(given.get("may", {}), usual, plant, place.of_file(plant.path, "[serve.may]"))
    behind_proxy = given.get("behind_proxy", False)
    if may.look == "token" and not tokens and "tokens" not in given:
        place.wrong('look = "token" of [serve.may] needs a file of tokens; add tokens = "tokens"')
    is_safe = behind_proxy or {"tokens", "certificate", "key"} <= given.keys()  # files are checked above
    if not is_loopback(host) and not is_safe and "listen" in given:
        place.wrong(
            f'listen = "{given["listen"]}" is open to other machines: that needs tokens, certificate and '
            "key, or behind_proxy = true; or listen on 127.0.0.1"
        )
    audit = folders.state / given.get("audit", "audit.jsonl")
    place.attempt(_check_audit, audit)
    limits = read_limits(given.get("limit", ()), plant, place)
    parts = {
        name: _part(name, given[name], plant, place.of_file(plant.path, f"[serve.{name}]"))
        for name in PARTS
        if name in given
    }
    if place.config_errors:
        raise PlantError(tuple(place.config_errors))
    digest = _digest(folders.find(given[key]) for key in ("certificate", "key")) if tls else ""
    alarms = folders.state / given.get("alarms", "alarms.jsonl")
    return ServeSettings(
        host,
        port,
        names,
        tls,
        digest,
        behind_proxy,
        tuple(tokens),
        may,
        audit,
        alarms,
        limits,
        folders.state,
        parts,
    )


def _address(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    host = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not colon or not host or not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > 65535:
        raise ValueError(f'listen = "{text}" is not an address and port; write listen = "{LISTEN}"')
    return host, int(port)


def _name(name: object) -> str:
    if not isinstance(name, str) or not HOST.fullmatch(name):
        raise ValueError(
            f'names: {name!r} is not a host name; write names = ["plant.example"], without a port'
        )
    return name


def _tls(given: Mapping[str, Any], folders: Folders, place: TomlPlace) -> ssl.SSLContext | None:
    paths = {key: folders.find(given[key]) for key in ("certificate", "key") if key in given}
    if len(paths) == 1:
        place.wrong(f"{next(iter(paths))} alone is not enough: give certificate and key")
    found = [place.attempt(_check_readable, f"{key} {path}", path) for key, path in paths.items()]
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
        place.wrong(f"certificate {paths['certificate']} and key {paths['key']} {why}")
        return None
    return context


def _tokens(given: Mapping[str, Any], folders: Folders, place: TomlPlace) -> list[Token]:
    if "tokens" not in given:
        return []
    path = folders.find(given["tokens"])
    if place.attempt(_check_readable, f"tokens {path}", path) is None:
        return []
    try:
        found, wrong = read_tokens(path.read_text("utf-8"))
    except UnicodeDecodeError:
        found, wrong = [], ["it is not UTF-8 text"]
    for sentence in wrong:
        place.wrong(f"tokens {path}: {sentence}")
    if not found and not wrong:
        place.wrong(
            f"tokens {path} is empty; `multidrop serve --new-token stop --for anna` makes a line for it"
        )
    return found


def _may(table: Any, look: str, plant: Plant, place: TomlPlace) -> May:
    """Return the rights in [serve.may]; the argument `look` is the default of the key `look`."""
    given = place.check(table, _MAY)
    for key in ("look", "stop"):
        if given.get(key, "anyone") not in ("anyone", "token"):
            place.wrong(f'{key} = "{given[key]}" is neither "anyone" nor "token"')
    lists = allowed(plant, given if plant.lines else {}, place)
    on_loopback = Right.STOP if given.get("stop") == "anyone" else Right.LOOK
    return May(given.get("look", look), on_loopback, lists["write"], lists["verbs"])


def _part(name: str, table: Mapping[str, Any], plant: Plant, place: TomlPlace) -> Any:
    """Return a part's settings, checked by its dataclass of settings; None if there are mistakes."""
    made = import_module(PARTS[name]).Settings
    defaults = {one.name: _default(one) for one in fields(made) if one.init}
    keys = {name: _key_of(name, default) for name, default in defaults.items()}
    before = len(place.config_errors)
    given = place.check(dict(table), keys)
    try:
        found = made(**given)
    except (ValueError, TypeError) as mistakes:
        for sentence in str(mistakes).splitlines():
            place.wrong(sentence)
        return None
    if len(place.config_errors) == before and hasattr(found, "check"):
        for sentence in found.check(plant):
            place.wrong(sentence)
    return found


def _default(one: Field[Any]) -> Any:
    return one.default_factory() if one.default_factory is not MISSING else one.default


def _key_of(name: str, default: object) -> Key:
    if default is None:
        return Key((str, int, float, dict, list), f"{name} = …")
    kind = list if isinstance(default, tuple) else type(default)
    example = json.dumps(default) if kind is str and default else EXAMPLES[kind]
    return Key((int, float) if kind is float else kind, f"{name} = {example}")


# ---- files ----


def _check_readable(what: str, path: Path) -> bool:
    try:
        with path.open("rb"):
            return True
    except OSError as failure:
        raise ValueError(f"{what} cannot be read: {failure.strerror}") from failure


def _digest(paths: Iterable[Path]) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def _check_audit(path: Path) -> bool:
    """Check that the file can be written; a disk that hangs is not a mistake in the plant file."""
    with suppress(Hung):
        in_time("audit log", AUDIT_S, partial(check_writable, path))
    return True


def check_writable(path: Path) -> bool:
    """Return True if this audit log can be written. Raises ValueError."""
    is_new = not path.exists()
    try:
        with path.open("ab"):
            pass
    except OSError as failure:
        raise ValueError(f"audit {path} cannot be written: {failure.strerror}") from failure
    if is_new:
        path.unlink(missing_ok=True)
    return True
