"""Arguments that several commands take."""

from __future__ import annotations

import argparse

from multidrop.printable import plain_number, plain_whole


def add_writing_arguments(parser: argparse.ArgumentParser, *, asks: bool = True) -> None:
    """Add --yes and --audit, for commands that may write; `asks`: this one asks before it does."""
    yes = "do not ask; needed where no terminal is" if asks else "changes nothing: this command never asks"
    parser.add_argument("--yes", action="store_true", help=yes)
    parser.add_argument(
        "--audit",
        metavar="FILE",
        help="append every write and its outcome to this file; to none if not given",
    )


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON for programs")


def whole(text: str) -> int:
    """Parse a whole number."""
    try:
        return plain_whole(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number such as 10") from None


def number(text: str) -> float:
    """Parse a number with a point."""
    try:
        return plain_number(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number such as 42.5") from None


def duration(text: str) -> float:
    """Parse a number of seconds above 0."""
    try:
        seconds = plain_number(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds above 0")
    return seconds
