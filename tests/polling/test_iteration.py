"""A poller in `for` and `async for`, drives by name, and drives that Python code adds."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import pytest
from lines import line, plant, polled
from toy import Toy

from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import EncodedDrive, Simulator, Wire


@pytest.fixture
def poller() -> Iterator[Poller]:
    with Simulator([Wire([EncodedDrive(Toy(1)), EncodedDrive(Toy(2))], unpaced=True)]) as simulator:
        toy = polled(Toy(1, name="pump-1"), [Toy.output_current])
        with Poller(plant(line(simulator.wires[0].path, toy))) as made:
            yield made


def test_a_for_loop_gets_batches_until_the_poller_is_closed(poller: Poller) -> None:
    rows = 0
    for batch in poller:
        rows += len(batch)
        if rows > 50:
            poller.close()
    assert rows > 50


def test_an_async_loop_gets_every_row_also_beside_a_cancelled_one(poller: Poller) -> None:
    found: list[Row] = []

    async def collect() -> None:
        async for batch in poller:
            found.extend(batch)

    async def main() -> None:
        first = asyncio.create_task(collect())
        await asyncio.sleep(0.2)
        first.cancel()
        with suppress(asyncio.CancelledError):
            await first
        second = asyncio.create_task(collect())
        await asyncio.sleep(0.2)
        second.cancel()
        with suppress(asyncio.CancelledError):
            await second

    asyncio.run(main())
    poller.close()
    for batch in poller:
        found.extend(batch)
    counted = poller.summary()
    assert len(found) == counted["samples"] + counted["misses"] > 10
    assert found == sorted(found, key=lambda row: row.monotonic_ns)


def test_a_drive_is_found_by_its_name(poller: Poller) -> None:
    assert poller["pump-1"] is poller.bus("line").drives[0]
    with pytest.raises(KeyError, match="did you mean pump-1"):
        poller["pump-11"]


def test_a_drive_is_added_with_names_of_its_registers(poller: Poller) -> None:
    fan = poller.add("line", Toy(2, name="fan"), poll=["output_current", Polled(Toy.status)], every=0.05)
    assert poller["fan"] is fan
    (declared,) = (each for each in poller.plant.lines[0].drives if each.drive is fan)
    assert declared.polls == (Polled(Toy.output_current, 0.05), Polled(Toy.status, None))
    assert any(row.drive == "fan" for batch in poller.batches(0.5) for row in batch)


def test_a_plant_of_keyword_arguments() -> None:
    fan = Toy(2, name="fan")
    made = Plant([PlantLine("hall", "/dev/ttyUSB0", drives=[PolledDrive(fan, every=0.5)])])
    assert made == Plant(
        (PlantLine("hall", "/dev/ttyUSB0", None, None, (PolledDrive(fan, made.lines[0].drives[0].polls),)),)
    )
    assert [poll.register for poll in made.lines[0].drives[0].polls] == list(fan.readings())


def test_a_poller_takes_a_plant_file(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    with Simulator([Wire([EncodedDrive(Toy(1))], unpaced=True)]) as simulator:
        path.write_text(
            f"""
            [[line]]
            name = "hall"
            port = "{simulator.wires[0].path}"

            [[line.drive]]
            name = "pump-1"
            model = "{Path(__file__).parents[1] / "support" / "drives" / "toy.py"}:Toy"
            address = 1
            """,
            encoding="utf-8",
        )
        with Poller(path) as poller:
            assert poller.plant.path == path
            assert next(iter(poller))


def test_the_time_of_a_row_is_a_datetime() -> None:
    row = Row(1_700_000_000_123_456_789, 1, None, "pump", "speed", None, "no reply")
    assert row.time == datetime(2023, 11, 14, 22, 13, 20, 123456, tzinfo=UTC)
    assert row.time_ns == 1_700_000_000_123_456_789
