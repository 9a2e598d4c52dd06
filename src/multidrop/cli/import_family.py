"""`multidrop import`: converts another program's register table into a family file."""

from __future__ import annotations

import argparse
from pathlib import Path

from multidrop.cli.support.arguments import whole
from multidrop.cli.support.files import refuse_overwriting, write_new
from multidrop.cli.support.output import print_text, warn
from multidrop.importers import ImportedDevice, family_text, plant_text, read_devices
from multidrop.printable import printable


def add_arguments(parser: argparse.ArgumentParser) -> None:
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


def run(arguments: argparse.Namespace) -> int:
    for target in filter(None, (arguments.out, arguments.plant)):
        refuse_overwriting(target)
    if arguments.plant and not arguments.out:
        raise ValueError("--plant needs --out FAMILY.toml: the plant file names the family file")
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
        known = ", ".join(printable(_spelt(device)[:100]) for device in devices)
        example = f"{example} --title {printable(first.title[:60])!r}".strip()
    raise ValueError(f"the file has devices at {known}: choose one, such as {example}")


def _spelt(device: ImportedDevice) -> str:
    return f"{'an unknown address' if device.address is None else device.address} of {device.title!r}"
