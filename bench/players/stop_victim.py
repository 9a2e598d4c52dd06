"""A client process on simulated lines, for tests of its stops, and the counters of the results."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from responder import ReceivedFrame, Responder, ResponderLine
from responder_drives import KINDS, ResponderDrive

CLIENT = "bench.players.stop_client"
PATIENCE = 150.0  # longest wait for the end of a client, in s


@dataclass
class Counters:
    """The number of requested stops (one for each motor), and the number of each result."""

    rounds: int = 0
    asked: int = 0
    turning: int = 0  # motors that still turn after the stop
    moved: int = 0  # frames that move a motor after its stop
    unsent: int = 0  # stops that never reached the line
    excused: int = 0  # motors that still turn, although the program reported that their stop was aborted
    first_ms: list[float] = field(default_factory=list)  # ms from each request to the first stop frame
    stories: list[str] = field(default_factory=list)

    @property
    def failures(self) -> int:
        return self.turning + self.moved


class Victim:
    """A client process under test, the simulated lines, and the time of the first request to stop."""

    def __init__(self, far: Responder, process: subprocess.Popen[str], errors: Path) -> None:
        self.far = far
        self.lines = far.lines
        self.process = process
        self.asked_ns = 0
        self._errors = errors
        self._begun: dict[ResponderLine, int] = {}

    def ask(self, **command: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()

    def hear(self, what: str) -> dict[str, Any]:
        """Return the client's next report, of the kind `what`; {} if the client has ended."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            said: dict[str, Any] = json.loads(line)
            if said["what"] == what:
                return said
        return {}

    def leave(self) -> None:
        """Make the client leave its `with` block."""
        assert self.process.stdin is not None
        self.process.stdin.close()

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the client; the first signal is the request to stop."""
        if not self.asked_ns:
            self.asked_ns = time.monotonic_ns()
        self.process.send_signal(number)

    def wait(self) -> None:
        assert self.process.stdout is not None
        self.process.stdout.read()
        self.process.wait(PATIENCE)

    @property
    def errors(self) -> str:
        return self._errors.read_text()

    def begin(self, *, turning: bool) -> None:
        """Forget the frames received so far. With `turning`, set all motors turning."""
        self.asked_ns = 0
        for line in self.lines:
            self._begun[line] = len(line.log)
            for drive in line.drives.values():
                if turning:
                    drive.turn()

    def hold(self, requests: int) -> None:
        """Stop answering on the first line after `requests` requests, until `release` is called."""
        self.far.do(lambda: self.lines[0].hold(requests))

    def release(self) -> None:
        self.far.release(self.lines[0])

    def received(self, line: ResponderLine, address: int, what: str) -> list[ReceivedFrame]:
        """Return the frames of the kind `what` (such as "stops") that the drive received since `begin`."""
        return [
            each
            for each in line.log[self._begun.get(line, 0) :]
            if each.what == what and each.asked is not None and each.asked.address in (0, address)
        ]

    def judge(self, counters: Counters, what: str, *, excuse: bool = False) -> None:
        """Count the results of all stops since `begin`.

        Set `excuse` if the client reported an aborted stop: then a motor that still turns is not a failure.
        """
        counters.rounds += 1
        for line in self.lines:
            for address, drive in line.drives.items():
                stops = self.received(line, address, "stops")
                counters.asked += 1
                if stops and self.asked_ns:
                    counters.first_ms.append((stops[0].at - self.asked_ns) / 1e6)
                late = [
                    each for each in self.received(line, address, "moves") if stops and each.at > stops[0].at
                ]
                counters.moved += len(late)
                counters.unsent += not stops
                counters.turning += drive.runs and not excuse
                counters.excused += drive.runs and excuse
                if late or drive.runs:
                    said = self.errors.strip().splitlines()[-1:]
                    story = "; ".join(str(stop) for stop in (*stops[:3], *late))
                    counters.stories.append(
                        f"{what}: {drive.kind.name}@{address}: {story or 'no stop'} {said}"
                    )


@contextmanager
def victim(
    plant: Sequence[Sequence[tuple[str, int]]],
    *,
    on_exit: bool = False,
    sets: bool = False,
    polls: bool = False,
    ramp: float = 0.0,
    far: Responder | None = None,
) -> Iterator[Victim]:
    """Start a client; yield it when its lines are open.

    `plant` has a list of drives for each line, each drive as (kind, address).
    """
    with TemporaryDirectory(prefix="multidrop-stops-") as name:
        directory = Path(name)
        if far is None:
            lines = [
                ResponderLine([ResponderDrive(KINDS[kind], at, ramp) for kind, at in drives])
                for drives in plant
            ]
            far = Responder(lines, directory)
        given = {"ports": far.ports, "drives": plant, "on_exit": on_exit, "sets": sets, "polls": polls}
        errors = directory / "errors"
        with (
            far,
            errors.open("w") as stderr,
            subprocess.Popen(
                [sys.executable, "-m", CLIENT, json.dumps(given)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
                env={"XDG_STATE_HOME": name, "PATH": "/usr/bin:/bin"},
            ) as process,
        ):
            found = Victim(far, process, errors)
            try:
                if not found.hear("ready"):
                    raise RuntimeError(f"the client did not start: {found.errors}")
                yield found
            finally:
                process.kill()
