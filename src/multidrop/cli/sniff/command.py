"""The `sniff` command: prints and captures a line's traffic, and sends nothing."""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path

from multidrop.capture import Capture, CaptureWriter
from multidrop.capture.lookup import line_of as captured_line
from multidrop.cli.sniff.listener import Listener
from multidrop.cli.support.arguments import add_json_argument, duration, whole
from multidrop.cli.support.files import check_capture
from multidrop.cli.support.output import print_text
from multidrop.cli.support.plants import add_line_arguments, line_of, plant_at, usual_settings
from multidrop.cli.support.signals import noting_signals
from multidrop.cli.support.traffic import TrafficPrinter, replay, summary
from multidrop.drive.timing import Settings
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant, PlantLine

_SILENT_S = 0.5  # longer than any pause within a frame
_GIVEN_UP_S = 1.5  # longer than any master waits for a reply


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_line_arguments(parser)
    parser.add_argument("--replay", metavar="FILE", type=Path, help="a capture, instead of a port")
    parser.add_argument("--plant", metavar="PLANT.toml", help="for names and engineering units")
    parser.add_argument("--out", metavar="FILE.pcapng", type=Path, help="write a capture, for Wireshark too")
    parser.add_argument(
        "--baudrate", type=whole, metavar="N", help="as the plant file says, or 9600, if not given"
    )
    parser.add_argument("--format", metavar="8N1", help="as the plant file says, or 8N1, if not given")
    parser.add_argument("--seconds", type=duration, metavar="S", help="how long; until Ctrl-C if not given")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    if (arguments.port is None) == (arguments.replay is None):
        raise ValueError("name a PORT to listen to, or a capture with --replay FILE, and not both")
    if arguments.out:
        check_capture(arguments.out)
    plant = load_plant(arguments.plant) if arguments.plant else None
    with ExitStack() as stack:
        if arguments.replay:
            source = stack.enter_context(Capture(arguments.replay))
            out = stack.enter_context(CaptureWriter(arguments.out)) if arguments.out else None
            counts = dict(replay(source, plant, as_json=arguments.json, out=out))
        else:
            line = _line(arguments, plant)
            listener = stack.enter_context(closing(Listener(arguments.port, _settings(arguments, line))))
            out = stack.enter_context(CaptureWriter(arguments.out)) if arguments.out else None
            name = line.name if line else _name(arguments.port)
            printer = TrafficPrinter(name, line, as_json=arguments.json, out=out)
            _listen(listener, printer, arguments.seconds)
            counts = printer.pairing.counts()
    print_text(json.dumps({"summary": counts}) if arguments.json else summary(counts))
    return 0


def _line(arguments: argparse.Namespace, plant: Plant | None) -> PlantLine | None:
    """Return the plant file's line to listen to, or None where none is known.

    With PLANT.toml in place of PORT, sets `arguments.port` to the line's port. With --plant it is the line
    that has this port, or else the plant's only line.
    """
    named = plant_at(arguments)
    if named is None:
        port = arguments.port
        lines = plant.lines if plant else ()
        return next((line for line in lines if line.port == port), captured_line(plant, port))
    if plant:
        raise ValueError(f"--plant is for a PORT: {arguments.port} is a plant file already")
    line = line_of(named, arguments.name)
    arguments.port = line.port
    return line


def _name(port: str) -> str:
    return port if "://" in port else Path(port).name


def _settings(arguments: argparse.Namespace, line: PlantLine | None) -> Settings:
    """Return the settings that the arguments state, and for the rest those of most of the line's drives."""
    usual = usual_settings(line)
    baudrate = usual.baudrate if arguments.baudrate is None else arguments.baudrate
    return Settings(baudrate, arguments.format or usual.format)


def _listen(listener: Listener, printer: TrafficPrinter, seconds: float | None) -> None:
    print_text(f"listening on {listener.port}, Ctrl-C ends", file=sys.stderr, flush=True)
    begun = received_at = time.monotonic()
    with noting_signals() as interruption:
        while not interruption.came:
            now = time.monotonic()
            if seconds is not None and now - begun >= seconds:
                break
            if listener.receive():
                received_at = time.monotonic()  # not `now`: a busy machine may have let us wait for long
            listener.stream.end(now - received_at > _SILENT_S)
            printer.show(listener.stream)
            if now - received_at > _GIVEN_UP_S:
                printer.finish()
    listener.stream.end(True)
    printer.show(listener.stream)
    printer.finish()
