"""Own machine: the servers that run beside a gateway and may die with it, and the lines it avoids for that.

A line's record can be written while its bucket has a leader. Where the leader dies with the line's master,
the line is nobody's until another server is elected, which takes 4 to 9 s. So a gateway avoids the lines of
the buckets whose leader has its home on the gateway's own machine.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from multidrop.fleet import names
from multidrop.fleet.leaders import owners_led_by
from multidrop.fleet.servers import ServerPath

_log = logging.getLogger("multidrop.fleet")


class OwnMachine:
    """The servers that were ever reached on this machine, and the buckets that are avoided for them."""

    def __init__(self) -> None:
        self.avoided: tuple[str, ...] = ()
        self._servers: frozenset[str] = frozenset()

    async def look(self, paths: Sequence[ServerPath], path: ServerPath) -> None:
        """Look for servers that were not known yet; one that is gone is remembered, for it comes back.

        Raises FleetError where it cannot be said now which buckets they lead.
        """
        servers = self._servers.union(one.server_name for one in paths if one.is_local)
        if servers == self._servers:
            return
        led = await owners_led_by(servers, path)
        self.avoided = led if len(led) < len(names.OWNERS) else ()  # all of them run here: nothing is gained
        self._servers = servers
        if self.avoided:
            _log.info("lines of %s are avoided: their leader runs on this machine", ", ".join(self.avoided))


def avoided_by(sessions: Mapping[str, Mapping[str, Any]]) -> dict[str, tuple[str, ...]]:
    """Return the buckets that each of these gateways avoids, by its name.

    Where one does not say, none is avoided by anybody: an older version would share the lines out otherwise.
    """
    found: dict[str, tuple[str, ...]] = {}
    for name, value in sessions.items():
        told = value.get("avoids")
        if not isinstance(told, list):
            return {}
        found[name] = tuple(bucket for bucket in names.OWNERS if bucket in told)
    return found
