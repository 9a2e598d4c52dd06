"""Errors of a fleet's servers. The message of each error is one sentence."""

from __future__ import annotations

import logging
import os
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from multidrop.printable import masked

MOST_DENIALS = 1000
REFUSALS = (  # a part of nats-py's error message, and the sentence that users see in its place
    ("authorization violation", "{} refuses these credentials, or the lack of any: see --credentials"),
    ("certificate_verify_failed", "the certificate of {} is not trusted ({why}); name its issuer with --ca"),
    (
        "[ssl",
        "{} does not start with TLS, which these options require: set `handshake_first: true` in its tls "
        "block, or name it with nats:// and no --ca",
    ),
    ("empty response", "{} requires TLS: write tls:// and --ca"),
)
_DENIAL = re.compile(r"permissions violation for (publish|subscription) to \"([^\"]+)\"", re.IGNORECASE)
_log = logging.getLogger("multidrop.fleet")


class FleetError(OSError):
    """The fleet's servers cannot be used. The error's message says why, in one sentence."""


class TooOld(FleetError):
    """The NATS server's version is too old: it may grant one lease to two gateways."""


class NotAdmitted(FleetError):
    """A server refused our credentials, or we do not trust its certificate."""


class NoRight(FleetError):
    """Our credentials do not allow us to send a request, or to read its answer."""


class NotDelivered(FleetError):
    """A request certainly reached no receiver."""


class MayNotSend(NoRight, NotDelivered):
    """The server did not forward a request, because our credentials do not allow us to send it."""


class NobodyThere(NotDelivered):
    """The server reports that a request has no receiver."""


class OutcomeUnknown(FleetError):
    """A request got no timely or usable answer: it may have been carried out, or may still be carried out."""


class Conflict(Exception):
    """A record was not replaced, because another client has changed it since it was read."""


def failure_to_connect(url: str, failure: BaseException) -> FleetError:
    """Return the error for a failed connection, without the password in the URL."""
    url, text = masked(url), masked(str(failure).removeprefix("nats: "))
    if not text:
        text = "no answer in time; write tls:// if it requires TLS"
    for sign, sentence in REFUSALS:
        if sign in text.lower():
            why = text.partition("failed: ")[2].partition(" (_ssl")[0]
            return NotAdmitted(sentence.format(url, why=why))
    return FleetError(f"no NATS server answers at {url}: {_words(text)}")


def _words(text: str) -> str:
    """Return an error's text without "[Errno ...]".

    For failed connections, return only the operating system's description of each error.
    """
    numbers = dict.fromkeys(re.findall(r"\[Errno (\d+)\] Connect call failed", text))
    if numbers:
        return ", ".join(os.strerror(int(number)) for number in numbers)
    return re.sub(r"\[Errno -?\d+\] ", "", text)


class Denials:
    """Counts requests that the server denied on one connection, by subject. Logs each denied subject once."""

    def __init__(self) -> None:
        # number of denials by kind ("publish" or "subscription") and subject
        self._counts: Counter[tuple[str, str]] = Counter()
        # a denied subscription to this subject is not logged, because `raising` raises an error for it
        self._raised = ""

    async def note(self, failure: Exception) -> None:
        """Count a denial if this error from a server reports one."""
        found = _DENIAL.search(str(failure))
        if not found:
            return
        kind, subject = found[1].lower(), found[2].lower()  # nats-py converts messages to lower case
        if (kind, subject) not in self._counts:
            if len(self._counts) >= MOST_DENIALS:
                return
            if (kind, subject) != ("subscription", self._raised):
                _log.warning("%s", _sentence(kind, subject))
        self._counts[kind, subject] += 1

    def of_request(self, subject: str) -> int:
        """Return how often a request to this subject was denied."""
        return self._counts["publish", subject.lower()]

    def check_request(self, subject: str, inbox: str, before: int) -> None:
        """Raise MayNotSend or NoRight if missing rights explain why a request got no answer.

        `before` is the number of denials of this subject before the request was sent. MayNotSend means that
        the request was not forwarded. NoRight means that we may not read answers in `inbox`.
        """
        if self.of_request(subject) > before:
            raise MayNotSend(_sentence("publish", subject))
        for kind, denied in self._counts:
            if kind == "subscription" and denied.startswith(inbox.lower()):
                raise NoRight(_sentence(kind, denied))

    @contextmanager
    def raising(self, subject: str) -> Iterator[None]:
        """When the context ends, raise NoRight if the server denied a subscription to this subject."""
        self._raised = subject.lower()
        try:
            yield
        finally:
            self._raised = ""
        if self._counts["subscription", subject.lower()]:
            raise NoRight(_sentence("subscription", subject))


def _sentence(kind: str, subject: str) -> str:
    return f"these credentials do not allow {'publishing' if kind == 'publish' else 'listening'} to {subject}"
