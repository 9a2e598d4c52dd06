"""`multidrop demo`: polls and records a simulated line with every family on it."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from multidrop.cli.monitor import is_possible, watch
from multidrop.cli.poll import add_polling_arguments, conclude, follow
from multidrop.cli.support.demo_plant import DRIVES, demo_port, plant_file, simulator, start_motors
from multidrop.cli.support.files import refuse_overwriting
from multidrop.plant.loader import load_plant
from multidrop.recording import open_recording

OUT, SECONDS = "demo.arrows", 10.0
POLLED = ("output_frequency", "motor_speed", "output_current", "dc_bus_voltage")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_polling_arguments(parser, out=OUT, seconds=SECONDS)
    parser.add_argument("--web", action="store_true", help="show it in a browser, as `serve --demo` does")
    parser.add_argument("--no-browser", action="store_true", help="open no page, with --web")


def run(arguments: argparse.Namespace) -> int:
    if arguments.web:
        _check_web(arguments)
        from multidrop.cli.serve import serve_demo

        return serve_demo(is_shown=not arguments.no_browser)
    _make_room(arguments.out)
    with TemporaryDirectory(prefix="multidrop-") as directory:
        path = Path(directory) / "demo.toml"
        path.write_text(plant_file(demo_port(Path(directory)), POLLED), "utf-8")
        with simulator(path, Path(directory)):
            plant = load_plant(path)
            start_motors(plant.lines[0], Path(directory) / "wear.sqlite")
            if _can_be_watched(arguments):
                return conclude(plant, watch(plant, out=arguments.out, seconds=arguments.seconds), arguments)
            return follow(plant, arguments)


def _check_web(arguments: argparse.Namespace) -> None:
    """Raise ValueError for options that --web ignores: it serves until Ctrl-C without recording."""
    given = {
        "--seconds": arguments.seconds != SECONDS,
        "--out": str(arguments.out) != OUT,
        "--capture": arguments.capture,
        "--flight-recorder": arguments.flight_recorder,
        "--json": arguments.json,
    }
    if names := [name for name, is_given in given.items() if is_given]:
        raise ValueError(f"--web serves until Ctrl-C and records nothing: remove {' and '.join(names)}")


def _make_room(out: Path) -> None:
    """Remove an earlier demo's recording. Raises ValueError for any other file."""
    with suppress(ValueError, TypeError, OSError):  # no file, or not a recording
        if set(open_recording(out).metadata.get("drives", ())) == {name for name, *_ in DRIVES}:
            out.unlink()
    refuse_overwriting(out)


def _can_be_watched(arguments: argparse.Namespace) -> bool:
    """Return whether the monitor can show the demo: no captures are wanted, and it has a terminal."""
    if arguments.capture or arguments.flight_recorder:
        return False
    return not arguments.json and is_possible()
