"""Forwarding: store all polled values on disk as rows, and send them to a receiver, such as a database.

The stored rows are messages in a folder, the spool. After an outage, the newest message is sent first.

The spool's position says which messages the receiver has. A database stores the position together with the
rows, so each row is stored once. `RepeatingReceiver` keeps the position in a file in the spool's folder. If
the answer to a message is lost, the message is sent again with the same id.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable, Iterator
from math import inf, isfinite
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import pyarrow as pa

from multidrop import Batch, Plant
from multidrop.core import now_ns
from multidrop.exposition import MetricFamily
from multidrop.gateway.metrics import counter
from multidrop.gateway.sending import Refused, RetryingSender
from multidrop.printable import format_time, printable
from multidrop.recording import parse_size
from multidrop.samples import MessageError, PolledUnits, SinkError, Spool, StoredMessage, unpack
from multidrop.supervisor import supervisor
from multidrop.whole_file import whole_file

MOST_ROWS = 2000  # limit of rows in one request or MQTT message, about 250 kB of JSON
NOT_FINITE = "not a finite number"  # status of a row whose value JSON and InfluxDB cannot represent
REMOVED_S = 0.01  # pause in s if the spool is full and has just removed the next message
# limit of gaps. A gap is a range of messages that were skipped in order to send a newer message first.
MOST_GAPS = 64
MOST_REFUSALS = 1000  # limit of stored refusals, one per refused message; the oldest is deleted
SET_BACK = (
    "the receiver has message {} of the spool {}, which ends at message {}: the folder was copied or set "
    "back; move it away to start a new spool"
)
_log = logging.getLogger("multidrop.gateway.forward")
LOOK_S = 1.0  # interval, in s, of checking that the threads still run
CLOSING_S = 2.0  # time limit for writing the last rows to the disk
SENDING_S = 0.5  # time limit for sending the message in progress at shutdown


def pieces(rows: Any) -> Iterator[Any]:
    """Yield a table of rows in pieces of at most MOST_ROWS rows."""
    for begin in range(0, len(rows), MOST_ROWS):
        yield rows.slice(begin, MOST_ROWS)


def listed(rows: Any) -> Iterator[tuple[int, str, str, float | None, str, str | None]]:
    """Yield time (UTC in ns), drive, register, value, status and unit of each row."""
    times = rows.column("time").cast(pa.int64())
    names = ("drive", "register", "value", "status", "unit")
    return zip(times.to_pylist(), *(rows.column(name).to_pylist() for name in names), strict=True)


def row_objects(rows: Any) -> list[dict[str, Any]]:
    """Return each row as a JSON object."""
    return [
        {
            "time": format_time(time_ns),
            "drive": drive,
            "register": register,
            "value": value if value is not None and isfinite(value) else None,
            "status": status if value is None or isfinite(value) else NOT_FINITE,
            "unit": unit,
        }
        for time_ns, drive, register, value, status, unit in listed(rows)
    ]


# ---- messages, and the thread that sends them ----


class SpoolPosition(NamedTuple):
    """The messages that a receiver has: all up to number `newest`, except those in `gaps`.

    A gap is a pair of the first and the last missing number.
    """

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

    id: str  # the same in all attempts to send this message, and different from that of every other message
    rows: Any  # pyarrow.Table with the columns of `samples.ROWS`
    # True: newer values were sent already, or the message is from an earlier run of the gateway
    is_historical: bool


class RowReceiver(Protocol):
    """A receiver of rows. Its methods are called in the forwarder's thread, and may hang."""

    def begin(self, log: str) -> SpoolPosition:
        """Connect, and return which of the spool's messages the receiver has. Raises OSError.

        `log` is the spool's id.
        """

    def write(self, message: Outgoing, after: SpoolPosition) -> None:
        """Send a message, and store `after`, the spool's position once the message has arrived.

        Raises Refused or another OSError.
        """

    def close(self) -> None:
        """Close the receiver's open files and connections."""


class RepeatingReceiver:
    """A receiver that may get a message twice: its position is kept in a file in the spool's folder.

    `deliver(message)` returns once the message's rows have arrived. It may raise Refused or another OSError.
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


class RowForwarder(RetryingSender):
    """Sends the messages of a spool, a folder of stored rows, to a receiver."""

    log, what = _log, "rows"

    def __init__(
        self, name: str, spool: Spool, receiver: RowReceiver, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(name, clock)
        state = spool.state()
        self.rows = 0  # rows sent since the gateway's start
        self.refused = 0
        self._spool = spool
        self._receiver = receiver
        self._earlier = state.newest  # number of the newest message of earlier runs
        # until the receiver is asked: assume that it has none of the stored messages
        self._position = SpoolPosition(max(0, state.oldest - 1))
        self._is_asked = False
        self._accepted = 0  # messages that the receiver accepted since the gateway's start
        # value of `_accepted` at the first refusal of a message, by the message's number
        self._refusals: dict[int, int] = {}
        spool.acknowledge(self._position.newest)
        spool.on_message = self.announce

    @property
    def behind(self) -> int:
        """The number of stored messages that the receiver lacks."""
        return self._position.behind(self._spool.state().newest)

    # ---- called in the forwarder's own thread ----

    def run(self) -> None:
        super().run()
        self._receiver.close()

    def _may_end(self, pause_s: float) -> bool:
        return True  # unsent rows stay in the spool

    def _note_failure(self, failure: Exception) -> None:
        self._is_asked = False
        super()._note_failure(failure)

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

        Raises SinkError if the receiver claims a message that is newer than the spool's newest message.
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
        """Return True if this message was refused twice, and another one was accepted in between.

        If no other message was accepted, a wrong setting may be the cause. Skipping each refused message
        would then lose all messages.
        """
        if sequence not in self._refusals and len(self._refusals) >= MOST_REFUSALS:
            del self._refusals[next(iter(self._refusals))]
        return self._accepted > self._refusals.setdefault(sequence, self._accepted)

    def _leave_out(self, stored: StoredMessage, why: str) -> None:
        self._refusals.pop(stored.sequence, None)
        self.refused += stored.rows
        _log.error("%s does not receive %d rows: %s", self.name, stored.rows, printable(why)[:200])


# ---- the part of the gateway ----


class Forwarding:
    """A spool of stored rows, and the forwarder that sends them.

    `name` is the prefix of the metrics, and `receiver` the receiver's name in logs. `make_receiver` is called
    with the spool's folder.

    Raises ValueError if the folder is not a spool, is in use, or cannot be written.
    """

    def __init__(
        self,
        name: str,
        receiver: str,
        folder: Path,
        most: str,
        plant: Plant,
        make_receiver: Callable[[Path], RowReceiver],
    ) -> None:
        self._name = name
        self._units = PolledUnits()
        self._note_units(plant, 0)
        self._spool = Spool(folder, "serve", most=parse_size(most), units=self._units, keep_sent=False)
        self._forwarder = RowForwarder(receiver, self._spool, make_receiver(folder))
        self._lost_before = 0  # number of lost rows that the health report no longer mentions
        self._sending: asyncio.Future[None] | None = None
        self._is_closed = False

    def _note_units(self, plant: Plant, since_ns: int) -> None:
        for line in plant.lines:
            self._units.note(line, since_ns)

    # ---- the methods of Part ----

    def take(self, batch: Batch) -> None:
        """Copy the batch's rows within microseconds; other threads store and send them."""
        self._spool.append(batch)

    def adopt(self, plant: Plant) -> None:
        """Use another plant: store the measuring units of its registers with all later rows."""
        self._note_units(plant, now_ns())

    async def run(self) -> None:
        """Forward until cancelled.

        If the storing or the sending thread ends before `close`, raises that thread's exception or
        RuntimeError.
        """
        sending = supervisor().thread(f"{self._name} rows", inf, self._forwarder.run)
        self._sending = sending
        while self._spool.is_alive() and not sending.done():
            if not self._forwarder.behind and not self._forwarder.problem:
                self._lost_before = self._spool.state().lost
            await asyncio.sleep(LOOK_S)
        if not self._is_closed:
            if sending.done():
                sending.result()
            raise RuntimeError("the thread that stores or sends rows has ended")

    def abandon(self) -> None:
        """Close the spool of a part that will not start, so that the next reload can open it."""
        self._spool.close()

    async def close(self) -> None:
        """Write the last rows to the disk; they are sent after the next start.

        Raises Hung if the disk hangs.
        """
        self._is_closed = True
        self._forwarder.close()
        await supervisor().within(f"{self._name} spool", CLOSING_S, self._spool.close)
        if self._sending is not None:
            await asyncio.wait([self._sending], timeout=SENDING_S)

    def health(self) -> str:
        """Return why rows are not stored or not sent; "" if they are stored and sent."""
        state = self._spool.state()
        lost = state.lost - self._lost_before
        found = [
            f"rows are not stored: {state.trouble}" if state.trouble else "",
            self._forwarder.problem,
            f"{lost} rows were lost, because the spool or the disk is full" if lost else "",
        ]
        return "; ".join(filter(None, found))

    def figures(self) -> list[MetricFamily]:
        """Return metrics: rows sent, lost and refused since the start, and messages not sent yet."""
        state, sent, name = self._spool.state(), self._forwarder, f"multidrop_{self._name}"
        gauges = {
            f"{name}_backlog_messages": ("Stored messages that are not sent yet.", sent.behind),
            f"{name}_spool_bytes": ("Size of the stored messages.", state.stored),
        }
        return [
            counter(f"{name}_rows_sent", "Rows that the receiver has taken.", sent.rows),
            counter(f"{name}_rows_lost", "Rows lost because the spool or the disk was full.", state.lost),
            counter(f"{name}_rows_refused", "Rows that the receiver does not accept.", sent.refused),
            *(
                MetricFamily(of, "gauge", text, [("", {}, float(value))])
                for of, (text, value) in gauges.items()
            ),
        ]
