"""The share of device templates that the library can represent, and why it cannot represent the others.

Reads a folder with files of other programs, in any format that `multidrop import` reads. Each entry is
declared as its program uses it, for reading or writing; the library accepts or rejects the declaration.

This repository contains none of the public collections. Use one whose licence allows it, or your own files.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from bench.support.holding import DETAILS, Holding, family_of, holdings
from bench.support.tables import heading, show
from multidrop.importers import SUFFIXES, ImportedDevice, all_devices

MOST_SHOWN = 15  # limit of remarks in the report
# Matches numbers and register names in error sentences, so that sentences that differ only there are counted
# together.
_DETAIL = re.compile(r"\b((?<=scale register )\w+|0x[0-9a-fA-F]+|[0-9A-F]{4}H|\d+)\b")


def load(folder: Path) -> tuple[list[ImportedDevice], list[str]]:
    """Return the devices in all files below a folder, and a sentence for each file without devices."""
    found: list[ImportedDevice] = []
    unread: list[str] = []
    for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES):
        try:
            devices = all_devices(path)
        except (ValueError, ImportError) as failure:
            unread.append(str(failure) if str(failure).startswith(str(path)) else f"{path}: {failure}")
            continue
        filled = [device for device in devices if holdings(device)]
        found += filled
        if not filled:
            unread.append(f"{path}: it has no register")
    return found, unread


class Coverage:
    """Counts the registers of imported devices, and how many registers the library can represent."""

    def __init__(self, devices: Iterable[ImportedDevice]) -> None:
        self.by_device = [(device, holdings(device)) for device in devices]
        # devices whose entries can be declared one by one, but not together in one class: their number, by
        # reason
        self.refused = Counter[str]()
        self.whole = sum(self._is_whole(entries) for _, entries in self.by_device)

    def _is_whole(self, entries: list[Holding]) -> bool:
        if not entries or not all(entry.is_whole for entry in entries):
            return False
        reason = family_of(entries)
        if reason:
            self.refused[reason] += 1
        return not reason

    @property
    def entries(self) -> list[Holding]:
        return [entry for _, entries in self.by_device for entry in entries]

    def needed(self) -> Iterator[tuple[str, int, int]]:
        """Yield each detail's title, the number of entries with it, and the number that can be declared."""
        for key, words in DETAILS.items():
            needing = [entry for entry in self.entries if key in entry.details]
            yield words, len(needing), sum(entry.is_whole for entry in needing)

    def lacking(self) -> Iterator[tuple[str, int, int]]:
        """Yield each reason for rejection, with the numbers of rejected entries and of their devices."""
        entries, devices = Counter[str](), Counter[str]()
        for _, found in self.by_device:
            reasons = [_lack(entry) for entry in found if entry.lacks]
            entries.update(reasons)
            devices.update(set(reasons))
        yield from ((reason, count, devices[reason]) for reason, count in entries.most_common())

    def besides(self) -> Iterator[tuple[str, int]]:
        """Yield each warning of the importers about entries that can be declared, and how often it occurs."""
        said = Counter(
            _DETAIL.sub("N", gap) for entry in self.entries if entry.entry for gap in entry.entry.gaps
        )
        said.update(
            f"{lost.name} (devices)"
            for device, _ in self.by_device
            for lost in device.lost
            if not lost.is_entry
        )
        yield from said.most_common(MOST_SHOWN)


def _lack(entry: Holding) -> str:
    reason = _DETAIL.sub("N", entry.lacks)
    return reason if not entry.is_held else f"is read, and not written: {reason}"


def report(coverage: Coverage, unread: list[str]) -> None:
    """Print how many entries and devices can be declared, and why the library rejects the others."""
    entries, devices = coverage.entries, len(coverage.by_device)
    held = sum(entry.is_whole for entry in entries)
    readable = sum(entry.is_held for entry in entries)
    shares = (
        ("templates, whole", devices, coverage.whole),
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
    show((f"said of what is held, the first {MOST_SHOWN}", "times"), coverage.besides())
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
    devices, unread = load(folder)
    if not devices:
        parser.error(
            f"{folder} has no template that can be read: {'; '.join(unread[:5]) or ', '.join(SUFFIXES)}"
        )
    heading("Templates that the register model holds")
    report(Coverage(devices), unread)


if __name__ == "__main__":
    main()
