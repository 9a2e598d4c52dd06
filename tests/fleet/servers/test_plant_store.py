"""A plant in the bucket: each line read from its record equals that line of the plant file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fleets import MemoryBucket

from multidrop import Plant
from multidrop.fleet.servers.buckets import Record
from multidrop.fleet.servers.plant_store import line_of, read_plant, store

PLANT = r"""
[[line]]
name = "hall-1"
port = "socket://10.0.0.7:4001"
baudrate = 19200
format = "8E1"
switching = "2 ms"
[[line.drive]]
name = "pump \"1\" \\ Größe æ"
model = "innovert-ibd"
address = 1
every = "50 ms"
poll = ["output_current", {register = "motor_speed", every = "1 s"}]
[[line.drive]]
name = "fan"
model = "innovert-ibd"
address = 2
maximum_frequency = 87.5
[[line]]
name = "hall-2"
port = "tcp://10.0.0.8:502"
[[line.drive]]
name = "other"
model = "invt-che"
address = 3
"""


def lines_again(path: Path, folder: Path) -> list[Any]:
    """Return the lines of a plant file as another computer reads them from their records in JSON."""
    _, records = read_plant(path)
    shipped: dict[str, Any] = json.loads(json.dumps(records))
    return [line_of(Record(name, 7, value), folder) for name, value in shipped.items()]


def as_text(line: Any) -> str:
    return repr(
        [line.name, line.port, line.baudrate, line.format, line.switching, line.echo, line.ids]
    ) + repr(
        [
            (
                polled.drive.name,
                polled.drive.address,
                type(polled.drive).__name__,
                vars(polled.drive.settings)
                if hasattr(polled.drive.settings, "__dict__")
                else polled.drive.settings,
                [(poll.register.name, poll.every) for poll in polled.polls],
            )
            for polled in line.drives
        ]
    )


def test_lines_read_from_their_records_equal_the_plant_files(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(PLANT, "utf-8")
    again = lines_again(path, tmp_path / "gateway")
    assert [as_text(line) for line in again] == [as_text(line) for line in Plant.load(path).lines]


def test_a_family_file_is_stored_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "families").mkdir()
    head = '[family]\ntitle = "Meter"\nmanual = "M"\ncounts_from = 0\n'
    (tmp_path / "families" / "own.toml").write_text(f'{head}[reading]\nvoltage = {{ at = 3, unit = "V" }}\n')
    path = tmp_path / "plant.toml"
    path.write_text(
        '[[line]]\nname = "hall"\nport = "socket://h:1"\n[[line.drive]]\nname = "meter"\n'
        'model = "families/own.toml"\naddress = 1\n'
    )
    [again] = lines_again(path, tmp_path / "gateway")
    assert as_text(again) == as_text(Plant.load(path).lines[0])
    assert (tmp_path / "gateway" / "hall" / "families" / "own.toml").exists()


@pytest.mark.parametrize("name", ["../escape.toml", "/escape.toml", "a/../../b.toml"])
def test_a_record_writes_no_file_outside_its_folder(tmp_path: Path, name: str) -> None:
    value = {"line": {"name": "hall"}, "files": {name: "text"}}
    with pytest.raises(ValueError, match="outside of its folder"):
        line_of(Record("hall", 1, value), tmp_path / "gateway")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == []


async def test_unchanged_lines_keep_their_records_revision() -> None:
    memory = MemoryBucket("plant")
    bucket: Any = memory
    first = {name: {"line": {"name": name}, "files": {}} for name in ("a", "b", "c")}
    assert await store(bucket, first) == {"new": 3, "changed": 0, "removed": 0, "kept": 0}
    before = {name: memory.revision(name) for name in first}
    second = {**first, "b": {"line": {"name": "b", "port": "x"}, "files": {}}}
    del second["c"]
    assert await store(bucket, second) == {"new": 0, "changed": 1, "removed": 1, "kept": 1}
    assert memory.revision("a") == before["a"]
    assert memory.records["c"].value is None
    assert await store(bucket, first) == {"new": 1, "changed": 1, "removed": 0, "kept": 1}


def test_a_lines_record_has_only_its_own_permissions(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(PLANT)
    _, before = read_plant(path)
    lists = 'write = ["fan.frequency"]\nverbs = ["other.start", "fan.start", "other.reset_fault"]'
    path.write_text(f"{PLANT}\n[fleet.may]\n{lists}\n")
    plant, records = read_plant(path)
    assert len(plant.lines) == 2
    assert records["hall-1"]["may"] == {"write": ["fan.frequency"], "verbs": ["fan.start"]}
    assert records["hall-2"]["may"] == {"verbs": ["other.reset_fault", "other.start"]}
    assert all("may" not in record for record in before.values())
    path.write_text(f'{PLANT}\n[fleet.may]\nverbs = ["other.start"]\n')
    assert read_plant(path)[1]["hall-1"] == before["hall-1"]  # the record is unchanged, so polling continues
