"""`multidrop schema`: prints the JSON Schema of plant or family files. Editors use it to check such files."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from multidrop.cli.support.files import require_extra


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", metavar="KIND", choices=["plant", "family"], help="plant or family")
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        default=[],  # else argparse's error for a missing KIND would call NAME required too
        help="plant: your own families, as the plant file names them, such as meter.toml or fan.py:Fan; "
        "family: the CSV files that a family file may name",
    )


def run(arguments: argparse.Namespace) -> int:
    made = schema_of(arguments.kind, arguments.names)
    print(json.dumps(made, indent=1))  # print_text would mask parts of URL patterns
    return 0


def schema_of(kind: str, names: Sequence[str] = (), folder: Path | None = None) -> dict[str, Any]:
    """Return the JSON Schema of a "plant" or "family" file in `folder`.

    For "plant", `names` are a user's own families, such as "meter.toml" or "fan.py:Fan". For "family", they
    are the CSV files that the family file may name. Raises ValueError if one of these cannot be used.
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
