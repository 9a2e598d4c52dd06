"""The `check` command: prints what a family's file says, what it leaves open, and what will be refused.

It checks a plant file too, but for its table `[serve]`: `multidrop serve --check` does that.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

from multidrop.cli.check.remarks import Remark, crowded, refused, unknown
from multidrop.cli.models import facts
from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.family_sheet import INDENT, sheet
from multidrop.cli.support.output import print_text, warn
from multidrop.cli.support.values import counted, wrapped
from multidrop.drive.family import Drive
from multidrop.families import MODELS
from multidrop.families.files.errors import FamilyError
from multidrop.families.files.loader import load_family
from multidrop.families.registry import find_model
from multidrop.plant.loader import PlantError, load_plant, port_or_address
from multidrop.toml_check import read_document


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file",
        metavar="FILE.toml",
        type=Path,
        help="a family's file, a shipped family's name, or a plant file",
    )
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    if why := port_or_address(arguments.file):
        raise ValueError(why)
    if _is_plant(arguments.file):
        return _check_plant(arguments)
    try:
        family = _family(arguments.file)
    except FamilyError as wrong:
        if arguments.json:
            print_text(json.dumps({"mistakes": wrong.mistakes}, indent=2))
        else:
            warn(str(wrong))
        return 1
    not_known, will_be_refused = list(unknown(family)), list(refused(family))
    if arguments.json:
        more = {
            "mistakes": [],
            "not_known": not_known,
            "will_be_refused": will_be_refused,
        }
        print_text(json.dumps(facts(family) | more, indent=2))
        return 0
    lines = [sheet(family)]
    for heading, remarks in (("not known", not_known), ("will be refused", will_be_refused)):
        lines += ["", heading, *_lines(remarks)]
    print_text("\n".join([*lines, "", *wrapped(_verdict(family, arguments.file), breaks_words=False)]))
    return 0


def _is_plant(file: Path) -> bool:
    """Return True for a file with lines. One that cannot be read is none: loading it as a family says why."""
    try:
        return "line" in read_document(file, "file")
    except ValueError:
        return False


def _check_plant(arguments: argparse.Namespace) -> int:
    mistakes: tuple[str, ...] = ()
    remarks: list[Remark] = []
    try:
        plant = load_plant(arguments.file)
        remarks += crowded(plant)
    except PlantError as wrong:
        mistakes = wrong.mistakes
    if arguments.json:
        print_text(json.dumps({"mistakes": mistakes, "remarks": remarks}, indent=2))
    elif mistakes:
        warn("\n".join(mistakes))
    else:
        drives = sum(len(line.drives) for line in plant.lines)
        holds = f"{counted(len(plant.lines), 'line')}, {counted(drives, 'drive')}"
        served = "; `multidrop serve --check` checks its [serve]" if plant.serve else ""
        for name, sentence in remarks:
            warn(f"{plant.path}: {name}: {sentence}")
        print_text(f"No mistake found in {plant.path}: {holds}{served}.")
    return 1 if mistakes else 0


def _family(file: Path) -> type[Drive]:
    """Return the family of a file, or a shipped one by its name. Raises ValueError for any other."""
    name = str(file)
    if name in MODELS:
        raise ValueError(f"{name} is built in, and no file declares it; see `multidrop models {name}`")
    is_name = not file.suffix and not file.exists()
    return find_model(name) if is_name else load_family(file)


def _lines(remarks: list[Remark]) -> Iterator[str]:
    if not remarks:
        yield "  nothing"
    width = max([INDENT, *(len(name) + 2 for name, _ in remarks)])
    for name, sentence in remarks:
        yield from wrapped(sentence, f"  {name:<{width}}", " " * (width + 2))


def _verdict(family: type[Drive], file: Path) -> str:
    if "confirmed" not in family.options:
        return f"No mistake found in {file}. Compare the addresses, as they are sent, with the manual."
    return (
        f"No mistake found in {file}. It can move a motor, and nobody has tested it: compare every line with "
        "the manual, and only then give its drives confirmed = 1 in the plant file, or --option confirmed=1."
    )
