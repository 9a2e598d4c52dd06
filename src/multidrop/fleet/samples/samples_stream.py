"""The stream of all gateways' samples, through JetStream's own API (ADR-31 for direct gets).

A message has the subject `samples.<gateway>.<log id>`, its number in that log in the header
`Multidrop-Sequence`, and a digest of its bytes. This module keeps no state: it asks the stream.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

from nats.aio.client import Client
from nats.errors import Error, NoRespondersError

from multidrop.fleet.errors import TooOld, Unsure, failure_to_connect
from multidrop.fleet.servers.batch_client import (
    STATUS,
    BatchClient,
    DirectGet,
    DirectMessage,
    Request,
    last_header,
    stored_message,
)
from multidrop.fleet.servers.buckets import parsed_answer
from multidrop.fleet.servers.connections import check_version

STREAM = "samples"
SEQUENCE, DIGEST, LOST = "Multidrop-Sequence", "Multidrop-Digest", "Multidrop-Lost"
BY_SERVER = "Nats-Stream"  # a header of each message that a server returns from a stream
EXPECTED = "Nats-Expected-Last-Subject-Sequence"
ANSWER_S = 5.0  # for an answer; an election takes 4 to 9 s, so requests are retried
NO_MESSAGE, NO_STREAM, WRONG_SEQUENCE = 10037, 10059, 10071  # error codes of JetStream
SENTENCES = {  # error messages by code
    NO_STREAM: f"there is no stream {STREAM!r}: create it with `multidrop fleet init`",
    **dict.fromkeys(
        (10005, 10047),
        "the NATS servers have no room for so many samples: keep less with `multidrop fleet init --keep`, "
        "or raise max_file in their jetstream blocks",
    ),
}


class StreamError(OSError):
    """NATS cannot be reached, refuses a request, or has no such stream. The message is one sentence."""


class StreamAbout(NamedTuple):
    """A stream's identity (when it was created), and its first and last positions."""

    created: str
    first: int
    last: int


class LastMessage(NamedTuple):
    """The newest message of a subject: its position in the stream, its number in the log, its digest.

    The number is 0 if the message is not a gateway's, but a server's answer that was directed to this
    subject.
    """

    place: int
    sequence: int
    digest: str


def subject_of(gateway: str, log: str) -> str:
    return f"{STREAM}.{gateway}.{log}"


def digest_of(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def end_if_cancelled() -> None:
    """Raise CancelledError again if `asyncio.wait_for` has swallowed it.

    In Python 3.11, it does so if the cancellation coincides with an answer.
    """
    task = asyncio.current_task()
    if task and task.cancelling():
        raise asyncio.CancelledError


async def connect(servers: list[str], **options: Any) -> BatchClient:
    """Return a connection that reconnects by itself. Raises StreamError or TooOld."""
    client = BatchClient()
    try:
        async with asyncio.timeout(ANSWER_S):
            await client.connect(
                servers,
                allow_reconnect=True,
                max_reconnect_attempts=-1,
                reconnect_time_wait=1,
                ping_interval=2,
                **{"error_cb": _ignore, **options},
            )
    except (Error, OSError, TimeoutError) as failure:
        last = client.last_error or failure
        await close(client)
        raise StreamError(str(failure_to_connect(", ".join(servers), last))) from failure
    try:
        check_version(client, ", ".join(servers))
    except TooOld:
        await close(client)
        raise
    return client


async def close(client: Client) -> None:
    """Close a connection, even if it is half open or its servers are gone."""
    with suppress(Exception):
        async with asyncio.timeout(ANSWER_S):
            await client.close()


async def _ignore(_: Exception) -> None:
    """Ignore the error: callers get it too, and the client would log a traceback for each."""


async def create_stream(client: Client, *, replicas: int = 3, most_bytes: int = -1) -> int:
    """Create the stream if it is missing, and return its size limit in bytes; -1 for none.

    The oldest messages are removed above `most_bytes`, which the servers reserve: a stream without a limit
    fills their disks, and then no lease can be renewed. An existing stream stays as it is.
    """
    config = {
        "name": STREAM,
        "subjects": [f"{STREAM}.*.*"],
        "retention": "limits",
        "discard": "old",
        "storage": "file",
        "num_replicas": replicas,
        "max_bytes": most_bytes,
        "allow_direct": True,
        "deny_delete": True,
    }
    found = await _ask(client, f"STREAM.INFO.{STREAM}", {}, NO_STREAM)
    if found is None:
        found = await _ask(client, f"STREAM.CREATE.{STREAM}", config)
    with _as_wanted():
        return int(found["config"].get("max_bytes", -1))


async def about(client: Client) -> StreamAbout:
    """Return the stream's identity and extent. Raises StreamError."""
    found = await _ask(client, f"STREAM.INFO.{STREAM}", {})
    with _as_wanted():
        config, state = found["config"], found["state"]
        if not config.get("allow_direct"):
            raise StreamError(f"the stream {STREAM!r} allows no direct gets: set allow_direct")
        return StreamAbout(str(found["created"]), int(state["first_seq"]), int(state["last_seq"]))


async def last_of(client: Client, subject: str) -> LastMessage | None:
    """Return the newest message of a subject, from the stream's leader. Raises StreamError."""
    found = await _ask(client, f"STREAM.MSG.GET.{STREAM}", {"last_by_subj": subject}, NO_MESSAGE)
    if found is None:
        return None
    with _as_wanted():
        message = found["message"]
        lines = base64.b64decode(message.get("hdrs", "")).decode("utf-8", "replace").splitlines()
        headers = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        number = 0 if BY_SERVER in headers else number_of(headers.get(SEQUENCE))
        return LastMessage(int(message["seq"]), number, headers.get(DIGEST, ""))


async def publish(client: Client, subject: str, data: bytes, headers: dict[str, str]) -> int | None:
    """Store a message, and return its position; None if the subject's last message is not the expected one.

    After a StreamError, the message may have been stored or not.
    """
    try:
        answer = await client.request(subject, data, timeout=ANSWER_S, headers=headers)
    except NoRespondersError as failure:
        raise StreamError(f"no stream takes {subject}: it is missing, or has no leader now") from failure
    except (Error, OSError, TimeoutError) as failure:
        raise silent(client, failure) from failure
    found = _table(answer.data)
    if error := found.get("error"):
        if error.get("err_code") == WRONG_SEQUENCE:
            return None
        raise StreamError(f"the stream {STREAM!r} refuses a message: {error.get('description')}")
    with _as_wanted():
        return int(found["seq"])


def number_of(text: str | None) -> int:
    """Return a header's number; 0 if it is missing or invalid."""
    return int(text) if text and text.isascii() and text.isdigit() and len(text) < 19 else 0


async def _ask(client: Client, subject: str, what: Mapping[str, Any], *none: int) -> Any:
    """Return the answer of JetStream's API; None for an error whose code is in `none`."""
    try:
        answer = await client.request(f"$JS.API.{subject}", json.dumps(what).encode(), timeout=ANSWER_S)
    except NoRespondersError as failure:
        raise StreamError("the NATS servers run without JetStream, or have no quorum now") from failure
    except (Error, OSError, TimeoutError) as failure:
        raise silent(client, failure) from failure
    found = _table(answer.data)
    error = found.get("error")
    if not error:
        return found
    if error.get("err_code") in none:
        return None
    if sentence := SENTENCES.get(error.get("err_code")):
        raise StreamError(sentence)
    raise StreamError(f"NATS refuses {subject}: {error.get('description')}")


def _table(data: bytes) -> dict[str, Any]:
    try:
        return parsed_answer(data)
    except Unsure as failure:
        raise StreamError(str(failure)) from None


@contextmanager
def _as_wanted() -> Iterator[None]:
    """Raise StreamError if an answer lacks a field."""
    try:
        yield
    except (AttributeError, KeyError, TypeError, ValueError):
        raise StreamError("the answer of NATS lacks a field") from None


def silent(client: Client, failure: Exception) -> StreamError:
    """Return the error for a missing answer; a server reports missing rights in a separate message."""
    last = client.last_error
    if last and "permissions violation" in str(last).lower():
        return StreamError(f"this connection lacks rights: {_text(last)}")
    if not client.is_connected:
        return StreamError(f"NATS cannot be reached: {_text(last or failure)}")
    return StreamError(f"NATS did not answer within {ANSWER_S:.0f} s")


def _text(failure: Exception) -> str:
    return str(failure).removeprefix("nats: ") or type(failure).__name__


SUBJECT = f"$JS.API.DIRECT.GET.{STREAM}"


class StreamMessage(NamedTuple):
    """A message as the hub reads it; `sequence` is 0 if the header is missing or invalid.

    It is also 0 for a message that a server returned from a stream. A client that may read stored messages
    can have the server send one to any subject, and so into the stream in another gateway's name.
    """

    place: int
    gateway: str
    log: str
    sequence: int
    lost: int  # rows that the gateway's spool had lost by then
    data: bytes


async def read_after(client: BatchClient, place: int, messages: int, size: int) -> list[StreamMessage]:
    """Return the next messages after this position, without a gap, within the limits of number and bytes.

    An empty list means that there is none now. Any replica may answer. Raises StreamError.
    """
    wanted = {"seq": place + 1, "batch": messages, "max_bytes": size, "next_by_subj": f"{STREAM}.>"}
    get = SampleGet()
    try:
        await client.batch(Request(SUBJECT, json.dumps(wanted).encode()), get, ANSWER_S)
    except (Error, OSError) as failure:
        if get.found or get.has_hole:  # each message is complete; the next call continues after the last
            return get.found
        raise _refused(get.end_line) if get.last.done() else silent(client, failure) from failure
    return get.found


class SampleGet(DirectGet):
    """The messages that one direct get returns, parsed from raw headers.

    A sender may write any headers into a message, and the server's headers come last. A parser that stops at
    an invalid header would take the sender's claim about the origin for the server's.
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: list[StreamMessage] = []
        self.has_hole = False  # a message of the answer was lost on the way
        self.end_line = ""

    def take(self, headers: bytes, data: bytes) -> None:
        """Add a message to `found`, or note the end of the answer."""
        self.count += 1
        if self.last.done():
            return
        stored = stored_message(headers, data)
        if stored is None:
            self.end_line = headers.partition(b"\r\n")[0][STATUS.start :].decode("ascii", "replace")
            self.end(self.end_line[:3])
        elif number_of(last_header(headers, "Nats-Last-Sequence")) != (
            self.found[-1].place if self.found else 0
        ):
            self.has_hole = True
            self.end()
        else:
            self.found.append(_stream_message(stored, headers))


def _refused(end_line: str) -> StreamError:
    if end_line.startswith("503"):
        return StreamError(f"there is no stream {STREAM!r}, or it has no leader now")
    return StreamError(f"the stream {STREAM!r} cannot be read: {end_line}")


def _stream_message(stored: DirectMessage, headers: bytes) -> StreamMessage:
    _, gateway, log, *_ = [*stored.subject.split("."), "", "", ""]
    return StreamMessage(
        stored.sequence,
        gateway,
        log,
        0 if headers.count(f"\r\n{BY_SERVER}: ".encode()) > 1 else number_of(last_header(headers, SEQUENCE)),
        number_of(last_header(headers, LOST)),
        stored.data,
    )
