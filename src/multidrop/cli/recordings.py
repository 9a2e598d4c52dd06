"""`multidrop report`, `plot` and `convert`: turn a recording into a page, a picture or another format."""

from __future__ import annotations

import argparse
import importlib
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from multidrop.cli.support.files import refuse_overwriting, require_extra, write_new
from multidrop.cli.support.output import print_text, warn
from multidrop.cli.support.signals import noting_signals
from multidrop.cli.support.values import counted
from multidrop.recording import EXPORTS, FORMATS, convert, open_recording
from multidrop.recording.segments import segments_of

if TYPE_CHECKING:
    from multidrop.report.load import Recording

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
    out = arguments.out or _beside(arguments.recording, ".html")
    if out.suffix.lower() != ".html":
        raise ValueError(f"{out}: a report's name must end in .html")
    recording = _load_recording(arguments.recording, out, "report")
    from multidrop.report import report_page

    write_new(out, report_page(recording))
    print_text(out)


def _plot(arguments: argparse.Namespace) -> None:
    out = arguments.out or _beside(arguments.recording, ".png")
    if out.suffix.lower() not in PICTURES:
        raise ValueError(f"{out}: a plot's name must end in {' or '.join(PICTURES)}")
    recording = _load_recording(arguments.recording, out, "plot")
    from multidrop.report import plot, plot_page, png

    figure, left_out = plot(recording, arguments.drive, arguments.register)
    write_new(out, png(figure) if out.suffix.lower() == ".png" else plot_page(recording, figure))
    print_text(out)
    if left_out:
        print_text(f"not shown: {'; '.join(left_out)} (choose with --drive and --register)")


def _convert(arguments: argparse.Namespace) -> None:
    refuse_overwriting(arguments.out)
    _check_no_segments(arguments.recording)
    _import_library(arguments.out)
    rows = convert(arguments.recording, arguments.out)
    _warn_truncated(arguments.recording, rows, open_recording(arguments.recording).truncated)
    print_text(f"{counted(rows, 'row')} in {arguments.out}")


def _import_library(out: Path) -> None:
    """Import the library that an export to this file needs, if it is installed.

    Ctrl-C during the import takes effect after the import. An earlier KeyboardInterrupt could be caught by
    an `except:` of asammdf.
    """
    if out.suffix.lower() not in EXPORTS:
        return
    _, library, _ = EXPORTS[out.suffix.lower()]
    with noting_signals() as interruption, suppress(ImportError):
        importlib.import_module(library)
    if interruption.came:
        raise KeyboardInterrupt


# ---- the recording ----


def _warn_truncated(path: Path, rows: int, left_out: int) -> None:
    if left_out:
        warn(
            f"{path} ends within a row: {counted(rows, 'row')} read, "
            f"and the last {counted(left_out, 'byte')} skipped"
        )


def _check_no_segments(path: Path) -> None:
    """Raise ValueError if the path is a folder, or names a recording that was split into segments."""
    if path.is_dir():
        kept = [*sorted(path.glob("rows/*.parquet")), *sorted(path.glob("rows.*.arrows"))]
        if not kept:
            raise _is_folder(path)
        raise ValueError(
            f"{path} is the folder of a history: name one of its files, such as {kept[-1]}, or read it from "
            "Python with `multidrop.History`"
        )
    if not path.exists() and path.parent.is_dir() and (segments := segments_of(path)):
        raise ValueError(f"{path} was recorded in several files: name one of them, such as {segments[-1][1]}")


def _is_folder(path: Path) -> ValueError:
    return ValueError(f"{path} is a folder: name the recording in it")


def _beside(recording: Path, suffix: str) -> Path:
    """Return a recording's path with another suffix. Raises ValueError if the path does not name a file."""
    if not recording.name:
        raise _is_folder(recording)
    return recording.with_suffix(suffix)


def _load_recording(path: Path, out: Path, command: str) -> Recording:
    """Load a recording for a command that draws it into the new file `out`.

    Raises ValueError if `out` exists, if `path` is a folder, or if the recording is split into segment files.
    """
    require_extra("matplotlib", "plot", command)
    refuse_overwriting(out)
    _check_no_segments(path)
    from multidrop.report import load

    recording = load(path)
    _warn_truncated(recording.path, recording.rows, recording.truncated)
    return recording
