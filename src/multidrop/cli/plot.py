"""`multidrop plot`: plots a recording's values as an image or an HTML page."""

from __future__ import annotations

import argparse
from pathlib import Path

from multidrop.cli.support.files import beside, load_recording, write_new
from multidrop.cli.support.output import print_text

SUFFIXES = (".png", ".html")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="a file of `multidrop poll --out`")
    parser.add_argument("--drive", action="append", default=[], help="only this one; may be repeated")
    parser.add_argument("--register", action="append", default=[], help="only this one; may be repeated")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help="picture.png or page.html; default: RECORDING with .png"
    )


def run(arguments: argparse.Namespace) -> int:
    out = arguments.out or beside(arguments.recording, ".png")
    if out.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{out}: a plot's name must end in {' or '.join(SUFFIXES)}")
    recording = load_recording(arguments.recording, out, "plot")
    from multidrop.report import plot, plot_page, png

    figure, left_out = plot(recording, arguments.drive, arguments.register)
    write_new(out, png(figure) if out.suffix.lower() == ".png" else plot_page(recording, figure))
    print_text(out)
    if left_out:
        print_text(f"not shown: {'; '.join(left_out)} (choose with --drive and --register)")
    return 0
