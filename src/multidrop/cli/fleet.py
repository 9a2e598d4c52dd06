"""The `fleet` command: several gateways for the lines of one plant, by NATS JetStream."""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from multidrop.cli import fleet_commands
from multidrop.cli.fleet_rights import write_rights
from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.extras import require_extra
from multidrop.cli.support.fleet_tables import (
    count_sentence,
    free_lines,
    gateway_table,
    line_table,
    move_table,
    trouble_sentences,
)
from multidrop.cli.support.nats import add_nats_arguments, nats_options
from multidrop.cli.support.output import logging_to, print_text, warn
from multidrop.cli.support.signals import on_end_signals

if TYPE_CHECKING:
    from multidrop.fleet.servers import ServerPath

URLS = "nats://127.0.0.1:4222"
DRAIN_S = 30.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "action", metavar="ACTION", choices=[*ACTIONS, "demo"], help=", ".join([*ACTIONS, "demo"])
    )
    parser.add_argument(
        "what", metavar="NAME", nargs="?", help="a gateway's name; PLANT.toml for init; for rights all names"
    )
    parser.add_argument(
        "--nats", metavar="URLS", help=f"servers, with commas; else MULTIDROP_NATS, or {URLS}"
    )
    parser.add_argument(
        "--folder", metavar="DIR", type=Path, help="where a gateway keeps things, or rights go"
    )
    parser.add_argument("--keep", metavar="SIZE", default="10 GB", help="most that the spool takes: 10 GB")
    add_nats_arguments(parser)
    parser.add_argument(
        "--cert", metavar="FILE", type=Path, help="with rights: a server's certificate, there"
    )
    parser.add_argument("--key", metavar="FILE", type=Path, help="with rights: its key, there")
    parser.add_argument("--metrics", metavar="HOST:PORT", help="answer GET /metrics there, with serve")
    fleet_commands.add_command_arguments(parser)
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    fleet_commands.check_words(arguments)
    for library in ("nats", "pyarrow"):
        require_extra(library, "fleet", "fleet")
    if arguments.action == "demo":
        from multidrop.cli.fleet_demo.command import run_demo

        return run_demo()
    with logging_to(warn, "multidrop.fleet", logging.INFO if arguments.action == "serve" else logging.ERROR):
        return int(asyncio.run(ACTIONS[arguments.action](arguments)))


def _urls(arguments: argparse.Namespace) -> list[str]:
    text = arguments.nats or os.environ.get("MULTIDROP_NATS") or URLS
    found = [url.strip() for url in text.split(",") if url.strip()]
    for url in found:
        if not url.startswith(("nats://", "tls://")):
            raise ValueError(f"{url} is no address of a NATS server; write {URLS}")
    return found


async def _with_paths(
    arguments: argparse.Namespace, work: Callable[[list[ServerPath]], Awaitable[int]]
) -> int:
    from multidrop.fleet.servers import paths_of

    urls = _urls(arguments)
    paths = paths_of(urls, nats_options(arguments, urls))
    try:
        return await work(paths)
    finally:
        for path in paths:
            await path.close()


# ---- init ----


async def _init(arguments: argparse.Namespace) -> int:
    from multidrop.fleet import names
    from multidrop.fleet.buckets import Bucket
    from multidrop.fleet.plant_store import read_plant, store
    from multidrop.fleet.samples_stream import connect, create_stream
    from multidrop.fleet.setup import set_up

    records = read_plant(Path(arguments.what))[1] if arguments.what else None

    async def work(paths: list[ServerPath]) -> int:
        made = await set_up(paths)
        urls = _urls(arguments)
        client = await connect(urls, **nats_options(arguments, urls))
        await create_stream(client, replicas=made["replicas"])
        await client.close()
        if records is not None:
            made["lines"] = await store(Bucket(names.PLANT, lambda: paths[0]), records)
        if arguments.json:
            print_text(json.dumps(made, indent=2))
            return 0
        servers = ", ".join(f"{name} {version}" for name, version in made["servers"].items())
        print_text(f"servers: {servers}; each bucket on {made['replicas']}")
        if records is not None:
            print_text("lines: " + ", ".join(f"{count} {word}" for word, count in made["lines"].items()))
        if made["replicas"] < 3:
            warn("fewer than three servers: when one of them dies, no line is polled until it is back")
        return 0

    return await _with_paths(arguments, work)


# ---- serve ----


async def _serve(arguments: argparse.Namespace) -> int:
    from importlib.metadata import version

    from multidrop.fleet.gateway import FleetGateway
    from multidrop.fleet.gateway_metrics import families_of
    from multidrop.fleet.metrics_port import listen, serving
    from multidrop.recording.retention import parse_size

    name = _name(arguments, "serve gw-1")
    listener = listen(arguments.metrics) if arguments.metrics else None
    folder = arguments.folder or _state_folder() / name
    urls = _urls(arguments)
    options = nats_options(arguments, urls)
    gateway = FleetGateway(name, urls, folder, options=options, spool_bytes=parse_size(arguments.keep))
    on_end_signals(gateway.end)
    async with AsyncExitStack() as stack:
        if listener:
            release = version("multidrop")
            await stack.enter_async_context(serving(listener, lambda: families_of(gateway.state(), release)))
            host, port, *_ = listener.getsockname()
            print_text(f"metrics http://{host}:{port}/metrics", flush=True)
        await gateway.run(lambda: print_text(f"ready {name}", flush=True))
    return 0


def _state_folder() -> Path:
    state = os.environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "multidrop" / "fleet"


def _name(arguments: argparse.Namespace, example: str) -> str:
    if not arguments.what:
        raise ValueError(f"name a gateway, such as `multidrop fleet {example}`")
    return str(arguments.what)


# ---- drain, status, lines ----


async def _drain(arguments: argparse.Namespace) -> int:
    from multidrop.fleet.gateway import ask_gateway
    from multidrop.fleet.setup import check_buckets, open_all

    name = _name(arguments, "drain gw-1")

    async def work(paths: list[ServerPath]) -> int:
        await open_all(paths)
        path = next(one for one in paths if one.is_open)
        await check_buckets(path)
        said = await ask_gateway(path, name, "drain")
        ends = time.monotonic() + DRAIN_S
        while said["lines"] and time.monotonic() < ends:
            await asyncio.sleep(0.1)
            said = await ask_gateway(path, name, "state")
        if arguments.json:
            print_text(json.dumps(said, indent=2))
        else:
            print_text(f"{name} has {said['lines']} lines left; it takes none until it is started again")
        return 1 if said["lines"] else 0

    return await _with_paths(arguments, work)


async def _seen(paths: list[ServerPath]) -> dict[str, Any]:
    """Return gateways, lines and moves as the records have them, and what the gateways say themselves."""
    from multidrop.fleet.overview import FleetView
    from multidrop.fleet.setup import open_all

    await open_all(paths)
    view = FleetView(next(one for one in paths if one.is_open))
    await view.look()
    return view.fleet()


async def _status(arguments: argparse.Namespace) -> int:
    async def work(paths: list[ServerPath]) -> int:
        found = await _seen(paths)
        if arguments.json:
            print_text(json.dumps(found, indent=2))
            return 0
        print_text("\n".join([*gateway_table(found), "", count_sentence(found), *trouble_sentences(found)]))
        if found["moves"]:
            print_text("\n".join(["", "last moves:", *move_table(found["moves"])]))
        return 1 if free_lines(found) else 0

    return await _with_paths(arguments, work)


async def _lines(arguments: argparse.Namespace) -> int:
    async def work(paths: list[ServerPath]) -> int:
        lines = (await _seen(paths))["lines"]
        print_text(json.dumps(lines, indent=2) if arguments.json else "\n".join(line_table(lines)))
        return 0

    return await _with_paths(arguments, work)


async def _rights(arguments: argparse.Namespace) -> int:
    return write_rights(arguments, _urls(arguments))


async def _watch(arguments: argparse.Namespace) -> int:
    from multidrop.cli.fleet_watch import watch

    return await _with_paths(arguments, partial(watch, is_json=arguments.json))


# ---- commands to drives ----


async def _command(arguments: argparse.Namespace) -> int:
    action = fleet_commands.ACTIONS[arguments.action]
    return await action(arguments, _urls(arguments), _state_folder())


ACTIONS: dict[str, Callable[[argparse.Namespace], Any]] = {
    "rights": _rights,
    "init": _init,
    "serve": _serve,
    "drain": _drain,
    "status": _status,
    "lines": _lines,
    "watch": _watch,
    **dict.fromkeys(fleet_commands.ACTIONS, _command),
}
