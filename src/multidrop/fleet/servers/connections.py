"""Connections to NATS: each process has three, called paths, so that one failed server stops only one path.

Each path uses its own home server while that server answers, otherwise another server. A direct get is a read
that a server forwards to a random server that has the records: to itself, or to another one. A server that is
cut off still gets its share of the reads for seconds, until the others notice. So a read without an early
answer is repeated on all paths together. Each answer may be out of date. A write that depends on such an
answer therefore names the revision that was read.

A user's key is an Ed25519 key pair (an "nkey"). The secret key is in a file that only its user has; servers
know the public key. Answers to a user go to an inbox that is named after the public key. No other user may
read the inbox.
"""

from __future__ import annotations

import asyncio
import logging
import os
import ssl
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import nats
from nats.aio.msg import Msg
from nats.aio.subscription import Subscription
from nats.errors import Error as NatsError

from multidrop.fleet.errors import (
    Denials,
    FleetError,
    NobodyThere,
    NoRight,
    NotAdmitted,
    NotDelivered,
    OutcomeUnknown,
    TooOld,
    failure_to_connect,
)
from multidrop.fleet.servers import names
from multidrop.fleet.servers.batch_client import BatchClient, DirectGet, DirectMessage, Request
from multidrop.printable import masked
from multidrop.supervisor import end_tasks

PATHS = len(names.LEASES)  # number of connections of a process
# Minimum version of NATS. In 2.9.10, several clients may replace the same revision (nats-server issue 4320).
OLDEST = (2, 12)
CONNECT_S = 1.0
ANSWER_S = 1.0  # time limit of an answer; leases are renewed twice a second
PONG_S = 0.7  # time limit of a ping; if a server is slower, the connection moves to another server
KEEP_S = 1.0  # pause between checks of a connection
# One attempt: with a limit of 0, nats-py would retry a closed port until `connect` times out.
ONE_TRY = {"allow_reconnect": False, "max_reconnect_attempts": 1, "reconnect_time_wait": 0.05}
# Times (s) without data after which a read is repeated. After the last one, the read fails.
AGAIN_S = (0.1, 0.1, 0.2, 0.4, 1.0)
SLOW = 3.0  # a read is repeated only after this many times the usual response time
MOST_SILENCE_S = 1.0  # limit of the wait before a repeat, because requests time out after this time
# The usual response time is the longest recent one. Each answer multiplies it by this factor, so that one
# slow answer is forgotten after about a hundred fast ones.
FORGET = 0.97
# Limit of the repeated reads that a process can save up for later. If a route between servers fails, they
# notice it after 3 s. Until then a process needs half of these repeats.
MOST_REPEATS = 300.0
EARNED = 0.5  # each timely answer allows this many further repeats
SEED = "SU"  # prefix of a user's secret key
CREDS = "-----BEGIN NATS USER JWT-----"

_log = logging.getLogger("multidrop.fleet")


class ServerPath:
    """A connection to a home server while that server answers, otherwise to any other server."""

    def __init__(
        self, urls: Sequence[str], options: Mapping[str, Any] | None = None, pong_s: float = PONG_S
    ) -> None:
        self.urls = [masked(url) for url in urls]  # the first is the home server
        self._full = dict(zip(self.urls, urls, strict=True))  # URLs with users and passwords, by masked URL
        self.url = ""  # URL of the present server
        self.others: Sequence[ServerPath] = ()  # the other connections of this process, for repeated reads
        self.budget = RepeatBudget()  # limits repeated reads; shared by all connections of this process
        self._options = options or {}
        self._pong_s = pong_s
        self._client: BatchClient | None = None
        self._denials = Denials()
        self._trouble = ""  # the last logged failure; "" while the connection works
        self._leaving: set[asyncio.Task[None]] = set()
        self._wanted: dict[str, Callable[[Msg], Any]] = {}  # the function to call with messages, by subject
        self._standing: dict[str, Subscription] = {}  # active subscriptions at the present server, by subject
        self._changing = asyncio.Lock()

    @property
    def is_open(self) -> bool:
        return self._client is not None and self._client.is_connected and self._client.is_reading

    @property
    def server_name(self) -> str:
        """The name of the present server; "" if there is no connection."""
        return str(self._client._server_info.get("server_name", "")) if self._client else ""

    @property
    def version(self) -> str:
        assert self._client is not None
        found = self._client.connected_server_version
        return f"{found.major}.{found.minor}"

    async def open(self) -> None:
        """Connect to the first server that answers. Raises FleetError if no server does."""
        failures = []
        for url in self.urls:
            try:
                await self._move(url)
            except TooOld:
                raise
            except FleetError as failure:
                failures.append(failure)
            else:
                return
        refusals = [failure for failure in failures if isinstance(failure, NotAdmitted)]
        raise refusals[0] if refusals else FleetError("; ".join(map(str, failures)))

    async def keep(self) -> None:
        """Check the connection forever: leave a silent server, and return to the home server if possible."""
        while True:
            try:
                await self.check()
                self._trouble = ""
            except NotAdmitted as failure:
                if self._trouble != str(failure):
                    _log.warning("%s", failure)
                self._trouble = str(failure)
            except FleetError:
                pass
            await asyncio.sleep(KEEP_S)

    async def check(self) -> None:
        """Check the connection once. `keep` calls this repeatedly."""
        if not self.is_open or not await self._answers():
            self._leave()
            await self.open()
        elif self.url != self.urls[0]:
            await self._move(self.urls[0])

    async def _answers(self) -> bool:
        assert self._client is not None
        try:
            await asyncio.wait_for(self._client.flush(), self._pong_s)
        except (NatsError, OSError, TimeoutError):
            return False
        return True

    async def _move(self, url: str) -> None:
        denials = Denials()
        client = await connect(self._full[url], self._options, denials)
        async with self._changing:
            standing: dict[str, Subscription] = {}
            try:
                await self._update_subscriptions(client, standing)
            except (NatsError, OSError) as failure:
                await _close(client)
                raise FleetError(f"the new connection to {url} was lost at once: {failure}") from None
            self._leave()
            self._client, self.url, self._standing, self._denials = client, url, standing, denials

    def _leave(self) -> None:
        if self._client is not None:
            task = asyncio.get_running_loop().create_task(_close(self._client))
            self._leaving.add(task)
            task.add_done_callback(self._leaving.discard)
            self._client, self.url = None, ""

    async def subscribe(self, subject: str, called: Callable[[Msg], Any]) -> None:
        """Await `called` with each message of a subject, also after a change of server."""
        self._wanted[subject] = called
        await self._change_subscriptions()

    async def unsubscribe(self, subject: str) -> None:
        self._wanted.pop(subject, None)
        await self._change_subscriptions()

    async def _change_subscriptions(self) -> None:
        async with self._changing:
            if self._client is not None:
                # If this fails, `keep` soon connects again, and subscribes to all of `_wanted`.
                with suppress(NatsError, OSError):
                    await self._update_subscriptions(self._client, self._standing)

    async def _update_subscriptions(self, client: BatchClient, standing: dict[str, Subscription]) -> None:
        """Subscribe the client to exactly the subjects in `_wanted`, and update `standing`."""
        while standing.keys() != self._wanted.keys():
            for subject in self._wanted.keys() - standing.keys():
                if called := self._wanted.get(subject):  # `unsubscribe` may have removed the subject
                    standing[subject] = await client.subscribe(subject, cb=called)
            for subject in standing.keys() - self._wanted.keys():
                await standing.pop(subject).unsubscribe()

    async def subscribe_or_raise(self, subject: str, called: Callable[[Msg], Any]) -> None:
        """Subscribe to a subject. Raises NoRight if our credentials do not allow it."""
        with self._denials.raising(subject):
            await self.subscribe(subject, called)
            client = self._connected()
            with suppress(NatsError, OSError, TimeoutError):
                # the server may answer this ping before it handles pending data, but not the second ping
                await client.flush()
                await client.flush()

    async def request(
        self,
        subject: str,
        data: bytes = b"",
        headers: dict[str, str] | None = None,
        answer_s: float = ANSWER_S,
    ) -> Msg:
        """Send a request, and return the answer.

        Raises OutcomeUnknown if no answer comes in time, NoRight if our credentials do not allow the request
        or its answer, NotDelivered if the request certainly reached no receiver, and NobodyThere if the
        server reports that.
        """
        client, denials = self._connected(), self._denials
        before = denials.of_request(subject)
        try:
            return await client.request(subject, data, answer_s, headers=headers)
        except nats.errors.NoRespondersError:
            raise NobodyThere(f"{self.url} has no subscriber that answers {subject}") from None
        except (NatsError, OSError, TimeoutError) as failure:
            denials.check_request(subject, self._options.get("inbox_prefix", "_INBOX"), before)
            raise OutcomeUnknown(f"{self.url} gave no answer to {subject}: {failure}") from None

    async def collect(self, subject: str, data: bytes) -> list[DirectMessage]:
        """Return the stored messages that answer a read request. Raises the errors of the method `request`.

        If this connection is slow, the request is repeated on the other connections.
        """
        paths = [self, *(other for other in self.others if other.is_open)]
        return await first_answer(paths, Request(subject, data), self.budget)

    async def gather(self, request: Request, get: DirectGet, silence_s: float = ANSWER_S) -> None:
        """Collect the stored messages that answer a read request.

        Raises the errors of the method `request`.
        """
        client, denials = self._connected(), self._denials
        before = denials.of_request(request.subject)
        try:
            await client.batch(request, get, silence_s)
        except (NatsError, OSError) as failure:
            denials.check_request(request.subject, self._options.get("inbox_prefix", "_INBOX"), before)
            raise OutcomeUnknown(
                f"{self.url} gave no complete answer to {request.subject}: {failure}"
            ) from None

    async def request_all(self, requests: Sequence[Request]) -> list[bytes | None]:
        """Send all requests together and return the answer to each; None for a request without an answer."""
        try:
            return await self._connected().replies(requests, ANSWER_S)
        except (NatsError, OSError) as failure:
            raise OutcomeUnknown(
                f"{self.url} was lost while {len(requests)} requests were sent: {failure}"
            ) from None

    def _connected(self) -> BatchClient:
        if self._client is None or not self._client.is_connected:
            raise NotDelivered(f"no connection to {self.urls[0]}")
        return self._client

    async def close(self) -> None:
        self._leave()
        await asyncio.gather(*self._leaving)


async def connect(url: str, options: Mapping[str, Any], denials: Denials | None = None) -> BatchClient:
    """Connect to this server only, not to others of its cluster. Raises FleetError with one sentence."""
    refusals: list[Exception] = []
    noted = denials or Denials()

    async def note(failure: Exception) -> None:
        if not client.is_connected:
            refusals.append(failure)
        await noted.note(failure)

    client = BatchClient()
    settings = {**ONE_TRY, "connect_timeout": CONNECT_S}
    try:
        await asyncio.wait_for(client.connect(url, error_cb=note, **{**options, **settings}), 2 * CONNECT_S)
    except asyncio.CancelledError:
        _abort(client)
        raise
    except (NatsError, OSError, TimeoutError, ValueError) as failure:
        _abort(client)
        raise failure_to_connect(url, refusals[-1] if refusals else failure) from None
    found = client.connected_server_version
    if (found.major, found.minor) < OLDEST:
        await _close(client)
        raise TooOld(
            f"the NATS server at {masked(url)} has version {found.major}.{found.minor}, but a fleet needs "
            f"{'.'.join(map(str, OLDEST))} or newer. Older servers may give one lease to two gateways"
        )
    return client


async def _close(client: BatchClient) -> None:
    try:
        with suppress(NatsError, OSError, TimeoutError):
            await asyncio.wait_for(client.close(), CONNECT_S)
    finally:
        _abort(client)


def _abort(client: BatchClient) -> None:
    """Close the client's socket, and end the tasks that nats-py does not end itself."""
    for subscription in client._subs.values():
        subscription._stop_processing()
    reading = client._reading_task
    if reading is not None and reading.done() and not reading.cancelled():
        reading.exception()  # fetches the exception, so that asyncio does not report it
    writer = getattr(client._transport, "_io_writer", None)
    if writer is not None and writer.transport is not None:
        writer.transport.abort()


def paths_of(urls: Sequence[str], options: Mapping[str, Any] | None = None) -> list[ServerPath]:
    """Return three connections (paths). With three URLs, each connection prefers a different server."""
    paths = [ServerPath([*urls[at % len(urls) :], *urls[: at % len(urls)]], options) for at in range(PATHS)]
    for path in paths:
        path.others, path.budget = [other for other in paths if other is not path], paths[0].budget
    return paths


# ---- repeated reads ----


class RepeatBudget:
    """Limits how often one process repeats reads, and determines how long to wait before a repeat.

    If all servers are slow, repeated reads make them even slower. So the budget is empty at first. Each
    timely answer earns half a repeat. If a read was repeated, and its first request is answered after all,
    the repeat was needless, and the budget is halved.

    A client that has seen slow answers also waits proportionally longer before a repeat. Otherwise, when many
    gateways start and read whole buckets, these large reads would use up the repeats that small reads have
    earned.
    """

    def __init__(self) -> None:
        self._left = 0.0
        self._took_s = MOST_SILENCE_S / SLOW  # usual response time; the first value is an assumption

    def note(self, *, is_late: bool) -> None:
        """Earn or lose repeats, after the first request of a read was answered.

        `is_late` means that the read had already been repeated when this answer came.
        """
        self._left = self._left / 2 if is_late else min(self._left + EARNED, MOST_REPEATS)

    def learn(self, took_s: float) -> None:
        self._took_s = max(took_s, FORGET * self._took_s)

    def silence_s(self, least_s: float) -> float:
        """Return how many seconds to wait for a message: at least `least_s`, more if answers are slow."""
        return max(least_s, min(SLOW * self._took_s, MOST_SILENCE_S))

    def spend(self, paths: Sequence[ServerPath]) -> Sequence[ServerPath]:
        """Return as many connections as the budget allows, and charge the budget one repeat for each."""
        asked = paths[: int(self._left)]
        self._left -= len(asked)
        return asked


async def first_answer(
    paths: Sequence[ServerPath], request: Request, budget: RepeatBudget
) -> list[DirectMessage]:
    """Return the messages of the first complete answer. Raises FleetError if no complete answer comes.

    The request is first sent on the first connection only, because that one usually answers immediately.
    """
    loop = asyncio.get_running_loop()
    gets: dict[asyncio.Task[None], DirectGet] = {}
    asked_at: dict[DirectGet, float] = {}
    first: DirectGet | None = None
    failure: BaseException = OutcomeUnknown(f"no answer to {request.subject}")
    try:
        for number, least_s in enumerate(AGAIN_S):
            again = paths[1:] if number == 1 and paths[1:] else paths
            for path in budget.spend(again) if number else paths[:1]:
                get = DirectGet()
                first = first or get
                asked_at[get] = loop.time()
                gets[asyncio.create_task(path.gather(request, get))] = get
            while await _has_one_ended(gets, budget.silence_s(least_s)):
                for task in [task for task in gets if task.done()]:
                    get = gets.pop(task)
                    if not (failed := task.exception()):
                        budget.learn(loop.time() - asked_at[get])
                        if get is first:
                            budget.note(is_late=number > 0)
                        return get.messages
                    failure = failed
            is_refused = isinstance(failure, NoRight)  # all servers grant the same rights
            if not gets and (number or not paths[1:] or is_refused):
                break
        raise failure
    finally:
        await end_tasks(*gets)


async def _has_one_ended(gets: Mapping[asyncio.Task[None], DirectGet], silence_s: float) -> bool:
    """Wait until one of the requests has ended, and return True.

    Return False after `silence_s` seconds without data, or if no request is left.
    """
    while gets:
        before = sum(get.count for get in gets.values())
        done, _ = await asyncio.wait(gets, timeout=silence_s, return_when=asyncio.FIRST_COMPLETED)
        if done or sum(get.count for get in gets.values()) == before:
            return bool(done)
    return False


# ---- credentials, and trusted certificates ----


def new_seed() -> str:
    import nkeys

    return bytes(nkeys.encode_seed(os.urandom(32), nkeys.PREFIX_BYTE_USER)).decode()


def public_key(seed: str) -> str:
    """Return the public key that belongs to a secret key. Raises ValueError for an invalid key."""
    import nkeys

    try:
        pair = nkeys.from_seed(bytearray(seed.encode()))
    except (nkeys.NkeysError, ValueError) as failure:
        raise ValueError(f"not a secret key of a NATS user: {type(failure).__name__}") from None
    return bytes(pair.public_key).decode()


def inbox_of(public: str) -> str:
    return f"_INBOX_{public}"


def connect_options(
    urls: Sequence[str], credentials: Path | None = None, ca: Path | None = None
) -> dict[str, Any]:
    """Return nats-py's options for connecting to these servers.

    `credentials` is a file with a user's secret key, or a .creds file. `ca` is the certificate that has
    signed the servers' certificates. With `ca`, or with tls:// in a URL, TLS starts before anything else is
    sent. Raises ValueError for an invalid file.
    """
    options: dict[str, Any] = {}
    if ca is not None or any(url.startswith("tls://") for url in urls):
        options |= {"tls": _context(ca), "tls_handshake_first": True}
    return options | _user(credentials) if credentials is not None else options


def _user(credentials: Path) -> dict[str, Any]:
    try:
        text = credentials.read_text("utf-8", "replace").strip()
    except OSError as failure:
        raise ValueError(f"{credentials}: {failure.strerror}") from None
    if CREDS in text:
        return {"user_credentials": str(credentials)}
    if not text.startswith(SEED):
        raise ValueError(
            f"{credentials} has no credentials: name a key file of `multidrop fleet rights`, or a .creds file"
        )
    try:
        public = public_key(text)
    except ValueError:
        raise ValueError(f"{credentials} is not a valid key file of `multidrop fleet rights`") from None
    return {"nkeys_seed_str": text, "inbox_prefix": inbox_of(public)}


def _context(ca: Path | None) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=ca)
    except ssl.SSLError:
        raise ValueError(f"{ca} has no certificate: it must be a PEM file") from None
    except OSError as failure:
        raise ValueError(f"{ca}: {failure.strerror}") from None
