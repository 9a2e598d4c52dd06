"""Forwarder: sends a spool's messages to the NATS stream, in order, each exactly once.

One message is in flight at a time. Each message states the stream position of the previous message of its
subject. The stream stores the message only if that position is right. At the start, and after a timeout or
refusal, the forwarder asks the stream for the last message of the subject, and continues with the next one.
So the forwarder needs no file with an offset, and the stream refuses a duplicate however late it comes.
"""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import suppress
from pathlib import Path

from multidrop.fleet.samples.samples_stream import (
    DIGEST,
    EXPECTED,
    LOST,
    SEQUENCE,
    digest_of,
    last_of,
    publish,
    subject_of,
)
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.names import checked_name
from multidrop.samples import Spool, StoredMessage

AGAIN_S = 0.25  # pause after a failure
LOOKING_S = 1.0  # pause between checks for new messages, in case the spool has announced none
SET_BACK = (
    "the servers have message {} of the log {}, and the spool has {}: its folder was copied or set back; "
    "move it away to start a new log"
)

_log = logging.getLogger("multidrop.fleet.samples.forwarder")


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
