"""RowForwarder: sends the messages of a spool to a receiver.

After an outage, the newest message is sent first.

The receiver's position says which messages the receiver has. A database stores the position together with the
rows, so each row is stored once. `RepeatingReceiver` keeps the position in a file beside the spool: a message
whose answer was lost is sent again, with the same id.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from multidrop.gateway.http_post import Refused
from multidrop.printable import printable
from multidrop.samples import MessageError, SinkError, Spool, StoredMessage, unpack
from multidrop.whole_file import whole_file

RETRY_S, MOST_RETRY_S = 1.0, 30.0  # pause after the first failed attempt, and the longest pause
SLOW_S = 40.0  # a receiver that takes longer than this (in s) for one message is reported
REMOVED_S = 0.01  # pause if the full spool has just removed the message that was to be sent
# A gap is a range of messages that were skipped to send a newer one first. At this limit, none are skipped.
MOST_GAPS = 64
SET_BACK = (
    "it has message {} of the spool {}, which ends at message {}: the folder was copied or set back; "
    "move it away to start a new spool"
)

_log = logging.getLogger("multidrop.gateway.forward")


class SpoolPosition(NamedTuple):
    """The messages that a receiver has: all up to `newest`, except the ranges (first, last) in `gaps`."""

    newest: int = 0
    gaps: tuple[tuple[int, int], ...] = ()

    def next(self, newest: int) -> int | None:
        """Return the number of the message to send now: the newest or, if it was sent, the oldest unsent."""
        if newest > self.newest:
            return newest if len(self.gaps) < MOST_GAPS else self.newest + 1
        return self.gaps[0][0] if self.gaps else None

    def after(self, first: int, last: int) -> SpoolPosition:
        """Return the position that results from sending the messages `first` to `last`."""
        if first > self.newest:
            skipped = [(self.newest + 1, first - 1)] if first > self.newest + 1 else []
            return SpoolPosition(last, (*self.gaps, *skipped))
        left: list[tuple[int, int]] = []
        for begin, end in self.gaps:
            left += (begin, min(end, first - 1)), (max(begin, last + 1), end)
        return SpoolPosition(self.newest, tuple(gap for gap in left if gap[0] <= gap[1]))

    def behind(self, newest: int) -> int:
        """Return the number of messages up to `newest` that the receiver lacks."""
        return newest - self.newest + sum(last - first + 1 for first, last in self.gaps)


class Outgoing(NamedTuple):
    """A message to send."""

    id: str  # id that all attempts to send this message share, and no other message has
    rows: Any  # pyarrow.Table with the columns of `samples.ROWS`
    is_historical: bool  # newer values were sent before, or the message is from an earlier run


class RowReceiver(Protocol):
    """A receiver of rows. Its methods are called in the forwarder's thread, and may hang."""

    def begin(self, log: str) -> SpoolPosition:
        """Connect, and return which messages of this spool the receiver has. Raises OSError."""

    def write(self, message: Outgoing, after: SpoolPosition) -> None:
        """Send a message, and store the position after it. Raises Refused or another OSError."""

    def close(self) -> None:
        """Close the receiver's open files and connections."""


class RepeatingReceiver:
    """A receiver whose position is a file beside the spool. Such a receiver may get a message twice.

    `deliver(message)` returns once the message's rows have arrived. It may raise the errors of `write`.
    """

    def __init__(self, folder: Path, deliver: Callable[[Outgoing], object]) -> None:
        self._path = folder / "position.json"
        self._deliver = deliver
        self._position: SpoolPosition | None = None

    def begin(self, log: str) -> SpoolPosition:
        if self._position is None:
            self._position = self._load()
        return self._position

    def _load(self) -> SpoolPosition:
        try:
            found = json.loads(self._path.read_bytes())
            return SpoolPosition(int(found["newest"]), tuple((int(a), int(b)) for a, b in found["gaps"]))
        # without a valid position, all messages are sent again
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return SpoolPosition()

    def write(self, message: Outgoing, after: SpoolPosition) -> None:
        self._deliver(message)
        self._position = after
        with whole_file(self._path) as part:
            part.write_text(json.dumps(after._asdict()), "utf-8")

    def close(self) -> None:
        pass


class RowForwarder:
    """Sends a spool's messages to a receiver. `run` waits for the receiver, so it needs its own thread.

    `name` is the receiver's name in logs and in /health, without secrets.
    """

    def __init__(
        self, name: str, spool: Spool, receiver: RowReceiver, clock: Callable[[], float] = time.monotonic
    ) -> None:
        state = spool.state()
        self.rows = 0  # rows sent since the start
        self.refused = 0  # rows that the receiver does not accept
        self._name = name
        self._spool = spool
        self._receiver = receiver
        self._clock = clock
        self._earlier = state.newest  # number of the newest message of earlier runs
        self._position = SpoolPosition(max(0, state.oldest - 1))  # assumed before `_ask`
        self._is_asked = False
        self._accepted = 0  # messages sent since the start
        # by number of a refused message: the value of `_accepted` at the refusal
        self._refusals: dict[int, int] = {}
        self._trouble = ""
        self._retry_s = RETRY_S
        self._sending_since_s = inf
        self._changed = threading.Condition()
        self._has_news = False
        self._is_closed = False
        spool.acknowledge(self._position.newest)
        spool.on_message = self._announce

    # ---- called by the gateway ----

    @property
    def behind(self) -> int:
        """The number of stored messages that the receiver lacks."""
        return self._position.behind(self._spool.state().newest)

    @property
    def problem(self) -> str:
        """Why no rows are sent now; "" if they are sent."""
        if self._clock() - self._sending_since_s > SLOW_S:
            return f"{self._name} has not answered for {SLOW_S:g} s"
        return self._trouble

    def _announce(self) -> None:
        with self._changed:
            self._has_news = True
            self._changed.notify()

    def close(self) -> None:
        """End `run` after the message that is being sent."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    # ---- called in the forwarder's own thread ----

    def run(self) -> None:
        """Send messages until `close`."""
        while not self._is_closed:
            pause_s = self.step()
            with self._changed:
                if pause_s == inf:
                    self._changed.wait_for(lambda: self._is_closed or self._has_news)
                elif pause_s > 0:
                    self._changed.wait_for(lambda: self._is_closed, pause_s)
        self._receiver.close()

    def step(self) -> float:
        """Send the next message. Return the seconds until the next attempt (inf: until a new message)."""
        self._has_news = False
        self._sending_since_s = self._clock()
        try:
            pause_s = self._send_next()
        except Exception as failure:  # a library may raise anything; the rows stay in the spool
            self._is_asked = False
            self._note(f"{self._name} takes no rows: {_reason(failure)}")
            pause_s, self._retry_s = self._retry_s, min(2 * self._retry_s, MOST_RETRY_S)
            return pause_s
        finally:
            self._sending_since_s = inf
        self._note("")
        self._retry_s = RETRY_S
        return pause_s

    def _send_next(self) -> float:
        if not self._is_asked:
            self._ask()
        stored = self._next()
        if stored is None:
            return inf
        after = self._position.after(stored.sequence, stored.sequence)
        is_historical = stored.sequence <= max(self._earlier, self._position.newest)
        try:
            rows = unpack(stored.path.read_bytes())
        except FileNotFoundError:  # the full spool has just removed the message
            return REMOVED_S
        except MessageError as mistake:
            self._leave_out(stored, str(mistake))
        else:
            try:
                self._receiver.write(
                    Outgoing(f"{self._spool.log}-{stored.sequence}", rows, is_historical), after
                )
                self._accepted += 1
                self.rows += stored.rows
            except Refused as refusal:
                if not self._is_refused_alone(stored.sequence):
                    raise
                self._leave_out(stored, str(refusal))
        self._move(after)
        return 0.0

    def _ask(self) -> None:
        """Ask the receiver which messages it has.

        Raises SinkError if that position is beyond the spool's newest message.
        """
        position, newest = self._receiver.begin(self._spool.log), self._spool.state().newest
        if position.newest > newest:
            raise SinkError(SET_BACK.format(position.newest, self._spool.log, newest))
        self._move(position)
        self._is_asked = True

    def _move(self, position: SpoolPosition) -> None:
        self._position = position
        self._spool.acknowledge(position.newest, position.gaps)

    def _next(self) -> StoredMessage | None:
        """Return the next message to send; skip messages that were removed."""
        newest = self._spool.state().newest
        while (wanted := self._position.next(newest)) is not None:
            stored = self._spool.following(wanted - 1)
            if stored is not None and stored.sequence == wanted:
                return stored
            self._move(self._position.after(wanted, stored.sequence - 1 if stored else newest))
        return None

    def _is_refused_alone(self, sequence: int) -> bool:
        """Return True if this message was refused twice, and another message was accepted in between.

        If no other message was accepted, a wrong setting may be the cause: skipping each refused message
        would then lose all messages.
        """
        return self._accepted > self._refusals.setdefault(sequence, self._accepted)

    def _leave_out(self, stored: StoredMessage, why: str) -> None:
        self._refusals.pop(stored.sequence, None)
        self.refused += stored.rows
        _log.error("%s does not get %d rows: %s", self._name, stored.rows, printable(why)[:200])

    def _note(self, trouble: str) -> None:
        if trouble and trouble != self._trouble:
            _log.warning("%s", trouble)
        if self._trouble and not trouble:
            _log.info("%s takes rows again", self._name)
        self._trouble = trouble


def _reason(failure: Exception) -> str:
    text = str(failure) if isinstance(failure, OSError) else type(failure).__name__
    return printable(text or type(failure).__name__)[:200]
