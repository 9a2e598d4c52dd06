"""The part `fleet` of `multidrop serve`: shows a fleet on the web page, and can stop it with a key.

Parts are the optional features of `multidrop serve`. If the plant file has no lines, this part also has a
`source`: the gateway gets the fleet's lines and samples from it. `multidrop.gateway` imports this module by
its name, like every other part.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from multidrop.printable import masked
from multidrop.supervisor import end_tasks

if TYPE_CHECKING:
    from multidrop import Plant
    from multidrop.fleet.commands.fleet_commands import FleetCommands
    from multidrop.fleet.followed import FollowedFleet
    from multidrop.fleet.overview import FleetWatch
    from multidrop.fleet.servers.connections import ServerPath

EXAMPLE = "nats://127.0.0.1:4222"
OLD_S = 5.0  # if the view of the fleet is older than this, the page reports a problem
AGAIN_S = 1.0  # pause between attempts to connect with the key for stops
LOG = "fleet-commands.jsonl"
WHOLE = "the fleet"  # key of the result for the whole fleet in the answer to a stop
NO_COMMANDER = (
    "the stop was NOT sent: [serve.fleet] has no commander; use `multidrop fleet stop` or the hard-wired stop"
)


@dataclass(frozen=True)
class FleetSettings:
    """The table `[serve.fleet]`: the URLs of the fleet's servers, and the same files as for `fleet watch`.

    `commander` is the file with a commander's key. With it, the page can stop the whole fleet. `samples` is
    the file with a hub's key, for a plant file without lines.
    """

    nats: tuple[str, ...] = field(
        default=(EXAMPLE,), metadata={"items": {"type": "string", "pattern": "^(nats|tls)://"}}
    )
    credentials: str = ""
    commander: str = ""
    samples: str = ""
    ca: str = ""
    libraries: ClassVar[tuple[str, ...]] = ("nats",)  # required packages, which `build` imports

    def __post_init__(self) -> None:
        wrong = [
            f'nats: {url!r} is not an address of a NATS server; write nats = ["{EXAMPLE}"]'
            for url in self.nats
            if not isinstance(url, str) or not url.startswith(("nats://", "tls://"))
        ]
        if wrong:
            raise ValueError("\n".join(wrong))


class FleetPart:
    """The part `fleet`, which reads a fleet's state once a second.

    `command` is a function that returns a new client for commands, not connected yet. Without such a function
    (None), the web page cannot stop the fleet.
    """

    def __init__(
        self,
        path: ServerPath,
        watch: FleetWatch,
        command: Callable[[], FleetCommands] | None = None,
        source: FollowedFleet | None = None,
    ) -> None:
        self.source = source
        self._path = path
        self._watch = watch
        self._command = command
        self._commands: FleetCommands | None = None  # the client for commands while it is connected
        self._why = "no server of the fleet has answered yet"

    @property
    def can_stop(self) -> bool:
        return self._command is not None

    def take(self, batch: object) -> None:
        """Ignore a batch of samples, because this part shows only the state of the fleet."""

    async def run(self) -> None:
        works = [self._path.keep(), self._watch.run()]
        if self._command is not None:
            works.append(self._keep_commander(self._command))
        if self.source is not None:
            works += self.source.works()
        names = [f"fleet: {getattr(work, '__qualname__', '')}" for work in works]
        tasks = [asyncio.create_task(work, name=name) for work, name in zip(works, names, strict=True)]
        try:
            ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
        finally:
            await end_tasks(*tasks)

    async def _keep_commander(self, command: Callable[[], FleetCommands]) -> None:
        """Keep a connection whose key allows stops, so that a stop is sent without a delay."""
        while True:
            try:
                async with command() as self._commands:
                    await self._commands.stay()
            except (OSError, ValueError) as failure:
                self._why = masked(str(failure))
            finally:
                self._commands = None
            await asyncio.sleep(AGAIN_S)

    async def stop(self, by: str, drives: Sequence[str] | None = None) -> Mapping[str, tuple[bool, str]]:
        """Stop these drives, or all drives of the fleet if None.

        Return for each drive whether it is stopped, and a sentence. A failure that concerns all drives has
        the key "the fleet".
        """
        if not self.can_stop:
            return {WHOLE: (False, NO_COMMANDER)}
        try:
            if self._commands is None:
                raise ConnectionError(f"the stop was NOT sent: {self._why}; use the hard-wired stop")
            answer = await self._commands.stop(drives, by=by)
        except (OSError, ValueError) as failure:
            return {WHOLE: (False, masked(str(failure)))}
        found = {name: (one.ok, one.text) for name, one in answer.drives.items()}
        if not found or not answer.ok:  # if the line has no master, the answer lists no drives
            found[WHOLE] = answer.ok, answer.text
        return found

    async def close(self) -> None:
        await self._path.close()
        if self.source is not None:
            await self.source.path.close()

    def health(self) -> str:
        """Return why the fleet's state is unknown; "" if it is known."""
        age = self._watch.age_s
        if age is not None and age <= OLD_S:
            return self.source.health() if self.source is not None else ""
        seen = "the fleet was never read" if age is None else f"the fleet was read {age:.0f} s ago"
        return f"{seen}: {self._watch.trouble or 'the first read is in progress'}"

    def state(self) -> dict[str, Any]:
        return self._watch.state()


class HasFolder(Protocol):
    """The attributes of the gateway's PartContext that this part uses."""

    folder: Path  # relative file names start from this folder
    plant: Plant


def build(settings: FleetSettings, inside: HasFolder) -> FleetPart:
    """Return the part `fleet` of `multidrop serve`; it connects to the servers when `run` is called.

    Raises ImportError without the NATS client, OSError or ValueError for invalid files.
    """
    from multidrop.fleet.commands.fleet_commands import FleetCommands
    from multidrop.fleet.overview import FleetView, FleetWatch
    from multidrop.fleet.servers.connections import ServerPath, connect_options

    def options(credentials: str) -> dict[str, Any]:
        files = (inside.folder / name if name else None for name in (credentials, settings.ca))
        return connect_options(settings.nats, *files)

    path = ServerPath(settings.nats, options(settings.credentials))
    watch = FleetWatch(FleetView(path))
    source = None
    if not inside.plant.lines:
        from multidrop.fleet.followed import FollowedFleet  # needs pyarrow

        key_of_samples = options(settings.samples or settings.credentials)
        source = FollowedFleet(ServerPath(settings.nats, key_of_samples), watch)
    if not settings.commander:
        return FleetPart(path, watch, source=source)
    key, log = options(settings.commander), inside.folder / LOG
    return FleetPart(
        path, watch, lambda: FleetCommands(settings.nats, by="page", log=log, options=key), source
    )
