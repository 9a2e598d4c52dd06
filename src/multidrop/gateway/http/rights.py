"""Rights: callers, the ways they come by, and what each may do. Pure: texts and times come in."""

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

NOT_LISTED = "not on the list"  # rules of a WriteForbidden that the gateway itself raises
NOT_ALLOWED = "the role does not allow it"
NEVER_THIS_WAY = "never by this way"

MOST_WRONG, WINDOW_S = 5, 60.0  # wrong tokens of an address, and within which time
MOST_ADDRESSES = 10_000  # whose wrong tokens are remembered
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
SCHEMES = ("http", "https")
SHA256 = re.compile(r"[0-9a-f]{64}")


class Right(IntEnum):
    """Each role may do what those before it may."""

    LOOK = 0
    STOP = 1
    WRITE = 2


class Caller(NamedTuple):
    """Somebody who asks for something."""

    name: str  # a token's name, or "anyone"
    way: str  # "page", "http", "mqtt", "modbus"
    address: str
    role: Right

    @property
    def by(self) -> str:
        """Say who it is, as log lines do."""
        return f"{self.name} by {self.way} from {self.address}"


class Token(NamedTuple):
    """One line of the tokens' file; it holds a digest, so that the file itself lets nobody in."""

    name: str
    right: Right
    sha256: str

    @property
    def line(self) -> str:
        return f"{self.name} {self.right.name.lower()} {self.sha256}"


def digest(token: str) -> str:
    """Return a token's digest. Tokens are long and random, and need no slow hash."""
    return hashlib.sha256(token.encode(errors="surrogatepass")).hexdigest()


def new_token(name: str, right: Right) -> tuple[str, Token]:
    """Return a fresh token, to be told once, and its line. Raises ValueError for such a name."""
    if not NAME.fullmatch(name):
        raise ValueError(f"{name!r} is no name for a token: letters, digits, . _ @ and - do, 64 at most")
    secret = secrets.token_urlsafe(32)
    return secret, Token(name, right, digest(secret))


def read_tokens(text: str) -> tuple[list[Token], list[str]]:
    """Return the tokens of a file, and a sentence for each line that is none."""
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
            wrong.append(f"line {number}: another token is called {words[0]}; give every one its own name")
        else:
            found.append(Token(words[0], Right[role], words[2]))
    return found, wrong


class Tokens:
    """The valid tokens, and the wrong ones with which each address came.

    A wrong one that comes again is no further guess: a browser sends a token that was taken away with every
    request.
    """

    def __init__(self, tokens: Iterable[Token] = ()) -> None:
        self._tokens = tuple(tokens)
        self._wrong: dict[str, deque[tuple[float, str]]] = {}  # when, and its digest

    def __len__(self) -> int:
        return len(self._tokens)

    def replace(self, tokens: Iterable[Token]) -> None:
        """Take the tokens of a file that was read again."""
        self._tokens = tuple(tokens)

    def find(self, secret: str) -> Token | None:
        """Return the token of this secret, in the same time whether or not there is one."""
        given, found = digest(secret), None
        for token in self._tokens:
            if hmac.compare_digest(token.sha256, given):
                found = token
        return found

    def is_shut(self, address: str, now: float) -> bool:
        """Return True where no more wrong tokens are looked at from this address for now."""
        came = self._wrong.get(address)
        while came and now - came[0][0] >= WINDOW_S:
            came.popleft()
        if came is not None and not came:
            del self._wrong[address]
        return came is not None and len(came) >= MOST_WRONG

    def note_wrong(self, address: str, secret: str, now: float) -> bool:
        """Count a wrong token; return True unless it came before.

        The addresses that came first are forgotten where there are very many.
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
    """The table [serve.may]: the right of callers without a token, and which writes and verbs are allowed."""

    look: str = "anyone"  # or "token"
    on_loopback: Right = Right.LOOK  # without a token
    write: frozenset[str] = frozenset()
    verbs: frozenset[str] = frozenset()

    def bounded_by(self, other: May) -> May:
        """Return the same lists, and those rights without a token that both give."""
        look = "anyone" if self.look == other.look == "anyone" else "token"
        return self._replace(look=look, on_loopback=min(self.on_loopback, other.on_loopback))

    def without_token(self, *, is_loopback: bool) -> Right | None:
        """Return the right of those without a token; None: not even a look."""
        if is_loopback and self.on_loopback > Right.LOOK:
            return self.on_loopback
        return Right.LOOK if self.look == "anyone" else None


@lru_cache(maxsize=256)
def is_loopback(host: str) -> bool:
    """Return True for addresses and names that this machine alone can reach."""
    if host in ("localhost", ""):
        return host == "localhost"
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


class OwnNames:
    """The names of the gateway; a page under any other name is somebody else's."""

    def __init__(self, names: Iterable[str], listen: str, port: int) -> None:
        self._always = {"localhost", "127.0.0.1", "[::1]"}
        if listen not in ("0.0.0.0", "::", ""):
            self._always.add(f"[{listen}]" if ":" in listen else listen)
        self._port = port
        self.replace(names)

    def replace(self, names: Iterable[str]) -> None:
        """Take the names of a file that was read again."""
        self._hosts = frozenset({*self._always, *(name.lower() for name in names)})

    def has_host(self, host: str) -> bool:
        """Return True for a Host header that is ours; a proxy's port may be another one."""
        split = _split(host)
        return split is not None and split[0] in self._hosts

    def has_origin(self, origin: str, host: str, schemes: Container[str]) -> bool:
        """Return True for an Origin header of our own page: same host and port as the request itself.

        `schemes` are those by which a page may have come.
        """
        scheme, _, rest = origin.partition("://")
        if scheme not in schemes:
            return False
        ours, theirs = _split(host), _split(rest)
        if ours is None or theirs is None or theirs[0] not in self._hosts:
            return False
        usual = 443 if scheme == "https" else 80
        return (theirs[0], theirs[1] or usual) == (ours[0], ours[1] or usual)


@lru_cache(maxsize=64)  # each request of a viewer has the same one
def _split(host: str) -> tuple[str, int | None] | None:
    """Return name and port of a Host header; None where it is not one."""
    if not re.fullmatch(r"[A-Za-z0-9._-]+(:[0-9]{1,5})?|\[[0-9A-Fa-f:.]+\](:[0-9]{1,5})?", host):
        return None
    split = urlsplit(f"//{host}")
    name = split.hostname or ""
    try:
        port = split.port
    except ValueError:
        return None
    return (f"[{name}]" if ":" in name else name), port
