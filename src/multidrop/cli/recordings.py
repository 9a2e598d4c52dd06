"""`multidrop report`, `plot` and `convert`: turn a recording into a page, a picture or another format."""

from __future__ import annotations

import argparse
import importlib
from contextlib import suppress
from pathlib import Path

from multidrop.cli.support.files import (
    beside,
    check_no_segments,
    load_recording,
    refuse_overwriting,
    warn_truncated,
    write_new,
)
from multidrop.cli.support.output import print_text
from multidrop.cli.support.signals import noting_signals
from multidrop.cli.support.values import counted
from multidrop.recording import EXPORTS, FORMATS, convert, open_recording

PICTURES = (".png", ".html")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    command = parser.get_default("command")
    if command == "convert":
        parser.add_argument(
            "recording", metavar="RECORDING", type=Path, help="a recording; its end may be missing"
        )
        suffixes = ", ".join([*FORMATS, *EXPORTS])
        parser.add_argument("out", metavar="FILE", type=Path, help=f"a new file: {suffixes}")
        return
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="a file of `multidrop poll --out`")
    if command == "plot":
        parser.add_argument("--drive", action="append", default=[], help="only this one; may be repeated")
        parser.add_argument("--register", action="append", default=[], help="only this one; may be repeated")
        parser.add_argument(
            "--out", metavar="FILE", type=Path, help="picture.png or page.html; default: RECORDING with .png"
        )
    else:
        parser.add_argument(
            "--out", metavar="PAGE.html", type=Path, help="default: RECORDING with the suffix .html"
        )


def run(arguments: argparse.Namespace) -> int:
    {"report": _report, "plot": _plot, "convert": _convert}[arguments.command](arguments)
    return 0


def _report(arguments: argparse.Namespace) -> None:
    out = arguments.out or beside(arguments.recording, ".html")
    if out.suffix.lower() != ".html":
        raise ValueError(f"{out}: a report's name must end in .html")
    recording = load_recording(arguments.recording, out, "report")
    from multidrop.report import report_page

    write_new(out, report_page(recording))
    print_text(out)


def _plot(arguments: argparse.Namespace) -> None:
    out = arguments.out or beside(arguments.recording, ".png")
    if out.suffix.lower() not in PICTURES:
        raise ValueError(f"{out}: a plot's name must end in {' or '.join(PICTURES)}")
    recording = load_recording(arguments.recording, out, "plot")
    from multidrop.report import plot, plot_page, png

    figure, left_out = plot(recording, arguments.drive, arguments.register)
    write_new(out, png(figure) if out.suffix.lower() == ".png" else plot_page(recording, figure))
    print_text(out)
    if left_out:
        print_text(f"not shown: {'; '.join(left_out)} (choose with --drive and --register)")


def _convert(arguments: argparse.Namespace) -> None:
    refuse_overwriting(arguments.out)
    check_no_segments(arguments.recording)
    _import_library(arguments.out)
    rows = convert(arguments.recording, arguments.out)
    warn_truncated(arguments.recording, rows, open_recording(arguments.recording).truncated)
    print_text(f"{counted(rows, 'row')} in {arguments.out}")


def _import_library(out: Path) -> None:
    """Import the library that an export to this file needs, if it is installed.

    A signal during the import ends the command only after it. Raised earlier, the KeyboardInterrupt could be
    caught by asammdf's own `except:`.
    """
    if out.suffix.lower() not in EXPORTS:
        return
    _, library, _ = EXPORTS[out.suffix.lower()]
    with noting_signals() as interruption, suppress(ImportError):
        importlib.import_module(library)
    if interruption.came:
        raise KeyboardInterrupt
