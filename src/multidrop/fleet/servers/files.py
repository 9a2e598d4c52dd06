"""The files that configure a fleet's NATS servers with its users' rights, and the users' secret keys.

    n1.conf, n2.conf …   one server each, with its routes to the others; only for that server
    rights.conf          users by their public keys, their rights and accounts; for all servers
    keys/NAME.key        the secret key of a user; only for that user's computer
    keys/routes          the password between servers, as in the servers' files

Existing keys are kept, so adding a gateway changes no other key. A user whose name is no longer given loses
all rights.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from multidrop.fleet.servers.connections import new_seed, public_key
from multidrop.fleet.servers.rights import accounts, rights_of
from multidrop.printable import masked
from multidrop.whole_file import whole_file

CLUSTER = "multidrop"
# a server's port for routes to other servers is its client port plus this, such as 6222 for 4222
ROUTE_PORTS = 2000
MOST_PORTS = 65535
DATA = Path("/var/lib/nats")  # the folder of JetStream on each server
PINGS = 'ping_interval: "1s", ping_max: 2'  # for routes between servers: a dead route is noticed after 3 s


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
