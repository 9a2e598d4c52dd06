"""`multidrop report`: summarises a recording on one HTML page."""

from __future__ import annotations

import argparse
from pathlib import Path

from multidrop.cli.support.files import beside, load_recording, write_new
from multidrop.cli.support.output import print_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="a file of `multidrop poll --out`")
    parser.add_argument(
        "--out", metavar="PAGE.html", type=Path, help="default: RECORDING with the suffix .html"
    )


def run(arguments: argparse.Namespace) -> int:
    out = arguments.out or beside(arguments.recording, ".html")
    if out.suffix.lower() != ".html":
        raise ValueError(f"{out}: a report's name must end in .html")
    recording = load_recording(arguments.recording, out, "report")
    from multidrop.report import report_page

    write_new(out, report_page(recording))
    print_text(out)
    return 0
