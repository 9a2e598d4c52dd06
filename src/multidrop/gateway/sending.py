"""Send messages to other servers: a POST over HTTP, and a thread that repeats failed attempts."""

from __future__ import annotations

import io
import logging
import socket
import threading
import time
import urllib.error
import urllib.request
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from http.client import HTTPException, HTTPResponse
from math import inf
from typing import Any
from urllib.parse import parse_qs, urlsplit

from multidrop.printable import masked, printable

# time limit, in s, of each step: to connect, to send the request, and to receive the whole answer
SEND_S = 20.0
REFUSED = (400, 413, 422)  # HTTP statuses with which a server refuses the contents of a message
MOST_ANSWER = 300  # limit, in bytes, of a server's answer in an error message
# names of query parameters that contain secrets
SECRETS = ("p", "u", "token", "password", "api_key", "apikey", "key")
USER_AGENT = "multidrop"


def url_mistakes(url: str, example: str) -> Iterator[str]:
    """Yield an error sentence if this is not an http:// or https:// URL, or if it contains a secret."""
    try:
        parts = urlsplit(url)
        host, user = parts.hostname, parts.username
        is_valid = url.isascii() and url.isprintable() and " " not in url and parts.port != 0
    except ValueError:
        parts, host, user, is_valid = urlsplit(""), None, None, False
    if user is not None or set(parse_qs(parts.query)) & {*SECRETS}:
        yield 'url contains a user, password or token; write token = "FILE" instead'
    elif parts.scheme not in ("http", "https") or not host or not is_valid:
        yield f'url = "{masked(url)}" is not a URL; write url = "{example}"'


def host_of(url: str) -> str:
    """Return the scheme and the host of a URL, which logs may show."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.hostname}"


class Refused(OSError):
    """The receiver has refused this message.

    It may refuse all other messages too, for example because of a setting.
    """


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Refuses redirects: they would change a POST to a GET, and could name any host."""

    def redirect_request(self, *arguments: Any) -> None:
        return None


class _Answer(HTTPResponse):
    """An answer that must arrive within SEND_S. A server that sends single bytes could take days."""

    def __init__(self, sock: socket.socket, *arguments: Any, **more: Any) -> None:
        super().__init__(sock, *arguments, **more)
        self.fp: Any = io.BufferedReader(_TimedBytes(self.fp.detach(), sock))


class _TimedBytes(io.RawIOBase):
    """The bytes that arrive at a socket.

    A read raises TimeoutError if this object is older than SEND_S.
    """

    def __init__(self, raw: io.RawIOBase, sock: socket.socket) -> None:
        self._raw, self._sock = raw, sock
        self._ends = time.monotonic() + SEND_S

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> Any:
        left_s = self._ends - time.monotonic()
        if left_s <= 0:
            raise TimeoutError(f"the server's answer did not end within {SEND_S:g} s")
        self._sock.settimeout(left_s)
        return self._raw.readinto(buffer)

    def close(self) -> None:
        self._raw.close()
        super().close()


class _AnswerOpener(urllib.request.HTTPSHandler, urllib.request.HTTPHandler):
    """Opens HTTP connections whose answers have the time limit of `_Answer`."""

    def do_open(self, http_class: Any, req: urllib.request.Request, **options: Any) -> HTTPResponse:
        def connection(host: str, **more: Any) -> Any:
            made = http_class(host, **more)
            made.response_class = _Answer
            return made

        return super().do_open(connection, req, **options)


_opener = urllib.request.build_opener(_NoRedirects, _AnswerOpener)


def post(url: str, body: bytes, headers: Mapping[str, str]) -> None:
    """Send this body by POST.

    Raises Refused if the server will never accept the body, and OSError after any other failure.
    """
    request = urllib.request.Request(url, body, {"user-agent": USER_AGENT, **headers})
    try:
        with _opener.open(request, timeout=SEND_S):
            pass
    except urllib.error.HTTPError as answer:
        if answer.code not in REFUSED:
            raise
        with answer:
            text = answer.read(MOST_ANSWER).decode("utf-8", "replace")
        raise Refused(f"{answer}: {text}") from answer
    except urllib.error.URLError as failure:
        raise OSError(getattr(failure.reason, "strerror", None) or failure.reason) from failure
    except HTTPException as failure:
        raise OSError("the server's answer is not HTTP") from failure


# ---- the thread of a receiver ----


class RetryingSender(ABC):
    """Sends messages to one receiver, with growing pauses after failures.

    `name` is the receiver's name in logs and in the gateway's health, without secrets. Only `run`, which has
    its own thread, waits for the receiver.
    """

    log = logging.getLogger("multidrop.gateway")
    what = "messages"
    # in s: if the receiver takes longer than this for one message, that is reported as a problem
    slow_s = 2 * SEND_S
    # in s: the pause after the first failed attempt, and the longest pause
    first_pause_s, most_pause_s = 1.0, 30.0

    def __init__(self, name: str, clock: Callable[[], float]) -> None:
        self.name = name
        self._clock = clock
        self._trouble = ""  # why the receiver accepts no messages now
        self._pause_s = self.first_pause_s
        self._sending_since_s = inf
        self._changed = threading.Condition()
        self._has_news = False  # True: messages were added since the last attempt started
        self._is_closed = False

    @property
    def problem(self) -> str:
        """Why the receiver accepts no messages now; "" if it accepts them."""
        if self._clock() - self._sending_since_s > self.slow_s:
            return f"{self.name} has not answered for {self.slow_s:g} s"
        return self._trouble

    def announce(self) -> None:
        """Wake `run`, because a message was added."""
        with self._changed:
            self._has_news = True
            self._changed.notify()

    def close(self) -> None:
        """Make `run` return as soon as `_may_end` allows it."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    def run(self) -> None:
        """Send messages until `close` is called."""
        pause_s = 0.0
        while not (self._is_closed and self._may_end(pause_s)):
            pause_s = self.step()
            with self._changed:
                if pause_s == inf:
                    self._changed.wait_for(lambda: self._is_closed or self._has_news)
                elif pause_s > 0:
                    self._changed.wait_for(lambda: self._is_closed, pause_s)

    def step(self) -> float:
        """Send the next message. Return the seconds until the next attempt; inf if no message waits."""
        self._has_news = False
        self._sending_since_s = self._clock()
        try:
            wait_s = self._send_next()
        except Exception as failure:  # a library may raise anything
            self._note_failure(failure)
            wait_s, self._pause_s = self._pause_s, min(2 * self._pause_s, self.most_pause_s)
            return wait_s
        finally:
            self._sending_since_s = inf
        if self._trouble:
            self.log.info("%s takes %s again", self.name, self.what)
        self._trouble, self._pause_s = "", self.first_pause_s
        return wait_s

    def _note_failure(self, failure: Exception) -> None:
        reason = (isinstance(failure, OSError) and str(failure)) or type(failure).__name__
        trouble = f"{self.name} takes no {self.what}: {printable(reason)[:200]}"
        if trouble != self._trouble:
            self._trouble = trouble
            self.log.warning("%s", trouble)

    @abstractmethod
    def _send_next(self) -> float:
        """Send the next message, if any.

        Return the seconds until the next attempt; raise an exception after a failure.
        """

    @abstractmethod
    def _may_end(self, pause_s: float) -> bool:
        """Return True if `run` may end after `close`. `pause_s` is the result of the latest `step`."""
