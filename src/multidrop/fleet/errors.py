"""Failures of a fleet's servers."""

from __future__ import annotations

import logging
import os
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from multidrop.printable import masked


class FleetError(OSError):
    """Tell a user, in one sentence, why the fleet's servers cannot be used."""


class TooOld(FleetError):
    """A server that may give one lease to two gateways."""


class NotAdmitted(FleetError):
    """A server that does not believe us, or that we do not believe."""


class NoRight(FleetError):
    """A request that these credentials do not allow, or whose answer they do not allow to hear."""


class NotDelivered(FleetError):
    """A request that reached nobody, for certain."""


class MayNotSend(NoRight, NotDelivered):
    """A request that the server did not pass on, for want of rights."""


class NobodyThere(NotDelivered):
    """A request of which the server says that nobody takes it."""


class Unsure(FleetError):
    """A request without an answer in time: it may have been carried out, or still be."""


class Conflict(Exception):
    """A record that has another revision than the one that was to be replaced."""


MOST_DENIALS = 1000
REFUSALS = (  # what a failure says, and what that means at this address
    (
        "authorization violation",
        "{} admits nobody who says this, or nothing, of himself: see --credentials",
    ),
    (
        "certificate_verify_failed",
        "the certificate of {} cannot be believed ({why}); --ca names the one that it is signed by",
    ),
    (
        "[ssl",
        "{} does not begin with TLS, which these options demand: set `handshake_first: true` in its tls "
        "block, or name it with nats:// and no --ca",
    ),
    ("empty response", "{} does not begin in the clear: name it with tls://, and --ca"),
)
_DENIAL = re.compile(r"permissions violation for (publish|subscription) to \"([^\"]+)\"", re.IGNORECASE)

_log = logging.getLogger("multidrop.fleet")


def failure_to_connect(url: str, failure: BaseException) -> FleetError:
    """Return the sentence for a connection that did not come about; it has no password."""
    url, text = masked(url), masked(str(failure).removeprefix("nats: "))
    if not text:
        text = "it said nothing in time; one that begins with TLS is named with tls://"
    for sign, sentence in REFUSALS:
        if sign in text.lower():
            why = text.partition("failed: ")[2].partition(" (_ssl")[0]
            return NotAdmitted(sentence.format(url, why=why))
    return FleetError(f"no NATS server answers at {url}: {_words(text)}")


def _words(text: str) -> str:
    """Return an error's text without numbers; of asyncio's calls, what the system says in words."""
    numbers = dict.fromkeys(re.findall(r"\[Errno (\d+)\] Connect call failed", text))
    if numbers:
        return ", ".join(os.strerror(int(number)) for number in numbers)
    return re.sub(r"\[Errno -?\d+\] ", "", text)


class Denials:
    """The subjects that one connection may not use, as its server said; each is told once."""

    def __init__(self) -> None:
        self._said: Counter[tuple[str, str]] = Counter()  # how often, by kind and subject
        self._raised = ""  # a subscription whose denial is raised, and so not told

    async def note(self, failure: Exception) -> None:
        """Take what a server says of its own accord."""
        found = _DENIAL.search(str(failure))
        if not found:
            return
        kind, subject = found[1].lower(), found[2].lower()  # the client gives them so
        if (kind, subject) not in self._said:
            if len(self._said) >= MOST_DENIALS:
                return
            if (kind, subject) != ("subscription", self._raised):
                _log.warning("%s", _sentence(kind, subject))
        self._said[kind, subject] += 1

    def of_request(self, subject: str) -> int:
        """Return how often a request to this subject was denied."""
        return self._said["publish", subject.lower()]

    def check_request(self, subject: str, inbox: str, before: int) -> None:
        """Raise MayNotSend or NoRight where a request has no answer for want of rights.

        `before` is how often it was denied before it was sent. MayNotSend says that it reached nobody,
        NoRight that nothing can be heard in this inbox.
        """
        if self.of_request(subject) > before:
            raise MayNotSend(_sentence("publish", subject))
        for kind, denied in self._said:
            if kind == "subscription" and denied.startswith(inbox.lower()):
                raise NoRight(_sentence(kind, denied))

    @contextmanager
    def raising(self, subject: str) -> Iterator[None]:
        """Raise NoRight at the end where this was found not to be allowed to be listened to."""
        self._raised = subject.lower()
        try:
            yield
        finally:
            self._raised = ""
        if self._said["subscription", subject.lower()]:
            raise NoRight(_sentence("subscription", subject))


def _sentence(kind: str, subject: str) -> str:
    return f"these credentials do not allow to {'publish' if kind == 'publish' else 'listen'} to {subject}"
