"""A client program for tests of stops. It reads one command per line, and reports results with times."""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from own_drives import Fan
from responder_drives import KINDS

from multidrop.bus import Bus
from multidrop.drive import Drive
from multidrop.families import MODELS
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.poller import Poller

FAMILIES: dict[str, type[Drive]] = {**MODELS, "fan": Fan}


def tell(what: str, **more: Any) -> None:
    print(json.dumps({"at": time.monotonic_ns(), "what": what, **more}), flush=True)


def told(call: Callable[[], object]) -> str:
    """Call the function; return its error as text, or "" without an error."""
    try:
        call()
    except Exception as failure:
        return f"{type(failure).__name__}: {failure}"
    return ""


class Client:
    """The client's buses and drives; each public method carries out one command."""

    def __init__(self, buses: Sequence[Bus]) -> None:
        self.buses = buses
        self.drives = [drive for bus in buses for drive in bus.drives]

    def call(self, drive: int, verb: str, **more: Any) -> None:
        tell("asked")
        failure = told(lambda: getattr(self.drives[drive], verb)(**more))
        tell("called", failure=failure)

    def stop_all(self) -> None:
        tell("asked")
        for bus in self.buses:
            told(bus.stop_all)
        tell("called")

    def race(self, drive: int, verb: str, after: float, stop: str) -> None:
        """Start a motor in one thread, and stop it `after` s later in another."""
        found: list[str] = []
        moving = threading.Thread(target=lambda: found.append(told(getattr(self.drives[drive], verb))))
        moving.start()
        time.sleep(after)
        tell("asked")
        stops = getattr(self.drives[drive], stop) if stop != "stop_all" else self.buses[0].stop_all
        failure = told(stops)
        moving.join()
        tell("called", failure=failure, start=found[0])

    def start_aside(self, drive: int, verb: str) -> None:
        """Start a motor in another thread, and return immediately."""
        threading.Thread(target=told, args=(getattr(self.drives[drive], verb),), daemon=True).start()
        tell("asked")


def commands() -> Iterator[dict[str, Any]]:
    for line in sys.stdin:
        yield json.loads(line)


def attached(stack: ExitStack, port: str, drives: Sequence[Drive]) -> Bus:
    bus = stack.enter_context(Bus(port))
    for drive in drives:
        bus.attach(drive)
    return bus


def polled(stack: ExitStack, ports: Sequence[str], drives: Sequence[Sequence[Drive]]) -> list[Bus]:
    """Start a poller that reads two registers of each drive as fast as possible; return its buses."""
    lines = []
    for port, found in zip(ports, drives, strict=True):
        asked = [PolledDrive(each, tuple(Polled(reg, None) for reg in each.readings()[:2])) for each in found]
        lines.append(PlantLine(port, port, drives=tuple(asked)))
    return list(stack.enter_context(Poller(Plant(tuple(lines), Path("plant.toml")))).buses.values())


def main() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores SIGINT otherwise
    given = json.loads(sys.argv[1])
    drives = [
        [FAMILIES[kind](at, name=f"{kind}-{number}-{at}", **KINDS[kind].makes) for kind, at in found]
        for number, found in enumerate(given["drives"])
    ]
    with ExitStack() as stack:
        if given["polls"]:
            buses = polled(stack, given["ports"], drives)
        else:
            buses = [attached(stack, port, found) for port, found in zip(given["ports"], drives, strict=True)]
        if given["on_exit"]:
            for bus in buses:
                bus.stop_on_exit()
        client = Client(buses)
        for drive in client.drives:
            if given["sets"] and not isinstance(drive, Fan):
                drive.set_frequency(20)
        tell("ready")
        for command in commands():
            getattr(client, command.pop("do"))(**command)
        tell("leaving")
    tell("left")


if __name__ == "__main__":
    main()
