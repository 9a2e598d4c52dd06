"""`multidrop convert`: copies a recording into another file format, which the new file's suffix names."""

from __future__ import annotations

import argparse
from pathlib import Path

from multidrop.cli.support.files import check_no_segments, refuse_overwriting, warn_truncated
from multidrop.cli.support.output import print_text
from multidrop.cli.support.values import counted
from multidrop.recording import FORMATS, convert, open_recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="RECORDING", type=Path, help="a recording; its end may be missing")
    parser.add_argument("target", metavar="FILE", type=Path, help=f"a new file: {', '.join(FORMATS)}")


def run(arguments: argparse.Namespace) -> int:
    refuse_overwriting(arguments.target)
    check_no_segments(arguments.source)
    rows = convert(arguments.source, arguments.target)
    warn_truncated(arguments.source, rows, open_recording(arguments.source).truncated)
    print_text(f"{counted(rows, 'row')} in {arguments.target}")
    return 0
