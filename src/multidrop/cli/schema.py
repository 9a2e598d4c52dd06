"""`multidrop schema`: prints the JSON Schema of a plant file, by which an editor checks and completes it."""

from __future__ import annotations

import argparse
import json

from multidrop.cli.support.output import print_text
from multidrop.plant.loader import plant_schema


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", metavar="KIND", choices=["plant"], help="plant")


def run(arguments: argparse.Namespace) -> int:
    print_text(json.dumps(plant_schema(), indent=1))
    return 0
