"""A client that is attacked: it does what it is told line by line, and tells what it did, and when."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from far_drives import KINDS
from own_fan import Fan

from multidrop.bus import Bus
from multidrop.drive import Drive
from multidrop.drives import MODELS

FAMILIES: dict[str, type[Drive]] = {**MODELS, "fan": Fan}


def tell(what: str, **more: Any) -> None:
    print(json.dumps({"at": time.monotonic_ns(), "what": what, **more}), flush=True)


def told(call: Callable[[], object]) -> str:
    """How the call failed; nothing when it did not."""
    try:
        call()
    except Exception as failure:
        return f"{type(failure).__name__}: {failure}"
    return ""


class Client:
    """Buses with their drives; each method does one command."""

    def __init__(self, buses: Sequence[Bus]) -> None:
        self.buses = buses
        self.drives = [drive for bus in buses for drive in bus.drives]

    def call(self, drive: int, verb: str) -> None:
        tell("asked")
        failure = told(getattr(self.drives[drive], verb))
        tell("called", failure=failure)

    def stop_all(self) -> None:
        tell("asked")
        for bus in self.buses:
            told(bus.stop_all)
        tell("called")

    def race(self, drive: int, verb: str, after: float, stop: str) -> None:
        """Start in a thread, and stop `after` s later in another."""
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
        """Start in a thread, and go on."""
        threading.Thread(target=told, args=(getattr(self.drives[drive], verb),), daemon=True).start()
        tell("asked")


def commands() -> Iterator[dict[str, Any]]:
    for line in sys.stdin:
        yield json.loads(line)


def main() -> None:
    given = json.loads(sys.argv[1])
    with ExitStack() as stack:
        buses = [stack.enter_context(Bus(port)) for port in given["ports"]]
        for bus, drives in zip(buses, given["drives"], strict=True):
            for kind, address in drives:
                bus.attach(FAMILIES[kind](address, **KINDS[kind].makes))
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
