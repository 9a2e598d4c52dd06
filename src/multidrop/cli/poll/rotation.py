"""The options of `poll` for a recording in segments."""

from __future__ import annotations

import argparse

from multidrop.cli.support.polling import Rotation
from multidrop.recording.retention import parse_age, parse_size


def add_rotation_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rotate",
        metavar="TIME",
        type=_age,
        help='begin a new file so often, such as "1 h": run.arrows becomes run.00000001.arrows and so on',
    )
    parser.add_argument(
        "--keep",
        metavar="TIME",
        type=_age,
        help='with --rotate: remove files older than so long, such as "30 days"',
    )
    parser.add_argument(
        "--most",
        metavar="SIZE",
        type=_size,
        help='with --rotate: remove the oldest beyond a size, such as "20 GB"',
    )


def rotation_of(arguments: argparse.Namespace) -> Rotation | None:
    """Return how the recording is cut into files. Raises ValueError where options do not fit together."""
    if arguments.rotate is None:
        if arguments.keep is not None or arguments.most is not None:
            raise ValueError('--keep and --most remove whole files: say --rotate too, such as --rotate "1 h"')
        return None
    if not arguments.out or arguments.out.suffix != ".arrows":
        raise ValueError("--rotate needs a recording whose name ends in .arrows: say --out run.arrows")
    return Rotation(arguments.rotate, arguments.keep, arguments.most)


def _age(text: str) -> float:
    try:
        return parse_age(text)
    except ValueError as mistake:
        raise argparse.ArgumentTypeError(str(mistake)) from None


def _size(text: str) -> int:
    try:
        return parse_size(text)
    except ValueError as mistake:
        raise argparse.ArgumentTypeError(str(mistake)) from None
