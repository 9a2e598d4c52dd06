"""`multidrop demo`: polls and records a simulated plant whose motors run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from multidrop.cli.monitor import watch
from multidrop.cli.poll import add_polling_arguments, conclude, follow, tap_text
from multidrop.cli.simulate import DRIVES, Operator, demo_files, simulator
from multidrop.cli.support.files import refuse_overwriting
from multidrop.cli.support.output import command_line, print_text
from multidrop.cli.support.terminal import keys_are_readable
from multidrop.cli.support.values import aligned, counted
from multidrop.plant.loader import load_plant
from multidrop.poller import Poller
from multidrop.printable import install_command
from multidrop.recording import open_recording

OUT, SECONDS = "demo.arrows", 8.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_polling_arguments(parser, out=OUT, seconds=SECONDS)
    parser.add_argument("--web", action="store_true", help="show it in a browser, as `serve --demo` does")
    parser.add_argument("--no-browser", action="store_true", help="open no page, with --web")


def run(arguments: argparse.Namespace) -> int:
    if arguments.web:
        _check_web(arguments)
        from multidrop.cli.serve import serve_demo

        status = serve_demo(is_shown=not arguments.no_browser)
        print_text("\n".join(_next(WEB_NEXT)))
        return status
    _make_room(arguments.out)
    with TemporaryDirectory(prefix="multidrop-") as directory:
        path, faults = demo_files(Path(directory))
        with simulator(path, Path(directory), faults):
            plant = load_plant(path)
            if _can_be_watched(arguments):
                summary = watch(plant, out=arguments.out, seconds=arguments.seconds, beside=_operator)
            else:
                summary = follow(plant, arguments, beside=_operator)
            if arguments.json:
                return conclude(plant, summary, arguments)
            print_text("\n".join(_text(summary, arguments.out)))
            return 0 if summary["samples"] else 1


def _operator(poller: Poller) -> Operator:
    return Operator(poller.buses.values())


def _text(summary: Mapping[str, Any], out: Path) -> Iterator[str]:
    rows = [("LINE", "DRIVES", "EXCHANGES/S", "WIRE USED", "MISSES")]
    for name, line in summary["lines"].items():
        rate = line["exchanges"] / line["seconds"] if line["seconds"] else 0.0
        misses = sum(line["misses"].values())
        rows.append(
            (name, str(len(line["drives"])), f"{rate:.1f}", f"{line['utilisation']:.0%}", str(misses))
        )
    yield from aligned(rows, "<>>>>")
    samples, misses = counted(summary["samples"], "sample"), counted(summary["misses"], "miss", "misses")
    yield f"{samples} and {misses} in {out}"
    yield from tap_text(summary)
    yield from _next([WEB, NextCommand(("report", str(out)), "this recording as a page", "plot"), SCAN])


class NextCommand(NamedTuple):
    """A command that the user could try next, its effect, and the optional library that it needs."""

    words: tuple[str, ...]
    effect: str
    extra: str = ""

    @property
    def lacks(self) -> bool:
        return not all(map(find_spec, LIBRARIES[self.extra]))


LIBRARIES = {"": (), "plot": ("matplotlib",), "serve": ("starlette", "uvicorn")}
WEB = NextCommand(("demo", "--web"), "this plant on a page", "serve")
SCAN = NextCommand(("scan", "/dev/ttyUSB0"), "find your own drives, by reading only")
WEB_NEXT = (
    NextCommand(("demo",), "this plant on a terminal, recorded"),
    SCAN,
    NextCommand(("serve", "plant.toml"), "your own plant on this page", "serve"),
)


def _next(commands: Sequence[NextCommand]) -> Iterator[str]:
    """Yield the commands to try next as text, with the program's name as the user typed it."""
    typed = sys.argv[0]
    program = typed if Path(typed).name == "multidrop" and which("multidrop") != typed else "multidrop"
    rows = [(f"  {command_line([program, *one.words])}", one.effect) for one in commands]
    yield from ("", "Next:", *aligned(rows, "<<"))
    if lacking := [one for one in commands if one.lacks]:
        install = install_command(*dict.fromkeys(one.extra for one in lacking))
        pip = Path(program).with_name("pip")
        yield f"To install what these commands need: {pip}{install.removeprefix('pip')}"


def _check_web(arguments: argparse.Namespace) -> None:
    """Raise ValueError for options that have no effect with --web, such as those of a recording."""
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
    """Remove the recording of an earlier demo. Raises ValueError if there is any other file at `out`."""
    with suppress(ValueError, TypeError, OSError):  # no file, or a file that is not a recording
        if set(open_recording(out).metadata.get("drives", ())) == set(DRIVES):
            out.unlink()
    refuse_overwriting(out)


def _can_be_watched(arguments: argparse.Namespace) -> bool:
    """Return True if the monitor can show the demo: on a terminal, and without capture or JSON output."""
    if arguments.capture or arguments.flight_recorder:
        return False
    return not arguments.json and keys_are_readable()
