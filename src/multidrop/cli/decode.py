"""`multidrop decode`: converts a capture of a line's traffic into a recording or text."""

from __future__ import annotations

import argparse
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from multidrop.capture import Capture, Decoding
from multidrop.cli.sniff import replay, summary
from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.files import refuse_overwriting
from multidrop.cli.support.output import print_text, warn
from multidrop.cli.support.values import counted
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant
from multidrop.recording import FORMATS, open_writer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("capture", metavar="FILE", type=Path, help="a capture: pcap or pcapng")
    parser.add_argument("--plant", metavar="PLANT.toml", help="for names and engineering units")
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help=f"a new recording: {', '.join(FORMATS)}; printed as text if not given",
    )
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    if arguments.out:
        refuse_overwriting(arguments.out)
    plant = load_plant(arguments.plant) if arguments.plant else None
    with Capture(arguments.capture) as capture:
        if arguments.out:
            counts = _record(capture, plant, arguments.out)
        else:
            counts = dict(replay(capture, plant, as_json=arguments.json))
        if capture.truncated:
            warn(
                f"{capture.path} ends within a packet: "
                f"its last {counted(capture.truncated, 'byte')} were skipped"
            )
    into = f"{counted(counts['rows'], 'row')} in {arguments.out}: " if arguments.out else ""
    print_text(json.dumps({"summary": counts}) if arguments.json else into + summary(counts))
    return 0


def _record(capture: Capture, plant: Plant | None, out: Path) -> dict[str, Any]:
    about = plant.metadata() if plant else {"multidrop": version("multidrop")}
    decoding = Decoding(capture, plant)
    with open_writer(out, {**about, "capture": str(capture.path)}) as writer:
        for batch in decoding:
            writer.write(batch)
    return {**decoding.counts(), "rows": writer.rows}
