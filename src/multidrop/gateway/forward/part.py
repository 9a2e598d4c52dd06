"""Forwarding: the parts of the gateway that store all rows on disk and send them to one receiver each."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from math import inf
from pathlib import Path

from multidrop import Batch, Plant
from multidrop.exposition import MetricFamily
from multidrop.gateway.clock import monotonic_ns
from multidrop.gateway.forward.forwarder import RowForwarder, RowReceiver
from multidrop.gateway.metrics import counter
from multidrop.gateway.reload import changed_drives
from multidrop.recording import parse_size
from multidrop.samples import PolledUnits, Spool
from multidrop.supervisor import supervisor

LOOK_S = 1.0  # interval of checking that the threads are alive
CLOSING_S = 2.0  # time limit for writing the last rows to the disk
SENDING_S = 0.5  # time limit for the message that is being sent
SETTLED_NS = 60_000_000_000  # rows of the former plant arrive at most this long after a reload


class Forwarding:
    """A spool and its forwarder.

    `name` is the prefix of the metrics, and `receiver` the receiver's name in logs. `make_receiver`
    is called with the spool's folder.

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
        self._plant = plant
        self._units = PolledUnits()
        self._note_units(0)
        self._spool = Spool(folder, "serve", most=parse_size(most), units=self._units, keep_sent=False)
        self._forwarder = RowForwarder(receiver, self._spool, make_receiver(folder))
        self._changed: frozenset[str] = frozenset()  # drives that the newest plant changed
        self._adopted_ns = 0
        self._lost_before = 0  # number of lost rows that /health no longer reports
        self._sending: asyncio.Future[None] | None = None
        self._is_closed = False

    def _note_units(self, since_ns: int) -> None:
        for line in self._plant.lines:
            self._units.note(line, since_ns)

    # ---- the methods of Part ----

    def take(self, batch: Batch) -> None:
        """Copy the rows within microseconds; other threads store and send them."""
        self._spool.append(self._without_former_drives(batch) if self._changed else batch)

    def adopt(self, plant: Plant) -> None:
        """Use the units of another plant from now on."""
        self._adopted_ns = monotonic_ns()
        self._changed = changed_drives(self._plant, plant)
        self._plant = plant
        self._note_units(self._adopted_ns)

    def _without_former_drives(self, batch: Batch) -> Batch:
        """Return the batch without rows of drives that the new plant changes, if the old plant polled them.

        Such rows were requested before the new plant was adopted, so their units are unknown.
        """
        columns = batch.columns()
        former = {code for code, name in enumerate(columns.drives) if name in self._changed}
        rows = enumerate(zip(columns.drive, columns.monotonic_ns, strict=True))
        kept = [at for at, (drive, time_ns) in rows if time_ns >= self._adopted_ns or drive not in former]
        if columns.monotonic_ns and min(columns.monotonic_ns) >= self._adopted_ns + SETTLED_NS:
            self._changed = frozenset()
        return batch if len(kept) == len(columns.time) else batch.at(kept)

    async def run(self) -> None:
        """Forward until cancelled. If a thread ends before `close`, raises its exception or RuntimeError."""
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
        """Close the spool of a part that does not start, so that the next reload can open it."""
        self._spool.close()

    async def close(self) -> None:
        """Write the last rows to the disk; they are sent after the next start. Raises Hung."""
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
        """Return metrics: rows sent, lost and refused since the start, and the backlog."""
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
