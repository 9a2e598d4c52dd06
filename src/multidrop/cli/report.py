"""`multidrop report`: all that a recording tells of itself, as one HTML page."""

from __future__ import annotations

import argparse
from pathlib import Path

from multidrop.cli.support.extra import need
from multidrop.cli.support.files import refuse_overwriting
from multidrop.cli.support.saying import say
from multidrop.cli.support.truncated import tell_torn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="of `multidrop poll --out`")
    parser.add_argument(
        "--out", metavar="PAGE.html", type=Path, help="without it RECORDING with .html in place of its suffix"
    )


def run(arguments: argparse.Namespace) -> int:
    out = arguments.out or arguments.recording.with_suffix(".html")
    if out.suffix.lower() != ".html":
        raise ValueError(f"{out}: a report's name ends in .html")
    need("matplotlib", "plot", "report")
    refuse_overwriting(out)
    from multidrop.report import load, report_page

    look = load(arguments.recording)
    tell_torn(look.path, look.rows, look.truncated)
    out.write_text(report_page(look), "utf-8")
    say(out)
    return 0
