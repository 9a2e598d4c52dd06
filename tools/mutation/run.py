"""Does a test fail for every small mistake in these files? `python tools/mutation/run.py [FILE...]`

explained.toml lists the mutants that behave as the original, with reasons. This program fails if another
mutant survives (all tests pass), or if a listed mutant is killed.
"""

from __future__ import annotations

import os
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue

from edits import Mutant, Name, mutants
from trials import OUTPUT, ROOT, TRIALS, attempt, scratch

EXPLAINED = Path(__file__).with_name("explained.toml")
MOST_SHOWN = 3000  # limit of shown characters, from the end of a failed command's output


def explained() -> dict[Name, str]:
    """Return the reasons in explained.toml why mutants survive, by the mutant's name."""
    rows = tomllib.loads(EXPLAINED.read_text("utf-8"))["mutant"]
    return {
        (row["file"], row["function"], row["line"], row["becomes"], row.get("nth", 1)): row["why"]
        for row in rows
    }


def ends(path: str) -> Iterator[tuple[Mutant, str | None]]:
    """Yield each mutant of the file, and how it ended, such as "killed"; None if it survived."""
    source = (ROOT / path).read_text("utf-8")
    found = mutants(path, source)
    trees: SimpleQueue[Path] = SimpleQueue()

    def end(text: str) -> str | None:
        tree = trees.get()
        try:
            return attempt(tree, path, text)
        finally:
            trees.put(tree)

    with ExitStack() as stack:
        jobs = len(os.sched_getaffinity(0))
        for _ in range(jobs):
            trees.put(stack.enter_context(scratch()))
        tree = trees.get()
        if attempt(tree, path, source) not in {None, "same code"}:
            output = (tree / OUTPUT).read_text("utf-8", "replace")
            sys.exit(f"{output[-MOST_SHOWN:]}\nthe tests of {path} fail without a mistake, too")
        trees.put(tree)
        tried = stack.enter_context(ThreadPoolExecutor(jobs)).map(end, (each.text for each in found))
        yield from zip(found, tried, strict=True)


def report(path: str) -> int:
    """Print the unexplained survivors and a line of figures; return the number of failures.

    A failure is a survivor that explained.toml does not list, or a listed mutant that did not survive."""
    reasons = {name: why for name, why in explained().items() if name[0] == path}
    alive: set[Name] = set()
    count: Counter[str] = Counter()
    for mutant, end in ends(path):
        if end is None:
            alive.add(mutant.name)
            end = "explained" if mutant.name in reasons else "unexplained"
        if end == "unexplained":
            print(f"{mutant}", flush=True)
        count[end] += 1
    stale = reasons.keys() - alive
    for _, function, before, after, _ in sorted(stale):
        print(f"{path}: explained, but no survivor: {function}\n  - {before}\n  + {after}")
    figures = ", ".join(f"{count[end]} {end}" for end in sorted(count) if end != "no program")
    print(f"{path}: {count.total() - count['no program']} mutants: {figures}", flush=True)
    return count["unexplained"] + len(stale)


if __name__ == "__main__":
    sys.exit(1 if sum(report(path) for path in sys.argv[1:] or TRIALS) else 0)
