"""`multidrop completion` and `multidrop schema`: let shells and editors complete what a user types."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from multidrop.cli import COMMANDS
from multidrop.cli.support.files import require_extra
from multidrop.cli.support.output import print_text

SHELLS = ("bash", "zsh", "tcsh")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    if parser.get_default("command") == "completion":
        parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help=f"one of {', '.join(SHELLS)}")
        return
    parser.add_argument("kind", metavar="KIND", choices=["plant", "family"], help="plant or family")
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        default=[],  # without it, argparse's error for a missing KIND would demand a NAME too
        help="plant: your own families, as the plant file names them, such as meter.toml or fan.py:Fan; "
        "family: the CSV files that a family file may name",
    )


def run(arguments: argparse.Namespace) -> int:
    return _run_completion(arguments) if arguments.command == "completion" else _run_schema(arguments)


# ---- completion: a script for a shell ----


def _run_completion(arguments: argparse.Namespace) -> int:
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


# ---- schema: the JSON Schema of plant or family files ----


def _run_schema(arguments: argparse.Namespace) -> int:
    made = schema_of(arguments.kind, arguments.names)
    print(json.dumps(made, indent=1))  # not `print_text`, which would mask parts of URL patterns
    return 0


def schema_of(kind: str, names: Sequence[str] = (), folder: Path | None = None) -> dict[str, Any]:
    """Return the JSON Schema of a "plant" or "family" file in `folder`.

    For "plant", `names` are a user's own families, such as "meter.toml" or "fan.py:Fan". For "family", they
    are the CSV files that the family file may name. Raises ValueError if such a file cannot be used.
    """
    if kind == "family":
        from multidrop.families.files.registers import beside
        from multidrop.families.files.schema import family_schema

        for name in names:
            if not beside((folder or Path()) / "family.toml", name).is_file():
                raise ValueError(f"{name}: there is no such file")
        return family_schema(names)
    # the schema of [serve] is made by modules that import these libraries
    for library in ("starlette", "uvicorn"):
        require_extra(library, "serve", "schema plant")
    from multidrop.families.registry import find_model
    from multidrop.gateway.settings import serve_schema
    from multidrop.plant.schema import plant_schema

    return plant_schema(serve_schema(), {model: find_model(model, folder) for model in names})
