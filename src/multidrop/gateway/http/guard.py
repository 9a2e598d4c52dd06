"""Guard: checks the origin and the token of each HTTP request before a route handles it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from http.cookies import CookieError, SimpleCookie
from typing import Any, NamedTuple

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from multidrop.gateway.http.connections import MAY_STOP
from multidrop.gateway.http.messages import Denied, JsonResponse
from multidrop.gateway.http.rights import (
    ANYONE,
    SCHEMES,
    Caller,
    May,
    OwnNames,
    Right,
    Token,
    Tokens,
    caller_with,
    is_loopback,
)

COOKIE = "multidrop"
CSP = "default-src 'self'; base-uri 'none'; form-action 'none'; object-src 'none'; frame-ancestors 'none'"
HEADERS = {  # headers of all API answers; few, because pages request several frames a second
    "content-security-policy": "default-src 'none'; frame-ancestors 'none'",
    "cross-origin-resource-policy": "same-origin",
    "x-content-type-options": "nosniff",
    "cache-control": "no-store",
}
PAGE_HEADERS = HEADERS | {
    "content-security-policy": CSP,
    "cross-origin-opener-policy": "same-origin",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    # browsers keep a copy of each file, and check by its ETag at each load whether the copy is up to date
    "cache-control": "no-cache",
}
WRONG = "the token is wrong"
SHUT = "too many wrong tokens came from this address: try again in a minute"
# key in the ASGI scope: the request has a wrong token, so it is accepted only if it is a stop
HAS_WRONG_TOKEN = "has_wrong_token"
# limit of a request's headers in bytes; large, because browsers send the cookies of all ports of a host
# together
MOST_HEAD = 64 * 1024


def _raw(headers: Mapping[str, str]) -> list[tuple[bytes, bytes]]:
    return [(name.encode("latin-1"), value.encode("latin-1")) for name, value in headers.items()]


_RAW_HEADERS, _RAW_PAGE_HEADERS = _raw(HEADERS), _raw(PAGE_HEADERS)

_log = logging.getLogger("multidrop.gateway")


class RouteAccess(NamedTuple):
    """The HTTP method and the right that a path needs. If the right is None, no token is checked."""

    method: str
    right: Right | None


class Guard:
    """Refuses forbidden requests; passes the others to `app`, with the caller in the scope's key `caller`."""

    def __init__(
        self,
        app: ASGIApp,
        *,
        needed: Mapping[str, RouteAccess],
        names: OwnNames,
        tokens: Tokens,
        may: Callable[[], May],
        behind_proxy: bool,
        clock: Callable[[], float],
    ) -> None:
        self._app = app
        self._needed = needed
        self._names = names
        self._tokens = tokens
        self._may = may
        self._behind_proxy = behind_proxy
        self._clock = clock

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        is_page = scope["path"] == "/" or scope["path"].startswith("/page/")
        added = _RAW_PAGE_HEADERS if is_page else _RAW_HEADERS

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = message["headers"]
                own = {name for name, _ in headers}
                message["headers"] = [*headers, *(one for one in added if one[0] not in own)]
            await send(message)

        try:
            scope["caller"] = self._check(scope)
        except Denied as denied:
            response = JsonResponse({"error": str(denied)}, denied.status)
            if denied.status == 405:
                response.headers["allow"] = self._find(scope["path"]).method
            if denied.status == 401:
                response.headers["www-authenticate"] = "Bearer"
                # make the browser delete the cookie with the wrong token
                if COOKIE in Headers(scope=scope).get("cookie", ""):
                    response.delete_cookie(COOKIE, httponly=True, samesite="strict")
            await response(scope, receive, send_with_headers)
            return
        await self._app(scope, receive, send_with_headers)

    def _check(self, scope: Scope) -> Caller:
        headers = Headers(scope=scope)
        hosts = headers.getlist("host")
        if len(hosts) != 1 or not self._names.has_host(hosts[0]):
            name = hosts[0] if hosts else ""
            raise Denied(
                421,
                f"{name[:100]!r} is not a known name of this gateway. To allow the name, add it to names of "
                "[serve] in the plant file",
            )
        path: str = scope["path"]
        needed = self._find(path)
        if path not in MAY_STOP and _length(scope) > MOST_HEAD:
            raise Denied(431, f"the headers are longer than {MOST_HEAD} bytes")
        if scope["method"] != needed.method and (scope["method"], needed.method) != ("HEAD", "GET"):
            raise Denied(405, f"{path[:100]!r} takes only the method {needed.method}")
        self._check_site(headers, hosts[0], needed, SCHEMES if self._behind_proxy else (scope["scheme"],))
        if needed.right is None:
            return Caller(ANYONE, "page", self.address(scope, headers), Right.LOOK)
        return self._admit(scope, headers, needed.right)

    def _find(self, path: str) -> RouteAccess:
        """Return the method and the right that a path needs: the entry of its longest prefix in `needed`."""
        while path not in self._needed:
            path = f"{path.rstrip('/').rpartition('/')[0]}/"
        return self._needed[path]

    def _check_site(self, headers: Headers, host: str, needed: RouteAccess, schemes: Sequence[str]) -> None:
        """Raise Denied if the browser's headers say that another site's page sent the request."""
        origin = headers.get("origin")
        if origin is not None and not self._names.has_origin(origin, host, schemes):
            raise Denied(403, f"the request comes from a page of {origin[:100]!r}, not of this gateway")
        site = headers.get("sec-fetch-site", "none")
        is_page = needed == RouteAccess("GET", None) and headers.get("sec-fetch-mode") == "navigate"
        if site not in ("none", "same-origin") and not is_page:
            raise Denied(403, "the request comes from a page of another site")
        if needed.method == "POST":
            kind = headers.get("content-type", "").partition(";")[0].strip().lower()
            if kind != "application/json":
                raise Denied(415, "the body must be application/json")

    def _admit(self, scope: Scope, headers: Headers, needed: Right) -> Caller:
        """Return the caller of a request that needs the right `needed`. Raises Denied if the caller lacks it.

        A request with a wrong token is refused, even if it needs no token. After several wrong tokens, all
        tokens from that address are refused for a while. Stops are different: their tokens are always
        checked, and a wrong one is ignored if anyone may stop.
        """
        address = self.address(scope, headers)
        local = is_loopback(address) and not self._behind_proxy
        free = self._may().without_token(is_loopback=local)
        secret, way = _secret(headers)
        secret = secret if self._tokens else ""  # without tokens of its own, the gateway ignores any token
        token: Token | None = None
        may_stop = scope["path"] in MAY_STOP
        is_shut = not may_stop and self._tokens.is_shut(address, self._clock())
        if secret and not is_shut:
            token = self._tokens.find(secret)
            if token is None and self._tokens.note_wrong(address, secret, self._clock()):
                _log.warning("wrong token from %s", address)
        if secret and token is None:
            if not may_stop or free is None or free < Right.STOP:
                raise Denied(429, SHUT) if is_shut else Denied(401, WRONG)
            scope[HAS_WRONG_TOKEN] = True
        caller = caller_with(token, free, way, address)
        if caller is None:
            raise Denied(401, "this request needs a token")
        if caller.role >= needed:
            return caller
        if token is None:
            raise Denied(401, f"this request needs a token with the right to {needed.name.lower()}")
        raise Denied(
            403,
            f"{caller.name} has only the right to {caller.role.name.lower()}, but this request needs the "
            f"right to {needed.name.lower()}",
        )

    def address(self, scope: Scope, headers: Headers) -> str:
        """Return the client's address.

        Behind a proxy, it is the last address in the X-Forwarded-For header.
        """
        client: Any = scope.get("client")
        peer = str(client[0]) if client else ""
        if not self._behind_proxy:
            return peer
        forwarded = ",".join(headers.getlist("x-forwarded-for")).rpartition(",")[2].strip()
        return forwarded[:64] or peer


def _length(scope: Scope) -> int:
    """Return the length of a request's path, query and headers in bytes."""
    words = sum(len(name) + len(value) for name, value in scope["headers"])
    return words + len(scope["raw_path"]) + len(scope["query_string"])


def _secret(headers: Headers) -> tuple[str, str]:
    """Return the token in a request, and its sender's kind: "http" for a program, "page" for a browser."""
    scheme, _, secret = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return secret.strip(), "http"
    cookies: SimpleCookie = SimpleCookie()
    try:
        cookies.load(headers.get("cookie", ""))
    except CookieError:
        return "", "page"
    found = cookies.get(COOKIE)
    is_page = found is not None or "origin" in headers or "sec-fetch-site" in headers
    return (found.value if found is not None else ""), "page" if is_page else "http"
