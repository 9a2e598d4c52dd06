"""Print the test coverage of Python and C, and the lines that no test reached.

Usage: `python tests/support/processes/covered.py PATH...`. A PATH is coverage.py's JSON report, or the
directory of a core built with --coverage. tests/README.md explains the lines that no test reaches.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path


@dataclass
class Reach:
    lines: int = 0
    branches: int = 0
    taken: int = 0
    missed: set[int] = field(default_factory=set)  # numbers of lines that were not reached
    untaken: set[tuple[int, int]] = field(default_factory=set)  # branches not taken, as (from, to)


def of_python(report: Path) -> dict[str, Reach]:
    found = {}
    for path, each in json.loads(report.read_text())["files"].items():
        summary = each["summary"]
        name = "src/multidrop/" + path.rpartition("multidrop/")[2]
        missed = set(each["missing_lines"])
        untaken = {(line, to) for line, to in each["missing_branches"] if line not in missed}
        figures = (summary[each] for each in ("num_statements", "num_branches", "covered_branches"))
        found[name] = Reach(*figures, missed, untaken)
    return found


def of_c(build: Path) -> dict[str, Reach]:
    found: defaultdict[str, Reach] = defaultdict(Reach)
    for counts in sorted(build.rglob("*.gcda")):
        command = ["gcov", "--json-format", "--stdout", "--branch-probabilities", counts]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        for file in (load for line in text.splitlines() for load in json.loads(line)["files"]):
            if "/csrc/" not in file["file"]:
                continue
            reach = found["csrc/" + file["file"].rpartition("/csrc/")[2]]
            for line in file["lines"]:
                number, ways = line["line_number"], line["branches"]
                reach.lines += 1
                untaken = {(number, way) for way, each in enumerate(ways) if each["count"] == 0}
                reach.branches += len(ways)
                reach.taken += len(ways) - len(untaken)
                if line["count"]:
                    reach.untaken |= untaken
                else:
                    reach.missed.add(number)
    return dict(found)


def spans(numbers: Iterable[int]) -> str:
    """Return line numbers as text with ranges: 1-3 7 9-10."""
    runs = groupby(enumerate(sorted(numbers)), lambda each: each[1] - each[0])
    ends = [[number for _, number in run] for _, run in runs]
    return " ".join(f"{end[0]}-{end[-1]}" if len(end) > 1 else f"{end[0]}" for end in ends)


def room(name: str) -> str:
    """Return the table row for a file: the C file itself, or the directory of a Python file."""
    return name if name.endswith((".c", ".h")) else name.rpartition("/")[0] + "/"


def main(*where: str) -> None:
    reached: dict[str, Reach] = {}
    for path in map(Path, where):
        reached |= of_c(path) if path.is_dir() else of_python(path)
    rooms: defaultdict[str, list[Reach]] = defaultdict(list)
    for name, reach in sorted(reached.items()):
        rooms[room(name)].append(reach)
    print(f"{'':28}{'lines':>8}{'reached':>9}{'branches':>10}{'reached':>9}")
    for name, reaches in [*rooms.items(), ("all", [*reached.values()])]:
        lines, branches = sum(each.lines for each in reaches), sum(each.branches for each in reaches)
        hit = lines - sum(len(each.missed) for each in reaches)
        taken = sum(each.taken for each in reaches)
        print(f"{name:28}{lines:8}{hit / (lines or 1):9.1%}{branches:10}{taken / (branches or 1):9.1%}")
    for name, reach in sorted(reached.items()):
        if reach.missed:
            print(f"not reached: {name} {spans(reach.missed)}")
        if reach.untaken:
            print(f"one way only: {name} {spans({line for line, _ in reach.untaken})}")


if __name__ == "__main__":
    main(*sys.argv[1:])
