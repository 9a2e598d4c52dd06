"""The part `fleet` of `multidrop serve`: looks at a fleet for the page, and touches nothing of it.

`multidrop.gateway` finds it by its name, as its own parts.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from multidrop.fleet.task_end import end_tasks

if TYPE_CHECKING:
    from multidrop.fleet.servers import ServerPath
    from multidrop.fleet.watching import FleetWatch

EXAMPLE = "nats://127.0.0.1:4222"
OLD_S = 5.0  # an older look is not well


@dataclass(frozen=True)
class FleetSettings:
    """The table `[serve.fleet]`: the servers of the fleet, and files as for `fleet watch`."""

    nats: tuple[str, ...] = (EXAMPLE,)
    credentials: str = ""
    ca: str = ""

    def __post_init__(self) -> None:
        wrong = [
            f'nats: {url!r} is no address of a NATS server; write nats = ["{EXAMPLE}"]'
            for url in self.nats
            if not isinstance(url, str) or not url.startswith(("nats://", "tls://"))
        ]
        if wrong:
            raise ValueError("\n".join(wrong))


class FleetPart:
    """A part that looks at a fleet once a second."""

    def __init__(self, path: ServerPath, watch: FleetWatch) -> None:
        self._path = path
        self._watch = watch

    def take(self, batch: object) -> None:
        """Ignore them: they are of the gateway's own lines, and not of the fleet's."""

    async def run(self) -> None:
        tasks = [asyncio.create_task(work) for work in (self._path.keep(), self._watch.run())]
        try:
            ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
        finally:
            await end_tasks(*tasks)

    async def close(self) -> None:
        await self._path.close()

    def health(self) -> str:
        """Return why the fleet is not seen now; "" is well."""
        age = self._watch.age_s
        if age is not None and age <= OLD_S:
            return ""
        seen = "nothing of it was seen yet" if age is None else f"it was seen {age:.0f} s ago"
        return f"{seen}: {self._watch.trouble or 'no look has ended yet'}"

    def told(self) -> dict[str, Any]:
        """Return the fleet for the page, with its age."""
        return self._watch.told()


class HasFolder(Protocol):
    """The gateway, as this part sees it."""

    folder: Path  # to which files' names are relative


def build(settings: FleetSettings, inside: HasFolder) -> FleetPart:
    """Return the part. Nothing is connected before it runs.

    Raises ImportError without NATS' client, OSError or ValueError for files that are none.
    """
    from multidrop.fleet.credentials import connect_options
    from multidrop.fleet.overview import FleetView
    from multidrop.fleet.servers import ServerPath
    from multidrop.fleet.watching import FleetWatch

    credentials, ca = (inside.folder / name if name else None for name in (settings.credentials, settings.ca))
    path = ServerPath(settings.nats, connect_options(settings.nats, credentials, ca))
    return FleetPart(path, FleetWatch(FleetView(path)))
