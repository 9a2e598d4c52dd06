"""`multidrop check` and `import`: check a family file, or make one from another program's register table.

`check` prints a family file's contents, unknown facts, and requests that are never sent. It also checks a
plant file, except its table `[serve]`, which `multidrop serve --check` checks.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from multidrop.cli.models import INDENT, facts, sheet
from multidrop.cli.support.arguments import add_json_argument, whole
from multidrop.cli.support.files import refuse_overwriting, write_new
from multidrop.cli.support.output import print_json, print_text, warn
from multidrop.cli.support.values import counted, wrapped
from multidrop.control.eeprom_ledger import BUDGET, LEAST_INTERVAL
from multidrop.control.rules import wears
from multidrop.drive.family import Drive
from multidrop.drive.register import Access, Kept, Register
from multidrop.drive.verbs import MOVING
from multidrop.families import MODELS
from multidrop.families.files import FamilyError
from multidrop.families.files.loader import load_family
from multidrop.families.files.notation import TABLES
from multidrop.families.registry import find_model
from multidrop.plant.loader import PlantError, load_plant, port_or_address
from multidrop.plant.model import Plant
from multidrop.printable import printable
from multidrop.toml_document import read_document

if TYPE_CHECKING:
    from multidrop.importers import ImportedDevice


def add_arguments(parser: argparse.ArgumentParser) -> None:
    if parser.get_default("command") == "import":
        _add_import(parser)
        return
    parser.add_argument(
        "file",
        metavar="FILE.toml",
        type=Path,
        help="a family file, the name of a shipped family, or a plant file",
    )
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    return _run_import(arguments) if arguments.command == "import" else _run_check(arguments)


# ---- check ----


def _run_check(arguments: argparse.Namespace) -> int:
    if why := port_or_address(arguments.file):
        raise ValueError(why)
    if _is_plant(arguments.file):
        return _check_plant(arguments)
    try:
        family = _family(arguments.file)
    except FamilyError as wrong:
        if arguments.json:
            print_json({"mistakes": wrong.mistakes})
        else:
            warn(str(wrong))
        return 1
    not_known, will_be_refused = list(unknown(family)), list(refused(family))
    if arguments.json:
        more = {"mistakes": [], "not_known": not_known, "will_be_refused": will_be_refused}
        print_json(facts(family) | more)
        return 0
    lines = [sheet(family)]
    for heading, remarks in (("not known", not_known), ("will be refused", will_be_refused)):
        lines += ["", heading, *_lines(remarks)]
    print_text("\n".join([*lines, "", *wrapped(_verdict(family, arguments.file), breaks_words=False)]))
    return 0


def _is_plant(file: Path) -> bool:
    """Return True for a plant file.

    Return False for an unreadable file too: loading it as a family then reports why it cannot be read.
    """
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
        print_json({"mistakes": mistakes, "remarks": remarks})
    elif mistakes:
        warn("\n".join(mistakes))
    else:
        holds = f"{counted(len(plant.lines), 'line')}, {counted(len(plant.drives), 'drive')}"
        served = "; `multidrop serve --check` checks its [serve]" if plant.serve else ""
        for name, sentence in remarks:
            warn(f"{plant.path}: {name}: {sentence}")
        print_text(f"No mistake found in {plant.path}: {holds}{served}.")
    return 1 if mistakes else 0


def _family(file: Path) -> type[Drive]:
    """Return the family in a file, or the installed family of this name.

    Raises ValueError for an unknown name, and for a built-in family: it has no file to check.
    """
    name = str(file)
    if name in MODELS:
        raise ValueError(f"{name} is built in and has no file; see `multidrop models {name}`")
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
        f"No mistake found in {file}. It can move a motor and is untested: compare every line with the "
        "manual, and only then give its drives confirmed = 1 in the plant file, or --option confirmed=1."
    )


# ---- remarks ----


Remark = tuple[str, str]  # name of a register or key, and a sentence about this register or key

_OF_A_MOTOR = {
    "remote": "the keypad settings that let the line command the motor",
    "watchdog": "whether the motor stops when polling stops; assumed to run on",
}


def unknown(family: type[Drive]) -> Iterator[Remark]:
    """Yield each key that is missing in the family file, and a sentence that names the unknown fact."""
    drive = family(family.addresses[0])
    registers = family.registers.values()
    for register in registers:
        yield from ((register.name, sentence) for sentence in _unknown_of(drive, register))
    placeless = [one.name for one in registers if one.access is Access.READING and not one.place]
    if placeless:
        yield "place", f"the manual's place of {_some(placeless)}"
    if family.identify is Drive.identify:
        yield "identify", "how to recognise this device; read its name plate"
    if not family.most_registers:
        tables = dict.fromkeys(one.table for one in registers if one.table.read is not None)
        names = (name for name, table in TABLES.items() if table in tables)
        counts = ", ".join(f"{name} = 20" for name in names)
        yield "together", f"how many neighbouring addresses one request may read; together = {{ {counts} }}"
    if "confirmed" in family.options:
        for key in ("remote", "watchdog"):
            if getattr(family, key) == getattr(Drive, key):
                yield key, _OF_A_MOTOR[key]


def _unknown_of(drive: Drive, register: Register[Any]) -> Iterator[str]:
    if wears(drive, register) is Kept.UNKNOWN and register.writable:
        yield 'whether it is stored in EEPROM: each write counts as wear; kept = "ram" or "eeprom"'
    if register.step is None:
        yield "its scale: raw counts are shown"
    has_span = register.is_bit or register.values is not None or register.span is not None
    if register.access is Access.SETTING and not has_span:
        yield "its span: every value that fits is written; span = [0, 50]"
    if register.access is not Access.READING and not register.place:
        yield 'its place in the manual, for comparison; place = "table 3"'


def crowded(plant: Plant) -> Iterator[Remark]:
    """Yield each line with more drives than the manual of a drive on it allows, and a sentence about it."""
    for line in plant.lines:
        stated = [polled.drive for polled in line.drives if polled.drive.most_devices]
        strictest = min(stated, key=lambda drive: drive.most_devices, default=None)
        if strictest is not None and len(line.drives) > strictest.most_devices:
            kind, most = strictest.title or type(strictest).__name__, strictest.most_devices
            has = f"it has {len(line.drives)} drives"
            yield f"line {line.name}", f"{has}; the manual of {kind} allows {most} devices: split the line"


def _some(names: list[str]) -> str:
    return (
        ", ".join(names) if len(names) <= 4 else f"{', '.join(names[:3])} and {len(names) - 3} more readings"
    )


def refused(family: type[Drive]) -> Iterator[Remark]:
    """Yield the requests that are never sent to a drive of this family, each with the reason."""
    drive = family(family.addresses[0])
    for register in family.registers.values():
        if register.access is not Access.READING:
            yield from ((register.name, sentence) for sentence in _refused_of(drive, register))
    moving = [name for name in MOVING if getattr(family, name) is not getattr(Drive, name)]
    if "confirmed" in family.options:
        writes = "every write that is not declared harmless" if moving else "every write"
        yield "confirmed", f"{', '.join([*moving, writes])}, until the drive has confirmed = 1"
    if not moving:
        yield "verbs", "start, stop and the others: the family has none"
    if not family.broadcasts:
        yield "broadcast", "all: no register has counts documented for broadcasts"


def _refused_of(drive: Drive, register: Register[Any]) -> Iterator[str]:
    if register.never:
        yield f"every write: {register.never}"
        return
    if not register.writable:
        yield f"every write: a {register.table.name} cannot be written"
    elif register.commands:
        harmless = ", ".join(f"{raw:04X}H" for raw in register.harmless or ())
        yield f"every write except by verbs, and of {harmless}" if harmless else "every write except by verbs"
    if register.while_running is False:
        if type(drive).state is Drive.state:
            yield "every write: it is unknown whether the motor has stopped ([state])"
        else:
            yield "a write unless the motor has stopped"
    kept = wears(drive, register)
    if register.writable and kept is Kept.EEPROM:
        yield f"more than one write in {LEAST_INTERVAL:.0f} s, or {BUDGET} a year: it is stored in EEPROM"
    elif register.writable and kept is Kept.UNKNOWN:
        yield f"more than {BUDGET} writes a year: it may be stored in EEPROM"


# ---- import ----


def _add_import(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file",
        metavar="FILE",
        type=Path,
        help="CSV, TSV, YAML (Home Assistant, ESPHome), TOML (Telegraf) or JSON",
    )
    parser.add_argument("--address", metavar="N", type=whole, help="the device, if the file has several")
    parser.add_argument("--title", metavar="NAME", help="the device's hub, if several have that address")
    parser.add_argument(
        "--out",
        metavar="FAMILY.toml",
        type=Path,
        help="the new family file; without it the family is printed",
    )
    parser.add_argument("--plant", metavar="PLANT.toml", type=Path, help="a new plant file with this device")


def _run_import(arguments: argparse.Namespace) -> int:
    for target in filter(None, (arguments.out, arguments.plant)):
        refuse_overwriting(target)
    if arguments.plant and not arguments.out:
        raise ValueError("--plant needs --out FAMILY.toml, because the plant file must name the family file")
    from multidrop.importers import family_text, plant_text, read_devices

    try:
        devices = read_devices(arguments.file)
    except ImportError as failure:
        raise ValueError(str(failure)) from failure
    device = _chosen(devices, arguments.address, arguments.title)
    text = family_text(device, arguments.file.name)
    plant = plant_text(device, arguments.out.name) if arguments.plant else ""
    if arguments.out:
        write_new(arguments.out, text)
        print_text(f"wrote {arguments.out}: fill its gaps, then run multidrop check {arguments.out}")
    else:
        print_text(text)
    if plant:
        write_new(arguments.plant, plant)
        print_text(f"wrote {arguments.plant}: enter its port")
    for sentence in device.lost:
        warn(f"not imported: {sentence}")
    return 0


def _chosen(devices: list[ImportedDevice], address: int | None, title: str | None) -> ImportedDevice:
    found = [
        device for device in devices if address in (None, device.address) and title in (None, device.title)
    ]
    if len(found) == 1:
        return found[0]
    first = devices[0]
    addresses = {device.address for device in devices}
    example = f"--address {first.address}" if first.address is not None else ""
    if len(addresses) == len(devices) and None not in addresses:
        known = ", ".join(str(device.address) for device in devices)
    else:
        places = ("an unknown address" if one.address is None else one.address for one in devices)
        named = (f"{place} of {one.title!r}" for place, one in zip(places, devices, strict=True))
        known = ", ".join(printable(text[:100]) for text in named)
        example = f"{example} --title {printable(first.title[:60])!r}".strip()
    raise ValueError(
        f"the file has several devices, at {known}. Choose one with an option, such as {example}"
    )
