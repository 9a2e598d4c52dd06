"""Overview: the fleet as its records have it."""

from __future__ import annotations

from typing import Any

from multidrop.fleet import names
from multidrop.fleet.buckets import Bucket, Follower
from multidrop.fleet.lease_bucket import LeaseBucket
from multidrop.fleet.observer import BELIEVING, Observer
from multidrop.fleet.ownership import owner_of
from multidrop.fleet.servers import ServerPath


async def read_fleet(path: ServerPath) -> dict[str, Any]:
    """Return gateways with a session that nobody ended, and lines with their masters.

    A gateway that died a moment ago is still there, until another one has ended its session.
    """
    observer = Observer("", [LeaseBucket(bucket, lambda: path, "") for bucket in names.LEASES], BELIEVING)
    for number in range(len(names.LEASES)):
        await observer.look(number)
    plant = Follower(Bucket(names.PLANT, lambda: path))
    await plant.look()
    owners = [Follower(Bucket(bucket, lambda: path)) for bucket in names.OWNERS]
    for follower in owners:
        await follower.look()
    records = {line: record for follower in owners for line, record in follower.records.items()}
    sessions = observer.sessions()
    lines: dict[str, Any] = {}
    for name, description in sorted(plant.records.items()):
        if description.value is None:
            continue
        record = records.get(name)
        gateway, session = owner_of(record)
        is_held = bool(gateway) and gateway in sessions and not observer.is_over(gateway, session)
        lines[name] = {
            "port": description.value["line"].get("port", ""),
            "revision": description.revision,
            "master": gateway if is_held else None,
            "session": session if is_held else None,
            "since_ms": record.value["since"] if record and record.value and is_held else None,
        }
    gateways = {
        name: {
            "host": value["host"],
            "session": value["session"],
            "began_ms": value["began"],
            "draining": value["draining"],
            "lines": sum(line["master"] == name for line in lines.values()),
        }
        for name, value in sessions.items()
    }
    return {"gateways": gateways, "lines": lines}
