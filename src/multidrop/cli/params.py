"""`multidrop params`: saves, compares, lists and writes the parameters of one drive."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from multidrop import params
from multidrop.cli import DONE, FAILED
from multidrop.cli.support.arguments import (
    Target,
    add_json_argument,
    add_target_arguments,
    add_writing_arguments,
    check_words,
    is_plant,
    mistaken,
    target_of,
)
from multidrop.cli.support.output import confirm, print_json, print_text, reporting_interruption
from multidrop.cli.support.values import aligned, counted
from multidrop.drive.parameters import parameters_of
from multidrop.errors import Unsupported, WriteForbidden
from multidrop.families.registry import find_model
from multidrop.params import NotWritten, ParameterSet, files
from multidrop.params.values import check_same_model

ACTIONS = {  # each action's module in this package ("" for this module), and its help text
    "save": ("", "read all parameters of a drive into a new TOML or CSV file"),
    "diff": ("", "compare files and drives; exit status 1 if they differ"),
    "apply": ("", "write a file's parameters to a stopped drive, if they differ"),
    "list": ("", "list the parameters of a drive or a model"),
}
_DRIVES = ("PORT MODEL ADDRESS", "PLANT.toml DRIVE")
_WAYS = {  # usage lines, by action
    "save": [f"{drive} FILE" for drive in _DRIVES],
    "diff": [
        *(f"FILE {drive}" for drive in _DRIVES),
        "FILE FILE",
        "PLANT.toml DRIVE PLANT.toml DRIVE",
        *(f"--defaults {drive}" for drive in _DRIVES),
    ],
    "apply": [f"FILE {drive}" for drive in _DRIVES],
    "list": [*_DRIVES, "MODEL"],
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    action = parser.get_default("command")
    parser.set_defaults(command=f"params {action}", action=action)
    add_target_arguments(parser)
    parser.usage = "\n       ".join(f"{parser.prog} {way} [options]" for way in _WAYS[action])
    if action == "diff":
        parser.add_argument("--defaults", action="store_true", help="compare a drive with the factory values")
    if action == "apply":
        add_writing_arguments(parser)
        parser.add_argument("--dry-run", action="store_true", help="print the plan, and write nothing")
        parser.add_argument(
            "--also",
            metavar="CODE",
            action="append",
            default=[],
            help="also write this parameter of the drive's line, such as its address; may be repeated",
        )
        parser.add_argument(
            "--commissioning",
            action="store_true",
            help="write a register again within a minute; only at a terminal",
        )
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    acts = {"save": _save, "diff": _diff, "apply": _apply, "list": _list}
    return acts[arguments.action](arguments)


# ---- save ----


def _save(arguments: argparse.Namespace) -> int:
    target, words = _drive_of(arguments, arguments.words)
    if len(words) != 1:
        raise mistaken(arguments, "give a drive, and then the name of one file for its parameters")
    files.check_name(Path(words[0]))
    found = _read(target)
    params.save(found, words[0], type(target.drive))
    if arguments.json:
        facts = {name: getattr(found, name) for name in files.FACTS if getattr(found, name)}
        print_json({"source": found.source, **facts, "parameters": dict(found.values), "file": words[0]})
    else:
        print_text(f"{words[0]}: {counted(len(found.values), 'parameter')} of {target.drive.name}")
    return DONE


def _read(target: Target, codes: Sequence[str] | None = None) -> ParameterSet:
    with _progress() as progress, target.open_bus():
        return params.read(target.drive, codes, progress=progress)


# ---- diff ----


def _diff(arguments: argparse.Namespace) -> int:
    words = list(arguments.words)
    if arguments.defaults:
        target, words = _drive_of(arguments, words)
        check_words(arguments, words, ())
        family: Any = type(target.drive)
        first = params.defaults(family)
        second = _read(target, [*first.values])
    else:
        one, words = _side(arguments, words)
        if isinstance(one, Target) and len(words) == 1 and not params.is_parameter_file(words[0]):
            # such as `params diff plant.toml pump-1 pump-2`: pump-2 is a drive of the same plant file
            words = [one.words[0], *words]
        other, words = _side(arguments, words)
        check_words(arguments, words, ())
        first, second = _both(one, other)
        family = _family_of(one, other, first)
    different = params.compare(first, second, family)
    if arguments.json:
        differences = [each._asdict() for each in different]
        print_json({"first": first.source, "second": second.source, "differences": differences})
    elif different:
        head = ("CODE", "NAME", first.source, second.source)
        rows = [(each.code, each.name, each.first_text, each.second_text) for each in different]
        print_text("\n".join(aligned([head, *rows], "<<>>")))
    else:
        print_text(f"{first.source} and {second.source} have the same parameters")
    return FAILED if different else DONE


def _side(arguments: argparse.Namespace, words: list[str]) -> tuple[Target | ParameterSet, list[str]]:
    """Return the drive or parameter file that the first words name, and the remaining words."""
    if not words:
        raise mistaken(arguments, "give two sides to compare: files, drives, or a file and a drive")
    if _is_file(words):
        return params.load(words[0]), words[1:]
    return _drive_of(arguments, words)


def _is_file(words: list[str]) -> bool:
    """Return True if the first word names a parameter file, or a .toml or .csv file that does not exist."""
    first = words[0]
    if "://" in first or Path(first).suffix.lower() not in (".toml", ".csv"):
        return False
    return params.is_parameter_file(first) or not Path(first).exists()


def _both(one: Target | ParameterSet, other: Target | ParameterSet) -> tuple[ParameterSet, ParameterSet]:
    """Return the two parameter sets to compare.

    If one set is a file, only the parameters in the file are read from the drive.
    """
    sides = [
        ParameterSet(each.drive.model, {}, source=each.drive.name) if isinstance(each, Target) else each
        for each in (one, other)
    ]
    check_same_model(*sides)  # checked before the parameters are read, because reading takes long
    codes = [[*each.values] if isinstance(each, ParameterSet) else None for each in (one, other)]
    first = _read(one, codes[1]) if isinstance(one, Target) else one
    second = _read(other, codes[0]) if isinstance(other, Target) else other
    return first, second


def _family_of(one: Target | ParameterSet, other: Target | ParameterSet, first: ParameterSet) -> Any:
    """Return the drive class that declares the parameters' names and units; None for an unknown model."""
    for side in (one, other):
        if isinstance(side, Target):
            return type(side.drive)
    with suppress(ValueError, Unsupported):
        family = find_model(first.model)
        parameters_of(family)
        return family
    return None


# ---- apply ----


def _apply(arguments: argparse.Namespace) -> int:
    if not arguments.words or not _is_file(arguments.words):
        raise mistaken(arguments, "give a parameter file, and then the drive")
    if arguments.commissioning and not sys.stdin.isatty():
        raise WriteForbidden(
            "nothing was sent: --commissioning needs a terminal, at which a person confirms the writes"
        )
    given = params.load(arguments.words[0])
    target, words = _drive_of(arguments, arguments.words[1:])
    check_words(arguments, words, ())
    drive = target.drive
    with reporting_interruption(drive, "apply") as known, target.open_bus(arguments.audit):
        known.clear()
        with _progress() as progress:
            made = params.plan(drive, given, also=arguments.also, progress=progress)
        if not arguments.json:
            print_text("\n".join(made.lines()) or f"{drive.name} has these parameters already")
        if arguments.dry_run:
            if arguments.json:
                print_json(_plan_as_json(made))
            else:
                print_text(f"{counted(len(made.writes), 'parameter')} to write; nothing was written")
            return DONE
        if made.writes:
            count = counted(len(made.writes), "parameter")
            confirm(f"Write {count} to {drive.name} on {target.port}?", arguments)

        def report(
            number: int, total: int, change: params.ParameterChange, not_written: NotWritten | None
        ) -> None:
            known[:] = [f"{drive.name}: {number} of {counted(total, 'parameter')} done, up to {change}"]
            if not arguments.json:
                outcome = "written" if not_written is None else f"not written: {_reason(not_written)}"
                print_text(f"{number}/{total} {change}: {outcome}", flush=True)

        result = params.apply_plan(made, commissioning=arguments.commissioning, report=report)
    if arguments.json:
        print_json(_applied_as_json(result))
    else:
        print_text("\n".join(_applied_lines(result)))
    if result.failure is not None:
        raise result.failure
    return DONE if result.ok else FAILED


def _applied_lines(result: params.Applied) -> list[str]:
    rest, left = len(result.plan.writes) - len(result.written), len(result.plan.left)
    lines = [f"{counted(len(result.written), 'parameter')} written"]
    lines[0] += f", {rest} not written" * bool(rest) + f", {left} left out" * bool(left)
    if result.earlier:
        lines += ["before, and not finished:", *(f"  {sentence}" for sentence in result.earlier)]
    if result.failure is not None:
        lines.append("run the command again to write the rest")
    return lines


# ---- list ----


def _list(arguments: argparse.Namespace) -> int:
    words = arguments.words
    held: ParameterSet | None = None
    if len(words) == 1 and not is_plant(words[0]):
        family: Any = find_model(words[0])
    else:
        target, rest = _drive_of(arguments, words)
        check_words(arguments, rest, ())
        family = type(target.drive)
        held = _read(target)
    rows = params.rows(family, held)
    if arguments.json:
        print_json({"model": family.model, "parameters": rows})
        return DONE
    head = ("CODE", "NAME", "VALUE", "FACTORY", "NOT WRITTEN BECAUSE")
    keys = ("code", "name", "value", "factory", "not_written")
    print_text("\n".join(aligned([head, *([row[key] for key in keys] for row in rows)], "<<>><")))
    unknown = len(parameters_of(family)) - len(rows)
    if held is None and unknown:
        print_text(f"\nand {unknown} codes by rule, which are saved as raw counts")
    return DONE


# ---- arguments and output ----


def _drive_of(arguments: argparse.Namespace, words: Sequence[str]) -> tuple[Target, list[str]]:
    return target_of(argparse.Namespace(**vars(arguments) | {"words": [*words]}))


@contextmanager
def _progress() -> Iterator[Callable[[int, int], None] | None]:
    """Show the progress of reading in one line on a terminal's stderr, and remove it at the end."""
    if not sys.stderr.isatty():
        yield None
        return
    try:
        yield lambda done, total: print(f"\rread {done} of {total}", end="", file=sys.stderr, flush=True)
    finally:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def _plan_as_json(made: params.ApplyPlan) -> dict[str, Any]:
    return {
        "drive": made.drive.name,
        "source": made.source,
        "writes": [_change_as_json(change) for change in made.writes],
        "not_written": dict(made.left),
        "notes": [*made.notes],
    }


def _change_as_json(change: params.ParameterChange) -> dict[str, Any]:
    return {"code": change.parameter.code, "before": change.before, "after": change.after}


def _reason(not_written: NotWritten) -> str:
    if isinstance(not_written, WriteForbidden):
        return not_written.for_command_line()
    return str(not_written)


def _applied_as_json(result: params.Applied) -> dict[str, Any]:
    return {
        "drive": result.plan.drive.name,
        "written": [_change_as_json(change) for change in result.written],
        "not_written": {**result.plan.left, **{code: _reason(why) for code, why in result.refused.items()}},
        "earlier": result.earlier,
        "failure": "" if result.failure is None else _reason(result.failure),
    }
