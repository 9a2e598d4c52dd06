"""The stream of all gateways' samples, and its Forwarder. Uses JetStream's own API (direct gets: ADR-31).

A message has the subject `samples.<gateway>.<log id>`. The message's headers contain its number in that
log (`Multidrop-Sequence`) and a digest of its bytes.

A Forwarder sends a spool's messages to the stream, in order, each exactly once. One message is in flight at a
time. Each message states the stream position of the previous message of its subject. The stream stores the
message only if that position is right. At the start, and after a timeout or refusal, the forwarder asks the
stream for the last message of the subject, and continues with the next one. So the forwarder needs no file
with an offset, and the stream refuses a duplicate however late it comes.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from multidrop.fleet.errors import FleetError, NobodyThere
from multidrop.fleet.servers.batch_client import (
    STATUS,
    DirectGet,
    DirectMessage,
    Request,
    last_header,
    stored_message,
)
from multidrop.fleet.servers.buckets import ServerError, ask, parsed_answer
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.names import checked_name
from multidrop.samples import Spool, StoredMessage
from multidrop.supervisor import end_tasks, supervisor

STREAM = "samples"
SEQUENCE, DIGEST, LOST = "Multidrop-Sequence", "Multidrop-Digest", "Multidrop-Lost"
BY_SERVER = "Nats-Stream"  # header that a server adds to each stored message that it returns
EXPECTED = "Nats-Expected-Last-Subject-Sequence"
ANSWER_S = 5.0  # time limit for a server's answer; an election takes 4 to 9 s, so requests are retried
NO_MESSAGE, NO_STREAM, WRONG_SEQUENCE = 10037, 10059, 10071  # error codes of JetStream
SENTENCES = {  # messages of FleetError, by JetStream's error code
    NO_STREAM: f"there is no stream {STREAM!r}: create it with `multidrop fleet init`",
    **dict.fromkeys(
        (10005, 10047),
        "the NATS servers have no room for so many samples: keep less with `multidrop fleet init --keep`, "
        "or raise max_file in their jetstream blocks",
    ),
}
SUBJECT = f"$JS.API.DIRECT.GET.{STREAM}"
AGAIN_S = 0.25  # pause after a failure
LOOKING_S = 1.0  # pause between checks for new messages, in case the spool has announced none
SET_BACK = (
    "the servers have message {} of the log {}, and the spool has {}: its folder was copied or set back; "
    "move it away to start a new log"
)
T = TypeVar("T")

_log = logging.getLogger("multidrop.fleet.samples.forwarder")


class StreamInfo(NamedTuple):
    """A stream's identity, which is the time of its creation, and its first and last positions."""

    created: str
    first: int
    last: int


class LastMessage(NamedTuple):
    """The newest message of a subject."""

    place: int  # the message's position in the stream
    sequence: int  # number in the gateway's log; 0 if the message is not from a gateway
    digest: str


def subject_of(gateway: str, log: str) -> str:
    return f"{STREAM}.{gateway}.{log}"


def digest_of(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()


async def _answer_to(request: Awaitable[T]) -> T:
    """Return the answer to a request; raise CancelledError if this task was cancelled in the meantime.

    In Python 3.11, `asyncio.wait_for` swallows that exception if an answer arrives at the same moment.
    """
    try:
        return await request
    finally:
        task = asyncio.current_task()
        if task and task.cancelling():
            raise asyncio.CancelledError


@asynccontextmanager
async def samples_path(
    urls: Sequence[str], options: Mapping[str, Any] | None = None
) -> AsyncIterator[ServerPath]:
    """Yield a connection to one of the servers; if that server fails, the connection moves to another one.

    Raises FleetError if no server can be used.
    """
    path = ServerPath(urls, options, ANSWER_S)
    try:
        await path.open()
        keeping = supervisor().keep("samples path", path.keep())
        try:
            yield path
        finally:
            supervisor().let_go("samples path")
            await end_tasks(keeping)
    finally:
        await path.close()


async def create_stream(path: ServerPath, *, replicas: int = 3, most_bytes: int = -1) -> int:
    """Create the stream of samples if it is missing.

    Return the stream's size limit in bytes, or -1 if it is unlimited. Above `most_bytes`, the oldest messages
    are removed. The servers reserve that much space. A stream without a limit fills their disks, and then no
    lease can be renewed.
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
    found = await _ask(path, f"STREAM.INFO.{STREAM}", {}, NO_STREAM)
    if found is None:
        found = await _ask(path, f"STREAM.CREATE.{STREAM}", config)
    with _checked_fields():
        return int(found["config"].get("max_bytes", -1))


async def stream_info(path: ServerPath) -> StreamInfo:
    found = await _ask(path, f"STREAM.INFO.{STREAM}", {})
    with _checked_fields():
        config, state = found["config"], found["state"]
        if not config.get("allow_direct"):
            raise FleetError(
                f"the stream {STREAM!r} allows no direct gets: set allow_direct of the stream to true in NATS"
            )
        return StreamInfo(str(found["created"]), int(state["first_seq"]), int(state["last_seq"]))


async def last_of(path: ServerPath, subject: str) -> LastMessage | None:
    """Return the newest message of a subject, from the stream's leader. Raises FleetError."""
    found = await _ask(path, f"STREAM.MSG.GET.{STREAM}", {"last_by_subj": subject}, NO_MESSAGE)
    if found is None:
        return None
    with _checked_fields():
        message = found["message"]
        lines = base64.b64decode(message.get("hdrs", "")).decode("utf-8", "replace").splitlines()
        headers = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        number = 0 if BY_SERVER in headers else number_of(headers.get(SEQUENCE))
        return LastMessage(int(message["seq"]), number, headers.get(DIGEST, ""))


async def publish(path: ServerPath, subject: str, data: bytes, headers: dict[str, str]) -> int | None:
    """Store a message and return its position; None if the subject's last message is not the expected one.

    After a FleetError, the outcome is unknown: the message may have been stored.
    """
    try:
        answer = await _answer_to(path.request(subject, data, headers, ANSWER_S))
    except NobodyThere as failure:
        raise FleetError(
            f"no stream stores {subject}: the stream is missing, or has no leader now"
        ) from failure
    found = parsed_answer(answer.data)
    if error := found.get("error"):
        if error.get("err_code") == WRONG_SEQUENCE:
            return None
        raise FleetError(f"the stream {STREAM!r} refuses a message: {error.get('description')}")
    with _checked_fields():
        return int(found["seq"])


def number_of(text: str | None) -> int:
    """Return the number in a header's text; 0 if the header is missing or invalid."""
    return int(text) if text and text.isascii() and text.isdigit() and len(text) < 19 else 0


async def _ask(path: ServerPath, subject: str, what: Mapping[str, Any], *none: int) -> Any:
    """Send a request to JetStream's API and return the answer; None for an error whose code is in `none`."""
    try:
        return await _answer_to(ask(path, subject, what, ANSWER_S))
    except NobodyThere as failure:
        raise FleetError("the NATS servers run without JetStream, or have no quorum now") from failure
    except ServerError as failure:
        if failure.code in none:
            return None
        raise FleetError(SENTENCES.get(failure.code, str(failure))) from failure


@contextmanager
def _checked_fields() -> Iterator[None]:
    """Raise FleetError if an answer lacks a field or has a wrong type."""
    try:
        yield
    except (AttributeError, KeyError, TypeError, ValueError):
        raise FleetError("the answer of NATS lacks a field") from None


class StreamMessage(NamedTuple):
    """A message as the hub reads it. `sequence` is 0 if the message cannot be from a gateway.

    Such a message has no valid `Multidrop-Sequence`, or it is a server's answer to a read request: a client
    can make a server send the answer to any subject, even to one of the stream's subjects.
    """

    place: int
    gateway: str
    log: str
    sequence: int
    lost: int  # number of rows that the gateway's spool had lost when it sent the message
    data: bytes


async def read_after(path: ServerPath, place: int, messages: int, size: int) -> list[StreamMessage]:
    """Return at most `messages` messages after this position, with at most `size` bytes together.

    No message between them is left out. Any replica may answer. Raises FleetError.
    """
    wanted = {"seq": place + 1, "batch": messages, "max_bytes": size, "next_by_subj": f"{STREAM}.>"}
    get = SampleGet()
    try:
        await _answer_to(path.gather(Request(SUBJECT, json.dumps(wanted).encode()), get, ANSWER_S))
    except FleetError as failure:
        # messages before the lost one are complete; the next call reads the rest
        if get.found or get.has_hole:
            return get.found
        raise _refused(get.end_line) if get.last.done() else failure from failure
    return get.found


class SampleGet(DirectGet):
    """Collects the stored messages that answer one read request, parsed from raw headers.

    The sender of a message may write any headers, even invalid ones or imitations of a server's headers. The
    server appends its own headers. A parser that stops at an invalid header would read only the sender's.
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: list[StreamMessage] = []
        self.has_hole = False  # True if a message of the answer was lost between the server and this client
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


def _refused(end_line: str) -> FleetError:
    if end_line.startswith("503"):
        return FleetError(f"there is no stream {STREAM!r}, or it has no leader now")
    return FleetError(f"the stream {STREAM!r} cannot be read: {end_line}")


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


# ---- sending ----


class NotOurLog(Exception):
    """The stream has a message that this spool never wrote: its folder was copied or restored."""


class Forwarder:
    """Sends the messages of a spool over this connection: `await forwarder.run()` runs until it is cancelled.

    Raises ValueError if the gateway's name cannot be part of a NATS subject.
    """

    def __init__(self, spool: Spool, path: ServerPath) -> None:
        self._spool, self._path = spool, path
        self._subject = subject_of(checked_name("gateway", spool.gateway), spool.log)
        self._news = asyncio.Event()
        self.sent = 0  # messages sent since the start
        # number of the newest message that was moved from the gateway's disk to the stream; None: unknown yet
        self.last: int | None = None
        self.trouble: str | None = None

    def lag_s(self) -> float | None:
        """Return the age (s, by the system clock) of the oldest message that is not in the stream yet.

        Return 0 if the stream has all messages. Return None if the stream's position is not known yet, or if
        the spool has removed the message.
        """
        if self.last is None:
            return None
        stored = self._spool.following(self.last)
        if stored is None:
            return 0.0
        with suppress(OSError):  # the spool may just have removed the file
            return max(0.0, time.time() - stored.path.stat().st_mtime)
        return None

    async def run(self) -> None:
        loop = asyncio.get_running_loop()

        def announce() -> None:
            with suppress(RuntimeError):  # raised if the event loop is closed
                loop.call_soon_threadsafe(self._news.set)

        self._spool.on_message = announce
        while True:
            try:
                await self._forward()
            except (NotOurLog, OSError) as failure:
                self._note(str(failure))
            except Exception as failure:  # such as MemoryError, or a bug in this program
                self._note(f"{type(failure).__name__}: {failure}", failure)
            await asyncio.sleep(AGAIN_S)

    async def _forward(self) -> None:
        """Find the spool's last message in the stream, and send the following ones until one is refused."""
        place, sequence = await self._ask()
        while True:
            self._news.clear()
            stored = self._spool.following(sequence)
            if stored is None:
                self._note(None)
                with suppress(TimeoutError):
                    async with asyncio.timeout(LOOKING_S):
                        await self._news.wait()
                continue
            data = await asyncio.to_thread(_read, stored.path)
            if data is None:  # the spool is full and has just removed the message
                continue
            found = await publish(self._path, self._subject, data, self._headers(stored, data, place))
            if found is None:  # refused, because the earlier attempt was stored after all
                return
            place, sequence = found, stored.sequence
            self.sent += 1
            self._have(sequence)
            self._note(None)

    async def _ask(self) -> tuple[int, int]:
        """Return the stream position and the sequence number of the spool's last message in the stream."""
        last = await last_of(self._path, self._subject)
        # if the stream has no message of this gateway now, or its last message is from another program
        if last is None or last.sequence == 0:
            sequence = self.last or 0
            self._have(sequence)
            return (last.place if last else 0), sequence
        if last.sequence > self._spool.state().newest:
            raise NotOurLog(SET_BACK.format(last.sequence, self._spool.log, "no such message"))
        stored = self._spool.stored(last.sequence)
        data = await asyncio.to_thread(_read, stored.path) if stored else None
        if data is not None and digest_of(data) != last.digest:
            raise NotOurLog(SET_BACK.format(last.sequence, self._spool.log, "another one"))
        self._have(last.sequence)
        return last.place, last.sequence

    def _headers(self, stored: StoredMessage, data: bytes, place: int) -> dict[str, str]:
        return {
            EXPECTED: str(place),
            SEQUENCE: str(stored.sequence),
            DIGEST: digest_of(data),
            LOST: str(self._spool.state().lost),
        }

    def _have(self, sequence: int) -> None:
        self.last = sequence
        self._spool.acknowledge(sequence)

    def _note(self, trouble: str | None, cause: Exception | None = None) -> None:
        if trouble and trouble != self.trouble:
            _log.error("samples are not forwarded: %s", trouble, exc_info=cause)
        if self.trouble and not trouble:
            _log.warning("samples are forwarded again, after message %s", self.last)
        self.trouble = trouble


def _read(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
