"""The share of your own device templates that the register model holds, and what the rest lacks.

It takes a folder with templates of other programs: JSON of wb-mqtt-serial, CSV of modpoll. Each entry is
declared as a register in a class of its own, so the library itself decides. None of the public collections is
part of this repository: get one that its licence lets you use, or take what you wrote.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from bench.support import modpoll_templates, wb_templates
from bench.support.tables import heading, show
from bench.support.templates import DETAILS, Holding, Template, details, family_of, hold

READERS: dict[str, Callable[[Path], Iterator[Template]]] = {
    ".json": wb_templates.templates,
    ".csv": modpoll_templates.templates,
}


def load(folder: Path) -> tuple[list[Template], list[str]]:
    """Return the templates of all files below a folder, and a sentence for each file that is none."""
    found: list[Template] = []
    unread: list[str] = []
    for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in READERS):
        try:
            found += list(READERS[path.suffix.lower()](path))
        except (ValueError, TypeError, KeyError, OSError, RecursionError) as failure:
            unread.append(f"{path}: {failure}")
    return found, unread


class Coverage:
    """Counts of what came of the entries of some templates."""

    def __init__(self, templates: Iterable[Template]) -> None:
        self.by_template = [
            (template, [hold(quantity) for quantity in template.quantities]) for template in templates
        ]
        self.refused = Counter[str]()  # by reason: templates whose entries are held, but not together
        self.whole = sum(map(self._is_whole, self.by_template))

    def _is_whole(self, found: tuple[Template, list[Holding]]) -> bool:
        template, entries = found
        if not template.quantities or not all(entry.is_held and entry.is_written for entry in entries):
            return False
        reason = family_of(template.quantities)
        if reason:
            self.refused[reason] += 1
        return not reason

    @property
    def entries(self) -> list[Holding]:
        return [entry for _, entries in self.by_template for entry in entries]

    def needed(self) -> Iterator[tuple[str, int, int]]:
        """Yield each detail, the entries that need it, and those of them that are held."""
        for key, words in DETAILS.items():
            needing = [entry for entry in self.entries if key in details(entry.quantity)]
            yield words, len(needing), sum(entry.is_held and entry.is_written for entry in needing)

    def lacking(self) -> Iterator[tuple[str, int, int]]:
        """Yield each reason, the entries that lack it, and the templates with one of them."""
        entries, templates = Counter[str](), Counter[str]()
        for _, found in self.by_template:
            reasons = [_lack(entry) for entry in found if entry.lacks]
            entries.update(reasons)
            templates.update(set(reasons))
        yield from ((reason, count, templates[reason]) for reason, count in entries.most_common())

    def besides(self) -> Iterator[tuple[str, int]]:
        """Yield what entries and devices say that a register or a family does not, and how many do."""
        said = Counter(key for entry in self.entries for key in entry.quantity.besides)
        said.update(f"{key} (devices)" for template, _ in self.by_template for key in template.besides)
        yield from said.most_common()


def _lack(entry: Holding) -> str:
    return entry.lacks if not entry.is_held else f"is read, and not written: {entry.lacks}"


def report(coverage: Coverage, unread: list[str]) -> None:
    """Print the shares, the details that are needed, and what lacks."""
    entries, templates = coverage.entries, len(coverage.by_template)
    held = sum(entry.is_held and entry.is_written for entry in entries)
    readable = sum(entry.is_held for entry in entries)
    shares = (
        ("templates, whole", templates, coverage.whole),
        ("entries, as they are", len(entries), held),
        ("entries, for reading", len(entries), readable),
    )
    show(("", "all", "held", "share"), [(*row, _share(row[2], row[1])) for row in shares])
    print()
    show(("needed beyond 16 and 32 bit with a step", "entries", "held"), coverage.needed())
    print()
    show(("what lacks", "entries", "templates"), coverage.lacking())
    for reason, count in coverage.refused.items():
        print(f"{count} templates are not one family, though each entry is held: {reason}")
    print()
    show(("said besides the value, and not held", "times"), coverage.besides())
    for sentence in unread:
        print(f"not read: {sentence}")


def _share(part: int, whole: int) -> str:
    return f"{part / whole:.1%}" if whole else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="with templates; folders below it too")
    folder = parser.parse_args().folder
    if not folder.is_dir():
        parser.error(f"{folder} is no folder")
    templates, unread = load(folder)
    if not templates:
        parser.error(f"{folder} has no template that can be read: {'; '.join(unread) or 'no .json, no .csv'}")
    heading("Templates that the register model holds")
    report(Coverage(templates), unread)


if __name__ == "__main__":
    main()
