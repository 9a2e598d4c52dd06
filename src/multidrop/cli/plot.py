"""`multidrop plot`: a recording's values as a picture, or as a page with the picture in it."""

from __future__ import annotations

import argparse
from pathlib import Path

from multidrop.cli.support.extra import need
from multidrop.cli.support.files import refuse_overwriting
from multidrop.cli.support.saying import say
from multidrop.cli.support.truncated import tell_torn

SUFFIXES = (".png", ".html")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="of `multidrop poll --out`")
    parser.add_argument("--drive", action="append", default=[], help="only this one; may be repeated")
    parser.add_argument("--register", action="append", default=[], help="only this one; may be repeated")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help="picture.png or page.html; without it RECORDING with .png"
    )


def run(arguments: argparse.Namespace) -> int:
    out = arguments.out or arguments.recording.with_suffix(".png")
    if out.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{out}: a plot's name ends in {' or '.join(SUFFIXES)}")
    need("matplotlib", "plot", "plot")
    refuse_overwriting(out)
    from multidrop.report import load, plot, plot_page, png

    look = load(arguments.recording)
    tell_torn(look.path, look.rows, look.truncated)
    figure, left = plot(look, arguments.drive, arguments.register)
    if out.suffix.lower() == ".png":
        out.write_bytes(png(figure))
    else:
        out.write_text(plot_page(look, figure), "utf-8")
    say(out)
    if left:
        say(f"not shown: {'; '.join(left)} (choose with --register)")
    return 0
