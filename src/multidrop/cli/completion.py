"""`multidrop completion`: prints a script that lets a shell complete commands, options and file names."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from multidrop.cli import COMMANDS
from multidrop.cli.support.files import require_extra
from multidrop.cli.support.output import print_text

SHELLS = ("bash", "zsh", "tcsh")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help=f"one of {', '.join(SHELLS)}")


def run(arguments: argparse.Namespace) -> int:
    require_extra("shtab", "completion", "completion")
    import shtab

    parser = argparse.ArgumentParser(prog="multidrop")
    _add(parser, COMMANDS, "multidrop.cli", shtab.FILE)
    print_text(shtab.complete(parser, shell=arguments.shell))
    return 0


def _add(
    parser: argparse.ArgumentParser, table: Mapping[str, tuple[str, str]], package: str, file: Any
) -> None:
    """Add the commands in `table` to the parser. Arguments without choices are completed as file names."""
    subparsers = parser.add_subparsers()
    for word, (name, text) in table.items():
        module: Any = import_module(f"{package}.{name}" if name else package)
        one = subparsers.add_parser(word, help=text, description=text)
        if hasattr(module, "ACTIONS") and name:
            _add(one, module.ACTIONS, module.__name__, file)
            continue
        one.set_defaults(command=word)
        module.add_arguments(one)
        for action in one._actions:
            if not action.choices and action.nargs != 0:
                action.complete = file  # type: ignore[attr-defined]
