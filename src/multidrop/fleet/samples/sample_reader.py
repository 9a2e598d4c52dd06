"""Sample reader: messages of the stream of samples, by direct gets, whoever wrote what into their headers."""

from __future__ import annotations

import json
from typing import NamedTuple

from nats.errors import Error

from multidrop.fleet.samples.batch_client import (
    STATUS,
    BatchClient,
    DirectGet,
    DirectMessage,
    Request,
    last_header,
    stored_message,
)
from multidrop.fleet.samples.samples_stream import (
    ANSWER_S,
    BY_SERVER,
    LOST,
    SEQUENCE,
    STREAM,
    StreamError,
    number_of,
    silent,
)

SUBJECT = f"$JS.API.DIRECT.GET.{STREAM}"


class StreamMessage(NamedTuple):
    """A message as the hub reads it; `sequence` 0 stands for a header that is missing or no number.

    It is 0 too for an answer of a server: whoever may ask for a stored message may have it sent anywhere, and
    so into the stream as another gateway's.
    """

    place: int
    gateway: str
    log: str
    sequence: int
    lost: int  # rows that the gateway's spool had lost when it sent this
    data: bytes


async def read_after(client: BatchClient, place: int, messages: int, size: int) -> list[StreamMessage]:
    """Return the next messages behind this place: so many and bytes at most, without a hole among them.

    An empty list says that there is none now. Any replica may answer. Raises StreamError.
    """
    wanted = {"seq": place + 1, "batch": messages, "max_bytes": size, "next_by_subj": f"{STREAM}.>"}
    get = SampleGet()
    try:
        await client.batch(Request(SUBJECT, json.dumps(wanted).encode()), get, ANSWER_S)
    except (Error, OSError) as failure:
        if get.found or get.has_hole:  # each is whole, and the next call goes on behind them
            return get.found
        raise _refused(get.end_line) if get.last.done() else silent(client, failure) from failure
    return get.found


class SampleGet(DirectGet):
    """The messages that one direct get gives, by the headers as they came.

    Whoever may say samples writes headers of a message as he likes, and a parser that stops at a strange one
    sees his words of whose it is in place of the server's, which are the last.
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: list[StreamMessage] = []
        self.has_hole = False  # a message was lost on the way here
        self.end_line = ""

    def take(self, headers: bytes, data: bytes) -> None:
        """Keep a message, or learn that there are no more."""
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
    return StreamError(f"the stream {STREAM!r} gives nothing: {end_line}")


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
