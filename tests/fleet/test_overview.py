"""FleetView: masters from the records, states from the gateways, and None for silent gateways."""

from __future__ import annotations

import asyncio
import json
import time
from types import SimpleNamespace
from typing import Any

import pytest
from fleets import HandClock, MemoryBucket
from tables import table

from multidrop.fleet.errors import FleetError
from multidrop.fleet.lines.ownership import owner_value
from multidrop.fleet.overview import MISSED_MS, FleetView
from multidrop.fleet.servers import names

SPOOL = {"bytes": 1, "lost": 0, "behind": 0, "lag_s": 0.0, "trouble": None}
STATE = {"state": "working", "lines": 1, "margin_s": 2.0, "troubles": {}, "trouble": "", "spool": SPOOL}
MOVE = {"line": "line-1", "turn": 5, "at_ms": 7, "from": "gw-9", "to": "gw-1"}


class Answering:
    """A path on which gateways give the test's answers, and other gateways do not exist."""

    urls = ["nats://a:4222"]
    is_open = True

    def __init__(self, answers: dict[str, Any]) -> None:
        self.answers = answers

    async def request(self, subject: str, *_: object, **__: object) -> Any:
        for gateway, answer in self.answers.items():
            if f".{gateway}." in subject:
                return SimpleNamespace(data=json.dumps(answer).encode())
        raise FleetError("nobody answers")


def lease(session: int, *, ended: bool = False) -> dict[str, Any]:
    return {"session": session, "ended": ended, "began": 5, "host": "pc", "draining": False}


def view(answers: dict[str, Any] | None = None) -> FleetView:
    """Return a view of five lines and three gateways, of which gw-3 has ended."""
    made = FleetView(Answering(answers or {}))  # type: ignore[arg-type]
    records, leases = made._records, [MemoryBucket(name) for name in names.LEASES]
    for follower, bucket in zip(records.observer.paths, leases, strict=True):
        follower.bucket = bucket  # type: ignore[assignment]
        for gateway, found in (("gw-1", lease(2)), ("gw-2", lease(1)), ("gw-3", lease(4, ended=True))):
            bucket.store(gateway, found)
    plant = records.plant.bucket = MemoryBucket(names.PLANT)  # type: ignore[assignment]
    owners = {name: MemoryBucket(name) for name in names.OWNERS}
    for name, bucket in owners.items():
        records.owners[name].bucket = bucket  # type: ignore[assignment]
    owned = {"line-1": ("gw-1", 2), "line-2": ("gw-1", 1), "line-3": ("gw-3", 4), "line-4": ("", 0)}
    for number in range(1, 6):
        line = f"line-{number}"
        plant.store(line, {"line": {"port": f"socket://h:{number}"}, "files": {}})
        if line in owned:
            for bucket in names.owner_buckets(line)[:2]:
                owners[bucket].store(line, owner_value(owned[line], 5, 1000 * number))
    made._is_checked = True
    return made


def looked(made: FleetView) -> dict[str, Any]:
    asyncio.run(made.look())
    return made.fleet()


def test_only_a_session_that_is_not_over_is_shown_as_master() -> None:
    found = looked(view())
    assert {name: line["master"] for name, line in found["lines"].items()} == {
        "line-1": "gw-1",
        "line-2": None,  # owned by an earlier session
        "line-3": None,  # owned by a session that has ended
        "line-4": None,  # released
        "line-5": None,  # no master yet
    }
    first = {"port": "socket://h:1", "revision": 1, "master": "gw-1", "session": 2, "since_ms": 1000}
    assert found["lines"]["line-1"] == first
    assert found["lines"]["line-2"]["since_ms"] is None
    assert {name: gateway["lines"] for name, gateway in found["gateways"].items()} == {"gw-1": 1, "gw-2": 0}


def test_a_silent_gateway_is_shown_without_a_state() -> None:
    made = view({"gw-1": STATE | {"last_moves": [MOVE]}})
    found = looked(made)
    assert found["gateways"]["gw-1"]["says"] == STATE
    assert found["gateways"]["gw-2"]["says"] is None
    assert [move["from"] for move in found["moves"] if move["line"] == "line-1"] == ["gw-9"]
    made._path.answers.clear()  # type: ignore[attr-defined]
    assert looked(made)["gateways"]["gw-1"]["says"] is None  # its earlier answer no longer counts


@table("moves", [[{}], [5], "text", None, [MOVE | {"at_ms": "now"}]])
def test_invalid_moves_are_ignored(moves: Any) -> None:
    found = looked(view({"gw-1": STATE | {"last_moves": moves}}))
    assert found["gateways"]["gw-1"]["says"] == STATE


def test_a_gateway_whose_session_others_ended_is_missing() -> None:
    now_ms = time.time_ns() // 1_000_000
    made = view()
    died = {  # by gateway: the newest record on each path, and whether the gateway is missing
        "gw-4": (lease(2, ended=True) | {"by": "gw-1", "at_ms": now_ms - 60_000}, True),
        "gw-5": (lease(2, ended=True) | {"at_ms": now_ms}, False),  # it ended its session itself
        "gw-6": (lease(2, ended=True) | {"by": "gw-6", "at_ms": now_ms}, False),
        "gw-7": (lease(2, ended=True) | {"by": "gw-1", "at_ms": now_ms - MISSED_MS}, False),
        "gw-9": (lease(2), False),  # it is starting, and holds one path
        "gw-8": (lease(2, ended=True) | {"by": "gw-1"}, True),
    }
    clock = HandClock()
    made._records.observer._clock = clock
    for at, follower in enumerate(made._records.observer.paths):
        for name, (record, _) in died.items():
            if name != "gw-9" or at == 0:
                follower.bucket.store(name, record)  # type: ignore[attr-defined]
    asyncio.run(made.look())
    clock.pass_s(60)  # an end by others counts when the lease must have expired
    found = looked(made)["missing"]
    assert found.keys() == {name for name, (_, is_missing) in died.items() if is_missing}
    assert found["gw-4"] == {"host": "pc", "session": 2, "seen_ms": now_ms - 60_000}
    assert found["gw-8"]["seen_ms"] is None
    for follower in made._records.observer.paths[:2]:
        follower.bucket.store("gw-4", lease(3))  # type: ignore[attr-defined]
    found = looked(made)
    assert "gw-4" not in found["missing"]
    assert found["gateways"]["gw-4"]["session"] == 3


def test_without_a_connection_the_error_names_the_servers() -> None:
    made = view()
    made._path.is_open = False  # type: ignore[misc]
    with pytest.raises(FleetError, match="no NATS server is reached at nats://a:4222"):
        looked(made)


def test_unseen_time_counts_from_the_last_renewal_of_two_paths() -> None:
    made = view()
    now = [10 * 10**9]
    observer = made._records.observer
    observer._clock = lambda: now[0]
    looked(made)
    now[0] += 2 * 10**9
    observer.paths[0].bucket.store("gw-1", lease(2))  # type: ignore[attr-defined]
    found = looked(made)  # a renewal on one of three paths does not count
    assert found["gateways"]["gw-1"]["unseen_s"] == 2.0
    observer.paths[1].bucket.store("gw-1", lease(2))  # type: ignore[attr-defined]
    assert looked(made)["gateways"]["gw-1"]["unseen_s"] == 0.0
