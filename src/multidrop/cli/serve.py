"""`multidrop serve`: polls a plant and serves it to browsers and programs."""

from __future__ import annotations

import argparse
import logging
import os
import threading
import time
import webbrowser
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from multidrop.cli.support.arguments import add_port_option, plant_of
from multidrop.cli.support.files import require_extra, write_new
from multidrop.cli.support.log_thread import add_log_argument, logging_to_stderr
from multidrop.cli.support.output import print_text, warn
from multidrop.cli.support.signals import on_end_signals, on_reload_signal, run_loop
from multidrop.cli.support.values import counted
from multidrop.drive.family import verbs_of
from multidrop.drive.known_state import can_show_fault
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway
    from multidrop.gateway.reload import Read
    from multidrop.gateway.settings import ServeSettings

DEMO_PORTS = (8750, 0)  # try the usual port first, then any free port (0)
END_S = 4.7  # if the process still runs this many s after the end signal, it ends itself
ROLES = ("look", "stop", "write")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plant", metavar="PLANT.toml", nargs="?", help="lines, drives, and the table [serve]")
    add_port_option(parser)
    parser.add_argument("--demo", action="store_true", help="serve a simulated plant, and open its page")
    parser.add_argument("--no-browser", action="store_true", help="with --demo: do not open the page")
    parser.add_argument("--check", action="store_true", help="check the file and its [serve], then exit")
    parser.add_argument(
        "--modbus-map",
        metavar="FILE",
        help="write the addresses of the Modbus server to a .csv or .json file",
    )
    add_log_argument(parser)
    parser.add_argument(
        "--new-token",
        metavar="ROLE",
        choices=ROLES,
        help=f"print a new token for this role: {', '.join(ROLES)}; needs --for",
    )
    parser.add_argument("--for", metavar="NAME", dest="owner", help="the owner of the new token")


def run(arguments: argparse.Namespace) -> int:
    if arguments.new_token or arguments.owner:
        return _new_token(arguments.new_token, arguments.owner)
    if arguments.demo:
        if arguments.plant:
            raise ValueError("--demo uses its own plant: give no plant file")
        if arguments.ports:
            raise ValueError("--demo uses its own plant: remove --port")
        return serve_demo(is_shown=not arguments.no_browser, log=arguments.log)
    if not arguments.plant:
        raise ValueError("name a plant file, or try `multidrop serve --demo`")
    _require_server()
    from multidrop.gateway.settings import read_plant

    def read() -> tuple[Plant, ServeSettings]:
        return read_plant(lambda: plant_of(arguments.plant, arguments), os.environ)

    plant, settings = read()
    if arguments.modbus_map:
        return _write_modbus_map(plant, settings, Path(arguments.modbus_map))
    if arguments.check:
        parts = ", ".join(settings.parts) or "none"
        for sentence in blind_spots(plant):
            warn(sentence)
        print_text(f"{plant.path}: no mistake found; {_url(settings, settings.port)}, parts: {parts}")
        return 0
    with logging_to_stderr(arguments.log, _levels(logging.INFO)):
        return _serve(plant, settings, partial(_announce, settings), read)


def _write_modbus_map(plant: Plant, settings: ServeSettings, path: Path) -> int:
    """Write the table that `GET /api/modbus-map` returns, with the ports that the plant file names."""
    from multidrop.gateway.modbus_server.address_map import address_map, to_csv, to_json
    from multidrop.gateway.modbus_server.settings import MAIN, Units

    if path.suffix not in (".csv", ".json"):
        raise ValueError(f"{path}: the name of an address map must end in .csv or .json")
    modbus: Any = settings.parts.get("modbus")
    if modbus is None:
        raise ValueError(f"{plant.path} has no Modbus server: add [serve.modbus]")
    rows = address_map(Units(plant, modbus), modbus, {MAIN: modbus.port, **modbus.ports}, settings.may)
    write_new(path, to_json(rows) if path.suffix == ".json" else to_csv(rows))
    print_text(f"{path}: {counted(len(rows), 'value')} of {counted(len({row[1] for row in rows}), 'drive')}")
    return 0


def serve_demo(*, is_shown: bool = True, log: str = "text") -> int:
    """Serve a simulated plant; every user of this computer has all rights."""
    from multidrop.cli.simulate import Operator, demo_files, simulator  # imports the simulator

    _require_server()
    with TemporaryDirectory(prefix="multidrop-") as directory:
        folder = Path(directory)
        path, faults = demo_files(folder)
        logged = logging_to_stderr(log, _levels(logging.WARNING))
        with simulator(path, folder, faults), logged, ExitStack() as stack:
            plant = load_plant(path)

            def on_ready(gateway: Gateway) -> None:
                stack.enter_context(Operator([gateway.bus(line.name) for line in plant.lines]))
                url = f"http://localhost:{gateway.port}/"
                print_text(f"ready {url}\nCtrl-C ends it", flush=True)
                if is_shown:
                    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()

            return _serve(plant, _demo_settings(plant, folder), on_ready)


def blind_spots(plant: Plant) -> list[str]:
    """Return a sentence for each drive whose polled registers cannot show a fault."""
    found = []
    for one in plant.drives:
        drive, polled = one.drive, [poll.register.name for poll in one.polls]
        if not can_show_fault(drive, polled):
            others = [each.name for each in drive.readings() if can_show_fault(drive, [*polled, each.name])]
            if not (others or drive.has_motor):
                continue
            advice = f"poll {' or '.join(others[:3])} too" if others else "its family has no such register"
            found.append(f"{drive.name}: no polled register can show a fault: {advice}")
    return found


def _require_server() -> None:
    for library in ("starlette", "uvicorn"):
        require_extra(library, "serve", "serve")


def _demo_settings(plant: Plant, folder: Path) -> ServeSettings:
    from multidrop.gateway.historian import HistorySettings
    from multidrop.gateway.http.rights import May, Right
    from multidrop.gateway.settings import ServeSettings

    drives = [polled.drive for polled in plant.drives]
    writes = [
        f"{one.name}.{name}" for one in drives for name, found in one.registers.items() if found.writable
    ]
    verbs = [f"{one.name}.{verb}" for one in drives for verb in verbs_of(one)]
    may = May("anyone", Right.WRITE, frozenset(writes), frozenset(verbs))
    parts = {"history": HistorySettings()}
    audit = folder / "audit.jsonl"
    alarms = folder / "alarms.jsonl"
    return ServeSettings(
        port=DEMO_PORTS[0], may=may, audit=audit, alarms=alarms, folder=folder, parts=parts, is_demo=True
    )


def _announce(settings: ServeSettings, gateway: Gateway) -> None:
    """Print the gateway's address: on standard error if some part of the gateway writes rows to stdout."""
    ready = f"ready {_url(settings, gateway.port)}"
    if getattr(settings.parts.get("influx"), "url", "") == "stdout":
        warn(ready)
    else:
        print_text(ready, flush=True)


def _serve(
    plant: Plant,
    settings: ServeSettings,
    on_ready: Callable[[Gateway], None],
    read: Read | None = None,
) -> int:
    from dataclasses import replace

    from multidrop.gateway.gateway import Gateway

    try:
        gateway = Gateway(plant, settings, read=read)
    except OSError:
        if not settings.is_demo:
            raise
        gateway = Gateway(plant, replace(settings, port=DEMO_PORTS[1]))

    def end() -> None:
        threading.Thread(target=_end_by_force, name="multidrop end", daemon=True).start()
        gateway.end()

    async def live() -> None:
        on_end_signals(end)
        if read:
            on_reload_signal(gateway.reload.begin, end)
        await gateway.run(lambda: on_ready(gateway))

    run_loop(live())
    return 0


def _end_by_force() -> None:
    """End the process after END_S, because a thread may hang while it reads a disk."""
    time.sleep(END_S)
    os._exit(1)


def _url(settings: ServeSettings, port: int) -> str:
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    return f"http{'s' if settings.tls else ''}://{host}:{port}/"


def _new_token(role: str | None, owner: str | None) -> int:
    """Print a line for the file of tokens on stdout; print the token itself only on stderr.

    The token is stored nowhere.
    """
    from multidrop.gateway.http.rights import Right, new_token

    if not role or not owner:
        raise ValueError(
            "a new token needs a role and an owner, such as `multidrop serve --new-token stop --for anna`"
        )
    secret, token = new_token(owner, Right[role.upper()])
    print_text(token.line)
    warn(f"the token of {owner}, shown this once: {secret}")
    return 0


def _levels(level: int) -> dict[str, int]:
    return {"multidrop": level, "uvicorn": logging.WARNING, "asyncio": logging.WARNING}
