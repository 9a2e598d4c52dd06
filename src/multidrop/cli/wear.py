"""`multidrop wear`: lists writes to registers that may be stored in EEPROM, and how many writes are left."""

from __future__ import annotations

import argparse
import json
from datetime import UTC, datetime
from pathlib import Path

from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.output import print_text
from multidrop.cli.support.values import aligned
from multidrop.control.eeprom_ledger import BUDGET, CYCLES, Ledger, Wear, default_path
from multidrop.core import utc_minus_monotonic_ns
from multidrop.transport.clock import now_ns

HEAD = ("PORT", "ADDRESS", "MODEL", "REGISTER", "WRITES", "THIS YEAR", "LEFT", "LAST")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--ledger", metavar="FILE", help="another ledger than the user's")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    if arguments.ledger and not Path(arguments.ledger).is_file():
        raise ValueError(f"there is no ledger {arguments.ledger}; the default is {default_path()}")
    ledger = Ledger(arguments.ledger)
    found = ledger.wear((now_ns() + utc_minus_monotonic_ns()) / 1e9)
    if arguments.json:
        print_text(json.dumps([_as_json(wear) for wear in found], indent=2))
    elif not found:
        print_text(f"{ledger.path}: no writes to EEPROM yet")
    else:
        print_text("\n".join(aligned([HEAD, *map(_row, found)], "<><<>>><")))
        print_text(f"\n{ledger.path}: {BUDGET} writes of a register a year; an EEPROM lasts {CYCLES} writes.")
    return 0


def _row(wear: Wear) -> tuple[str, ...]:
    """Return the cells of a row. The model is shown without the title that follows its ": "."""
    port, address, model, *columns, last = map(str, _as_json(wear).values())
    return port, address, model.partition(": ")[0], *columns, last[:16].replace("T", " ")


def _as_json(wear: Wear) -> dict[str, object]:
    cell = wear.cell
    return {
        "port": cell.port,
        "address": cell.address,
        "model": cell.model,
        "register": cell.register,
        "writes": wear.writes,
        "this_year": wear.this_year,
        "left": BUDGET - wear.this_year,
        "last": datetime.fromtimestamp(wear.last, UTC).isoformat(timespec="seconds"),
    }
