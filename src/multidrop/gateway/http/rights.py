"""Callers, tokens and rights. File contents and times are arguments: this module does no I/O."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections import deque
from collections.abc import Container, Iterable
from enum import IntEnum
from functools import lru_cache
from ipaddress import ip_address
from typing import NamedTuple
from urllib.parse import urlsplit

# values of the field `rule` of WriteForbidden
NOT_LISTED = "not on the list"
NOT_ALLOWED = "the role does not allow it"
NEVER_THIS_WAY = "never by this way"
ANYONE = "anyone"

# limit of wrong tokens from one address, and for how many seconds each wrong token counts
MOST_WRONG, WINDOW_S = 5, 60.0
MOST_ADDRESSES = 10_000  # limit of stored addresses of clients with wrong tokens
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
SCHEMES = ("http", "https")
COMMAND_ID = re.compile(r"[!-~]{1,64}")
SHA256 = re.compile(r"[0-9a-f]{64}")


class Right(IntEnum):
    """Roles, in ascending order; each role includes the rights of the roles before it."""

    LOOK = 0
    STOP = 1
    WRITE = 2


class Caller(NamedTuple):
    """The sender of a request, and its role."""

    name: str  # a token's name, or "anyone"
    way: str  # the interface: "page", "http", "mqtt", "modbus", "tool" or "opcua"
    address: str
    role: Right
    command: str = ""  # the id of the command that this caller sends; "": none yet

    @property
    def by(self) -> str:
        """The caller's name for log lines: name, interface, address and the command's id."""
        command = f" (command {self.command})" if self.command else ""
        return f"{self.name} by {self.way} from {self.address}{command}"

    def commanding(self, given: object = None) -> Caller:
        """Return this caller with `given` as the id of the command.

        If `given` is None, keep the caller's command id, or make a new one if there is none. Raises
        ValueError for an invalid id.
        """
        if given is None:
            return self._replace(command=self.command or secrets.token_hex(8))
        if not isinstance(given, str) or not COMMAND_ID.fullmatch(given):
            raise ValueError("key 'id' must be a string of 1 to 64 ASCII characters without spaces")
        return self._replace(command=given)

    def stopping(self, given: object = None) -> Caller:
        """Return this caller with `given` as the id of a stop; an invalid id is replaced by a new one."""
        try:
            return self.commanding(given)
        except ValueError:
            return self.commanding()


class Token(NamedTuple):
    """One line of the token file.

    The line has only a digest of the secret, so the file alone gives no access.
    """

    name: str
    right: Right
    sha256: str

    @property
    def line(self) -> str:
        return f"{self.name} {self.right.name.lower()} {self.sha256}"


def digest(token: str) -> str:
    """Return a token's digest. Tokens are long and random, so a fast hash is safe."""
    return hashlib.sha256(token.encode(errors="surrogatepass")).hexdigest()


def new_token(name: str, right: Right) -> tuple[str, Token]:
    """Return a new secret and its token. Raises ValueError for an invalid name."""
    if not NAME.fullmatch(name):
        raise ValueError(
            f"invalid owner {name!r}: use up to 64 letters, digits and . _ @ -, a letter or digit first"
        )
    secret = secrets.token_urlsafe(32)
    return secret, Token(name, right, digest(secret))


def read_tokens(text: str) -> tuple[list[Token], list[str]]:
    """Return the tokens in a token file, and an error sentence for each invalid line."""
    found: list[Token] = []
    wrong: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        role = words[1].upper() if len(words) == 3 else ""
        if role not in Right.__members__ or not NAME.fullmatch(words[0]) or not SHA256.fullmatch(words[2]):
            wrong.append(f"line {number} is not `name role sha256`; `multidrop serve --new-token` prints one")
        elif any(words[0] == token.name for token in found):
            wrong.append(f"line {number}: the name {words[0]} is in use already; give each token its own")
        else:
            found.append(Token(words[0], Right[role], words[2]))
    return found, wrong


class Tokens:
    """The valid tokens, and the wrong tokens that each address has sent recently.

    A repeated wrong token counts once, because a browser sends a revoked token with every request.
    """

    def __init__(self, tokens: Iterable[Token] = ()) -> None:
        self._tokens = tuple(tokens)
        self._wrong: dict[str, deque[tuple[float, str]]] = {}  # times and digests of wrong tokens, by address

    def __len__(self) -> int:
        return len(self._tokens)

    def replace(self, tokens: Iterable[Token]) -> None:
        self._tokens = tuple(tokens)

    def find(self, secret: str) -> Token | None:
        """Return the token with this secret; None if there is none. Compares in constant time."""
        given, found = digest(secret), None
        for token in self._tokens:
            if hmac.compare_digest(token.sha256, given):
                found = token
        return found

    def is_shut(self, address: str, now: float) -> bool:
        """Return True if this address has sent too many wrong tokens recently."""
        came = self._wrong.get(address)
        while came and now - came[0][0] >= WINDOW_S:
            came.popleft()
        if came is not None and not came:
            del self._wrong[address]
        return came is not None and len(came) >= MOST_WRONG

    def note_wrong(self, address: str, secret: str, now: float) -> bool:
        """Count a wrong token; return False if this address has sent the same token recently, else True.

        If MOST_ADDRESSES are stored already, the oldest address is deleted.
        """
        given = digest(secret)
        if address not in self._wrong and len(self._wrong) >= MOST_ADDRESSES:
            del self._wrong[next(iter(self._wrong))]
        came = self._wrong.setdefault(address, deque(maxlen=MOST_WRONG))
        is_new = all(given != wrong for _, wrong in came)
        if is_new:
            came.append((now, given))
        return is_new


class May(NamedTuple):
    """The table [serve.may]: the rights of callers without a token, and the allowed writes and verbs."""

    look: str = "anyone"  # who may read values: "anyone", or "token" for callers with a token
    on_loopback: Right = Right.LOOK  # right of callers without a token on this computer
    write: frozenset[str] = frozenset()
    verbs: frozenset[str] = frozenset()

    def bounded_by(self, other: May) -> May:
        """Return this table, with at most the rights of `other` for callers without a token."""
        look = "anyone" if self.look == other.look == "anyone" else "token"
        return self._replace(look=look, on_loopback=min(self.on_loopback, other.on_loopback))

    def without_token(self, *, is_loopback: bool) -> Right | None:
        """Return the right of callers without a token; None if they have no access."""
        if is_loopback and self.on_loopback > Right.LOOK:
            return self.on_loopback
        return Right.LOOK if self.look == "anyone" else None


def caller_with(token: Token | None, free: Right | None, way: str, address: str) -> Caller | None:
    """Return a caller with the larger of two rights; None if it has neither.

    The first is the right of its token. The second is `free`, the right of all callers without a token.
    """
    if token is not None and (free is None or token.right >= free):
        return Caller(token.name, way, address, token.right)
    return None if free is None else Caller(ANYONE, way, address, free)


@lru_cache(maxsize=256)
def is_loopback(host: str) -> bool:
    """Return True for an address or a host name that only this computer can reach."""
    if host in ("localhost", ""):
        return host == "localhost"
    try:
        address = ip_address(host.strip("[]"))
    except ValueError:
        return False
    # a socket that listens on [::] reports clients at 127.0.0.1 as ::ffff:127.0.0.1
    return (getattr(address, "ipv4_mapped", None) or address).is_loopback


class OwnNames:
    """The gateway's own host names. Requests to other hosts, or from pages of other hosts, are refused."""

    def __init__(self, names: Iterable[str], listen: str, port: int) -> None:
        self._always = {"localhost", "127.0.0.1", "[::1]"}
        if listen not in ("0.0.0.0", "::", ""):
            self._always.add(f"[{listen}]" if ":" in listen else listen)
        self._port = port
        self.replace(names)

    def replace(self, names: Iterable[str]) -> None:
        self._hosts = frozenset({*self._always, *(name.lower() for name in names)})

    def has_host(self, host: str) -> bool:
        """Return True if a Host header names this gateway. Its port is not checked: a proxy's may differ."""
        split = _split(host)
        return split is not None and split[0] in self._hosts

    def has_origin(self, origin: str, host: str, schemes: Container[str]) -> bool:
        """Return True if an Origin header is that of the gateway's page: it has the host and port in `host`.

        `host` is the request's Host header, and `schemes` are the page's allowed URL schemes.
        """
        scheme, _, rest = origin.partition("://")
        if scheme not in schemes:
            return False
        ours, theirs = _split(host), _split(rest)
        if ours is None or theirs is None or theirs[0] not in self._hosts:
            return False
        usual = 443 if scheme == "https" else 80
        return (theirs[0], theirs[1] or usual) == (ours[0], ours[1] or usual)


@lru_cache(maxsize=64)  # cached, because all requests of a browser have the same Host header
def _split(host: str) -> tuple[str, int | None] | None:
    """Return name and port of a Host header; None if it is invalid."""
    if not re.fullmatch(r"[A-Za-z0-9._-]+(:[0-9]{1,5})?|\[[0-9A-Fa-f:.]+\](:[0-9]{1,5})?", host):
        return None
    split = urlsplit(f"//{host}")
    name = split.hostname or ""
    try:
        port = split.port
    except ValueError:
        return None
    return (f"[{name}]" if ":" in name else name), port
