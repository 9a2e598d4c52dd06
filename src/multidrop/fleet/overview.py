"""Overview: the state of a fleet, from its records and its gateways' answers, once or repeatedly."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Container
from contextlib import suppress
from typing import Any

from multidrop.fleet.errors import FleetError
from multidrop.fleet.gateway import ask_gateway
from multidrop.fleet.lines.observer import BELIEVING
from multidrop.fleet.lines.records import FleetRecords, move_of
from multidrop.fleet.lines.rules import owner_of
from multidrop.fleet.servers.buckets import Record
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.setup import check_buckets
from multidrop.printable import masked

MOVES_SHOWN = 20
# a gateway that has ended without a shutdown is listed as missing for this long: 30 days
MISSED_MS = 30 * 24 * 3600 * 1000
EVERY_S = 1.0  # pause between two reads of the fleet's state


class FleetView:
    """The state of a fleet, read over one server connection.

    Each call of `look` reads the changed records and asks every gateway for its state.
    """

    def __init__(self, path: ServerPath) -> None:
        self._path = path
        self._records = FleetRecords("", lambda: path, BELIEVING, lambda: None)
        self._says: dict[str, dict[str, Any] | None] = {}
        self._is_checked = False

    async def check(self) -> None:
        """Raise FleetError if these servers have no fleet or no quorum."""
        await check_buckets(self._path)
        self._is_checked = True

    async def look(self) -> None:
        """Read the fleet's records, and ask each gateway for its state.

        Raises FleetError if no server returns the records.
        """
        if not self._path.is_open:
            raise FleetError(f"no NATS server can be reached at {', '.join(self._path.urls)}")
        if not self._is_checked:
            await self.check()
        await self._records.look()
        present = list(self._records.observer.sessions())
        said = await asyncio.gather(*map(self._ask, present))
        self._says = dict(zip(present, said, strict=True))
        for state in filter(None, said):
            with suppress(KeyError, TypeError, ValueError):  # raised if the list `last_moves` is invalid
                self._records.moves.add(map(move_of, state.pop("last_moves")))

    async def _ask(self, gateway: str) -> dict[str, Any] | None:
        with suppress(FleetError):
            return await ask_gateway(self._path, gateway, "state")
        return None

    def line_records(self) -> dict[str, Record]:
        return {name: self._records.plant.records[name] for name in self._records.lines()}

    def fleet(self) -> dict[str, Any]:
        """Return living and missing gateways, lines with their masters, and the last changes of master.

        A dead gateway is listed as living until another one has ended its session. If a gateway does not
        answer, its `says` is None. `unseen_s` is the time in s since a renewal of its lease was last
        seen. Once its session is ended, a gateway is listed as missing until it runs again. Its `seen_ms`
        is then the time of its last renewal (UTC).
        """
        sessions = self._records.observer.sessions()
        lines = self._lines(sessions)
        masters = Counter(line["master"] for line in lines.values())
        gateways = {
            name: {
                "host": value["host"],
                "session": value["session"],
                "began_ms": value["began"],
                "draining": value["draining"],
                "lines": masters[name],
                "unseen_s": round(self._records.observer.unseen_s(name), 3),
                "says": self._says.get(name),
            }
            for name, value in sessions.items()
        }
        now_ms = time.time_ns() // 1_000_000
        missing = {
            name: {"host": value["host"], "session": value["session"], "seen_ms": seen_ms}
            for name, value in self._records.observer.missing().items()
            if (seen_ms := _ms(value.get("at_ms"))) is None or now_ms - seen_ms < MISSED_MS
        }
        moves = [move.as_json() for move in self._records.moves.newest(MOVES_SHOWN)]
        return {"gateways": gateways, "missing": missing, "lines": lines, "moves": moves}

    def _lines(self, sessions: Container[str]) -> dict[str, Any]:
        observer, plant = self._records.observer, self._records.plant.records
        held: dict[tuple[str, int], bool] = {}  # True if the owner's session is alive, by owner
        found: dict[str, Any] = {}
        for name in self._records.lines():
            record = self._records.owner(name)
            owner = owner_of(record)
            if owner not in held:
                held[owner] = owner[0] in sessions and not observer.is_over(*owner)
            gateway, session = owner if held[owner] else (None, None)
            found[name] = {
                "port": plant[name].value["line"].get("port", ""),
                "revision": plant[name].revision,
                "master": gateway,
                "session": session,
                "since_ms": record.value["since"] if record and record.value and gateway else None,
            }
        return found


def _ms(found: object) -> int | None:
    return found if type(found) is int else None


class FleetWatch:
    """The newest complete view of a fleet, its age, and why a newer read failed."""

    def __init__(self, view: FleetView, clock: Callable[[], float] = time.monotonic) -> None:
        self._view = view
        self._clock = clock
        self._looked: float | None = None
        self.trouble: str | None = None  # why the newest read failed; None if it succeeded

    async def look(self) -> None:
        """Read the fleet's state again. If that fails, set `trouble` and keep the last view."""
        begun = self._clock()
        try:
            await self._view.look()
        except OSError as failure:
            self.trouble = masked(str(failure))
        else:
            self._looked, self.trouble = begun, None

    async def run(self) -> None:
        """Read the fleet's state once a second, forever."""
        while True:
            await self.look()
            await asyncio.sleep(EVERY_S)

    @property
    def age_s(self) -> float | None:
        """Return the seconds since the fleet's state was last read; None if it was not read yet."""
        return None if self._looked is None else round(self._clock() - self._looked, 3)

    def lines(self) -> dict[str, Record]:
        return self._view.line_records()

    def state(self) -> dict[str, Any]:
        """Return the view of the fleet that `fleet watch --json` prints and the gateway's page shows."""
        about = {"at_ms": time.time_ns() // 1_000_000, "age_s": self.age_s, "trouble": self.trouble}
        return {**about, **self._view.fleet()}
