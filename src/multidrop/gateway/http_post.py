"""Send a POST to another server, without following redirects."""

from __future__ import annotations

import io
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from http.client import HTTPException, HTTPResponse
from typing import Any

SEND_S = 20.0  # time limit of each step: connecting, sending the request, and receiving the whole answer
REFUSED = (400, 413, 422)  # HTTP statuses of a body that the server does not accept
MOST_ANSWER = 300  # an error reports at most this many bytes of the server's answer
USER_AGENT = "multidrop"


class Refused(OSError):
    """The receiver rejected this message; it may reject every other message too."""


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Refuses redirects: they would change a POST to a GET, and could name any host."""

    def redirect_request(self, *arguments: Any) -> None:
        return None


class _Answer(HTTPResponse):
    """An answer that must arrive within SEND_S. Else a server that sends single bytes could take days."""

    def __init__(self, sock: socket.socket, *arguments: Any, **more: Any) -> None:
        super().__init__(sock, *arguments, **more)
        self.fp: Any = io.BufferedReader(_TimedBytes(self.fp.detach(), sock))


class _TimedBytes(io.RawIOBase):
    """The bytes of a socket. Reading raises TimeoutError once this object is older than SEND_S."""

    def __init__(self, raw: io.RawIOBase, sock: socket.socket) -> None:
        self._raw, self._sock = raw, sock
        self._ends = time.monotonic() + SEND_S

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> Any:
        left_s = self._ends - time.monotonic()
        if left_s <= 0:
            raise TimeoutError(f"the answer did not end within {SEND_S:g} s")
        self._sock.settimeout(left_s)
        return self._raw.readinto(buffer)

    def close(self) -> None:
        self._raw.close()
        super().close()


class _AnswerOpener(urllib.request.HTTPSHandler, urllib.request.HTTPHandler):
    """Opens connections whose answers are `_Answer`."""

    def do_open(self, http_class: Any, req: urllib.request.Request, **options: Any) -> HTTPResponse:
        def connection(host: str, **more: Any) -> Any:
            made = http_class(host, **more)
            made.response_class = _Answer
            return made

        return super().do_open(connection, req, **options)


_opener = urllib.request.build_opener(_NoRedirects, _AnswerOpener)


def post(url: str, body: bytes, headers: Mapping[str, str]) -> None:
    """Send this body. Raises Refused if the server will never accept the body, and OSError after any other
    failure.
    """
    request = urllib.request.Request(url, body, {"user-agent": USER_AGENT, **headers})
    try:
        with _opener.open(request, timeout=SEND_S):
            pass
    except urllib.error.HTTPError as answer:
        if answer.code not in REFUSED:
            raise
        with answer:
            said = answer.read(MOST_ANSWER).decode("utf-8", "replace")
        raise Refused(f"{answer}: {said}") from answer
    except urllib.error.URLError as failure:
        raise OSError(getattr(failure.reason, "strerror", None) or failure.reason) from failure
    except HTTPException as failure:
        raise OSError("the answer is not HTTP") from failure
