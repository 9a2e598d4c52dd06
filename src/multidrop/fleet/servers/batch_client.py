"""BatchClient: a NATS client that sends many requests together and handles their answers cheaply.

nats-py parses the headers of each message with Python's e-mail parser, passes the message through a queue,
and has a timer for each request. A gateway of a large fleet reads tens of thousands of records and claims
hundreds of lines at a time. This client takes the answers directly from the connection, and parses only the
needed headers. nats-py has no public hook for this. If its internals change, the answers arrive as ordinary
messages, which costs more.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from nats.aio.client import Client
from nats.aio.msg import Msg

STATUS = slice(9, 12)  # position of the status in headers such as "NATS/1.0 404 No Messages"
PROCESSED = 4  # number of the arguments that Client._process_msg has after the subscription id
# statuses that end a complete answer: 204 follows the last message, 404 means that there is no message
WHOLE = ("204", "404")


class DirectMessage(NamedTuple):
    """A stored message that JetStream has returned from a stream."""

    subject: str
    sequence: int
    data: bytes


class Request(NamedTuple):
    """A message whose sender waits for an answer."""

    subject: str
    data: bytes
    headers: dict[str, str] | None = None


class Gathered:
    """Collects answers that arrive one by one. The future `last` gets the status of the final one."""

    def __init__(self) -> None:
        self.count = 0
        self.last: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def end(self, status: str = "") -> None:
        if not self.last.done():
            self.last.set_result(status)

    async def wait(self, silence_s: float) -> None:
        """Wait for the final answer; return earlier if no answer has arrived for `silence_s` seconds."""
        before = -1
        while not self.last.done() and self.count > before:
            before = self.count
            await asyncio.wait({self.last}, timeout=silence_s)


class DirectGet(Gathered):
    """Collects the stored messages that answer one direct get, which is a read request to JetStream."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[DirectMessage] = []

    def take(self, headers: bytes, data: bytes) -> None:
        """Add a message to `messages`, or note the end of the answer."""
        self.count += 1
        message = stored_message(headers, data)
        if message is None:
            self.end(headers[STATUS].decode("ascii", "replace"))
        else:
            self.messages.append(message)


class Replies(Gathered):
    """Collects the answers to several requests, in the order of the requests. A missing answer is None."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.found: list[bytes | None] = [None] * number

    def take(self, place: int, headers: bytes, data: bytes) -> None:
        """Store the first answer to request number `place`."""
        if self.found[place] is None:
            self.found[place] = data
            self.count += 1
        if self.count == len(self.found):
            self.end()


class BatchClient(Client):
    """A nats-py client with an additional subscription, which receives the answers to batches of requests."""

    def __init__(self) -> None:
        super().__init__()
        self._takers: dict[bytes, Callable[[bytes, bytes], None]] = {}  # handlers of answers, by inbox
        self._inboxes = ""
        self._batch_sid = 0
        self._subscribing = asyncio.Lock()

    async def batch(self, request: Request, get: DirectGet, silence_s: float) -> None:
        """Collect the messages that answer a read request.

        Raises OSError for an incomplete answer, and nats-py's errors.
        """
        await self._ask([request], [get.take], get, silence_s)
        if not get.last.done():
            raise TimeoutError(f"the server sent no message for {silence_s:g} s")
        if get.last.result() not in WHOLE:
            raise OSError(f"the answer to a read ended with status {get.last.result() or 'none'}")

    async def replies(self, requests: Sequence[Request], silence_s: float) -> list[bytes | None]:
        """Send all requests together, and return their answers; None for an answer that came too late."""
        replies = Replies(len(requests))
        takers = [partial(replies.take, place) for place in range(len(requests))]
        await self._ask(requests, takers, replies, silence_s)
        return replies.found

    async def _ask(
        self,
        requests: Sequence[Request],
        takers: Sequence[Callable[[bytes, bytes], None]],
        gathered: Gathered,
        silence_s: float,
    ) -> None:
        await self._subscribe()
        inboxes = [f"{self._inboxes}.{self._nuid.next().decode()}" for _ in requests]
        names = [inbox.encode() for inbox in inboxes]
        self._takers.update(zip(names, takers, strict=True))
        try:
            for inbox, request in zip(inboxes, requests, strict=True):
                await self.publish(request.subject, request.data, reply=inbox, headers=request.headers)
            await gathered.wait(silence_s)
        finally:
            for name in names:
                del self._takers[name]

    async def _subscribe(self) -> None:
        async with self._subscribing:
            if not self._batch_sid:
                self._inboxes = self.new_inbox()
                self._batch_sid = (await self.subscribe(f"{self._inboxes}.*", cb=self._take_message))._id

    @property
    def is_reading(self) -> bool:
        """Return True while nats-py reads the connection.

        After an internal error, nats-py stops reading, but its flushes still succeed.
        """
        return self._reading_task is not None and not self._reading_task.done()

    async def _process_pong(self) -> None:
        """Accept a pong that arrives after its flush has timed out. nats-py would fail and stop reading."""
        if self._pongs and self._pongs[0].done():
            self._pongs[0] = asyncio.get_running_loop().create_future()
        await super()._process_pong()

    async def _process_msg(self, sid: int, *rest: Any) -> None:
        """Handle an answer directly, without nats-py's queue.

        `rest` has the message's subject, reply subject, data and headers.
        """
        if sid != self._batch_sid or len(rest) != PROCESSED:
            await super()._process_msg(sid, *rest)
            return
        subject, _, data, headers = rest
        self._take(subject, headers or b"", data)

    async def _take_message(self, message: Msg) -> None:
        headers = message.headers or {}
        lines = "".join(f"\r\n{name}: {value}" for name, value in headers.items())
        block = f"NATS/1.0 {headers.get('Status', '')}{lines}\r\n\r\n"
        self._take(message.subject.encode(), block.encode(), message.data)

    def _take(self, inbox: bytes, headers: bytes, data: bytes) -> None:
        if take := self._takers.get(inbox):
            take(headers, data)


def stored_message(headers: bytes, data: bytes) -> DirectMessage | None:
    """Return the stored message in an answer; None if these headers mark the end of the answer.

    The writer's own headers come first and may have any name. The server's headers come last.
    """
    subject, sequence = last_header(headers, "Nats-Subject"), last_header(headers, "Nats-Sequence")
    if not subject or not (sequence.isascii() and sequence.isdigit()):
        return None
    return DirectMessage(subject, int(sequence), data)


def last_header(headers: bytes, name: str) -> str:
    """Return the text of the last header of this name; "" if there is none."""
    sign = f"\r\n{name}: ".encode()
    at = headers.rfind(sign)
    found = headers[at + len(sign) : headers.find(b"\r\n", at + len(sign))] if at >= 0 else b""
    return found.decode("utf-8", "replace")
