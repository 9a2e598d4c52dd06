"""The files that configure a fleet's NATS servers with its users' rights, and the users' secret keys.

    n1.conf, n2.conf …   one server each, with its routes to the others; only for that server
    rights.conf          users by their public keys, their rights and accounts; for all servers
    keys/NAME.key        the secret key of a user; only for that user's computer
    keys/routes          the password between servers, as in the servers' files

Existing keys are kept, so adding a gateway changes no other key. A user whose name is no longer given loses
all rights.

The rights say what each user may publish and subscribe to:

| user      | may                                                                                          |
|-----------|----------------------------------------------------------------------------------------------|
| a gateway | publish its own samples, write leases in its own name, write owners of lines, read all       |
|           | records, take commands of any line and requests about itself, answer them, move leaders home |
| hub       | read the stream of samples                                                                   |
| viewer    | read all records, ask gateways about themselves                                              |
| commander | as a viewer, and send commands                                                               |
| operator  | as a viewer, and create missing buckets, store the plant, drain gateways                     |

No user may change, empty or remove a stream (except the test bucket of `fleet init`), create a consumer, or
read another user's answers.

NATS sends an answer to any subject that the requester names, without checking the requester's rights there.
So each user has its own account, which answers do not leave, and all stored data are in one account without
users. Only these messages cross accounts:

| from        | to           | what                                                            |
|-------------|--------------|-----------------------------------------------------------------|
| a user      | the store    | JetStream requests and records that it may write, as services   |
| a commander | each gateway | commands, stops and requests about the gateway, as streams      |
| a gateway   | a commander  | answers to the commander's inbox, as a service                  |

A server does not forward a message that arrived through a service to the importers of a stream, so an answer
cannot become a stop.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from multidrop.fleet.samples.samples_stream import STREAM
from multidrop.fleet.servers import names
from multidrop.fleet.servers.connections import inbox_of, new_seed, public_key
from multidrop.fleet.servers.setup import CONTEST
from multidrop.printable import masked
from multidrop.whole_file import whole_file

CLUSTER = "multidrop"
# a server's port for routes to other servers is its client port plus this, such as 6222 for 4222
ROUTE_PORTS = 2000
MOST_PORTS = 65535
DATA = Path("/var/lib/nats")  # the folder of JetStream on each server
PINGS = 'ping_interval: "1s", ping_max: 2'  # for routes between servers: a dead route is noticed after 3 s
API = "$JS.API"
STORE = "multidrop"
LAST_ANSWER = "10s"  # how long the server forwards further answers to one request
ANSWER = '{ max: 1, expires: "1m" }'  # limits of answers to one request; a stop of many drives may take long
_STORED = ("$JS.", "$KV.", f"{STREAM}.")
_MANY = "$JS.API.DIRECT.GET."  # prefix of JetStream requests that get several answers
# Each account must import this request, although no user has the right to send it. Without the import, a
# server answers every JetStream request in the account with "not enabled".
_INFO = "$JS.API.INFO"


# ---- files ----


class TlsFiles(NamedTuple):
    """Paths of a server's TLS files: its certificate, its key, and the CA certificate of all servers."""

    cert: Path
    key: Path
    ca: Path


class ServerAddress(NamedTuple):
    """A server's name and address."""

    name: str
    host: str
    port: int

    @property
    def routes(self) -> int:
        return self.port + ROUTE_PORTS


def addresses_of(urls: Sequence[str]) -> list[ServerAddress]:
    """Return the servers at these URLs. Raises ValueError for a URL without a valid port."""
    found = []
    for number, url in enumerate(urls, 1):
        parts = urlsplit(url)
        try:
            port = parts.port or 4222
        except ValueError:
            port = MOST_PORTS
        if not parts.hostname or port + ROUTE_PORTS > MOST_PORTS:
            raise ValueError(f"{masked(url)} is not an address of a NATS server: write nats://host:4222")
        host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
        found.append(ServerAddress(f"n{number}", host, port))
    return found


def write_files(
    folder: Path, gateways: Sequence[str], urls: Sequence[str], tls: TlsFiles | None, store: Path = DATA
) -> list[Path]:
    """Write all files, and return their paths. Secrets are readable only by their owner (mode 0600).

    Raises ValueError for an invalid argument, before any file is written.
    """
    servers = addresses_of(urls)
    rights = rights_of(gateways)
    keys = folder / "keys"
    seeds = {name: _kept(keys / f"{name}.key") or new_seed() for name in rights}
    public = {name: _public(keys / f"{name}.key", seed) for name, seed in seeds.items()}
    password = _kept(keys / "routes") or secrets.token_hex(32)
    keys.mkdir(parents=True, exist_ok=True, mode=0o700)
    written = {keys / f"{name}.key": seed for name, seed in seeds.items()}
    written |= {keys / "routes": password}
    written |= {folder / f"{one.name}.conf": _server(one, servers, password, tls, store) for one in servers}
    for path, text in written.items():
        _write_secret(path, text + "\n")
    (folder / "rights.conf").write_text("\n".join(accounts(rights, public)) + "\n", "utf-8")
    return [*written, folder / "rights.conf"]


def _kept(path: Path) -> str:
    return path.read_text("utf-8", "replace").strip() if path.exists() else ""


def _public(path: Path, seed: str) -> str:
    try:
        return public_key(seed)
    except ValueError:
        raise ValueError(
            f"{path} is damaged: delete it and run the command again, which writes a new key"
        ) from None


def _write_secret(path: Path, text: str) -> None:
    """Write a file that other users cannot read, not even while it is written."""
    with whole_file(path) as part:
        part.touch(0o600, exist_ok=False)
        part.write_text(text, "utf-8")


def _server(
    one: ServerAddress, servers: Sequence[ServerAddress], password: str, tls: TlsFiles | None, store: Path
) -> str:
    lines = [
        f"server_name: {one.name}",
        f'listen: "{one.host}:{one.port}"',
        f"jetstream {{ store_dir: {json.dumps(str(store / one.name))}, sync_interval: always }}",
        "include rights.conf",
    ]
    if tls:
        lines.append(f"tls {{ {_tls_entries(tls)}, handshake_first: true }}")
    if len(servers) > 1:
        user = f"{{ user: routes, password: {json.dumps(password)} }}"
        routes = [f"nats-route://routes:{password}@{other.host}:{other.routes}" for other in servers]
        lines += [
            f'cluster {{ name: {CLUSTER}, listen: "{one.host}:{one.routes}"',
            f"  authorization {user}",
            f"  routes: {json.dumps(routes)}",
            f"  {PINGS}",
            *([f"  tls {{ {_tls_entries(tls)}, verify: true }}"] if tls else []),
            "}",
        ]
    return "\n".join(lines)


def _tls_entries(tls: TlsFiles) -> str:
    named = {"cert_file": tls.cert, "key_file": tls.key, "ca_file": tls.ca}
    return ", ".join(f"{name}: {json.dumps(str(path))}" for name, path in named.items())


# ---- rights ----


class UserRights(NamedTuple):
    """The subjects that a user may publish and subscribe to, besides its inbox."""

    publish: Sequence[str]
    subscribe: Sequence[str] = ()
    answers: bool = False  # True if the user may answer requests on the requester's inbox


def _api(request: str, *buckets: str) -> list[str]:
    return [f"{API}.{request}.KV_{bucket}" for bucket in buckets]


READ = [*_api("STREAM.INFO", *names.BUCKETS), *_api("DIRECT.GET", *names.BUCKETS)]
LEADERS = _api("STREAM.LEADER.STEPDOWN", *names.LEASES, *names.OWNERS)
LOOK = [*READ, names.gateway_subject("*", "state")]


def _gateway(name: str) -> UserRights:
    return UserRights(
        [
            *READ,
            *LEADERS,
            *_api("STREAM.MSG.GET", *names.LEASES),
            *(f"$KV.{bucket}.*.{name}" for bucket in names.LEASES),
            *(f"$KV.{bucket}.*" for bucket in names.OWNERS),
            f"{STREAM}.{name}.*",
            f"{API}.STREAM.MSG.GET.{STREAM}",
        ],
        [
            names.gateway_subject(name, "*"),
            names.command_subject("*"),
            names.stop_subject("*"),
            names.do_subject(name, "*"),
        ],
        answers=True,
    )


_CREATED = [*(f"KV_{bucket}" for bucket in names.BUCKETS), STREAM]
OTHERS: Mapping[str, UserRights] = {
    "hub": UserRights([f"{API}.STREAM.INFO.{STREAM}", f"{API}.DIRECT.GET.{STREAM}"]),
    "operator": UserRights(
        [
            *LOOK,
            *LEADERS,
            *(f"{API}.STREAM.CREATE.{stream}" for stream in _CREATED),
            f"{API}.STREAM.INFO.{STREAM}",
            f"$KV.{names.PLANT}.*",
            *(f"{API}.STREAM.{request}.KV_{CONTEST}" for request in ("CREATE", "INFO", "MSG.GET", "DELETE")),
            f"$KV.{CONTEST}.*.*",
            names.gateway_subject("*", "drain"),
        ]
    ),
    "viewer": UserRights(LOOK),
    "commander": UserRights(
        [*LOOK, names.command_subject("*"), names.stop_subject("*"), names.do_subject("*", "*")]
    ),
}


def rights_of(gateways: Sequence[str]) -> dict[str, UserRights]:
    """Return the rights of a fleet with these gateways, by user name.

    Raises ValueError for a name that is invalid or used twice.
    """
    for name in gateways:
        names.checked_name("gateway", name)
        if name in OTHERS or gateways.count(name) > 1:
            raise ValueError(
                f"the gateway name {name!r} is used twice or reserved: write another name "
                f"(reserved: {', '.join(OTHERS)})"
            )
    return {**{name: _gateway(name) for name in gateways}, **OTHERS}


def accounts(rights: Mapping[str, UserRights], public: Mapping[str, str]) -> Iterator[str]:
    """Yield the lines of a server's configuration for these users, with their public keys."""
    asked = {name: [one for one in mine.publish if one.startswith(_STORED)] for name, mine in rights.items()}
    yield "accounts {"
    yield f"  {STORE} {{ jetstream: enabled, exports: ["
    for subject in sorted({_INFO, *(one for subjects in asked.values() for one in subjects)}):
        many = f", response_type: stream, threshold: {LAST_ANSWER}" if subject.startswith(_MANY) else ""
        yield f"    {{ service: {json.dumps(subject)}{many} }}"
    yield "  ] }"
    for name, mine in rights.items():
        others = [other for other in rights if other != name] if mine.answers else []
        yield f"  {account_of(name)} {{"
        yield "    exports: ["
        if wanted := _request_subjects(mine):
            yield from (f"      {{ stream: {json.dumps(subject)} }}" for subject in wanted)
            yield f"      {{ service: {json.dumps(_inboxes(public[name]))} }}"
        yield "    ]"
        yield "    imports: ["
        yield from (_import("service", STORE, subject) for subject in (_INFO, *asked[name]))
        for other in others:
            if heard := list(_shared(_request_subjects(rights[other]), mine.subscribe)):
                yield from (_import("stream", account_of(other), subject) for subject in heard)
                yield _import("service", account_of(other), _inboxes(public[other]))
        yield "    ]"
        yield from _user(name, mine, public[name])
        yield "  }"
    yield "}"


def account_of(user: str) -> str:
    """Return the name of a user's NATS account, which always differs from the store's."""
    return f"{STORE}-{user}"


def _request_subjects(mine: UserRights) -> list[str]:
    """Return the subjects on which a user may send requests to gateways, without those to the servers."""
    return [subject for subject in mine.publish if not subject.startswith(_STORED)]


def _inboxes(public: str) -> str:
    return f"{inbox_of(public)}.>"


def _import(kind: str, account: str, subject: str) -> str:
    return f"      {{ {kind}: {{ account: {account}, subject: {json.dumps(subject)} }} }}"


def _shared(some: Iterable[str], others: Iterable[str]) -> Iterator[str]:
    """Yield each subject that both lists allow. In a subject, * stands for any one token."""
    for one in some:
        for other in others:
            words = list(zip(one.split("."), other.split("."), strict=False))
            is_as_long = one.count(".") == other.count(".")
            if is_as_long and all(mine == its or "*" in (mine, its) for mine, its in words):
                yield ".".join(its if mine == "*" else mine for mine, its in words)


def _user(name: str, mine: UserRights, public: str) -> Iterator[str]:
    yield "    users: ["
    yield f"      {{ # {name}"
    yield f"        nkey: {public}, permissions: {{"
    yield f"          publish: {{ allow: {json.dumps(list(mine.publish))} }}"
    yield f"          subscribe: {{ allow: {json.dumps([_inboxes(public), *mine.subscribe])} }}"
    if mine.answers:
        yield f"          allow_responses: {ANSWER}"
    yield "        }"
    yield "      }"
    yield "    ]"
