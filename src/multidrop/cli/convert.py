"""`multidrop convert`: a recording anew, in the format of another suffix."""

from __future__ import annotations

import argparse
from pathlib import Path

from multidrop.cli.support.files import refuse_overwriting
from multidrop.cli.support.saying import say
from multidrop.cli.support.truncated import tell_torn
from multidrop.recording import FORMATS, convert, open_reader


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="A", type=Path, help="a recording; its end may be torn")
    parser.add_argument("target", metavar="B", type=Path, help=f"a new file: {', '.join(FORMATS)}")


def run(arguments: argparse.Namespace) -> int:
    refuse_overwriting(arguments.target)
    rows = convert(arguments.source, arguments.target)
    tell_torn(arguments.source, rows, open_reader(arguments.source).truncated)
    say(f"{rows} rows in {arguments.target}")
    return 0
