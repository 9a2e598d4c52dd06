"""`multidrop sniff`: listens to a line that someone else masters, and sends nothing."""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from multidrop.capture import Capture, CaptureWriter
from multidrop.capture.lookup import line_of
from multidrop.cli.sniff.listening import Listener
from multidrop.cli.sniff.sniffed import Ear, replay, summary
from multidrop.cli.support.arguments import add_json_argument, duration
from multidrop.cli.support.files import check_capture
from multidrop.cli.support.saying import say
from multidrop.cli.support.signals import Interruption
from multidrop.drive.timing import Settings
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant, PlantLine

_SILENT_S = 0.5  # so long no frame pauses midway
_GIVEN_UP_S = 1.5  # so long no master waits for a reply


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "port", metavar="PORT", nargs="?", help="device such as /dev/ttyUSB0, or pyserial URL"
    )
    parser.add_argument("--replay", metavar="FILE", type=Path, help="a capture, instead of a port")
    parser.add_argument("--plant", metavar="PLANT.toml", help="for names and engineering units")
    parser.add_argument("--out", metavar="FILE.pcapng", type=Path, help="write a capture, for Wireshark too")
    parser.add_argument("--baudrate", type=int, metavar="N", help="the plant's, or 9600")
    parser.add_argument("--format", metavar="8N1", help="the plant's, or 8N1")
    parser.add_argument("--seconds", type=duration, metavar="S", help="how long; until Ctrl-C")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    if (arguments.port is None) == (arguments.replay is None):
        raise ValueError("name a PORT to listen to, or a capture with --replay FILE")
    if arguments.out:
        check_capture(arguments.out)
    plant = load_plant(arguments.plant) if arguments.plant else None
    with ExitStack() as stack:
        if arguments.replay:
            source = stack.enter_context(Capture(arguments.replay))
            out = stack.enter_context(CaptureWriter(arguments.out)) if arguments.out else None
            counts = dict(replay(source, plant, as_json=arguments.json, out=out))
        else:
            line = _line_at(plant, arguments.port)
            listener = stack.enter_context(Listener(arguments.port, _settings(arguments, line)))
            out = stack.enter_context(CaptureWriter(arguments.out)) if arguments.out else None
            ear = Ear(line.name if line else _name(arguments.port), line, as_json=arguments.json, out=out)
            _listen(listener, ear, arguments.seconds)
            counts = ear.pairing.counts()
    say(json.dumps({"summary": counts}) if arguments.json else summary(counts))
    return 0


def _line_at(plant: Plant | None, port: str) -> PlantLine | None:
    """The plant's line at this port; its only line may be listened to at any."""
    lines = plant.lines if plant else ()
    return next((line for line in lines if line.port == port), line_of(plant, port))


def _name(port: str) -> str:
    return port if "://" in port else Path(port).name


def _settings(arguments: argparse.Namespace, line: PlantLine | None) -> Settings:
    """The arguments', else the line's, else those that most of its drives have."""
    found = [polled.drive.settings for polled in line.drives] if line else []
    usual = max(found, key=found.count) if found else Settings(9600, "8N1")
    baudrate = usual.baudrate if arguments.baudrate is None else arguments.baudrate
    return Settings(baudrate, arguments.format or usual.format)


def _listen(listener: Listener, ear: Ear, seconds: float | None) -> None:
    say(f"listening on {listener.port}, Ctrl-C ends", file=sys.stderr, flush=True)
    begun = heard_at = time.monotonic()
    with Interruption() as interruption:
        while not interruption.came:
            now = time.monotonic()
            if seconds is not None and now - begun >= seconds:
                break
            if listener.hear():
                heard_at = now
            listener.stream.end(now - heard_at > _SILENT_S)
            ear.hear(listener.stream)
            if now - heard_at > _GIVEN_UP_S:
                ear.rest()
    listener.stream.end(True)
    ear.hear(listener.stream)
    ear.rest()
