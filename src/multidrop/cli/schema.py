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
        "models",
        metavar="MODEL",
        nargs="*",
        help="add the registers and options of your own families, as the plant file names them: "
        "meter.toml or fan.py:Fan",
    )


def run(arguments: argparse.Namespace) -> int:
    made = schema_of(arguments.kind, arguments.models)
    print(json.dumps(made, indent=1))  # print_text would mask parts of URL patterns
    return 0


def schema_of(kind: str, models: Sequence[str] = (), folder: Path | None = None) -> dict[str, Any]:
    """Return the JSON Schema of a "plant" or "family" file.

    `models` are a user's own families, written as a plant file in `folder` would name them.
    """
    if kind == "family":
        from multidrop.families.files.schema import family_schema

        if models:
            raise ValueError(f"schema family takes no model; leave out {' '.join(models)}")
        return family_schema()
    for library in ("starlette", "uvicorn"):  # libraries that the gateway's settings import
        require_extra(library, "serve", "schema plant")
    from multidrop.families.registry import find_model
    from multidrop.gateway.settings import serve_schema
    from multidrop.plant.schema import plant_schema

    return plant_schema(serve_schema(), {model: find_model(model, folder) for model in models})
