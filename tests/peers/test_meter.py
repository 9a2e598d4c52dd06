"""Poll a meter of 40 values, simulated by pymodbus, through its family file."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from kills import BoundProcess
from lines import HOST_LATE, rows_of, until
from meter import ADDRESSES
from peers import require_module
from ptys import linked_ptys

from multidrop.bus import Bus
from multidrop.cli import main
from multidrop.families.files.loader import load_family
from multidrop.plant.loader import load_plant
from multidrop.poller import Poller
from multidrop.polling.batch import Row

SERVER = Path(__file__).parents[1] / "support" / "servers" / "pymodbus_meter.py"
FAMILY = Path(__file__).parents[1] / "data" / "families" / "sdm630.toml"
PAGE = Path(__file__).parents[2] / "docs" / "howto" / "family-file.md"
STATED = ("together", "gaps")
UNIT = 5
SERIAL_NUMBER = 0x01020304
FLOATS = {name: (-1) ** at * (at * 37.11 + 0.25) for at, name in enumerate(ADDRESSES)}
HELD = {
    **{name: struct.unpack(">f", struct.pack(">f", value))[0] for name, value in FLOATS.items()},
    "serial_number": SERIAL_NUMBER,
}


def family_file(folder: Path, *, stated: bool) -> Path:
    """Write the meter's family file, with or without its read limits and gaps."""
    lines = FAMILY.read_text("utf-8").splitlines(keepends=True)
    path = folder / ("meter.toml" if stated else "unstated.toml")
    path.write_text("".join(line for line in lines if stated or not line.startswith(STATED)), "utf-8")
    return path


@contextmanager
def served(folder: Path, *options: str) -> Iterator[str]:
    """Yield the port of a meter that pymodbus simulates."""
    require_module("pymodbus")
    values = folder / "values.json"
    floats = {ADDRESSES[name]: value for name, value in FLOATS.items()}
    values.write_text(json.dumps({"floats": floats, "serial_number": SERIAL_NUMBER}))
    with linked_ptys() as (theirs, ours):
        command = [sys.executable, str(SERVER), theirs, str(UNIT), str(values), *options]
        with BoundProcess(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield ours
            process.kill()


def plant_file(folder: Path, port: str, family: Path, *polled: str) -> Path:
    path = folder / "plant.toml"
    path.write_text(
        f'[[line]]\nname = "house"\nport = "{port}"\n'
        f'[[line.drive]]\nname = "meter"\nmodel = "{family.name}"\naddress = {UNIT}\n'
        + (f"poll = {list(polled)}\n" if polled else "")
    )
    return path


@pytest.mark.long
@pytest.mark.parametrize("stated", [True, False], ids=["gaps stated", "nothing stated"])
def test_poll_reads_all_40_values_of_the_server(tmp_path: Path, stated: bool) -> None:
    """Check all values; the server rejects undeclared registers."""
    assert len(HELD) == 40
    family = family_file(tmp_path, stated=stated)
    rows: list[Row] = []
    with served(tmp_path, *([] if stated else ["refusing"])) as port:
        plant = load_plant(plant_file(tmp_path, port, family))
        with Poller(plant) as poller:
            until(lambda: rows.extend(rows_of(poller)) or len(rows) > 400)
    assert {row.status for row in rows} <= {"ok"} | HOST_LATE
    assert {(row.register, row.value) for row in rows if row.value is not None} == set(HELD.items())


@pytest.mark.slow
def test_read_many_reads_all_40_values_of_the_server(tmp_path: Path) -> None:
    meter = load_family(FAMILY)
    with served(tmp_path) as port, Bus(port) as bus:
        assert bus.attach(meter, UNIT).read_many(meter.registers.values()) == HELD


@pytest.mark.parametrize(("stated", "requests"), [(True, 4), (False, 8)])
def test_plan_of_39_floats_at_9600(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], stated: bool, requests: int
) -> None:
    """Check the plan in the documentation; 5 ms is the default response delay."""
    family = family_file(tmp_path, stated=stated)
    assert load_family(family).response_delay == 0.005
    assert main(["plan", str(plant_file(tmp_path, "/dev/null", family, *ADDRESSES))]) == 0
    shown = capsys.readouterr().out
    assert shown.splitlines()[2].split()[:3] == ["meter", str(requests), "39"]
    assert shown in PAGE.read_text("utf-8")


@pytest.mark.parametrize(
    ("stated", "most"), [(True, "at most 80"), (False, "at most 125, the standard's limit")]
)
def test_models_prints_the_read_limit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], stated: bool, most: str
) -> None:
    assert main(["models", str(family_file(tmp_path, stated=stated))]) == 0
    assert f"input registers (read 04H, {most}" in capsys.readouterr().out
