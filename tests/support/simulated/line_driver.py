"""Run one line's state machine from the core on a clock that the test sets."""

from __future__ import annotations

from typing import Any

import pytest
from batches import copied, new_completion
from frames import words
from multidrop._core import ffi, lib

from multidrop.core import Completion, Exchange, Failure, Framing, Message, Peer, TransactionIds, build_reply
from multidrop.core.port import TRANSACTIONS

MS = 1_000_000


class LineDriver:
    """Runs exchanges on a struct md_line; `now` is in ns and advances only by calls."""

    def __init__(self, transactions: TransactionIds | None = None) -> None:
        self.now = 1000 * MS
        self._line = ffi.new("struct md_line *")
        lib.md_line_init(self._line, self.now)
        self._line.transactions = TRANSACTIONS[transactions]
        self.found = new_completion()
        self._exchanges: list[Exchange] = []  # keeps exchanges alive that the line refers to

    @property
    def want(self) -> str:
        return {lib.MD_DONE: "done", lib.MD_WAIT: "wait", lib.MD_WRITE: "write", lib.MD_READ: "read"}[
            lib.md_line_want(self._line, self.now)
        ]

    @property
    def listens(self) -> bool:
        """Return True while the line waits only for time or received bytes."""
        return self.want in ("wait", "read")

    @property
    def wake(self) -> int:
        return int(self._line.wake_ns)

    @property
    def state(self) -> int:
        """Return the line's present state (enum md_line_state)."""
        return int(self._line.state)

    @property
    def echo(self) -> int:
        """Return whether the adapter is known to echo (enum md_echo)."""
        return int(self._line.echo)

    @echo.setter
    def echo(self, known: int) -> None:
        self._line.echo = known

    def set_echo(self, known: int) -> None:
        """Set whether the adapter is known to echo, as the line's caller does."""
        self.echo, self._line.echo_is_configured = known, known == lib.MD_ECHO

    @property
    def is_out_of_step(self) -> bool:
        """Return True if received bytes were no Modbus TCP header; the engine then closes the port."""
        return bool(self._line.is_out_of_step)

    @property
    def completion(self) -> Completion:
        return copied(self.found)

    @property
    def still_open(self) -> int:
        """Return the number of received bytes that may be the start of the reply."""
        return int(self._line.rx_len - self._line.rx_from)

    def begin(self, exchange: Exchange) -> None:
        self._exchanges.append(exchange)
        lib.md_line_begin(self._line, exchange.c, self.found, self.now)

    def take(self, most: int = 513, held_up: int = 0) -> bytes:
        """Return up to `most` bytes of the line's request, taken as by a write that lasts `held_up` ns."""
        tx = bytes(ffi.buffer(self._line.tx, self._line.tx_len))[self._line.tx_at :][:most]
        begun = self.now
        self.now += held_up
        lib.md_line_sent(self._line, len(tx), begun, self.now)
        return tx

    def receive(self, data: bytes, piece: int = 4096) -> None:
        for at in range(0, len(data), piece):
            lib.md_line_received(self._line, data[at : at + piece], len(data[at : at + piece]), self.now)

    def lose(self, error: int) -> None:
        self.abandon(Failure.LINE_LOST, error)

    def abandon(self, result: Failure, error: int = 0) -> None:
        lib.md_line_abandon(self._line, result, error)

    def wait_until_write(self) -> bytes:
        """Wait like the engine until the silence is over, and take the request; return its bytes."""
        for _ in range(8):
            if self.want == "write":
                return self.take()
            self.now = max(self.now, self.wake)
        raise AssertionError("the line never wants to write")

    def send(self, exchange: Exchange) -> bytes:
        """Start an exchange and wait until its request is sent; return the request's bytes."""
        self.begin(exchange)
        return self.wait_until_write()

    def data_after(self, received: bytes, piece: int = 4096) -> bytes:
        """Receive bytes that end the exchange; return the data of its reply."""
        self.receive(received, piece)
        assert self.want == "done"
        return self.completion.reply.data

    def wait_for_look(self) -> None:
        """Advance time until the line's next read is due."""
        while self.want == "wait":
            self.now = self.wake

    def wait_until_done(self) -> None:
        for _ in range(8):
            if self.want == "done":
                return
            self.now = max(self.now, self.wake)
        raise AssertionError("the exchange never ends")


CHARACTER = 1 * MS
SILENCE = 4 * MS
LEAST, MOST = 20 * MS, 300 * MS
READ, OTHER, LONGER = Message(1, 3, 0, 1), Message(1, 3, 50, 1), Message(1, 3, 0, 2)
WRITE = Message(1, 6, 2, data=words(7))


@pytest.fixture
def line() -> LineDriver:
    return LineDriver()


@pytest.fixture
def drive() -> Peer:
    return Peer(least_timeout=LEAST / 1e9, most_timeout=MOST / 1e9)


def exchange(request: Message, drive: Peer, framing: Framing = Framing.RTU, **details: Any) -> Exchange:
    return Exchange(
        framing,
        request,
        drive,
        baudrate=9600,
        format="8N1",
        character=CHARACTER / 1e9,
        silence=SILENCE / 1e9,
        **details,
    )


def reply(value: int = 0) -> bytes:
    return build_reply(Framing.RTU, Message(1, 3, data=words(value)))


def ask(line: LineDriver, drive: Peer, request: Message = READ) -> int:
    """Send the request to the drive; return the time in ns at which its last bit has left."""
    line.send(exchange(request, drive))
    return line.now + 8 * CHARACTER


def answer(line: LineDriver, drive: Peer, delay: int) -> None:
    """Run a whole exchange; the reply arrives one character at a time, the first after `delay` ns."""
    left = ask(line, drive)
    for at, character in enumerate(reply()):
        line.now = left + delay + (at + 1) * CHARACTER
        assert line.listens
        line.receive(bytes([character]))
    assert line.want == "done"
